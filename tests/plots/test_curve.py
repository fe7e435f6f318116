"""The figure of an approach curve: what is drawn where, and what is not."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import overtone as ot
from overtone import plots
from overtone.plots.curve import jumps_of


@pytest.fixture(scope="module")
def probe() -> ot.Probe:
    return ot.Probe.simple(
        stiffness=40,
        frequency=320e3,
        quality_factor=400,
        radius=10e-9,
        drive_frequency=320e3,
        free_amplitude=25e-9,
    )


@pytest.fixture(scope="module")
def polymer() -> ot.Sample:
    return ot.sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9, viscosity=50)


@pytest.fixture(scope="module")
def curve(probe: ot.Probe, polymer: ot.Sample) -> xr.Dataset:
    return ot.approach_curve(probe, polymer, z=np.linspace(12e-9, 30e-9, 25))


@pytest.fixture(scope="module")
def states(probe: ot.Probe, polymer: ot.Sample) -> xr.Dataset:
    return ot.steady_states(probe, polymer, z=np.linspace(12e-9, 30e-9, 25))


def lines(axes: Axes, gid: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return what a panel draws under a name, without the breaks."""
    drawn = [line.get_data() for line in axes.lines if line.get_gid() == gid]
    return [(x[np.isfinite(y)], y[np.isfinite(y)]) for x, y in drawn]


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_panel_has_a_title_a_symbol_and_a_unit(curve: xr.Dataset, titles) -> None:
    figure = plots.curve_figure(curve, heading="a polymer")
    assert titles(figure) == [
        "amplitude",
        "phase",
        "mean deflection",
        "amplitude of harmonic 2",
        "amplitude of harmonic 3",
        "maximum indentation",
        "strongest repulsion",
        "time in contact",
        "energy lost per cycle",
    ]
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == [
        "$A_{1}$ [nm]",
        r"$\phi_{1}$ [deg]",
        "$A_{0}$ [pm]",
        "$A_{2}$ [pm]",
        "$A_{3}$ [pm]",
        r"$\delta_{\mathrm{max}}$ [nm]",
        r"$F_{\mathrm{max}}$ [nN]",
        "share of a period",
        r"$E_{\mathrm{dis}}$ [eV]",
    ]
    assert {axes.get_xlabel() for axes in figure.axes} == {"$Z$ [nm]"}
    assert figure.get_suptitle() == "a polymer"
    assert plots.png_bytes(figure)[:4] == b"\x89PNG"


def test_sweeps_are_the_data_and_are_broken_at_jumps(curve: xr.Dataset) -> None:
    figure = plots.curve_figure(curve)
    amplitude = figure.axes[0]
    for direction in ("approach", "retract"):
        ((x, y),) = lines(amplitude, direction)
        order = np.argsort(x)
        np.testing.assert_allclose(x[order], np.linspace(12.0, 30.0, 25))
        sweep = curve["A1"].sel(direction=direction).sortby("z").values
        np.testing.assert_allclose(y[order], 1e9 * sweep)
    for direction, before in (("approach", 18.0), ("retract", 21.0)):
        ((before_row, after_row),) = jumps_of(curve.sel(direction=direction))
        assert curve["z"].values[before_row] == pytest.approx(1e-9 * before)
        whole = next(line for line in amplitude.lines if line.get_gid() == direction)
        breaks = np.flatnonzero(np.isnan(whole.get_xdata()))
        assert [float(whole.get_xdata()[k - 1]) for k in breaks] == pytest.approx([before])
        arrow = [
            note.xyann + note.xy
            for note in amplitude.texts
            if note.xyann[0] == pytest.approx(before)  # type: ignore[attr-defined]
        ]
        assert arrow[0][2] == pytest.approx(1e9 * curve["z"].values[after_row])
    assert legend_of(figure) == ["approach", "retract", "jump"]


def test_branches_that_are_not_stable_are_dashed(curve: xr.Dataset, states: xr.Dataset) -> None:
    figure = plots.curve_figure(curve, states)
    dashed = [line for line in figure.axes[0].lines if line.get_gid() == "unstable"]
    assert {line.get_linestyle() for line in dashed} <= {"--", "None"}
    shown = np.sort(np.concatenate([y for _, y in lines(figure.axes[0], "unstable")]))
    there = ~states["stable"] & np.isfinite(states["A1"])
    np.testing.assert_allclose(shown, np.sort(1e9 * states["A1"].values[there.values]))
    assert shown.size > 3
    assert legend_of(figure)[-2:] == ["other stable states", "unstable states"]


def test_the_sweeps_set_the_scale_and_not_a_branch_far_away(curve: xr.Dataset, states: xr.Dataset) -> None:
    plain, far = (
        plots.curve_figure(curve, other)
        for other in (None, states.assign(A0=states["A0"] - 1e-6, indentation=states["indentation"] + 1e-6))
    )
    for k in (2, 5):
        (low, high), (lowest, highest) = plain.axes[k].get_ylim(), far.axes[k].get_ylim()
        assert 1.3 < (highest - lowest) / (high - low) < 1.7
    # nor the gap, which is no indentation
    bottom, top = plain.axes[5].get_ylim()
    assert -bottom < 0.7 * top


def test_phases_about_zero_do_not_wrap(curve: xr.Dataset) -> None:
    turned = curve.assign(phi1=(curve["phi1"] - curve["phi1"].mean()) % (2.0 * np.pi))
    low, high = (
        plots.curve_figure(turned.assign(phi1=turned["phi1"].assign_attrs(units="rad"))).axes[1].get_ylim()
    )
    assert -90.0 < low < 0.0 < high < 90.0


def test_heights_without_a_state_are_marked_and_no_jump_leads_over_them(curve: xr.Dataset) -> None:
    lost = np.zeros(25, bool)
    lost[14:18] = True  # from 19.5 to 17.25 nm, over the jump of the approach
    holes = curve.where(~xr.DataArray(lost, dims="z"))
    holes["jump"] = curve["jump"]
    figure = plots.curve_figure(holes)
    assert "no state found" in legend_of(figure)
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    for line in crosses:
        np.testing.assert_allclose(line.get_xdata(), 1e9 * curve["z"].values[lost])
    assert not jumps_of(holes.sel(direction="approach"))
    assert len(jumps_of(holes.sel(direction="retract"))) == 1
    assert plots.png_bytes(figure)


def test_what_is_missing_is_left_out_and_nothing_at_all_is_drawn(curve: xr.Dataset, titles) -> None:
    few = curve[["A1", "phi1"]]
    figure = plots.curve_figure(few)
    assert titles(figure) == ["amplitude", "phase"]
    assert legend_of(figure) == ["approach", "retract"]
    empty = plots.curve_figure(few.where(False))
    assert "no state found" in legend_of(empty)
    assert plots.png_bytes(empty)


def test_no_loss_is_a_line_and_not_noise(curve: xr.Dataset) -> None:
    noise = curve.assign(dissipation=curve["dissipation"] * 1e-16)
    low, high = plots.curve_figure(noise).axes[8].get_ylim()
    assert high - low > 0.01  # eV

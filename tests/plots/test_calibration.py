"""Figures of a calibration: a curve made backwards from what the fit says, so that every drawn number is known."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import overtone as ot
from overtone import plots
from overtone.errors import CalibrationError, ObservablesError
from overtone.instrument.calibration import Calibration, ReferenceMaterial
from overtone.instrument.shared import redo
from overtone.instrument.signals import Signals, with_signals
from overtone.instrument.unknowns import NEUTRAL, distortion_basis, distortion_of
from overtone.quantities import named_array

FREE = 94e-9
NOISE = {"A0": 1e-12, "A2": 2e-12, "A3": 2e-12}
VALUES = NEUTRAL | {
    "A0_offset": 1.2e-9,
    "phi1_offset": 0.1,
    "distortion2_0_re": -6e-10,
    "distortion2_0_im": 2e-10,
    "distortion3_0_re": 2e-10,
    "crosstalk2_re": 3e-11,
    "gain2": 0.9,
    "latency2": 0.3,
}


def on_the_reference(A: np.ndarray) -> dict[str, np.ndarray]:
    """What an elastic contact might say at an amplitude."""
    depth = np.sqrt(1.0 - (A / FREE) ** 2)
    zero = 0.0 * depth
    return {
        "A1": A,
        "phi1": np.arcsin(A / FREE),
        "A0": 150e-12 * depth,
        "e2_re": -100e-12 * depth,
        "e2_im": zero,
        "e3_re": 40e-12 * depth**2,
        "e3_im": zero,
    }


def clean_signals(z: np.ndarray) -> Signals:
    says = on_the_reference(np.minimum(FREE, FREE + 0.95 * z))
    turn = np.exp(-1j * says["phi1"])
    return Signals(
        says["A0"], {1: says["A1"] * turn, 2: says["e2_re"] * turn**2 + 0j, 3: says["e3_re"] * turn**3 + 0j}
    )


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    probe = ot.Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287,
        radius=10e-9,
        drive_frequency=161.8e3,
        free_amplitude=FREE,
    )
    known = on_the_reference(np.linspace(0.16, 0.95, 24)[::-1] * FREE)
    names = ("A0_offset", "gain2")
    return Calibration(
        probe,
        FREE,
        VALUES,
        names,
        np.diag([1e-24, 1e-4]),
        NOISE,
        ReferenceMaterial("PS_$1", "dmt", 0.35, {"modulus": (1.9e9, 0.05)}),
        known,
    )


@pytest.fixture(scope="module")
def raw() -> xr.Dataset:
    """300 readings with noise, from far to near, the onset at 500 nm of the piezo."""
    z = np.linspace(250e-9, -80e-9, 300)
    rng = np.random.default_rng(4)
    signals = redo(clean_signals(z), VALUES, FREE)
    assert signals.mean is not None
    shaken = {
        n: a + NOISE.get(f"A{n}", 1e-14) * (rng.normal(size=z.size) + 1j * rng.normal(size=z.size))
        for n, a in signals.phasor.items()
    }
    mean = signals.mean + NOISE["A0"] * rng.normal(size=z.size)
    empty = xr.Dataset({"A1": named_array("A1", z, ("z",))}, coords={"z": z + 500e-9})
    return with_signals(empty, Signals(mean, shaken))


@pytest.fixture(scope="module")
def corrected(raw: xr.Dataset, calibration: Calibration) -> xr.Dataset:
    return ot.correct(raw, calibration)


@pytest.fixture(scope="module")
def ladder() -> xr.Dataset:
    """Readings without a sample; the last one at half the drive."""
    A = np.append(np.linspace(0.3, 1.0, 8), 0.5) * FREE
    first = A * np.exp(-1j * np.linspace(0.4, 2.8, 9))
    phasor = {1: first}
    for n in (2, 3):
        added = distortion_basis(first, n, FREE) @ distortion_of(VALUES, n)
        phasor[n] = added + VALUES[f"crosstalk{n}_re"]
    empty = xr.Dataset(
        {"A1": named_array("A1", A, ("point",))}, coords={"drive": ("point", [1.0] * 8 + [0.5])}
    )
    return with_signals(empty, Signals(np.full(9, 1.2e-9), phasor))


@pytest.fixture(scope="module")
def figure(raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration, ladder: xr.Dataset) -> Figure:
    return plots.calibration_figure(raw, corrected, calibration, ladder)


def panel(figure: Figure, title: str) -> Axes:
    return next(
        axes for axes in figure.axes if axes.get_title(loc="left").replace("\n", " ").startswith(title)
    )


def drawn(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    line = next(line for line in axes.lines if line.get_label() == label)
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


# --- the curve ----------------------------------------------------------------------------------------------------


def test_every_panel_has_a_title_a_symbol_and_a_unit(figure: Figure, titles) -> None:
    assert [title.replace("\n", " ") for title in titles(figure)] == [
        "amplitude",
        "phase",
        "phase of harmonic 2, corrected where A2 is above its noise",
        "mean deflection, raw − 1.2 nm",
        "amplitude of harmonic 2",
        "amplitude of harmonic 3",
        "mean deflection and its fit",
        "harmonic 2 and its fit",
        "harmonic 3 and its fit",
        "corrected less fit, over the noise of a reading",
        "harmonic 2 without a sample",
        "harmonic 3 without a sample",
    ]
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "$A_{1}$ [nm]",
        r"$\phi_{1}$ [deg]",
        r"$\phi_{2}$ [deg]",
        *["$A_{0}$ [pm]", "$A_{2}$ [pm]", "$A_{3}$ [pm]"] * 2,
        "residual / noise",
        "$A_{2}$ [pm]",
        "$A_{3}$ [pm]",
    ]
    assert {axes.get_xlabel() for axes in figure.axes} == {"$Z$ above the onset [nm]", "$A_{1}$ [nm]"}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "raw",
        "corrected",
        "fit on PS_$1",
        "± 2 standard deviations of a reading",
        "distortion by the detector, without crosstalk",
    ]
    assert figure.get_size_inches()[0] == pytest.approx(10.2)  # 1020 pixels
    assert plots.png_bytes(figure)[:4] == b"\x89PNG"


def test_the_onset_is_at_zero_and_the_far_part_is_cut_with_a_word(figure: Figure) -> None:
    x, A = drawn(panel(figure, "amplitude"), "corrected")
    assert x.min() == pytest.approx(-78.0, abs=2.5)  # 2 % of the amplitude are lost at -2 nm
    assert x.max() < 1.2 * -x.min()
    np.testing.assert_allclose(A[x > 3.0], 94.0, rtol=1e-5)
    beyond = 300 - x.size
    assert (
        figure.get_suptitle() == f"{beyond} of 300 readings, beyond {1.2 * -x.min():.3g} nm, are not drawn."
    )
    assert beyond > 0


def test_raw_and_corrected_are_the_data(figure: Figure, raw: xr.Dataset, corrected: xr.Dataset) -> None:
    _, before = drawn(panel(figure, "phase"), "raw")
    _, after = drawn(panel(figure, "phase"), "corrected")
    np.testing.assert_allclose(before - after, math.degrees(0.1), rtol=1e-3)
    near_first = slice(None, None, -1)
    for name, title in (("A2", "amplitude of harmonic 2"), ("A3", "amplitude of harmonic 3")):
        for label, data in (("raw", raw), ("corrected", corrected)):
            _, y = drawn(panel(figure, title), label)
            np.testing.assert_allclose(y, 1e12 * data[name].values[near_first][: y.size])
    x, y = drawn(panel(figure, "mean deflection, raw"), "raw")
    assert np.median(y[x > 20.0]) == pytest.approx(0.0, abs=0.5)  # pm, of 1.2 nm
    assert y[0] == pytest.approx(148.0, abs=5.0)


def test_the_fit_is_what_the_reference_says_where_it_says_something(figure: Figure) -> None:
    for title, scale, power in (
        ("mean deflection and", 150.0, 1),
        ("harmonic 2 and", 100.0, 1),
        ("harmonic 3 and", 40.0, 2),
    ):
        x, fit = drawn(panel(figure, title), "fit")
        _, A = drawn(panel(figure, "amplitude"), "corrected")
        known = (A > 0.16 * 94.0) & (A < 0.95 * 94.0)
        expected = scale * np.sqrt(1.0 - (A[known] / 94.0) ** 2) ** power
        # between 24 points of a root that ends steeply: a fifth of the noise of a reading
        np.testing.assert_allclose(fit[known], expected, atol=0.2)
        assert np.isnan(fit[~known]).all()
        assert np.isnan(fit[x > 0.0]).all()
    x, phase = drawn(panel(figure, "phase of harmonic 2"), "fit")
    _, first = drawn(panel(figure, "phase"), "corrected")
    known = np.isfinite(phase)
    np.testing.assert_allclose(
        phase[known], 2.0 * first[known] + 180.0, atol=0.05
    )  # a negative e2 lags half a turn


def test_another_branch_with_the_same_amplitudes_gets_no_fit(
    raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration
) -> None:
    attracted = corrected.assign(phi1=math.pi - corrected["phi1"])
    figure = plots.calibration_figure(raw, attracted, calibration)
    _, fit = drawn(panel(figure, "mean deflection and"), "fit")
    _, A = drawn(panel(figure, "amplitude"), "corrected")
    assert np.isnan(fit[A < 0.9 * 94.0]).all()


def test_the_second_phase_is_left_out_in_the_noise_and_has_no_jump(figure: Figure) -> None:
    axes = panel(figure, "phase of harmonic 2")
    x, after = drawn(axes, "corrected")
    assert np.isnan(after[x > 5.0]).all()
    assert np.isfinite(after[x < -5.0]).all()
    _, before = drawn(axes, "raw")
    assert np.abs(np.diff(before)).max() < 60.0
    contact = x < -5.0
    assert np.abs(np.nanmedian(before[contact]) - np.nanmedian(after[contact])) < 180.0


def test_without_a_stated_noise_the_far_part_tells_it(
    raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration
) -> None:
    figure = plots.calibration_figure(raw, corrected, replace(calibration, noise={}))
    x, after = drawn(panel(figure, "phase of harmonic 2"), "corrected")
    assert np.isfinite(after[x > 5.0]).mean() < 0.02
    assert not [axes for axes in figure.axes if axes.get_title(loc="left").startswith("corrected less")]


def test_residuals_are_in_standard_deviations(
    figure: Figure, raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration
) -> None:
    axes = panel(figure, "corrected less fit")
    labels = ["$A_0$", "Re $e_2$", "Im $e_2$", "Re $e_3$", "Im $e_3$"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == labels
    for label in labels:
        _, left = drawn(axes, label)
        left = left[np.isfinite(left)]
        assert left.size > 50
        assert left.std() == pytest.approx(1.0, rel=0.25)
        assert left.mean() == pytest.approx(0.0, abs=0.5)
    off = dict(calibration.curve) | {
        "e2_re": calibration.curve["e2_re"] - 10.0 * NOISE["A2"] / VALUES["gain2"]
    }
    moved = plots.calibration_figure(raw, corrected, replace(calibration, curve=off))
    _, left = drawn(panel(moved, "corrected less fit"), "Re $e_2$")
    assert np.nanmean(left) == pytest.approx(10.0, abs=0.5)
    assert panel(moved, "corrected less fit").get_ylim()[1] > 12.0


def test_the_legend_of_the_residuals_is_above_them(figure: Figure) -> None:
    axes = panel(figure, "corrected less fit")
    figure.canvas.draw()
    box = axes.get_legend().get_window_extent()
    highest = max(np.nanmax(line.get_ydata()) for line in axes.lines)
    assert axes.transData.transform((0.0, highest))[1] < box.y0


def test_distortion_over_amplitude(figure: Figure) -> None:
    axes = panel(figure, "harmonic 2 without a sample")
    before, after, fitted = (np.asarray(line.get_ydata()) for line in axes.lines)
    A = np.asarray(axes.lines[2].get_xdata())
    np.testing.assert_allclose(fitted, 1e12 * math.hypot(6e-10, 2e-10) * (A / 94.0) ** 2, atol=1e-6)
    assert np.abs(after[:8]).max() < 1.0  # pm, of hundreds
    assert np.isnan(after[8])  # what crosstalk is at another drive is not known
    assert before[7] == pytest.approx(np.abs((-6e-10 + 2e-10j) * np.exp(-2j * 2.5) + 3e-11) * 1e12, rel=0.05)


def test_what_is_not_there_is_not_drawn(raw: xr.Dataset, calibration: Calibration, titles) -> None:
    bare = raw[["A1", "phi1"]]
    alone = replace(calibration, reference=None)
    figure = plots.calibration_figure(bare, ot.correct(bare, alone), alone, heading="curve 7.")
    assert titles(figure) == ["amplitude", "phase"]
    assert str(figure.get_suptitle()).startswith("curve 7. ")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["raw", "corrected"]
    two = raw.drop_vars(["A3", "phi3"])
    names = titles(plots.calibration_figure(two, ot.correct(two, calibration), calibration))
    assert not [name for name in names if "harmonic 3" in name]
    assert "harmonic 2 and its fit" in names


def test_curves_that_do_not_fit_are_refused(
    raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration
) -> None:
    with pytest.raises(ObservablesError, match="do not fit"):
        plots.calibration_figure(raw, corrected.isel(z=slice(0, -1)), calibration)
    with pytest.raises(CalibrationError, match="never touches"):
        plots.calibration_figure(raw.isel(z=slice(0, 200)), corrected.isel(z=slice(0, 200)), calibration)


# --- the scan -----------------------------------------------------------------------------------------------------


DRIFT = np.linspace(0.0, 40e-12, 12)


@pytest.fixture(scope="module")
def scans(a_map: Callable[..., xr.DataArray]) -> tuple[xr.Dataset, xr.Dataset]:
    """A scan of 12 lines before and after: the left half is the reference, the right half differs by 30 pm in A0."""
    rng = np.random.default_rng(5)
    right = np.repeat([[0.0] * 10 + [1.0] * 10], 12, axis=0)
    A0 = 150e-12 + 30e-12 * right + rng.normal(0.0, 1e-13, (12, 20))
    A2 = 95e-12 + 10e-12 * right
    after = xr.Dataset(
        {
            "A0": a_map("A0", A0),
            "A1": a_map("A1", 40e-9 + 0.0 * right),
            "phi1": a_map("phi1", 0.4 + rng.normal(0.0, 1e-3, right.shape)),
            "A2": a_map("A2", A2),
            "phi2": a_map("phi2", 0.8 + rng.normal(0.0, 0.01, right.shape)),  # phi2 - 2 phi1 scatters about 0
            "reference": a_map(
                "reference",
                (right == 0.0).astype(np.int8),
                flag_values=[0, 1],
                flag_meanings="other reference",
            ),
        }
    )
    # the lines of the other material drift five times as far, which is none of the reference's business
    moved = DRIFT[:, None] * np.where(right == 1.0, 5.0, 1.0)
    before = after.drop_vars("reference").assign(
        A0=after["A0"].copy(data=A0 + 2.1e-9 + moved), A2=after["A2"].copy(data=A2 + 180e-12)
    )
    return before, after


def bar_of(axes: Axes) -> str:
    return str(axes.child_axes[0].get_ylabel())


def test_before_and_after_have_one_unit_and_one_width_of_colours(scans, titles) -> None:
    before, after = scans
    figure = plots.correction_figure(before, after)
    assert titles(figure) == [
        "mean deflection, as read",
        "harmonic 2, as read",
        "phase of harmonic 2, as read",
        "mean deflection, corrected",
        "harmonic 2, corrected",
        "phase of harmonic 2, corrected",
        "pixels taken as the reference",
        "mean deflection, line by line",
        "phase, line by line",
    ]
    cells = figure.axes[:9]
    symbols = ["$A_{0}$ [pm]", "$A_{2}$ [pm]", r"$\phi_2 - 2\phi_1$ [deg]"]
    assert [bar_of(axes) for axes in cells[:6]] == symbols * 2
    for above, below in zip(cells[:3], cells[3:6], strict=True):
        one, other = (axes.images[0].norm for axes in (above, below))
        assert one.vmax - one.vmin == pytest.approx(other.vmax - other.vmin, rel=1e-9, abs=0)
    # whichever of the two needs more; in the unit of what is shown as corrected, here 2 nm
    turned = plots.correction_figure(after.drop_vars("reference"), before).axes[0]
    norm, other = turned.images[0].norm, cells[0].images[0].norm
    assert bar_of(turned) == "$A_{0}$ [nm]"
    assert 1e3 * (norm.vmax - norm.vmin) == pytest.approx(other.vmax - other.vmin, rel=1e-9, abs=0)
    np.testing.assert_allclose(cells[0].images[0].get_array(), 1e12 * before["A0"].values)
    np.testing.assert_allclose(cells[3].images[0].get_array(), 1e12 * after["A0"].values)
    assert plots.png_bytes(figure)[:4] == b"\x89PNG"


def test_a_phase_about_zero_is_not_split(scans) -> None:
    figure = plots.correction_figure(*scans)
    values = figure.axes[5].images[0].get_array()
    assert np.ptp(values) < 10.0
    np.testing.assert_allclose(
        np.mod(values, 360.0),
        np.mod(np.degrees((scans[1]["phi2"] - 2.0 * scans[1]["phi1"]).values), 360.0),
        atol=1e-9,
    )


def test_drift_is_that_of_the_reference_pixels(scans) -> None:
    strip = plots.correction_figure(*scans).axes[7]
    before, after = strip.lines[1:]
    np.testing.assert_allclose(np.asarray(before.get_ydata()), 1e12 * (DRIFT - np.median(DRIFT)), atol=0.5)
    assert np.abs(after.get_ydata()).max() < 0.5
    np.testing.assert_allclose(before.get_xdata(), scans[0]["y"].values * 1e9)
    assert strip.get_xlabel() == "y [nm]"
    assert strip.get_ylabel() == "Δ $A_{0}$ [pm]"


def test_scans_with_less_in_them(scans, titles) -> None:
    before, after = (scan.drop_vars(["x", "y"])[["A1", "phi1"]] for scan in scans)
    lost = after.where(after["A1"] * 0.0 + np.arange(12)[:, None] > 2)  # lines without data
    figure = plots.correction_figure(before, lost)
    assert titles(figure) == ["phase, as read", "phase, corrected", "phase, line by line"]
    strip = figure.axes[2]
    assert strip.get_xlabel() == "y [pixel]"
    assert np.isnan(strip.lines[2].get_ydata()[:3]).all()
    assert np.isfinite(strip.lines[2].get_ydata()[3:]).all()
    assert plots.png_bytes(figure)
    empty = after.where(after["A1"] < 0.0)
    assert plots.png_bytes(plots.correction_figure(before, empty))


def test_what_is_no_pair_of_scans_is_refused(scans, raw: xr.Dataset, corrected: xr.Dataset) -> None:
    with pytest.raises(ObservablesError, match="no map"):
        plots.correction_figure(raw, corrected)
    with pytest.raises(ObservablesError, match="do not fit"):
        plots.correction_figure(scans[0], scans[1].isel(x=slice(0, 5)))

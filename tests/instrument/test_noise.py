import numpy as np
import pytest
import xarray as xr

from overtone.errors import ObservablesError, OvertoneError
from overtone.instrument.noise import ORDINARY_NOISE, add_noise, complete_noise, noise_from_pair
from overtone.instrument.phantom import POLYOLEFIN, POLYSTYRENE, blend


def clean(n: int = 200_000) -> xr.Dataset:
    values = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.5, "A2": 1e-10, "phi2": 4.0, "A3": 1e-13, "phi3": 1.0}
    return xr.Dataset({name: ("point", np.full(n, value)) for name, value in values.items()})


def test_noise_has_the_stated_size() -> None:
    noisy = add_noise(clean(), {"A0": 7e-12}, seed=0)
    assert noisy["A0"].std() == pytest.approx(7e-12, rel=0.01, abs=0)
    assert noisy["phi1"].std() == pytest.approx(ORDINARY_NOISE["phi1"], rel=0.01, abs=0)
    assert noisy["A2"].std() == pytest.approx(ORDINARY_NOISE["A2"], rel=0.02, abs=0)
    assert float((noisy["phi2"] - 4.0).std()) == pytest.approx(ORDINARY_NOISE["A2"] / 1e-10, rel=0.02, abs=0)


def test_noise_averages_out_of_phasors_not_of_amplitudes() -> None:
    """A third harmonic ten times below the noise: its amplitude is noise, its mean phasor is not."""
    noisy = add_noise(clean(), seed=1)
    phasor = (noisy["A3"].values * np.exp(-1j * noisy["phi3"].values)).mean()
    assert abs(phasor - 1e-13 * np.exp(-1j)) < 2e-14
    assert float(noisy["A3"].mean()) > 1e-12


def test_the_seed_decides() -> None:
    xr.testing.assert_identical(add_noise(clean(10), seed=3), add_noise(clean(10), seed=3))
    assert float(add_noise(clean(10), seed=4)["A0"][0]) != float(add_noise(clean(10), seed=3)["A0"][0])


@pytest.mark.parametrize("noise", [{"modulus": 1.0}, {"A0": -1e-12}, {"A0": float("nan")}])
def test_noise_that_makes_no_sense_is_refused(noise: dict[str, float]) -> None:
    with pytest.raises(OvertoneError, match="noise is not stated"):
        complete_noise(noise, (0, 1, 2))


def test_a_phantom_has_the_materials_it_was_made_of() -> None:
    phantom = blend(shape=(60, 80), seed=0)
    assert phantom["modulus"].shape == (60, 80)
    for index, material in enumerate((POLYSTYRENE, POLYOLEFIN)):
        mask = phantom["material"].values == index
        assert 0.3 < mask.mean() < 0.7
        assert np.median(phantom["modulus"].values[mask]) == pytest.approx(material.modulus, rel=0.02, abs=0)
        assert np.log(phantom["adhesion"].values[mask]).std() == pytest.approx(
            material.spread, rel=0.1, abs=0
        )
    assert float(phantom["y"][0]) > float(phantom["y"][-1])


def test_impossible_phantoms_are_refused() -> None:
    with pytest.raises(OvertoneError, match="coverage"):
        blend(coverage=0.99, seed=0)


# --- trace and retrace ----------------------------------------------------------------------------

NOISE = {"A0": 4e-12, "A1": 30e-12, "phi1": 3e-3, "A2": 2e-12, "A3": 1e-12}


def two_phases(shape: tuple[int, int] = (100, 200)) -> xr.Dataset:
    """Return a scan of two materials side by side: what they differ by is far beyond any noise."""
    right = np.arange(shape[1]) >= shape[1] // 2
    values = {
        "A0": (1e-10, 4e-11),
        "A1": (4e-8, 4e-8),
        "phi1": (0.5, 0.8),
        "A2": (1e-10, 8e-11),
        "phi2": (4.0, 4.4),
        "A3": (1e-12, 5e-11),
        "phi3": (1.0, 2.0),
    }
    return xr.Dataset(
        {n: (("y", "x"), np.where(right, b, a) * np.ones(shape)) for n, (a, b) in values.items()}
    )


def pair(**noise: float) -> tuple[xr.Dataset, xr.Dataset]:
    stated = NOISE | noise
    return add_noise(two_phases(), stated, seed=1), add_noise(two_phases(), stated, seed=2)


def test_noise_is_found_from_trace_and_retrace() -> None:
    found = noise_from_pair(*pair())
    assert list(found) == ["A1", "phi1", "A0", "A2", "A3"]
    # a phasor in the frame of the first takes n times the noise of its phase as well
    turned = {"A2": 2 * 3e-3 * 9e-11, "A3": 3 * 3e-3 * 2.6e-11}
    for name, sigma in NOISE.items():
        tolerance = 0.03 + (turned.get(name, 0.0) / sigma) ** 2
        assert found[name] == pytest.approx(sigma, rel=tolerance, abs=0), name
    # and serves where noise is stated
    assert complete_noise(found, (0, 1, 2, 3)) == pytest.approx(found, rel=1e-12, abs=0)


def test_edges_do_not_count() -> None:
    """The retrace lags by two pixels: at the boundary it differs by as much as the materials do."""
    trace, retrace = pair()
    late = retrace.roll(x=2)
    here, there = noise_from_pair(trace, retrace), noise_from_pair(trace, late)
    for name, sigma in here.items():
        assert there[name] == pytest.approx(sigma, rel=0.06, abs=0), name


def test_what_both_ways_differ_by_as_a_whole_is_not_noise() -> None:
    trace, retrace = pair()
    moved = retrace.assign(
        A0=retrace["A0"] + 5e-10,
        A1=retrace["A1"] * 1.01,
        phi1=retrace["phi1"] + 3.1415,
        phi2=retrace["phi2"] + 6.283,
    )
    moved = moved.assign(phi3=retrace["phi3"] + 9.4245)
    here, there = noise_from_pair(trace, retrace), noise_from_pair(trace, moved)
    for name in ("A0", "A1", "phi1", "A2", "A3"):
        assert there[name] == pytest.approx(here[name], rel=0.02, abs=0), name


def test_only_harmonics_of_both_are_told() -> None:
    trace, retrace = pair()
    assert list(noise_from_pair(trace.drop_vars("A0"), retrace.drop_vars("A3"))) == ["A1", "phi1", "A2"]


def test_lost_pixels_do_not_count_and_too_few_are_refused() -> None:
    trace, retrace = pair()
    lost = trace.copy(deep=True)
    for name in ("A1", "phi1", "A0"):
        lost[name][:50] = np.nan
    lost["A1"][50, :10] = 0.0  # a lock-in that lost its signal
    found = noise_from_pair(lost, retrace)
    for name in ("A0", "A1", "phi1"):
        assert found[name] == pytest.approx(NOISE[name], rel=0.05, abs=0), name
    with pytest.raises(OvertoneError, match=r"too few pixels.*100 or more.*99"):
        noise_from_pair(trace.isel(y=[0], x=slice(99)), retrace.isel(y=[0], x=slice(99)))
    nowhere = retrace.copy(deep=True)
    nowhere["A1"][50:] = np.nan
    with pytest.raises(OvertoneError, match=r"too few pixels.*got 0"):
        noise_from_pair(lost.where(lost["A1"] > 0.0), nowhere)


def test_scans_that_do_not_fit_are_refused() -> None:
    trace, retrace = pair()
    with pytest.raises(OvertoneError, match="do not fit"):
        noise_from_pair(trace, retrace.isel(x=slice(10)))
    with pytest.raises(ObservablesError, match="lack phi1"):
        noise_from_pair(trace, retrace.drop_vars("phi1"))

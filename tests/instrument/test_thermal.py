import itertools
import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import integrate

from overtone.beam import beam_modes
from overtone.errors import ObservablesError, OvertoneError, ResonanceWarning, UncalibratedWarning, UnitError
from overtone.instrument.periodogram import windowed_resonance
from overtone.instrument.sensitivity import Sensitivity
from overtone.instrument.thermal import BOLTZMANN, fit_thermal, resonance_density, thermal_spectrum
from overtone.io.spectrum import spectrum_array
from overtone.plots import png_bytes
from overtone.plots.thermal import thermal_figure

LEVER: dict[str, Any] = {"stiffness": 16.4, "frequency": 161.8e3, "quality_factor": 287.0}
KNOWN = {"sensitivity_error": 1e-9}  # so that nothing warns of a missing error


def spectrum(
    seed: int,
    *,
    stiffness: float = 16.4,
    frequency: float = 161.8e3,
    quality_factor: float = 287.0,
    averages: float = 30.0,
    floor: float = 50e-15,
    step: float = 50.0,
    highest: float = 400e3,
    temperature: float = 295.0,
    unit: str = "m^2/Hz",
    factor: float = 1.0,
) -> xr.DataArray:
    """Averaged periodograms of a lever: gamma distributed about the density; floor [m/rtHz]."""
    f = np.arange(step, highest, step)
    mean = BOLTZMANN * temperature / stiffness * resonance_density(f, frequency, quality_factor) + floor**2
    drawn = mean * np.random.default_rng(seed).gamma(averages, 1.0 / averages, f.size)
    return spectrum_array(f, factor * drawn, unit)


def trace(seed: int, *, points: int = 2**16, rate: float = 500e3, floor: float = 50e-15) -> xr.DataArray:
    """Thermal motion with exact covariance (k 2 N/m, 70 kHz, Q 150): no spectrum is used to make it."""
    lag = np.minimum(np.arange(4 * points), 4 * points - np.arange(4 * points)) / rate
    omega = 2 * np.pi * 70e3
    decay = omega / 300.0
    ringing = np.sqrt(omega**2 - decay**2)
    covariance = np.exp(-decay * lag) * (np.cos(ringing * lag) + decay / ringing * np.sin(ringing * lag))
    power = np.maximum(np.fft.fft(BOLTZMANN * 295.0 / 2.0 * covariance).real, 0.0)
    rng = np.random.default_rng(seed)
    white = rng.normal(size=lag.size) + 1j * rng.normal(size=lag.size)
    motion = np.fft.fft(np.sqrt(power / lag.size) * white).real[:points]
    motion += rng.normal(0.0, floor * np.sqrt(rate / 2), points)
    time = np.arange(points) / rate
    return xr.DataArray(motion, dims="time", coords={"time": time}, attrs={"units": "m"})


# --- the density ----------------------------------------------------------------------------------


@pytest.mark.parametrize("quality_factor", [0.8, 3.0, 287.0])
def test_the_density_integrates_to_equipartition(quality_factor: float) -> None:
    f1 = 161.8e3
    parts = [
        0.0,
        f1 * (1 - 0.5 / max(quality_factor, 1)),
        f1,
        f1 * (1 + 0.5 / max(quality_factor, 1)),
        3 * f1,
        3e9,
    ]
    total = sum(
        integrate.quad(lambda f: float(resonance_density(f, f1, quality_factor)), a, b, epsabs=0, limit=500)[
            0
        ]
        for a, b in itertools.pairwise(parts)
    )
    assert total == pytest.approx(1.0, rel=1e-6, abs=0)
    # 4 kB T/(k Q w1) of the theory, per kB T/k
    assert float(resonance_density(0.0, f1, quality_factor)) == pytest.approx(
        4.0 / (quality_factor * 2 * np.pi * f1), rel=1e-12, abs=0
    )
    at_peak = np.sqrt(BOLTZMANN * 295 / 16.4 * resonance_density(161.8e3, 161.8e3, 287.0))
    assert at_peak == pytest.approx(530e-15, rel=0.01, abs=0)


# --- estimates and their intervals ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 200),
        ({"averages": 1.0, "step": 20.0, "highest": 250e3}, 200),
        ({"stiffness": 0.1, "frequency": 20e3, "quality_factor": 2.5, "step": 25.0, "highest": 90e3}, 200),
    ],
)
def test_estimates_are_unbiased_and_intervals_cover(change: dict[str, float], count: int) -> None:
    truth = {name: change.get(name, LEVER[name]) for name in LEVER}
    errors, widths, averages = [], [], []
    for seed in range(count):
        fit = fit_thermal(spectrum(seed, **change), **KNOWN)
        errors.append([np.log(getattr(fit, name) / truth[name]) for name in truth])
        widths.append([fit.relative_error(name) for name in truth])
        averages.append(fit.averages)
        assert abs(fit.chi2_per_dof - 1.0) < 6.0 * fit.chi2_error
    z = np.array(errors) / np.array(widths)
    covered = (np.abs(z) < 1.645).mean(axis=0)
    assert ((covered > 0.85) & (covered < 0.95)).all(), covered
    # the mean of z is 0 +- 1/sqrt(count), plus half its width for the logarithm
    assert (np.abs(z.mean(axis=0)) < 3.0 / np.sqrt(count) + 0.1).all(), z.mean(axis=0)
    assert np.median(averages) == pytest.approx(change.get("averages", 30.0), rel=0.05, abs=0)


def test_least_squares_on_the_same_spectra_would_be_biased() -> None:
    """Why the likelihood: the scatter of a bin is its mean, which least squares do not know."""
    from scipy import optimize

    likelihood, squares = [], []
    for seed in range(60):
        drawn = spectrum(seed, averages=1.0, step=20.0, highest=250e3)
        fit = fit_thermal(drawn, averages=1.0, **KNOWN)
        likelihood.append(np.log(fit.quality_factor / 287.0))
        near = drawn.sel(frequency=slice(*fit.between))
        f, P = near["frequency"].values, near.values

        def miss(t: np.ndarray, f: np.ndarray = f, P: np.ndarray = P) -> np.ndarray:
            return np.exp(t[2]) * resonance_density(f, t[0] * 161.8e3, np.exp(t[1])) * 1e25 - P * 1e25

        start = [1.0, np.log(287.0), np.log(BOLTZMANN * 295 / 16.4)]
        best = optimize.least_squares(miss, start, x_scale=[1e-3, 1.0, 1.0]).x
        squares.append(best[1] - np.log(287.0))
    assert abs(np.mean(likelihood)) < 0.08
    assert np.std(squares) > 1.3 * np.std(likelihood)


def test_a_trace_in_time_gives_its_lever_back_even_where_the_window_is_broad() -> None:
    z, bare = [], []
    for seed in range(30):
        density = thermal_spectrum(trace(seed), segment=2048)  # two bins in f1/Q
        fit = fit_thermal(density, **KNOWN)
        z.append([np.log(fit.quality_factor / 150.0) / fit.relative_error("quality_factor"),
                  np.log((fit.stiffness or 0.0) / 2.0) / fit.relative_error("stiffness")])  # fmt: skip
        with pytest.warns(ResonanceWarning, match="bins wide"):
            bare.append(fit_thermal(density, window="", **KNOWN).quality_factor)
    assert (np.abs(np.mean(z, axis=0)) < 0.6).all()
    assert (np.std(z, axis=0) < 1.35).all()
    # a Hann window adds a variance of a third of a bin squared to the line
    assert np.mean(bare) < 0.97 * 150.0


@pytest.mark.parametrize(("window", "bins", "off"), [("hann", 3.0, -0.0661), ("boxcar", 8.0, -0.039)])
def test_what_a_window_does_to_q_is_what_the_warning_says(window: str, bins: float, off: float) -> None:
    step, quality_factor = 100.0, 300.0
    f1 = bins * step * quality_factor
    f = np.arange(1, int(2 * f1 / step)) * step
    seen = windowed_resonance(f, window, step)(f1, quality_factor)
    density = spectrum_array(f, seen + 0.1 * seen.max(), "m^2/Hz", averages=1000.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResonanceWarning)
        bare = fit_thermal(density, **KNOWN)
        fit = fit_thermal(density, window=window, **KNOWN)
    assert bare.quality_factor / quality_factor - 1.0 == pytest.approx(off, rel=0.05, abs=0)
    assert bare.mean_square == pytest.approx(1.0, rel=0.012, abs=0)
    # allowed for, what is left is rounding and the segments of another length
    assert fit.quality_factor == pytest.approx(quality_factor, rel=2e-3, abs=0)
    assert fit.mean_square == pytest.approx(1.0, rel=2e-3, abs=0)


def test_the_spectrum_of_a_trace_has_its_mean_square_and_number_of_averages() -> None:
    deflection = trace(3)
    density = thermal_spectrum(deflection, segment=4096)
    assert density.attrs["units"] == "m^2/Hz"
    total = integrate.trapezoid(density.values, density["frequency"].values)
    assert total == pytest.approx(float(deflection.var()), rel=0.05, abs=0)
    fit = fit_thermal(density, averages=None, **KNOWN)
    assert fit.averages == density.attrs["averages"]
    free = density.copy()
    free.attrs = {"units": "m^2/Hz"}
    with pytest.warns(ResonanceWarning, match="4.* bins wide"):
        unknown = fit_thermal(free, **KNOWN)
    assert unknown.averages == pytest.approx(fit.averages, rel=0.35, abs=0)


def test_overlapping_windows_widen_the_errors() -> None:
    density = thermal_spectrum(trace(5), segment=8192)
    independent = density.copy()
    independent.attrs = {"units": "m^2/Hz", "averages": density.attrs["averages"], "window": "boxcar"}
    ratio = fit_thermal(density, **KNOWN).relative_error("stiffness") / fit_thermal(
        independent, **KNOWN
    ).relative_error("stiffness")
    assert ratio == pytest.approx(np.sqrt(1 + 2 * (4 / 9 + 1 / 36)), rel=0.1, abs=0)


def test_higher_modes_are_found_where_a_beam_has_them() -> None:
    first = spectrum(1, highest=1.6e6)
    f = first["frequency"].values
    second = BOLTZMANN * 295 / 664.0 * resonance_density(f, 1.005e6, 600.0) * 10.0
    both = first + second * np.random.default_rng(2).gamma(30.0, 1 / 30.0, f.size)
    both.attrs = first.attrs
    fit = fit_thermal(both, modes=2, **KNOWN)
    (higher,) = fit.higher
    assert higher.frequency == pytest.approx(1.005e6, rel=1e-3, abs=0)
    assert higher.quality_factor == pytest.approx(600.0, rel=0.3, abs=0)
    assert higher.stiffness is None
    with pytest.raises(ObservablesError, match="modes"):
        fit_thermal(both, modes=9)


def test_a_line_of_the_electronics_is_not_the_lever() -> None:
    drawn = spectrum(4)
    drawn.values[1500:1502] += 300e-24  # 75 kHz, far above the peak, as a Hann window leaves it
    assert fit_thermal(drawn, **KNOWN).frequency == pytest.approx(161.8e3, rel=1e-3, abs=0)
    alone = spectrum(4, stiffness=1e9)
    alone.values[1500] += 300e-24
    with pytest.raises(ObservablesError, match="no thermal peak"):
        fit_thermal(alone, **KNOWN)


def test_flicker_below_a_broad_peak_is_told_from_it() -> None:
    lever = {"stiffness": 0.1, "frequency": 20e3, "quality_factor": 2.5, "step": 25.0, "highest": 90e3}
    drawn = spectrum(6, averages=100.0, **lever)
    f = drawn["frequency"].values
    plain = BOLTZMANN * 295 / 0.1 * resonance_density(f, 20e3, 2.5) + 50e-15**2
    with_flicker = drawn * (1.0 + plain[0] * 10e3 / f / plain)
    with_flicker.attrs = drawn.attrs
    fit = fit_thermal(with_flicker, flicker=True, between=(3e3, 80e3), **KNOWN)
    assert fit.stiffness == pytest.approx(0.1, rel=4 * fit.relative_error("stiffness"), abs=0)
    with pytest.warns(ResonanceWarning, match="does not describe"):
        assert fit_thermal(with_flicker, between=(3e3, 80e3), **KNOWN).chi2_per_dof > 1.2


# --- which sensitivity, which stiffness -----------------------------------------------------------


def test_a_spectrum_in_volts_takes_the_dynamic_sensitivity() -> None:
    volts = spectrum(7, unit="V^2/Hz", factor=60e-9**-2)
    without = fit_thermal(volts)
    assert without.stiffness is None
    assert without.stiffness_error is None
    assert without.relative_error("mean_square") > 0.0
    fit = fit_thermal(volts, sensitivity=60e-9, **KNOWN)
    metres = fit_thermal(spectrum(7), **KNOWN)
    assert fit.stiffness == pytest.approx(metres.stiffness, rel=1e-6, abs=0)
    assert fit.mean_square == pytest.approx(without.mean_square, rel=1e-9, abs=0)


def test_a_static_sensitivity_is_turned_into_a_dynamic_one() -> None:
    """With 0.817 kB T / <z*^2>, the static stiffness of a uniform beam (Butt and Jaschke 1995)."""
    beam = beam_modes(**LEVER)
    apparent = fit_thermal(spectrum(8), **KNOWN)
    static = fit_thermal(
        spectrum(8), sensitivity_kind="static", static_slope_ratio=beam.static_slope_ratio, **KNOWN
    )
    assert static.stiffness is not None
    assert apparent.stiffness is not None
    assert static.stiffness / apparent.stiffness == pytest.approx(1.0897**-2, rel=1e-3, abs=0)
    at_rest = beam_modes(frequency=161.8e3, quality_factor=287.0, stiffness=static.stiffness).static_stiffness
    assert at_rest == pytest.approx(0.817 * apparent.stiffness, rel=1e-3, abs=0)
    volts = spectrum(8, unit="V^2/Hz", factor=50e-9**-2)
    record = Sensitivity(50e-9, "static", 2e-9)
    fit = fit_thermal(volts, sensitivity=record, static_slope_ratio=beam.static_slope_ratio)
    assert fit.stiffness == pytest.approx(static.stiffness, rel=1e-6, abs=0)
    with pytest.raises(OvertoneError, match="static_slope_ratio"):
        fit_thermal(volts, sensitivity=record)


def test_the_error_of_the_sensitivity_enters_twice() -> None:
    sharp = fit_thermal(spectrum(9), **KNOWN)
    blurred = fit_thermal(spectrum(9), sensitivity_error=0.04)
    assert blurred.relative_error("stiffness") ** 2 == pytest.approx(
        sharp.relative_error("stiffness") ** 2 + 0.08**2, rel=1e-9, abs=0
    )
    assert blurred.relative_error("frequency") == sharp.relative_error("frequency")
    with pytest.warns(UncalibratedWarning, match="10 % of stiffness"):
        fit_thermal(spectrum(9))


def test_the_covariance_is_that_of_the_draws() -> None:
    fits = [fit_thermal(spectrum(seed), **KNOWN) for seed in range(150)]
    logs = np.log([[fit.frequency, fit.quality_factor, fit.stiffness, fit.floor] for fit in fits])
    seen = np.corrcoef(logs.T)
    stated = np.mean([fit.covariance.values for fit in fits], axis=0)
    stated = stated / np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    np.testing.assert_allclose(seen, stated, atol=0.25)
    assert stated[1, 2] < -0.3  # the flanks fix the area over Q, so that a higher Q is a softer lever


# --- refusals -------------------------------------------------------------------------------------


def test_a_floor_above_the_peak_is_no_peak() -> None:
    for floor in (700e-15, 5e-12):
        with pytest.raises(ObservablesError, match="no thermal peak"):
            fit_thermal(spectrum(10, floor=floor), **KNOWN)
    flat = spectrum(10)
    flat.values[:] = 0.0
    with pytest.raises(ObservablesError, match="no thermal peak"):
        fit_thermal(flat, **KNOWN)


def test_white_noise_is_never_taken_for_a_lever() -> None:
    for seed in range(40):
        for averages in (1.0, 30.0):
            noise = spectrum(seed, stiffness=1e12, averages=averages, highest=100e3)
            with pytest.raises(ObservablesError, match="no thermal peak"):
                fit_thermal(noise, **KNOWN)


def test_spectra_that_are_none_are_refused() -> None:
    good = spectrum(11)
    wrong = good.copy()
    wrong.attrs = {"units": "m"}
    with pytest.raises(UnitError, match=r"m\^2/Hz"):
        fit_thermal(wrong)
    with pytest.raises(UnitError, match="metres already"):
        fit_thermal(good, sensitivity=60e-9)
    holes = good.copy()
    holes.values[3230:3240] = np.nan
    with pytest.raises(ObservablesError, match=r"10 of .* bins are NaN"):
        fit_thermal(holes)
    decibels = good.copy(data=10 * np.log10(good.values))
    decibels.attrs = good.attrs
    with pytest.raises(ObservablesError, match="dB"):
        fit_thermal(decibels)
    with pytest.raises(ObservablesError, match="no spectrum"):
        fit_thermal(good[:0])
    with pytest.raises(ObservablesError, match="too few bins"):
        fit_thermal(good, between=(161e3, 161.3e3))
    with pytest.raises(ObservablesError, match="temperature"):
        fit_thermal(good, temperature=-5.0)
    with pytest.raises(ObservablesError, match="unknown window"):
        fit_thermal(good, window="curtain")


def test_traces_that_are_none_are_refused() -> None:
    good = trace(0, points=1024)
    with pytest.raises(UnitError, match="deflection"):
        thermal_spectrum(good.assign_attrs(units="N"))
    with pytest.raises(ObservablesError, match="1 of them NaN"):
        thermal_spectrum(good.where(good["time"] > 0.0))
    with pytest.raises(ObservablesError, match="evenly"):
        thermal_spectrum(good.assign_coords(time=good["time"] ** 2))
    with pytest.raises(ObservablesError, match="segment"):
        thermal_spectrum(good, segment=4096)
    with pytest.raises(ObservablesError, match="no trace"):
        thermal_spectrum(good.rename(time="t"))


def test_a_picture_shows_spectrum_and_fit_in_readable_units() -> None:
    volts = spectrum(12, unit="V^2/Hz", factor=60e-9**-2)
    fit = fit_thermal(volts, sensitivity=60e-9, **KNOWN)
    figure = thermal_figure(volts, fit, 60e-9, "m")
    whole, close = figure.axes
    assert (whole.get_xlabel(), close.get_ylabel()) == ("frequency [kHz]", "amplitude density [fm/√Hz]")
    drawn = {line.get_label(): line for line in close.lines}
    peak = np.nanmax(drawn["fit"].get_ydata())
    assert peak == pytest.approx(1e15 * 60e-9 * np.sqrt(fit.density(fit.frequency)), rel=1e-3, abs=0)
    assert drawn["noise floor"].get_ydata()[0] == pytest.approx(50.0, rel=0.05, abs=0)
    assert png_bytes(figure)[:4] == b"\x89PNG"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert thermal_figure(volts, fit).axes[0].get_ylabel() == "amplitude density [µV/√Hz]"

"""Stiffness, quality factor and resonance of a lever from its thermal motion.

Far from the sample, in equilibrium, the first mode has the mean square ``kB T/k`` and the one-sided density

    S(f) = 4 kB T/(k Q w1) / ((1 - x^2)^2 + (x/Q)^2),   x = f/f1,   integral over f from 0: kB T/k

Averaged periodograms scatter about their mean by a gamma distribution, whose width is the mean: least squares
on them are biased low. The fit maximises the likelihood of that distribution (Whittle), and its errors allow
for the correlation of neighbouring bins that windows leave.

Which stiffness? Read as displacement of the tip in the first mode, which is what the *dynamic* sensitivity
gives, the mean square gives the dynamic stiffness k_1 of that mode at the tip: the ``stiffness`` of
`overtone.beam_modes`. A spectrum that was calibrated with the static sensitivity (InvOLS of a force curve)
is too small by ``static_slope_ratio**2`` and its stiffness too large by as much, 1.187 for a uniform beam.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ObservablesError, OvertoneError, ResonanceWarning, UncalibratedWarning, UnitError
from overtone.instrument.periodogram import (
    averages_of,
    correlation_of_bins,
    covariance_of,
    log_slopes,
    maximise,
    windowed_resonance,
)
from overtone.instrument.sensitivity import Sensitivity
from overtone.instrument.thermal_noise import BOLTZMANN
from overtone.io.spectrum import POWER_UNITS, spectrum_array
from overtone.probe import DYNAMIC, STATIC

_Array = npt.NDArray[np.float64]

_BEAM_RATIOS = (1.0, 6.267, 17.547, 34.386)  # of the modes of a uniform beam: where to look for higher ones
_SIDE = 15.0  # widths of the peak on either side that the fit takes
_LEAST_SIDE = 25  # bins on either side
_LEAST_BINS = 20
_FEW_BINS = 5.0  # bins a width below which windows broaden the peak by per cents
_SMEARED_BELOW = 60.0  # bins a width below which a stated window is allowed for
_LINE = 3.0  # bins, below which a peak may be a line of the electronics
_DESPIKED = 7  # bins, of which a line fills less than half
_EVIDENCE = 30.0  # twice the gain in log-likelihood that noise does not reach, wherever it looks


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """A lever from its thermal spectrum; errors are standard errors.

    Parameters
    ----------
    frequency, quality_factor : float
        f_1 [Hz] and Q_1.
    stiffness : float or None
        Dynamic stiffness of the first mode at the tip [N/m]; None where the spectrum is in volts without a
        sensitivity, and of higher modes.
    mean_square : float
        Integral of the peak in the spectrum as it came [m^2 or V^2].
    floor : float
        White floor below the peak [unit of the spectrum]; 0 where the data show none.
    unit : str
        Unit of the spectrum.
    covariance : DataArray, dims (parameter, other)
        Of the natural logarithms of ``frequency``, ``quality_factor``, ``stiffness`` and ``floor``; without
        a stiffness, ``mean_square`` stands in its place. An error of the sensitivity enters the stiffness twice.
    averages : float
        How many averages each bin is worth, given or from its scatter.
    chi2_per_dof : float
        About 1 where the model describes the spectrum within its scatter, and its standard deviation.
    chi2_error : float
        Standard deviation of ``chi2_per_dof`` for a model that is right.
    bins : int
        Bins in the fit.
    between : tuple of float
        First and last frequency in the fit [Hz].
    bins_per_width : float
        Bins in f_1/Q.
    temperature : float
        [K]
    warnings : tuple of str
        What was warned of.
    higher : tuple of ThermalFit
        Further modes, in the same unit.
    """

    frequency: float
    quality_factor: float
    stiffness: float | None
    mean_square: float
    floor: float
    unit: str
    covariance: xr.DataArray
    averages: float
    chi2_per_dof: float
    chi2_error: float
    bins: int
    between: tuple[float, float]
    bins_per_width: float
    temperature: float
    warnings: tuple[str, ...] = ()
    higher: tuple[ThermalFit, ...] = ()

    def relative_error(self, name: str) -> float:
        """Return the standard error of ``ln`` of frequency, quality_factor, stiffness, mean_square or floor."""
        return math.sqrt(float(self.covariance.sel(parameter=name, other=name)))

    @property
    def frequency_error(self) -> float:
        """Standard error of f_1 [Hz]."""
        return self.frequency * self.relative_error("frequency")

    @property
    def quality_factor_error(self) -> float:
        """Standard error of Q_1."""
        return self.quality_factor * self.relative_error("quality_factor")

    @property
    def stiffness_error(self) -> float | None:
        """Standard error of k_1 [N/m], that of the sensitivity included; None without a stiffness."""
        return None if self.stiffness is None else self.stiffness * self.relative_error("stiffness")

    def density(self, frequency: npt.ArrayLike) -> _Array:
        """Return the fitted density with its floor [unit of the spectrum], before any window broadens it."""
        shape = resonance_density(np.asarray(frequency, dtype=float), self.frequency, self.quality_factor)
        return self.mean_square * shape + self.floor


def resonance_density(frequency: npt.ArrayLike, resonance: float, quality_factor: float) -> _Array:
    """Return the one-sided density of a resonance in white force noise, whose integral over f is 1 [1/Hz].

    Examples
    --------
    >>> step = 10.0
    >>> round(float(np.sum(resonance_density(np.arange(step, 400e3, step), 70e3, 150.0))) * step, 3)
    1.0
    """
    x2 = np.square(np.asarray(frequency, dtype=float) / resonance)
    return np.asarray(2.0 / (np.pi * resonance * quality_factor) / ((1.0 - x2) ** 2 + x2 / quality_factor**2))


def thermal_spectrum(deflection: xr.DataArray, *, segment: int | None = None) -> xr.DataArray:
    """Return the power spectral density of a deflection that was recorded over time (Welch, Hann windows).

    Parameters
    ----------
    deflection : DataArray, dims (time,)
        Deflection [m or V] at evenly spaced ``time`` [s].
    segment : int, optional
        Points a segment: bins are 1/(segment * step) wide, and f_1/Q should be 5 of them or more. A
        power of two near an eighth of the trace unless given. Segments overlap by half.

    Returns
    -------
    DataArray
        One-sided density over ``frequency`` [m^2/Hz or V^2/Hz], with the number of averages it is worth and
        the window in its attributes, which `fit_thermal` allows for.

    Raises
    ------
    ObservablesError
        If the trace is not over time, too short, not evenly spaced, or has holes.
    UnitError
        If its unit is neither m nor V.
    """
    from scipy import signal

    unit = str(deflection.attrs.get("units", ""))
    if unit not in ("m", "V"):
        raise UnitError(
            "the deflection has no usable unit", expected='attrs["units"] "m" or "V"', got=repr(unit)
        )
    if deflection.dims != ("time",) or "time" not in deflection.coords:
        raise ObservablesError(
            "the deflection is no trace", expected="a coordinate time [s]", got=str(deflection.dims)
        )
    time, values = deflection["time"].values.astype(float), deflection.values.astype(float)
    if time.size < 64 or not np.isfinite(values).all():
        lost = int((~np.isfinite(values)).sum())
        raise ObservablesError(
            "no spectrum can be made of the trace",
            expected="64 points or more, none of them NaN",
            got=f"{time.size} points, {lost} of them NaN",
        )
    step = (time[-1] - time[0]) / (time.size - 1)
    if not (step > 0.0 and np.abs(np.diff(time) - step).max() < 1e-3 * step):
        raise ObservablesError("the trace is not evenly spaced in time", got=f"steps about {step:g} s")
    length = segment if segment is not None else 2 ** int(math.log2(max(time.size / 8, 64)))
    if not 16 <= length <= time.size:
        raise ObservablesError(
            "the segment does not fit the trace", expected=f"16 to {time.size} points", got=str(segment)
        )
    frequency, density = signal.welch(values, fs=1.0 / step, window="hann", nperseg=length)
    count = 1 + (time.size - length) // (length - length // 2)
    # Half-overlapping Hann segments share (1/6)^2 of their scatter with each neighbour.
    averages = count / (1.0 + 2.0 / 36.0 * (1.0 - 1.0 / count))
    return spectrum_array(frequency, density, f"{unit}^2/Hz", averages=averages, window="hann")


def fit_thermal(
    spectrum: xr.DataArray,
    *,
    temperature: float = 295.0,
    sensitivity: float | Sensitivity | None = None,
    sensitivity_error: float = 0.0,
    sensitivity_kind: str = DYNAMIC,
    static_slope_ratio: float | None = None,
    between: tuple[float, float] | None = None,
    modes: int = 1,
    averages: float | None = None,
    flicker: bool = False,
    window: str | None = None,
) -> ThermalFit:
    """Fit the thermal peak of a lever: f_1, Q and the dynamic stiffness of its first mode.

    Parameters
    ----------
    spectrum : DataArray, dims (frequency,)
        One-sided power density [m^2/Hz or V^2/Hz] over ``frequency`` [Hz], as `read_spectrum` and
        `thermal_spectrum` return it, far from the sample and without drive.
    temperature : float
        [K]
    sensitivity : float or Sensitivity, optional
        For spectra in volts [m/V]. A record brings its kind and its error. Without, there is no stiffness.
    sensitivity_error : float
        Relative standard error of the sensitivity, also that with which a spectrum in metres was made.
    sensitivity_kind : str
        ``dynamic`` (of the first mode) or ``static`` (slope of a force curve), of ``sensitivity`` or of what
        a spectrum in metres was made with.
    static_slope_ratio : float, optional
        Needed for a static one: `Cantilever.static_slope_ratio`, 1.0897 for a uniform beam read at its end.
    between : tuple of float, optional
        Frequencies [Hz] between which to fit; about the largest peak unless given.
    modes : int
        How many modes, 1 to 4: the higher ones are sought within 20 % of where a uniform beam has them.
    averages : float, optional
        Averages behind each bin; from ``spectrum.attrs`` or from the scatter of the bins unless given.
    flicker : bool
        Whether there may be noise that falls as 1/f below the peak, besides the white floor.
    window : str, optional
        Window behind the spectrum (a name of `scipy.signal.get_window`, ``boxcar`` for none), where each bin
        is as wide as one over the length of a segment. Its broadening of the peak is then allowed for. From
        ``spectrum.attrs`` unless given; an empty text stands for unknown.

    Returns
    -------
    ThermalFit
        With standard errors from the curvature of the likelihood and the correlation of the bins.

    Warns
    -----
    ResonanceWarning
        If the peak is so narrow that an unknown window broadens it, or the model does not describe it.
    UncalibratedWarning
        If the sensitivity is given without an error.

    Raises
    ------
    ObservablesError
        If the spectrum is empty, has NaN or negative bins in the fit, or shows no thermal peak.
    UnitError
        If the unit is neither m^2/Hz nor V^2/Hz, or does not go with a sensitivity.

    Notes
    -----
    What no fit can tell: a lever that is driven or not in equilibrium, a drift of f_1 during the recording (which
    looks like a lower Q), and light that cools or heats the lever.
    """
    unit = _check(spectrum, temperature, modes)
    scale, scale_error, said = _scale(
        unit, sensitivity, sensitivity_error, sensitivity_kind, static_slope_ratio
    )
    stated = spectrum.attrs.get("averages")
    averages = averages if averages is not None else float(stated) if stated is not None else None
    if averages is not None and not (math.isfinite(averages) and averages >= 1.0):
        raise ObservablesError("averages is out of range", expected="1 or more", got=repr(averages))
    window = (spectrum.attrs.get("window") if window is None else window) or None
    first = _fit_peak(spectrum, between, averages, flicker, window, temperature)
    higher = []
    for ratio in _BEAM_RATIOS[1:modes]:
        about = (0.8 * ratio * first.frequency, 1.2 * ratio * first.frequency)
        higher.append(_fit_peak(spectrum, about, averages, flicker, window, temperature, may_be_low=True))
    said += [text for fit in (first, *higher) for text in fit.warnings]
    for text in said:
        kind = UncalibratedWarning if text.startswith("the sensitivity") else ResonanceWarning
        warnings.warn(text, kind, stacklevel=2)
    if scale is None:
        return replace(first, warnings=tuple(said), higher=tuple(higher))
    covariance = first.covariance.copy()
    covariance[2, :2] *= -1.0  # ln k = ln kB T - ln mean square
    covariance[2, 3] *= -1.0
    covariance[:2, 2] *= -1.0
    covariance[3, 2] *= -1.0
    covariance[2, 2] += 4.0 * scale_error**2
    names = ["frequency", "quality_factor", "stiffness", "floor"]
    return replace(
        first,
        stiffness=BOLTZMANN * temperature / (first.mean_square * scale**2),
        covariance=covariance.assign_coords(parameter=names, other=names),
        warnings=tuple(said),
        higher=tuple(higher),
    )


# --- what was asked for ---------------------------------------------------------------------------


def _check(spectrum: xr.DataArray, temperature: float, modes: int) -> str:
    unit = str(spectrum.attrs.get("units", ""))
    if spectrum.dims != ("frequency",) or "frequency" not in spectrum.coords or spectrum.size == 0:
        raise ObservablesError(
            "there is no spectrum to fit",
            expected="densities over a coordinate frequency [Hz]",
            got=f"{spectrum.size} values over {spectrum.dims}",
            hint="read_spectrum or thermal_spectrum",
        )
    if unit not in POWER_UNITS:
        raise UnitError(
            "the spectrum is no power density in SI units",
            expected=f'attrs["units"] {" or ".join(POWER_UNITS)}',
            got=repr(unit),
            hint="read_spectrum, which knows amplitude densities and prefixes as well",
        )
    if not (math.isfinite(temperature) and temperature > 0.0):
        raise ObservablesError("unphysical temperature", expected="kelvin above 0", got=repr(temperature))
    if modes not in range(1, len(_BEAM_RATIOS) + 1):
        raise ObservablesError("modes is out of range", expected=f"1 to {len(_BEAM_RATIOS)}", got=repr(modes))
    return unit


def _scale(
    unit: str,
    sensitivity: float | Sensitivity | None,
    error: float,
    kind: str,
    static_slope_ratio: float | None,
) -> tuple[float | None, float, list[str]]:
    """Return metres of the tip per unit of the spectrum in the first mode, its relative error, and remarks."""
    said: list[str] = []
    if isinstance(sensitivity, Sensitivity):
        kind, error = sensitivity.kind, math.hypot(error, sensitivity.relative_error)
        sensitivity = sensitivity.value
    if kind not in (DYNAMIC, STATIC):
        raise OvertoneError(
            "unknown kind of sensitivity", expected=f"{DYNAMIC!r} or {STATIC!r}", got=repr(kind)
        )
    if not (math.isfinite(error) and error >= 0.0):
        raise OvertoneError(
            "unusable error of the sensitivity", expected="a share of it, 0 or more", got=repr(error)
        )
    if unit.startswith("m") and sensitivity is not None:
        raise UnitError(
            "the spectrum is in metres already",
            expected="a sensitivity for spectra in volts",
            got=unit,
            hint='sensitivity_kind="static" says with which sensitivity it was made',
        )
    if unit.startswith("V") and sensitivity is None:
        return None, 0.0, said
    if sensitivity is not None and not (math.isfinite(sensitivity) and sensitivity > 0.0):
        raise UnitError("unphysical sensitivity", expected="m/V above 0", got=repr(sensitivity))
    if error == 0.0:
        said.append(
            "the sensitivity has no error, so that of the stiffness counts the noise of the spectrum alone: 5 % of "
            "sensitivity are 10 % of stiffness"
        )
    scale = 1.0 if sensitivity is None else sensitivity
    if kind == STATIC:
        if static_slope_ratio is None or not (math.isfinite(static_slope_ratio) and static_slope_ratio > 0.0):
            raise OvertoneError(
                "a static sensitivity does not read the first mode",
                expected="static_slope_ratio of the lever",
                got=repr(static_slope_ratio),
                hint="overtone.beam_modes(...).static_slope_ratio, 1.0897 for a uniform beam read at its end",
            )
        scale *= static_slope_ratio
    return scale, error, said


# --- one peak -------------------------------------------------------------------------------------


def _fit_peak(
    spectrum: xr.DataArray,
    between: tuple[float, float] | None,
    averages: float | None,
    flicker: bool,
    window: str | None,
    temperature: float,
    *,
    may_be_low: bool = False,
) -> ThermalFit:
    """Find a peak and fit it; one that ``may_be_low`` may stand below its floor, if it is beyond doubt."""
    frequency, density = spectrum["frequency"].values.astype(float), spectrum.values.astype(float)
    inside = frequency > 0.0
    if between is not None:
        inside &= (frequency >= between[0]) & (frequency <= between[1])
    f, P = frequency[inside], density[inside]
    if f.size < _LEAST_BINS:
        asked = "" if between is None else f" between {between[0]:g} and {between[1]:g} Hz"
        raise ObservablesError(
            f"too few bins{asked}", expected=f"{_LEAST_BINS} or more above 0 Hz", got=str(f.size)
        )
    bad = ~(np.isfinite(P) & (P >= 0.0))
    if bad.any():
        raise ObservablesError(
            f"{int(bad.sum())} of {P.size} bins are NaN or negative",
            expected="power densities, which are neither",
            got=f"{P[bad][0]:g} at {f[bad][0]:g} Hz",
            hint="between=(low, high) leaves bins out; spectra in dB are no densities",
        )
    if not P.any():
        raise ObservablesError("no thermal peak", expected="a spectrum", got="zero in every bin")
    theta, step = _search(f, P, averages)
    if between is None:
        width = math.exp(theta[0] - theta[1])
        side = max(_SIDE * width, _LEAST_SIDE * step)
        centre = math.exp(theta[0])
        near = (f >= max(centre - side, 0.25 * centre)) & (f <= min(centre + side, 3.0 * centre))
        f, P = f[near], P[near]
    unit = str(spectrum.attrs["units"])
    fit = _refined(f, P, theta, step, averages, flicker, window, unit, temperature)
    peak = float(fit.density(fit.frequency)) - fit.floor
    if peak < fit.floor and not may_be_low:
        raise _no_peak(f"the largest is {peak:.3g} {unit} high on a floor of {fit.floor:.3g}")
    return fit


def _refined(
    f: _Array,
    P: _Array,
    theta: _Array,
    step: float,
    averages: float | None,
    flicker: bool,
    window: str | None,
    unit: str,
    temperature: float,
) -> ThermalFit:
    smeared = window is not None and (
        window == "boxcar" or math.exp(theta[0] - theta[1]) < _SMEARED_BELOW * step
    )
    shape = windowed_resonance(f, window, step) if window and smeared else partial(resonance_density, f)
    if flicker:
        theta = np.append(theta, theta[3] + math.log(f[0]) - 2.0)

    def model(parameters: _Array) -> _Array:
        rest = math.exp(parameters[4]) / f if flicker else 0.0
        floor = math.exp(parameters[3]) if math.isfinite(parameters[3]) else 0.0
        return math.exp(parameters[2]) * shape(*np.exp(parameters[:2])) + floor + rest

    theta, _ = maximise(model, theta, P)
    free = np.ones(theta.size, bool)
    for k in range(3, theta.size):
        # A term that is nowhere a thousandth of the rest is not there, and would spoil the covariance.
        without = theta.copy()
        without[k] = -math.inf if k == 3 else -700.0
        if (model(theta) / model(without) - 1.0).max() < 1e-3:
            theta, free[k] = without, False
    if not free.all():
        held = theta.copy()

        def reduced(parameters: _Array) -> _Array:
            full = held.copy()
            full[free] = parameters
            return model(full)

        best, _ = maximise(reduced, theta[free], P)
        theta[free] = best
    ratio = P / model(theta)
    shared = correlation_of_bins(ratio - 1.0, window)
    known = averages if averages is not None else averages_of(ratio)
    covariance = np.zeros((theta.size, theta.size))
    covariance[np.ix_(free, free)] = covariance_of(log_slopes(model, theta, free), known, shared)
    resonance, quality, area = (float(math.exp(value)) for value in theta[:3])
    floor = math.exp(theta[3]) if free[3] else 0.0
    dof = P.size - int(free.sum())
    chi2 = known * float(np.sum((ratio - 1.0) ** 2)) / dof
    chi2_error = math.sqrt((2.0 + 6.0 / known) * (1.0 + 2.0 * float(np.sum(shared**2))) / dof)
    bins = resonance / quality / step
    if bins < 1.0 and not smeared:
        raise ObservablesError(
            "no thermal peak can be resolved",
            expected="f_1/Q of several bins",
            got=f"a line of {bins:.2g} bins at {resonance:.6g} Hz",
            hint="longer segments; between=(low, high) if the line is not the lever",
        )
    said = []
    if bins < _FEW_BINS and not smeared:
        said.append(
            f"f_1/Q is {bins:.2g} bins wide: an unknown window broadens such a peak. A Hann window lowers Q by up to "
            f"{min(60.0 / bins**2, 90.0):.2g} %, the stiffness by a seventh of that; none at all lowers Q by about "
            f"{min(30.0 / bins, 90.0):.2g} %. Use longer segments, or give window="
        )
    if abs(chi2 - 1.0) > 5.0 * chi2_error and abs(chi2 - 1.0) > 0.05:
        said.append(
            f"one resonance on a white floor does not describe the bins: chi2/dof {chi2:.3g}, expected "
            f"1 +- {chi2_error:.2g}. Other lines, a drift of f_1, or another number of averages"
        )
    names = ["frequency", "quality_factor", "mean_square", "floor"]
    return ThermalFit(
        frequency=resonance,
        quality_factor=quality,
        stiffness=None,
        mean_square=area,
        floor=floor,
        unit=unit,
        covariance=xr.DataArray(
            covariance[:4, :4], dims=("parameter", "other"), coords={"parameter": names, "other": names}
        ),
        averages=known,
        chi2_per_dof=chi2,
        chi2_error=chi2_error,
        bins=P.size,
        between=(float(f[0]), float(f[-1])),
        bins_per_width=bins,
        temperature=temperature,
        warnings=tuple(said),
    )


def _no_peak(got: str) -> ObservablesError:
    return ObservablesError(
        "no thermal peak",
        expected="a resonance that stands above its noise floor",
        got=got,
        hint="more averages, less detector noise, or between=(low, high) about the resonance",
    )


def _search(f: _Array, P: _Array, averages: float | None) -> tuple[_Array, float]:
    """Return ln(f1, Q, area, floor) to start from, and the width of a bin.

    The spectrum is smoothed over 1, 3, 9, ... bins and held against the median within half an octave; the
    largest excess at each scale is fitted, and the one that gains most likelihood over no peak is taken.
    """
    from scipy import ndimage

    step = float(np.median(np.diff(f)))
    centres = np.geomspace(f[0], f[-1], 150)
    octaves = [P[(f >= centre / 1.5) & (f <= centre * 1.5)] for centre in centres]
    level = np.array([np.median(part) if part.size else 0.0 for part in octaves])
    kept = level > 0.0
    if not kept.any():
        raise _no_peak("zero in most bins")
    background = np.exp(np.interp(np.log(f), np.log(centres[kept]), np.log(level[kept])))
    wide: tuple[float, _Array] = (0.0, np.empty(0))
    narrow = wide
    scale, despiked = 1, ndimage.median_filter(P, size=_DESPIKED, mode="nearest")
    while scale <= max(f.size // 3, 1):
        # At coarse scales a strong line would still outweigh the lever.
        smooth = np.convolve(P if scale == 1 else despiked, np.full(scale, 1.0 / scale), mode="valid")
        excess = smooth / background[scale // 2 : scale // 2 + smooth.size]
        at = int(np.argmax(excess)) + scale // 2
        part = slice(max(at - 30 * scale, 0), at + 30 * scale + 1)
        height = max(float(P[at - scale // 2 : at + scale // 2 + 1].mean()), 1e-300)
        quality = max(f[at] / (scale * step), 0.7)
        start = np.log([f[at], quality, height * 0.5 * np.pi * scale * step, background[at]])
        theta, gain = _gain(f[part], P[part], start)
        n = averages if averages is not None else averages_of(P[part] / _plain(f[part], theta))
        if f[0] < math.exp(theta[0]) < f[-1]:
            width = math.exp(theta[0] - theta[1])
            if width >= _LINE * step:
                wide = max(wide, (2.0 * n * gain, theta), key=lambda found: found[0])
            elif width >= 0.3 * step:
                narrow = max(narrow, (2.0 * n * gain, theta), key=lambda found: found[0])
        scale *= 3
    # Lines of the electronics are as narrow as the window makes them: a lever goes before them.
    best = narrow if narrow[0] > 10.0 * wide[0] else wide
    if best[0] < _EVIDENCE:
        raise _no_peak("nothing wider than a line of one bin beyond the scatter of the bins")
    return best[1], step


def _plain(f: _Array, theta: _Array) -> _Array:
    return math.exp(theta[2]) * resonance_density(f, math.exp(theta[0]), math.exp(theta[1])) + math.exp(
        theta[3]
    )


def _gain(f: _Array, P: _Array, start: _Array) -> tuple[_Array, float]:
    """Fit a peak on a floor; return it, and the log-likelihood for one average gained over floor and 1/f noise."""
    if f.size < 8:
        return start, -math.inf
    theta, with_peak = maximise(partial(_plain, f), start, P)
    mean = math.log(P.mean())
    _, without = maximise(
        lambda t: math.exp(t[0]) + math.exp(t[1]) * f[0] / f, np.array([mean - 0.7, mean - 0.7]), P
    )
    return theta, without - with_peak

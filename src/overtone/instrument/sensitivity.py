"""Two sensitivities of an optical lever, kept apart: of a force curve (static) and of the first mode (dynamic).

A beam that is bent by a force at its tip and a beam that swings in its first mode have different slopes at the
laser spot for one displacement of the tip, so that a metre a volt is not the same for both:

    dynamic = static_slope_ratio * static        1.0897 for a uniform beam, tip and spot at its end

The static one turns the deflection of a force curve into metres, and A0; the dynamic one turns A1 and the thermal peak.
Confused, they cost 9 % of amplitude and 19 % of stiffness.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CurveWarning, ObservablesError, ProbeError, UnitError
from overtone.probe import DYNAMIC, STATIC, Cantilever

_Array = npt.NDArray[np.float64]

_LEAST_POINTS = 8
_TOUCH = 10.0  # noise levels of a deflection that is contact beyond doubt
_STRAIGHT = 0.05  # change of the slope over the fit, as a share of it, that a hard surface does not show


@dataclass(frozen=True)
class Sensitivity:
    """An inverse optical lever sensitivity that says which it is.

    Parameters
    ----------
    value : float
        Metres of the tip a volt [m/V].
    kind : str
        ``static`` (a force curve) or ``dynamic`` (the first mode).
    error : float
        Standard error [m/V]; 0 where it is not known.
    source : str
        Where it comes from, for people.
    """

    value: float
    kind: str
    error: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        if self.kind not in (DYNAMIC, STATIC):
            raise ProbeError(
                "unknown kind of sensitivity", expected=f"{STATIC!r} or {DYNAMIC!r}", got=repr(self.kind)
            )
        if not (math.isfinite(self.value) and self.value > 0.0 and 0.0 <= self.error < math.inf):
            raise ProbeError(
                "unphysical sensitivity",
                expected="m/V above 0 and an error of 0 or more",
                got=f"{self.value!r} +- {self.error!r}",
            )

    @property
    def relative_error(self) -> float:
        """Standard error over the value."""
        return self.error / self.value


def static_sensitivity(deflection: xr.DataArray, *, between: tuple[float, float] = (0.2, 0.9)) -> Sensitivity:
    """Return the static sensitivity from one sweep of a force curve on a hard surface.

    Parameters
    ----------
    deflection : DataArray, dims (z,)
        Deflection [V] over ``z`` [m], heights of the base or extension of the piezo: either sign will do.
    between : tuple of float
        Which part of the rise is fitted, as shares of the largest deflection; lower the upper one
        where the detector saturates.

    Returns
    -------
    Sensitivity
        Of kind ``static``: one over the slope in contact, less that of the free lever; its error is from the
        scatter about a straight line and counts the correlation of neighbouring points.

    Warns
    -----
    CurveWarning
        If the contact part is bent: a soft sample, a detector out of its range, or creep.

    Raises
    ------
    ObservablesError
        If the curve never touches, has no free part, too few points, or NaN.
    UnitError
        If the deflection is not in volts or z not in metres.

    Notes
    -----
    On a sample that gives way the sensitivity comes out too large, with no sign of it but the bend.
    """
    z, volts = _sweep(deflection, "deflection")
    # Contact is at the end that is farther from the middle level; there z is turned to fall towards it.
    middle = float(np.median(volts))
    ends = max(volts.size // 20, 2)
    if abs(np.mean(volts[-ends:]) - middle) > abs(np.mean(volts[:ends]) - middle):
        z, volts = -z[::-1], volts[::-1]
    count = max(z.size // 4, _LEAST_POINTS // 2)
    free = slice(z.size - count, z.size)
    line = np.polyfit(z[free] - z[-1], volts[free], 1)
    rise = volts - np.polyval(line, z - z[-1])
    noise = 1.4826 * float(np.median(np.abs(np.diff(rise[free])))) / math.sqrt(2.0)
    sign = 1.0 if np.mean(rise[:ends]) > 0.0 else -1.0
    rise *= sign
    top = float(np.max(rise))
    rounding = 1e-9 * float(np.abs(volts).max())
    if not top > _TOUCH * max(noise, float(np.std(rise[free])), rounding):
        raise ObservablesError(
            "the curve never touches",
            expected=f"a deflection of more than {_TOUCH:g} times the noise",
            got=f"{top:.3g} V on noise of {noise:.3g} V",
            hint="a curve that goes on into contact, on a hard surface, one sweep of it",
        )
    # From the contact end up to where the rise first leaves the range: snap-off and free noise stay out.
    low, high = between[0] * top, between[1] * top
    last = int(np.argmax(rise < low)) if (rise < low).any() else z.size
    chosen = np.flatnonzero(rise[:last] <= high)
    if chosen.size < _LEAST_POINTS:
        raise ObservablesError(
            "too few points in contact", expected=f"{_LEAST_POINTS} or more", got=f"{chosen.size}"
        )
    slope, error, bend, bend_error = _line(z[chosen], rise[chosen])
    # The slope of the free lever was found from other points, and takes its error with it.
    _, free_error, _, _ = _line(z[free], rise[free])
    if abs(bend) > _STRAIGHT and abs(bend) > 4.0 * bend_error:
        warnings.warn(
            f"the contact part of the force curve is bent: its slope changes by {abs(bend):.0%} over the fit. A soft "
            "sample, a detector out of its range, or creep make the sensitivity wrong by about half of that",
            CurveWarning,
            stacklevel=2,
        )
    value = 1.0 / abs(slope)
    return Sensitivity(
        value, STATIC, value * math.hypot(error, free_error) / abs(slope), "slope of a force curve"
    )


def dynamic_from_amplitude(
    amplitude: xr.DataArray, *, between: tuple[float, float] = (0.5, 0.95)
) -> Sensitivity:
    """Return the dynamic sensitivity from an approach in tapping mode on a hard surface.

    Parameters
    ----------
    amplitude : DataArray, dims (z,)
        A1 [V] over ``z`` [m] while the tip taps, one sweep in one state (no jump), free part included.
    between : tuple of float
        Which part of the fall is fitted, as shares of the free amplitude.

    Returns
    -------
    Sensitivity
        Of kind ``dynamic``: one over the slope of the amplitude against z.

    Raises
    ------
    ObservablesError
        If the amplitude does not fall so far, or there are too few points.
    UnitError
        If the amplitude is not in volts or z not in metres.

    Notes
    -----
    The amplitude falls by what the base sinks only roughly: the sample gives way and the lever bends. The error
    does not count that: with 94 nm on Hertz contacts they come out 0.3 % (70 GPa) and 1.5 % (2 GPa) too large.
    """
    z, volts = _sweep(amplitude, "amplitude")
    if np.mean(volts[: max(volts.size // 10, 1)]) > np.mean(volts[-max(volts.size // 10, 1) :]):
        z, volts = -z[::-1], volts[::-1]
    free = float(np.median(volts[-max(volts.size // 10, 2) :]))
    low, high = between[0] * free, between[1] * free
    chosen = np.flatnonzero((volts >= low) & (volts <= high))
    if not volts.min() < high or chosen.size < _LEAST_POINTS:
        raise ObservablesError(
            "the amplitude does not fall far enough",
            expected=f"{_LEAST_POINTS} points or more from {between[0]:.0%} to {between[1]:.0%} of the free amplitude",
            got=f"{chosen.size} points, the lowest at {volts.min() / free:.0%}",
        )
    slope, error, _, _ = _line(z[chosen], volts[chosen])
    if not slope > 4.0 * error:
        raise ObservablesError(
            "the amplitude does not fall towards the surface", got=f"a slope of {slope:.3g} V/m"
        )
    return Sensitivity(1.0 / slope, DYNAMIC, error / slope**2, "slope of an amplitude curve")


def dynamic_from_static(static: Sensitivity, lever: Cantilever) -> Sensitivity:
    """Return the sensitivity of the first mode from that of a force curve, times the lever's static slope ratio.

    Raises
    ------
    ProbeError
        If the sensitivity is not static, or the lever does not state its static slope.

    Examples
    --------
    >>> from overtone.beam import beam_modes
    >>> lever = beam_modes(stiffness=40.0, frequency=300e3, quality_factor=450.0)
    >>> round(1e9 * dynamic_from_static(Sensitivity(50e-9, "static"), lever).value, 2)
    54.49
    """
    return _converted(static, lever, DYNAMIC)


def static_from_dynamic(dynamic: Sensitivity, lever: Cantilever) -> Sensitivity:
    """Return the sensitivity of a force curve from that of the first mode, over the lever's static slope ratio.

    Raises
    ------
    ProbeError
        If the sensitivity is not dynamic, or the lever does not state its static slope.
    """
    return _converted(dynamic, lever, STATIC)


def dynamic_from_thermal(
    spectrum: xr.DataArray,
    stiffness: float,
    *,
    stiffness_error: float = 0.0,
    temperature: float = 295.0,
    between: tuple[float, float] | None = None,
) -> Sensitivity:
    """Return the dynamic sensitivity from a thermal spectrum in volts of a lever whose stiffness is known.

    Parameters
    ----------
    spectrum : DataArray, dims (frequency,)
        One-sided power density [V^2/Hz].
    stiffness : float
        Dynamic stiffness of the first mode at the tip [N/m]. Sader's method gives the static one, which is
        smaller: 1.0302 for a uniform beam.
    stiffness_error : float
        Its standard error [N/m].
    temperature : float
        [K]
    between : tuple of float, optional
        As in `fit_thermal`.

    Returns
    -------
    Sensitivity
        Of kind ``dynamic``, without touching the surface.

    Raises
    ------
    UnitError
        If the spectrum is not in volts.
    ObservablesError
        If the spectrum shows no thermal peak.
    ProbeError
        If the stiffness is unphysical.
    """
    from overtone.instrument.thermal import fit_thermal  # which takes sensitivities
    from overtone.instrument.thermal_noise import BOLTZMANN

    if spectrum.attrs.get("units") != "V^2/Hz":
        raise UnitError(
            "the spectrum gives no sensitivity", expected="V^2/Hz", got=repr(spectrum.attrs.get("units", ""))
        )
    if not (math.isfinite(stiffness) and stiffness > 0.0 and 0.0 <= stiffness_error < math.inf):
        raise ProbeError(
            "unphysical stiffness",
            expected="N/m above 0 and an error of 0 or more",
            got=f"{stiffness!r} +- {stiffness_error!r}",
        )
    fit = fit_thermal(spectrum, temperature=temperature, between=between)
    value = math.sqrt(BOLTZMANN * temperature / stiffness / fit.mean_square)
    relative = 0.5 * math.hypot(fit.relative_error("mean_square"), stiffness_error / stiffness)
    return Sensitivity(value, DYNAMIC, value * relative, "thermal peak of a lever of known stiffness")


# --- curves ---------------------------------------------------------------------------------------


def _converted(sensitivity: Sensitivity, lever: Cantilever, kind: str) -> Sensitivity:
    if sensitivity.kind == kind:
        raise ProbeError(
            f"the sensitivity is {kind} already", got=sensitivity.source or f"{sensitivity.value:g} m/V"
        )
    if lever.static_stiffness is None:
        raise ProbeError(
            "the lever does not state its static slope",
            expected="static_stiffness and static_slope_ratio",
            got="modes alone",
            hint="overtone.beam_modes",
        )
    ratio = lever.static_slope_ratio if kind == DYNAMIC else 1.0 / lever.static_slope_ratio
    source = f"{sensitivity.kind} sensitivity ({sensitivity.source}) and the shape of the lever"
    return Sensitivity(sensitivity.value * ratio, kind, sensitivity.error * ratio, source)


def _sweep(curve: xr.DataArray, what: str) -> tuple[_Array, _Array]:
    """Return heights, rising, and volts of one sweep."""
    unit = str(curve.attrs.get("units", ""))
    if unit != "V":
        raise UnitError(f"the {what} is not in volts", expected='attrs["units"] "V"', got=repr(unit))
    if curve.dims != ("z",) or "z" not in curve.coords:
        raise ObservablesError(f"the {what} is no curve", expected="a coordinate z [m]", got=str(curve.dims))
    height = str(curve["z"].attrs.get("units", "m"))
    if height != "m":
        raise UnitError("z is not in metres", expected="m", got=repr(height))
    z, volts = curve["z"].values.astype(float), curve.values.astype(float)
    bad = int((~(np.isfinite(z) & np.isfinite(volts))).sum())
    if z.size < 4 * _LEAST_POINTS or bad:
        raise ObservablesError(
            f"the {what} is no usable curve",
            expected=f"{4 * _LEAST_POINTS} points or more, none of them NaN",
            got=f"{z.size} points, {bad} of them NaN",
        )
    order = np.argsort(z, kind="stable")
    if z[order[-1]] == z[order[0]]:
        raise ObservablesError(f"the {what} is no curve", expected="different heights", got="one height")
    return z[order], volts[order]


def _line(z: _Array, values: _Array) -> tuple[float, float, float, float]:
    """Return slope and error of a straight line, and the share by which the slope changes over it, with error."""
    span = float(np.ptp(z)) or 1.0
    x = (z - z.mean()) / span
    design = np.stack([np.ones_like(x), x, x**2 - np.mean(x**2)], axis=-1)

    def fitted(columns: int) -> tuple[_Array, _Array]:
        part = design[:, :columns]
        best = np.linalg.lstsq(part, values, rcond=None)[0]
        residual = values - part @ best
        power = float(np.sum(residual**2))
        shared = float(np.sum(residual[1:] * residual[:-1])) / power if power > 0.0 else 0.0
        # Smooth errors of scanner and detector count as few points; three in four is as far as this can tell.
        inflation = (1.0 + max(shared, 0.0)) / (1.0 - min(max(shared, 0.0), 0.95))
        variance = power / max(x.size - columns, 1) * inflation
        return best, np.sqrt(variance * np.diag(np.linalg.inv(part.T @ part)))

    best, error = fitted(2)
    bent, bent_error = fitted(3)
    slope = float(best[1])
    bend = 2.0 * float(bent[2]) / slope if slope else 0.0
    bend_error = 2.0 * float(bent_error[2]) / abs(slope) if slope else math.inf
    return slope / span, float(error[1]) / span, bend, bend_error

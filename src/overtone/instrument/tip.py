"""The radius of the tip from a reference material, and its wear over a scan.

A contact is measured as ``Lambda = 4/3 E* sqrt(R)``. A map that assumed the radius R_0 and found the modulus E of a
material whose modulus is known to be E_ref has measured the radius:

    R = R_0 (E*(E) / E*(E_ref))^2,   1/E* = (1 - nu_t^2)/E_t + (1 - nu_s^2)/E_s

so that 10 % of modulus are 20 % of radius. Over a scan the same ratio tells how the tip wears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.parameters import effective_modulus
from overtone.errors import ObservablesError, OvertoneError
from overtone.probe import Probe, required_radius

_Array = npt.NDArray[np.float64]

_NORMAL_90 = 1.6448536269514722
_LEAST_LINES = 12
_LEAST_INDEPENDENT = 6.0


@dataclass(frozen=True)
class TipRadius:
    """The radius of the tip that gives a reference material its known modulus.

    Parameters
    ----------
    radius : float
        [m]
    relative_error : float
        Standard error of ln R: twice that of ln E*, of map and reference together.
    lower, upper : float
        90 % interval [m].
    assumed_radius : float
        Radius that the map was made with [m].
    probe : Probe
        The probe with the radius found.
    """

    radius: float
    relative_error: float
    lower: float
    upper: float
    assumed_radius: float
    probe: Probe


@dataclass(frozen=True)
class TipWear:
    """How the radius of the tip changed over a scan, as the reference material tells.

    Parameters
    ----------
    change : float
        Growth of ln R from the first line to the last.
    error : float
        Its standard error, from the scatter of the lines and how alike neighbours are.
    lower, upper : float
        90 % interval of ``change``.
    significant : bool
        Whether that interval leaves out zero.
    lines, independent_lines : float
        Lines with the reference material in them, and how many independent ones they are worth.
    verdict : str
        A sentence.
    """

    change: float
    error: float
    lower: float
    upper: float
    significant: bool
    lines: int
    independent_lines: float
    verdict: str


def tip_radius(
    apparent_modulus: Any,
    reference_modulus: float,
    probe: Probe,
    *,
    poisson_ratio: float,
    apparent_error: float = 0.0,
    reference_error: float = 0.0,
    reference_poisson_ratio: float | None = None,
) -> TipRadius:
    """Return the radius of the tip from the modulus that a map gave a material of known modulus.

    Parameters
    ----------
    apparent_modulus : float or array
        Modulus of the reference material as the map has it [Pa], with the radius and the tip of ``probe``. Of an
        array the median of what is finite counts; over (y, x) the scatter of the medians of the lines is its error.
    reference_modulus : float
        Modulus of the material [Pa], at the frequency of the contact.
    probe : Probe
        The probe that the map was made with; its radius is the assumed one.
    poisson_ratio : float
        Poisson's ratio that the map was made with.
    apparent_error, reference_error : float
        Relative standard errors of the two moduli: for a map those that all pixels share, such as of the offset of
        A0, the stiffness and the gains.
    reference_poisson_ratio : float, optional
        Poisson's ratio of the material where it is another one.

    Returns
    -------
    TipRadius
        With the probe to map the scan anew with.

    Raises
    ------
    ProbeError
        If the probe has no radius.
    ObservablesError
        If no pixel is finite, or a modulus is not positive.
    OvertoneError
        If an error is negative.

    Notes
    -----
    For a sphere or paraboloid, whose contact goes as sqrt(R). Only as good as the reference: the modulus of a
    polymer at the frequency of the lever may be twice that of its data sheet.
    """
    assumed = required_radius(probe)
    for name, error in (("apparent_error", apparent_error), ("reference_error", reference_error)):
        if not 0.0 <= error < math.inf:
            raise OvertoneError(f"unusable {name}", expected="a relative error of 0 or more", got=repr(error))
    modulus, scatter = _median(apparent_modulus)
    if not (math.isfinite(reference_modulus) and reference_modulus > 0.0):
        raise ObservablesError(
            "unphysical reference modulus", expected="Pa above 0", got=repr(reference_modulus)
        )
    true_ratio = poisson_ratio if reference_poisson_ratio is None else reference_poisson_ratio
    apparent, apparent_share = _contact(modulus, poisson_ratio, probe)
    true, true_share = _contact(reference_modulus, true_ratio, probe)
    error = 2.0 * math.hypot(
        apparent_share * math.hypot(apparent_error, scatter), true_share * reference_error
    )
    radius = assumed * (apparent / true) ** 2
    spread = math.exp(_NORMAL_90 * error)
    return TipRadius(
        radius=radius,
        relative_error=error,
        lower=radius / spread,
        upper=radius * spread,
        assumed_radius=assumed,
        probe=replace(probe, tip=replace(probe.tip, radius=radius)),
    )


def tip_wear(
    apparent_modulus: xr.DataArray,
    probe: Probe,
    *,
    poisson_ratio: float,
    first: str | None = None,
) -> TipWear:
    """Say whether the tip wore over a scan, from the apparent modulus of the reference material.

    Parameters
    ----------
    apparent_modulus : DataArray, dims (y, x), (y,) or (time,)
        Modulus of the reference material [Pa] with one assumed radius, NaN in every other pixel. Lines are summed
        up by their medians.
    probe : Probe
        The probe that the map was made with.
    poisson_ratio : float
        Poisson's ratio that the map was made with.
    first : str
        Which line was scanned first, ``top`` or ``bottom``: without it wear and its reverse cannot be told apart.
        Not needed over ``time``.

    Returns
    -------
    TipWear
        A robust trend (Theil-Sen) of ln R, with an interval that counts how alike neighbouring lines are.

    Raises
    ------
    ObservablesError
        If there are too few lines, no slow axis, or a modulus is not positive.

    Notes
    -----
    Every drift that changes the apparent modulus, of A0 above all, looks like wear or hides it. Correlation is taken
    for that of a first-order process: drift that is slower counts as a trend.
    """
    dims = set(apparent_modulus.dims)
    slow = next((name for name in ("time", "y") if name in dims), None)
    if slow is None or not dims <= {slow, "x"}:
        raise ObservablesError(
            "the apparent modulus has no slow axis",
            expected="dimensions (y, x), (y,) or (time,)",
            got=str(apparent_modulus.dims),
        )
    if slow == "y" and first not in ("top", "bottom"):
        raise ObservablesError(
            "it is not said which line was scanned first", expected='first="top" or "bottom"', got=repr(first)
        )
    positions = (
        apparent_modulus["time"].values.astype(float)
        if slow == "time" and "time" in apparent_modulus.coords
        else np.arange(apparent_modulus.sizes[slow], dtype=float)
    )
    if slow == "y" and first == "bottom":
        positions = -positions
    t, lines = _lines(apparent_modulus, slow, positions)
    if lines.size < _LEAST_LINES or np.ptp(t) == 0.0:
        raise ObservablesError(
            "too few lines with the reference material",
            expected=f"{_LEAST_LINES} or more",
            got=str(lines.size),
        )
    radius = 2.0 * np.log(effective_modulus(np.exp(lines), poisson_ratio, *_tip(probe)))
    x = (t - t.min()) / np.ptp(t)
    order = np.argsort(x, kind="stable")
    x, radius = x[order], radius[order]
    change = _theil_sen(x, radius)
    residual = radius - change * x
    residual -= np.median(residual)
    correlation = _correlation(residual, trend=True)
    independent = max(lines.size * (1.0 - correlation) / (1.0 + correlation), 2.5)
    variance = float(np.sum(residual**2)) / max(lines.size - 2, 1)
    # A detrended series shows less than its variance where its lines are alike.
    variance *= 1.0 / max(1.0 - 2.0 / independent, 0.2)
    error = math.sqrt(
        variance / float(np.sum((x - x.mean()) ** 2)) * (1.0 + correlation) / (1.0 - correlation)
    )
    reach = _student_90(max(independent - 2.0, 1.0)) * error
    lower, upper = change - reach, change + reach
    enough = independent >= _LEAST_INDEPENDENT
    significant = bool(enough and not lower <= 0.0 <= upper)
    return TipWear(
        change=change,
        error=error,
        lower=lower,
        upper=upper,
        significant=significant,
        lines=int(lines.size),
        independent_lines=independent,
        verdict=_verdict(change, lower, upper, significant, enough),
    )


def _verdict(change: float, lower: float, upper: float, significant: bool, enough: bool) -> str:
    if not enough:
        return "whether the tip wore cannot be told: the lines are too much alike to be many."
    percent, half = 100.0 * math.expm1(change), 50.0 * (math.expm1(upper) - math.expm1(lower))
    if significant and change > 0.0:
        return f"the radius grew by {_short(percent)} +- {_short(half)} % over the scan (90 %)."
    if significant:
        return (
            f"the apparent radius fell by {_short(-percent)} +- {_short(half)} % over the scan (90 %), "
            "which no wear does: something else drifted."
        )
    return f"no wear beyond {_short(100.0 * math.expm1(upper))} % over the scan (95 %)."


def _short(percent: float) -> str:
    return f"{percent:.0f}" if abs(percent) >= 9.95 else f"{percent:.2g}"


# --- medians, trends and how alike neighbours are ---------------------------------------------------


def _tip(probe: Probe) -> tuple[float, float]:
    return probe.tip.modulus, probe.tip.poisson_ratio


def _contact(modulus: float, poisson_ratio: float, probe: Probe) -> tuple[float, float]:
    """Return E* [Pa] and d ln E*/d ln E, the share of the sample in the compliance."""
    star = float(effective_modulus(modulus, poisson_ratio, *_tip(probe)))
    return star, star * (1.0 - poisson_ratio**2) / modulus


def _median(apparent: Any) -> tuple[float, float]:
    """Return the median modulus, and the standard error of its logarithm as the lines scatter."""
    values = np.asarray(getattr(apparent, "values", apparent), dtype=float)
    _check(values)
    if values.ndim == 0 or values.size == 1:
        return float(values.ravel()[0]), 0.0
    array = apparent if isinstance(apparent, xr.DataArray) else None
    median = float(np.median(values[np.isfinite(values)]))
    if array is not None and "y" in array.dims and array.sizes["y"] >= _LEAST_LINES:
        _, series = _lines(array, "y", np.arange(array.sizes["y"], dtype=float))
    else:
        series = np.log(values[np.isfinite(values)].ravel())
    if series.size < 3:
        return median, 0.0
    correlation = _correlation(series - series.mean(), trend=False)
    independent = max(series.size * (1.0 - correlation) / (1.0 + correlation), 1.0)
    spread = float(np.std(series, ddof=1))
    # A median of normal values scatters a quarter more than their mean.
    return median, 1.2533 * spread / math.sqrt(independent)


def _check(values: _Array) -> None:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        raise ObservablesError(
            "there is no apparent modulus", expected="at least one finite pixel", got=f"{values.size} NaN"
        )
    if (finite <= 0.0).any():
        raise ObservablesError("unphysical apparent modulus", expected="Pa above 0", got=f"{finite.min():g}")


def _lines(array: xr.DataArray, slow: str, positions: _Array) -> tuple[_Array, _Array]:
    """Return position and ln of the median of every line that has one."""
    others = [name for name in array.dims if name != slow]
    values = array.transpose(slow, *others).values.astype(float).reshape(array.sizes[slow], -1)
    _check(values)
    found = np.isfinite(values).any(axis=1) & np.isfinite(positions)
    medians = np.array([np.median(line[np.isfinite(line)]) for line in values[found]])
    return positions[found], np.log(medians)


def _theil_sen(x: _Array, y: _Array) -> float:
    """Return the median slope of all pairs."""
    first, second = np.triu_indices(x.size, 1)
    apart = x[second] != x[first]
    first, second = first[apart], second[apart]
    return float(np.median((y[second] - y[first]) / (x[second] - x[first])))


def _correlation(residual: _Array, *, trend: bool) -> float:
    """Return the correlation of neighbours, freed of the bias of short series; 0 to 0.95."""
    power = float(np.sum(residual**2))
    if power == 0.0:
        return 0.0
    found = float(np.sum(residual[1:] * residual[:-1])) / power
    size = residual.size
    # Taking out a mean pulls the estimate down by (1 + 3 rho)/n, a trend by (2 + 4 rho)/n (Kendall).
    corrected = found + ((2.0 + 4.0 * found) if trend else (1.0 + 3.0 * found)) / size
    return min(max(corrected, 0.0), 0.95)


def _student_90(dof: float) -> float:
    from scipy import stats

    return float(stats.t.ppf(0.95, dof))

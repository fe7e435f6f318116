"""What the instrument adds where there is no sample: regressions on data taken far from the surface.

    A0  = offset + slope (Z - Z_0) + K0_0 u + K0_1 u^2                     u = |a1|^2/A_ref^2
    a_n = (K_n0 + K_n1 u + K_n2 u^2) (a1/A_ref)^n + d_n v + D_n v^2        v: drive over the one of the scan

``K`` is what the detector makes of the first harmonic, ``d`` is crosstalk of the drive and ``D`` the drive's own
harmonic. At one amplitude nothing tells them apart; over a frequency ladder at constant drive everything does; over a
ladder of drives ``K`` and ``D`` stay mixed. So every coefficient has a prior, and what the data leave open keeps its
width: the answer is a mean and a covariance, not a choice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import ObservablesError
from overtone.instrument.signals import Signals
from overtone.instrument.unknowns import HIGHER, TERMS, distortion_basis

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

PRIORS: Mapping[str, float] = {
    "A0_offset": 1e-6,
    "A0_slope_z": 0.02,
    "distortion": 0.3e-9,
    "crosstalk": 0.1e-9,
    "compression": 0.01,
}
"""Standard deviations before any far-field data [SI]: ``distortion`` of what the detector adds to a harmonic at the
free amplitude (each quadrature), of higher powers a third and a tenth of it; ``compression`` where no third harmonic
tells."""
_POWERS = (1.0, 0.3, 0.1)
_OPEN = 0.3  # of a prior's width: wider, and the data have not decided
_FEWEST = 3
_LEAST_NOISE = 1e-15  # [m], of data without any
_ELECTRONICS = 0.4  # of a term of the detector: what gain and latency, not known yet, make of it
_ALIKE = 0.2  # of the free amplitude: amplitudes that differ by less are one
_FAR_OFF = 0.2  # of the prior of a distortion
_MODEL = 0.15  # of the compression: the gain of the third harmonic, from which it is told, is not known yet


@dataclass(frozen=True)
class FarField:
    """What far-field data say of the instrument.

    Parameters
    ----------
    values : mapping
        Unknowns that they bear on, with their estimates.
    covariance : array (name, name)
        In the order of ``values``.
    noise : mapping
        Scatter of each observable about the regression [m, rad]: ``A0``, ``A1``, ``phi1``, ``A2``, ...
    findings : tuple of str
        What could not be told apart, and what was assumed.
    """

    values: Mapping[str, float]
    covariance: _Floats
    noise: Mapping[str, float]
    findings: tuple[str, ...]


@dataclass(frozen=True)
class FarPoints:
    """Readings far from the surface, flat.

    Parameters
    ----------
    signals : Signals
        As read.
    drive : array (point,)
        Drive over the one of the scan.
    height : array (point,)
        Z [m]; NaN where it was not recorded.
    group : array (point,)
        Set to which a reading belongs, from 0: between sets the spot may have moved, and heights have other origins.
    """

    signals: Signals
    drive: _Floats
    height: _Floats
    group: npt.NDArray[np.int64]


def joined(parts: Sequence[FarPoints]) -> FarPoints:
    """Return several sets of readings as one, with the harmonics that all of them have."""
    orders = set.intersection(*(set(part.signals.orders) for part in parts))
    means = [part.signals.mean for part in parts if part.signals.mean is not None and 0 in orders]
    phasors = {n: np.concatenate([p.signals.phasor[n] for p in parts]) for n in sorted(orders - {0})}
    return FarPoints(
        Signals(np.concatenate(means) if means else None, phasors),
        np.concatenate([part.drive for part in parts]),
        np.concatenate([part.height for part in parts]),
        np.concatenate([np.full(part.drive.size, k) for k, part in enumerate(parts)]),
    )


def _regress(
    design: _Floats, data: _Floats, prior: _Floats, sigma: float | None, floor: float
) -> tuple[_Floats, _Floats, float]:
    """Return mean, covariance and noise of linear coefficients with zero-mean Gaussian priors.

    The noise is that of the residuals where it is not given and enough of them are left.
    """
    rank = int(np.linalg.matrix_rank(design / np.maximum(np.abs(design).max(axis=0), 1e-300)))
    free = data.size - rank
    if sigma is None:
        best = np.linalg.lstsq(design, data, rcond=None)[0]
        left = data - design @ best
        sigma = math.sqrt(float(left @ left) / free) if free > 0 else math.nan
    if not sigma > 0.0:
        sigma = floor
    sigma = max(sigma, _LEAST_NOISE)
    # scaled by the priors, so that the matrix to invert is near one where the data say nothing
    # by orthogonal factors: the normal equations would lose the picometres beside a wide prior
    orthogonal, triangle = np.linalg.qr(np.concatenate([design * prior / sigma, np.eye(prior.size)]))
    inverse = np.linalg.inv(triangle)
    mean = prior * (inverse @ (orthogonal[: data.size].T @ (data / sigma)))
    root = prior[:, None] * inverse
    return mean, root @ root.T, sigma


def far_field(
    points: FarPoints,
    *,
    reference: float,
    centre_height: float = 0.0,
    noise: Mapping[str, float] | None = None,
    priors: Mapping[str, float] | None = None,
) -> FarField:
    """Return what data far from the surface say of offsets, distortion and crosstalk.

    Parameters
    ----------
    points : FarPoints
        At one amplitude, over a ladder of drive frequencies at constant drive, or of drives; frequencies within a
        few linewidths of the resonance, so that amplitudes span what the scan will see.
    reference : float
        A_ref [m], the free amplitude.
    centre_height : float
        Height [m] at which the offset of A0 is quoted.
    noise : mapping, optional
        Standard deviation of ``A0``, ``A2``, ``A3`` [m]; the scatter of the data where not stated.
    priors : mapping, optional
        Replaces entries of `PRIORS`.

    Raises
    ------
    ObservablesError
        If there are fewer than three points.
    """
    count = points.drive.size
    if count < _FEWEST:
        raise ObservablesError(
            "too few readings far from the surface",
            expected=f"{_FEWEST} or more",
            got=str(count),
            hint="a curve that begins farther away, or far_field= with a frequency ladder",
        )
    width = {**PRIORS, **(priors or {})}
    stated = dict(noise or {})
    first = points.signals.phasor[1]
    values: dict[str, float] = {}
    blocks: list[_Floats] = []
    findings: list[str] = []
    scatter: dict[str, float] = {}

    # the third harmonic first: it tells how the detector bends, which the others need to know
    orders = [n for n in HIGHER if n in points.signals.phasor]
    found: dict[int, tuple[dict[str, float], _Floats]] = {}
    compression, doubt = 0.0, width["compression"]
    if 3 in orders:
        found[3], scatter["A3"], sentences = _harmonic(
            3, points.signals.phasor[3], first, points.drive, reference, width, stated.get("A3")
        )
        findings += sentences
        # the latency of the electronics turns it, and leaves its size; a detector that bends the other way is rare
        bend = complex(found[3][0]["distortion3_0_re"], found[3][0]["distortion3_0_im"])
        index = list(found[3][0]).index("distortion3_0_re")
        compression = math.copysign(3.0 * abs(bend) / reference, -bend.real)
        # both quadratures: which of them is the detector's own, the latency decides
        error = (
            3.0 * math.sqrt(float(np.trace(found[3][1][index : index + 2, index : index + 2]))) / reference
        )
        doubt = min(math.hypot(error, _MODEL * compression), doubt)
    else:
        findings.append(
            f"no third harmonic far from the surface: how much of A1 the detector loses at "
            f"{reference * 1e9:.3g} nm is not known, and taken as 0 +- {100 * doubt:.2g} %"
        )
    moved: _Floats | None = None
    if points.signals.mean is not None:
        mean, moved, scatter["A0"], sentences = _mean(
            points.signals.mean,
            points,
            reference,
            centre_height,
            (compression, doubt),
            width,
            stated.get("A0"),
        )
        values |= mean[0]
        blocks.append(mean[1])
        findings += sentences
    values["compression"] = compression
    blocks.append(np.array([[doubt**2]]))
    if 2 in orders:
        data, beside = points.signals.phasor[2], None
        # a spot that has moved distorts otherwise, by as much as is known of the compression
        if moved is not None:
            for k in np.unique(points.group):  # a set without any A0 counts as unmoved
                if not np.isfinite(moved[points.group == k]).any():
                    moved = np.where(points.group == k, 0.0, moved)
            by_moving = -2.0 * moved * (first / reference) ** 2
            data = data - compression * by_moving
            beside = by_moving, math.hypot(doubt, _ELECTRONICS * compression)
            far_off = float(np.nanmax(moved) - np.nanmin(moved))
            if abs(compression) * far_off > _FAR_OFF * width["distortion"]:
                findings.append(
                    f"the spot moved by {far_off * 1e9:.3g} nm between the far-field data, which changes the "
                    "distortion: take them all at the height of the curve's far part"
                )
        found[2], scatter["A2"], sentences = _harmonic(
            2, data, first, points.drive, reference, width, stated.get("A2"), beside
        )
        findings += sentences
    for n in orders:
        values |= found[n][0]
        blocks.append(found[n][1])
    return FarField(values, _diagonal(blocks), scatter, tuple(findings))


def _diagonal(blocks: Sequence[_Floats]) -> _Floats:
    size = sum(block.shape[0] for block in blocks)
    result, at = np.zeros((size, size)), 0
    for block in blocks:
        result[at : at + block.shape[0], at : at + block.shape[0]] = block
        at += block.shape[0]
    return result


def _harmonic(
    n: int,
    data: _Complex,
    first: _Complex,
    drive: _Floats,
    reference: float,
    width: Mapping[str, float],
    sigma: float | None,
    beside: tuple[_Complex, float] | None = None,
) -> tuple[tuple[dict[str, float], _Floats], float, list[str]]:
    """Return distortion and crosstalk of a harmonic with their covariance, its noise, and what to say.

    ``beside`` is a further column whose coefficient is 0 but for a standard deviation.
    """
    good = np.isfinite(data) & np.isfinite(first)
    basis = distortion_basis(first[good], n, reference)
    v = drive[good]
    ladder = bool(np.ptp(v) > 1e-3 * np.abs(v).max()) if v.size else False
    columns = [basis, v[:, None] + 0j] + ([v[:, None] ** 2 + 0j] if ladder else [])
    columns += [beside[0][good, None]] if beside is not None else []
    B = np.concatenate(columns, axis=1)
    # complex coefficients as pairs of real ones: c B = (re + i im) B
    design = np.concatenate(
        [
            np.stack([B.real, -B.imag], -1).reshape(v.size, -1),
            np.stack([B.imag, B.real], -1).reshape(v.size, -1),
        ]
    )
    stacked = np.concatenate([data[good].real, data[good].imag])
    prior = [width["distortion"] * power for power in _POWERS] + [width["crosstalk"]] * (1 + ladder)
    prior += [beside[1]] if beside is not None else []
    mean, covariance, noise = _regress(design, stacked, np.repeat(prior, 2), sigma, 1e-12)
    turn = np.eye(2 * (TERMS + 1), mean.size)
    if ladder:  # at the drive of the scan both parts of it are there
        turn[2 * TERMS, 2 * TERMS + 2] = turn[2 * TERMS + 1, 2 * TERMS + 3] = 1.0
    mean, covariance = turn @ mean, turn @ covariance @ turn.T
    names = [f"distortion{n}_{j}_{part}" for j in range(TERMS) for part in ("re", "im")]
    names += [f"crosstalk{n}_re", f"crosstalk{n}_im"]
    sentences = []
    unsure = math.sqrt(float(covariance[2 * TERMS, 2 * TERMS]))
    if unsure > _OPEN * width["crosstalk"]:
        why = _why_open(first, reference)
        if ladder:
            why = "over a ladder of drives the drive's own harmonic grows as distortion does"
        kappa, d = (math.hypot(*mean[i : i + 2]) for i in (0, 2 * TERMS))
        sentences.append(
            f"distortion and crosstalk of harmonic {n} cannot be told apart: {why}. What is seen was shared out by "
            f"their priors ({width['distortion'] * 1e12:.3g} and {width['crosstalk'] * 1e12:.3g} pm), "
            f"{kappa * 1e12:.3g} and {d * 1e12:.3g} pm, each +- {unsure * 1e12:.3g} pm; a frequency ladder at constant "
            "drive tells them apart"
        )
    return (dict(zip(names, map(float, mean), strict=True)), covariance), noise, sentences


def _why_open(first: _Complex, reference: float) -> str:
    """Return why readings at these amplitudes leave something open."""
    span = float(np.nanmax(np.abs(first)) - np.nanmin(np.abs(first)))
    alike = span < _ALIKE * reference
    return "the far-field data have one amplitude" if alike else "the far-field data are too few or too noisy"


def _mean(
    data: _Floats,
    points: FarPoints,
    reference: float,
    centre: float,
    compression: tuple[float, float],
    width: Mapping[str, float],
    sigma: float | None,
) -> tuple[tuple[dict[str, float], _Floats], _Floats, float, list[str]]:
    """Return offset, slope and distortion of the mean with covariance, what moved the spot, noise, what to say.

    ``compression`` is an estimate and its standard deviation.
    """
    chi, doubt = compression
    basis = distortion_basis(points.signals.phasor[1], 0, reference).real
    u = basis[:, 0]
    weakened = (1.0 - 2.0 * chi * u) / (1.0 - 2.0 * chi)
    # every set of readings has a position of the spot of its own, and heights from an origin of its own
    groups = range(1, int(points.group.max()) + 1)
    position = (
        np.stack([weakened * (points.group == k) for k in groups], -1) if groups else np.empty((data.size, 0))
    )
    origin = np.array([centre, *(_middle(points.height[points.group == k]) for k in groups)])
    height = np.nan_to_num(points.height - origin[points.group])
    design = np.column_stack([np.ones(data.size), height * weakened, basis, position])
    prior = [
        width["A0_offset"],
        width["A0_slope_z"],
        *(width["distortion"] * p for p in _POWERS[: TERMS - 1]),
    ]
    prior += [width["A0_offset"]] * len(groups)
    good = np.isfinite(data) & np.isfinite(u)
    mean, _, _ = _regress(design[good], data[good], np.array(prior), sigma, 1e-11)
    # how much the detector weakens a spot that has moved is known no better than the compression is
    moving = (height * mean[1] + position @ mean[4:] / weakened) * 2.0 * (1.0 - u) / (1.0 - 2.0 * chi) ** 2
    design, prior = np.column_stack([design, moving]), [*prior, doubt]
    mean, covariance, noise = _regress(design[good], data[good], np.array(prior), sigma, 1e-11)
    names = ["A0_offset", "A0_slope_z", "distortion0_0", "distortion0_1"]
    mean, covariance = mean[: len(names)], covariance[: len(names), : len(names)]
    sentences = []
    unsure = math.sqrt(float(covariance[2, 2]))
    if unsure > _OPEN * width["distortion"]:
        sentences.append(
            f"offset and distortion of A0 cannot be told apart: {_why_open(points.signals.phasor[1], reference)}. "
            f"Where the amplitude falls to nothing A0 is unsure by {unsure * 1e12:.3g} pm; a frequency ladder at "
            "constant drive decides"
        )
    moved = (data - mean[0] - basis @ mean[2:]) / weakened
    return (dict(zip(names, map(float, mean), strict=True)), covariance), moved, noise, sentences


def _middle(height: _Floats) -> float:
    known = height[np.isfinite(height)]
    return float(known.mean()) if known.size else 0.0


def ladder_points(observables: Any) -> FarPoints:
    """Return far-field readings of a dataset, any dimensions.

    Parameters
    ----------
    observables : Dataset
        A1, phi1 and what else was recorded; optional ``drive`` (relative to the drive of the scan, 1 unless given) and
        ``z`` [m] as coordinates or variables.
    """
    from overtone.instrument.signals import signals_of

    signals = signals_of(observables)
    like = observables["A1"]

    def beside(names: Sequence[str], default: float) -> _Floats:
        for name in names:
            if name in observables or name in observables.coords:
                return np.asarray(
                    observables[name].broadcast_like(like).transpose(*like.dims).values, float
                ).ravel()
        return np.full(like.size, default)

    flat = Signals(
        signals.mean.ravel() if signals.mean is not None else None,
        {n: a.ravel() for n, a in signals.phasor.items()},
    )
    return FarPoints(
        flat, beside(["drive"], 1.0), beside(["z", "Z"], math.nan), np.zeros(like.size, np.int64)
    )

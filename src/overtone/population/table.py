"""The table of materials of a scan, what of it can be trusted, and the check of what was left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.instrument.gates import CONTRAST
from overtone.inversion.forces import Rows
from overtone.inversion.linear import stiffness
from overtone.population.evidence import inverse
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.held import PROPERTIES
from overtone.population.joint import Joint
from overtone.population.materials import MIXED, Question
from overtone.population.other_laws import Laws
from overtone.population.pooled import QUANTILES
from overtone.population.verdict import NINETY, verdict_of
from overtone.quantities import quantity

_Floats = npt.NDArray[np.float64]

_WIDE = np.array([4.0, 2.0, 2.0, 3.0])
"""Standard deviations of ln E, ln F_ad, ln tan and t before anything was measured, for the linear checks."""


@dataclass(frozen=True)
class Material:
    """A phase of a scan and its joint posterior.

    Parameters
    ----------
    index, pixels, domains : int
        Which phase, how many pixels and connected domains.
    resolved : bool
        Whether it is one material, as far as the scan can tell.
    reference : bool
        Whether it is the one of known modulus.
    joint : Joint or None
        What was inferred of it and others; None where the model cannot make its forces.
    place : int
        Which of them it is there.
    """

    index: int
    pixels: int
    domains: int
    resolved: bool
    reference: bool
    joint: Joint | None
    place: int

    @cached_property
    def misfit(self) -> float:
        """chi-squared of the phase by itself, with all that its errors allow."""
        return _misfit(self.joint, self.place) if self.joint is not None else math.nan

    @property
    def settled(self) -> bool:
        """Whether its draws are those of one distribution."""
        return self.joint is not None and bool(self.joint.draws.mixing[self.place] <= MIXED)

    @property
    def freedom(self) -> int:
        """Harmonics beyond the unknowns."""
        if self.joint is None:
            return 1
        rows, scans = int(self.joint.draws.scene.orders.size), int(self.joint.draws.scene.amplitude.shape[1])
        free = int((self.joint.spreads[self.place].value > 0.0).sum())
        return max(rows * scans - free - scans, 1)

    @property
    def misfit_probability(self) -> float:
        """Chance of a larger misfit if the model is right."""
        from scipy.stats import chi2

        return float(chi2.sf(self.misfit, self.freedom))


@dataclass(frozen=True)
class Materials:
    """The table, as arrays of a dataset and its attributes."""

    arrays: Mapping[str, xr.DataArray]
    attributes: Mapping[str, object]


def materials_of(
    materials: Sequence[Material],
    names: Sequence[str],
    question: Question,
    rows: Rows,
    exponent: float,
    known: Mapping[int, tuple[float, float]],
    note: str,
    anchored: bool,
    calibrated: bool,
    laws: Laws,
) -> Materials:
    """Return the table of materials.

    Parameters
    ----------
    materials : sequence of Material
        Every phase of the scan.
    names : sequence of str
        What they are called.
    question : Question
        Model, lever, priors.
    rows : Rows
        Force harmonics in use.
    exponent : float
        Change of ln of the elastic unknown with ln R at a given force.
    known : mapping of int to (float, float)
        ln of a modulus that was given, and its error, by phase.
    note : str
        How the number of phases came about.
    anchored : bool
        Whether the scan was anchored to its reference before.
    calibrated : bool
        Whether it has a calibration at all.
    laws : Laws
        What other laws of contact would make of them.
    """
    count = len(materials)
    columns: dict[str, _Floats] = {}

    def column(name: str) -> _Floats:
        return columns.setdefault(name, np.full(count, math.nan))

    for i, material in enumerate(materials):
        if material.joint is None:
            continue
        values = draws_of(question, material, exponent)
        spreads = dict(
            zip(
                ("modulus", "adhesion", "loss_tangent"),
                material.joint.spreads[material.place].value,
                strict=True,
            )
        )
        own = _statistical(material)
        for name, draws in values.items():
            low, middle, high = np.quantile(draws, QUANTILES)
            column(f"material_{name}")[i] = math.exp(middle)
            column(f"material_{name}_lower")[i], column(f"material_{name}_upper")[i] = (
                math.exp(low),
                math.exp(high),
            )
            # of the middle 90 %: the logarithm of what may vanish has no standard deviation
            total = float(high - low) / NINETY
            if name in own:
                statistical = min(own[name], total)
                if name == "modulus" and material.index in known:
                    # that the stated modulus is off is an error of all pixels
                    statistical = math.sqrt(max(total**2 - known[material.index][1] ** 2, 0.0))
                column(f"material_{name}_statistical")[i] = statistical
                column(f"material_{name}_systematic")[i] = math.sqrt(max(total**2 - statistical**2, 0.0))
            if name in spreads and spreads[name] > 0.0:
                column(f"material_{name}_spread")[i] = spreads[name]
        column("material_misfit")[i] = material.misfit
        column("material_misfit_probability")[i] = material.misfit_probability
    _ratios(materials, question, exponent, known, column)
    column("material_modulus_law")[:] = laws.error
    arrays = {name: _array(name, values, names) for name, values in columns.items()}
    for name, whole in (
        ("material_pixels", np.array([m.pixels for m in materials], np.int64)),
        ("material_domains", np.array([m.domains for m in materials], np.int64)),
        ("material_resolved", np.array([m.resolved for m in materials], np.int8)),
        ("material_reference", np.array([m.reference for m in materials], np.int8)),
    ):
        arrays[name] = _array(name, whole, names)
    arrays |= _checks(materials, rows, names) | laws.arrays
    verdict, reason = verdict_of(materials, columns, names, anchored, laws.better)
    if not calibrated and verdict != CONTRAST:
        verdict, reason = CONTRAST, "the scan has no calibration: what all pixels share is in no interval"
    notes = [note]
    unresolved = [names[i] for i, m in enumerate(materials) if not m.resolved]
    if unresolved:
        notes.append(f"{', '.join(unresolved)}: merged, not resolved")
    restless = [names[i] for i, m in enumerate(materials) if m.joint is not None and not m.settled]
    if restless:
        notes.append(f"the draws of {', '.join(restless)} have not settled: their intervals are rough")
    return Materials(arrays, {"verdict": verdict, "verdict_reason": reason, "phase_note": "; ".join(notes)})


def draws_of(question: Question, material: Material, exponent: float) -> dict[str, _Floats]:
    """Return draws of ln of every property of the median of a phase."""
    joint = material.joint
    assert joint is not None
    k, draws = material.place, joint.draws
    of_radius = exponent * (draws.z @ joint.evidence.radius)
    x, v = draws.ln_E[:, k], draws.unknowns[:, k]
    t = v[:, FIRST_DEPTH]
    found = {"modulus": x + of_radius}
    amplitude = joint.tiles[k].amplitude[0]
    found["indentation"] = math.log(2.0 * amplitude) - np.log1p(np.exp(-t))
    if question.sticky:
        found["adhesion"] = v[:, ADHESION] + math.log(joint.evidence.unit)
    if question.loss:
        S = np.array([stiffness(question.columns.contact, math.exp(value))[0] for value in x])
        found["loss_tangent"] = v[:, TANGENT]
        found["viscosity"] = np.log(S / question.columns.loss) + v[:, TANGENT] + of_radius
    return found


def _data_of(joint: Joint, k: int) -> slice:
    """Return where the harmonics of a phase stand among all."""
    size = joint.tiles[k].y.shape[1]
    return slice(k * size, (k + 1) * size)


def _slopes(joint: Joint, k: int) -> tuple[_Floats, _Floats]:
    """Return how the harmonics of a phase go with ln of its properties and its t, and how wide these are beforehand."""
    J = np.concatenate([joint.responses[k].J, joint.responses[k].along], axis=1)
    return J, np.concatenate([_WIDE[:PROPERTIES], np.full(J.shape[1] - PROPERTIES, _WIDE[-1])])


def _best(joint: Joint, k: int) -> tuple[_Floats, _Floats]:
    """Return how far the draw that fits a phase best is off its harmonics, and the precision of these."""
    at = _data_of(joint, k)
    W = inverse(joint.evidence.covariance[at, at])
    off = joint.draws.forces[:, at] - joint.evidence.centre[at]
    return off[int(np.argmin(np.einsum("di,ij,dj->d", off, W, off)))], W


def _statistical(material: Material) -> dict[str, float]:
    """Return standard deviations of ln of the properties were the calibration known; to first order."""
    joint, k = material.joint, material.place
    assert joint is not None
    at = _data_of(joint, k)
    J, wide = _slopes(joint, k)
    W = inverse(joint.evidence.statistical[at, at])
    covariance = inverse(J.T @ W @ J + np.diag(wide**-2.0))
    sd = np.sqrt(np.diag(covariance))
    return {"modulus": float(sd[0]), "adhesion": float(sd[1]), "loss_tangent": float(sd[2])}


def _misfit(joint: Joint, k: int) -> float:
    """Return the least chi-squared of a phase by itself, linear about the best of its draws."""
    off, W = _best(joint, k)
    J, _ = _slopes(joint, k)
    J = J[:, np.abs(J).max(axis=0) > 0.0]
    # the draws scatter about the best fit; what a step of the unknowns would still take off does not count
    root = np.linalg.cholesky(W).T
    step = np.linalg.lstsq(root @ J, -root @ off, rcond=1e-9)[0]
    left = off + J @ step
    return float(left @ W @ left)


def _ratios(
    materials: Sequence[Material],
    question: Question,
    exponent: float,
    known: Mapping[int, tuple[float, float]],
    column: Callable[[str], _Floats],
) -> None:
    """Fill the ratios of moduli to that of the reference."""
    which = [m for m in materials if m.reference and m.joint is not None]
    if not which:
        return
    reference = which[0]
    generator = np.random.default_rng(0)
    for i, material in enumerate(materials):
        if material.joint is None:
            continue
        draws = draws_of(question, material, exponent)["modulus"]
        if material.joint is reference.joint:
            other = draws_of(question, reference, exponent)["modulus"]
        else:
            value, error = known[reference.index]
            other = value + error * generator.standard_normal(draws.size)
        low, middle, high = np.exp(np.quantile(draws - other, QUANTILES))
        column("material_modulus_ratio")[i] = middle
        column("material_modulus_ratio_lower")[i], column("material_modulus_ratio_upper")[i] = low, high


def _array(name: str, values: npt.NDArray[np.generic], names: Sequence[str]) -> xr.DataArray:
    short = name.removeprefix("material_")
    for suffix in ("_lower", "_upper", "_spread", "_statistical", "_systematic", "_ratio"):
        short = short.removesuffix(suffix)
    record = quantity(short)
    plain = (
        any(name.endswith(end) for end in ("_spread", "_statistical", "_systematic", "_law"))
        or "_ratio" in name
    )
    unit = record.unit if record is not None and not plain else "1"
    meaning = _MEANINGS.get(name.removeprefix("material_"), "")
    if not meaning:
        base = record.meaning if record is not None else short
        ends = next((text for end, text in _ENDS.items() if name.endswith(end)), "median of the phase")
        meaning = f"{base}, {ends}"
    return xr.DataArray(
        values,
        dims=("material",),
        coords={"material": list(names)},
        attrs={"units": unit, "long_name": meaning},
    )


_MEANINGS = {
    "pixels": "pixels of the phase",
    "domains": "connected domains of the phase",
    "resolved": "whether the scan resolves it as one material: 0 merged, not resolved",
    "reference": "whether it is the reference",
    "misfit": "smallest chi-squared of the phase by itself",
    "misfit_probability": "chance of a larger misfit if the model is right",
    "modulus_law": "largest change of ln of the modulus under a law of contact that fits as well",
    "modulus_ratio": "modulus over that of the reference, median",
    "modulus_ratio_lower": "modulus over that of the reference, lower end of the 90 % interval",
    "modulus_ratio_upper": "modulus over that of the reference, upper end of the 90 % interval",
}
_ENDS = {
    "_lower": "lower end of the 90 % interval of the median of the phase",
    "_upper": "upper end of the 90 % interval of the median of the phase",
    "_spread": "standard deviation of its logarithm within the phase",
    "_statistical": "standard deviation of ln of the median of the phase, from noise and scatter",
    "_systematic": "standard deviation of ln of the median of the phase, from what the scan shares",
}


def _checks(materials: Sequence[Material], rows: Rows, names: Sequence[str]) -> dict[str, xr.DataArray]:
    """Return what each harmonic of a phase is, and what the others, under the model, say it should be."""
    labels: list[str] = []
    parts: list[tuple[_Floats, _Floats, _Floats]] = []
    for material in materials:
        joint = material.joint
        if joint is None:
            parts.append((np.empty(0), np.empty(0), np.empty(0)))
            continue
        scans = joint.draws.scene.amplitude.shape[1]
        if not labels:
            one = [
                f"{'DISS' if lossy else 'CONS'}_{n}" for n, lossy in zip(rows.orders, rows.lossy, strict=True)
            ]
            labels = one if scans == 1 else [f"{label} scan {s + 1}" for s in range(scans) for label in one]
        parts.append(_left_out(joint, material.place))
    size = len(labels)
    arrays = {}
    for i, (name, meaning) in enumerate(
        (
            ("check_observed", "mean of the force harmonics of the phase"),
            ("check_lower", "lower end of the 90 % interval that the other harmonics predict"),
            ("check_upper", "upper end of the 90 % interval that the other harmonics predict"),
        )
    ):
        values = np.array([p[i] if p[i].size == size else np.full(size, math.nan) for p in parts])
        arrays[name] = xr.DataArray(
            values.reshape(len(materials), size),
            dims=("material", "row"),
            coords={"material": list(names), "row": labels},
            attrs={"units": "N", "long_name": meaning},
        )
    return arrays


def _left_out(joint: Joint, k: int) -> tuple[_Floats, _Floats, _Floats]:
    """Return harmonics of a phase and the interval of each that all others predict, to first order."""
    at, unit = _data_of(joint, k), joint.evidence.unit
    J, wide = _slopes(joint, k)
    W = inverse(joint.evidence.covariance[at, at] + (J * wide**2) @ J.T)
    # as concluded from the readings, whatever is likelier of the calibration
    y = joint.evidence.mean[at]
    # about the draw that fits best
    off, _ = _best(joint, k)
    pull = -W @ off
    sd = 1.0 / np.sqrt(np.diag(W))
    predicted = y - pull / np.diag(W)
    reach = 0.5 * NINETY * sd
    return unit * y, unit * (predicted - reach), unit * (predicted + reach)

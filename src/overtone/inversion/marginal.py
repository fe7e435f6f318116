"""Method ``posterior``: medians and 90 % intervals of every pixel of a scan, and which model the data prefer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.contact.models import ContactModel
from overtone.inversion import posterior
from overtone.inversion.columns import Columns, unknowns_of
from overtone.inversion.motion import FEW, Followed, follow
from overtone.inversion.pixels import Pixels, Setting, radius_exponent
from overtone.inversion.priors import Prior, for_kernel, interval_width
from overtone.inversion.result import (
    DETERMINED,
    MISSING_DATA,
    NO_CONTACT,
    NOT_DETERMINED,
    POOR_FIT,
    WIDEST_DETERMINED,
    Sheet,
)
from overtone.inversion.table import Table
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]

BLOCK = 1024
_LIKELY = 0.95  # probability of contact, or of none, from which it counts as told
_AS_WIDE = 0.5  # share of the width of the prior from which an interval says no more than it
_COUNTS = 0.05  # probability from which a model counts in the interval of a pixel


@dataclass(frozen=True)
class Candidate:
    """A contact model with what it takes to sum its posterior."""

    record: ContactModel
    columns: Columns
    table: Table
    priors: Mapping[str, Prior]
    exponent: float

    @classmethod
    def of(
        cls,
        record: ContactModel,
        columns: Columns,
        setting: Setting,
        priors: Mapping[str, Prior],
        probe: Probe,
        given: Mapping[str, float],
    ) -> Candidate:
        """Return it for a scan."""
        return cls(record, columns, setting.table(columns), priors, radius_exponent(record, probe, given))

    @property
    def first(self) -> str:
        """Name of the elastic unknown."""
        return unknowns_of(self.record)[0].name

    @property
    def quantities(self) -> dict[str, int]:
        """Names of the quantities of this model, and where the kernel has them."""
        names = [q.name for q in unknowns_of(self.record)]
        where = {self.first: posterior.MODULUS_, "indentation": posterior.INDENTATION_}
        if "adhesion" in names:
            where["adhesion"] = posterior.ADHESION_
        for name in ("viscosity", "damping"):
            if name in names:
                where[name] = posterior.LOSS_
                where["loss_tangent"] = posterior.TANGENT_
        return where


def map_posteriors(
    setting: Setting,
    candidates: tuple[Candidate, ...],
    probe: Probe,
    sheet: Sheet,
    *,
    full_motion: bool,
    progress: Callable[[int, int], None] | None,
    parts: bool = True,
) -> None:
    """Fill a sheet with medians, intervals and status; of several models, with those of the one preferred.

    Parameters
    ----------
    setting : Setting
        The scan.
    candidates : tuple of Candidate
        One model, or several that have the same elastic unknown.
    probe : Probe
        Its lever.
    sheet : Sheet
        Filled.
    full_motion : bool
        Whether the harmonics of the motion count, or it is taken for a bare cosine.
    progress : callable, optional
        Called with (pixels done, pixels in all).
    parts : bool
        Whether the uncertainty is told apart into noise and shared errors, which takes a second sum over each pixel.

    Notes
    -----
    Of several models, each as likely before the data, the interval of a property reaches over those of every model that
    is left with a probability of `_COUNTS` and has the property.
    """
    names = list(dict.fromkeys(name for c in candidates for name in c.quantities))
    sheet.add(*(f"{name}{variant}" for name in names for variant in ("", "_unscreened", "_lower", "_upper")))
    apart = setting.shared is not None and parts
    sheet.add("uncertainty", *(["uncertainty_statistical", "uncertainty_systematic"] if apart else []))
    sheet.add("misfit", "log_evidence", "contact_probability")
    sheet.add("status", fill=MISSING_DATA, dtype="int8")
    if len(candidates) > 1:
        sheet.add("model", fill=-1, dtype="int8")
        sheet.add("model_probability")
        sheet.attributes["model"] = {
            "flag_values": [-1, *range(len(candidates))],
            "flag_meanings": " ".join(["none", *(c.record.key for c in candidates)]),
        }
    followed = follow(probe, setting.known, FEW if full_motion else 0)

    def run(block: slice) -> None:
        # models that go with the radius alike share the pixels
        pixels = {exponent: setting.pixels(block, exponent) for exponent in {c.exponent for c in candidates}}
        answers = [_answer(pixels[c.exponent], setting, c, followed, apart) for c in candidates]
        evidence = np.stack([a.summary[:, posterior.EVIDENCE_] for a in answers])
        known = np.isfinite(evidence).any(axis=0)
        best = np.argmax(np.where(np.isfinite(evidence), evidence, -np.inf), axis=0)
        with np.errstate(invalid="ignore"):
            relative = np.exp(evidence - np.where(known, np.take_along_axis(evidence, best[None], 0)[0], 0.0))
        relative = np.nan_to_num(relative)
        probability = relative / np.where(known, relative.sum(axis=0), 1.0)
        pick = np.arange(best.size)
        summary = np.stack([a.summary for a in answers])[best, pick]
        together: dict[str, _Floats] = {}
        for name in names:
            stack = np.stack([a.quantiles.get(name, np.full((best.size, 3), math.nan)) for a in answers])
            values = stack[best, pick]
            counted = (probability >= _COUNTS)[..., None] & np.isfinite(stack)
            lower = np.min(np.where(counted[..., 0], stack[..., 0], np.inf), axis=0)
            upper = np.max(np.where(counted[..., 2], stack[..., 2], -np.inf), axis=0)
            has = np.isfinite(values[:, 1])
            values[has, 0], values[has, 2] = lower[has], upper[has]
            together[name] = values
        status = _judge(summary, together[candidates[0].first], candidates, best, setting.rows.orders.size)
        status[~known] = MISSING_DATA
        sheet.put("status", block, status)
        for name, values in together.items():
            sheet.put(f"{name}_lower", block, values[:, 0])
            sheet.put(f"{name}_unscreened", block, values[:, 1])
            sheet.put(f"{name}_upper", block, values[:, 2])
            sheet.put(
                name,
                block,
                np.where(_sure(name, values, status, candidates[0].first), values[:, 1], math.nan),
            )
        sheet.put("uncertainty", block, summary[:, posterior.SPREAD_])
        if apart:
            statistical = np.stack([a.statistical for a in answers])[best, pick]
            with np.errstate(invalid="ignore"):
                rest = np.sqrt(np.maximum(summary[:, posterior.SPREAD_] ** 2 - statistical**2, 0.0))
            sheet.put("uncertainty_statistical", block, statistical)
            sheet.put("uncertainty_systematic", block, rest)
        sheet.put("misfit", block, summary[:, posterior.MISFIT_])
        sheet.put(
            "log_evidence", block, np.where(known, np.take_along_axis(evidence, best[None], 0)[0], math.nan)
        )
        sheet.put("contact_probability", block, summary[:, posterior.CONTACT_])
        if len(candidates) > 1:
            sheet.put("model", block, np.where(known, best, -1))
            sheet.put("model_probability", block, np.where(known, probability[best, pick], math.nan))

    run_blocks(run, sheet.like.size, BLOCK, progress)


@dataclass(frozen=True)
class _Answer:
    """What the kernel says of a block under one model."""

    quantiles: dict[str, _Floats]
    summary: _Floats
    statistical: _Floats


def _answer(
    pixels: Pixels, setting: Setting, candidate: Candidate, followed: Followed, apart: bool
) -> _Answer:
    size = pixels.y.shape[0]
    quantiles, summary = np.empty((size, posterior.QUANTITIES, 3)), np.empty((size, posterior.SUMMARIES))
    prior = for_kernel(candidate.priors, candidate.first)
    columns, rows = candidate.columns, setting.rows

    def integrate(whitening: _Floats, pull: _Floats, left: _Floats, whole: bool) -> None:
        posterior.posterior_pixels(
            pixels.y,
            whitening,
            pixels.amplitude,
            pixels.usable,
            columns,
            candidate.table,
            rows.orders,
            rows.lossy,
            setting.attraction,
            prior,
            followed,
            pixels.known,
            pull,
            left,
            whole,
            quantiles,
            summary,
        )

    statistical = np.full(size, math.nan)
    if apart:
        integrate(pixels.of_noise, np.zeros_like(pixels.pull), np.zeros_like(pixels.left), False)
        statistical = summary[:, posterior.SPREAD_].copy()
    integrate(pixels.whitening, pixels.pull, pixels.left, True)
    found = {}
    for name, where in candidate.quantities.items():
        values = quantiles[:, where].copy()
        if where == posterior.MODULUS_:
            values = np.exp(values)
        elif where == posterior.LOSS_:
            values = values / columns.loss
        found[name] = values
    return _Answer(found, summary, statistical)


def _judge(
    summary: _Floats,
    elastic: _Floats,
    candidates: tuple[Candidate, ...],
    best: npt.NDArray[np.intp],
    rows: int,
) -> npt.NDArray[np.int8]:
    """Return the status of every pixel; where several apply, the gravest."""
    from scipy.stats import chi2

    status = np.full(best.size, DETERMINED, np.int8)
    with np.errstate(invalid="ignore", divide="ignore"):
        width = np.log(elastic[:, 2] / elastic[:, 0])
    prior = np.array([interval_width(c.priors[c.first]) for c in candidates])[best]
    contact = summary[:, posterior.CONTACT_]
    status[~(width <= np.minimum(WIDEST_DETERMINED, _AS_WIDE * prior))] = NOT_DETERMINED
    status[~(contact >= _LIKELY)] = NOT_DETERMINED
    status[contact < 1.0 - _LIKELY] = NO_CONTACT
    spare = np.array([max(rows - len(unknowns_of(c.record)) - 1, 1) for c in candidates])[best]
    status[summary[:, posterior.MISFIT_] > chi2.isf(1e-3, spare)] = POOR_FIT
    return status


def _sure(name: str, values: _Floats, status: npt.NDArray[np.int8], first: str) -> npt.NDArray[np.bool_]:
    """Return where a property is determined: its own interval is narrow, and the model and the regime are right."""
    if name == first:
        return np.asarray(status == DETERMINED)
    apart = status == NO_CONTACT
    with np.errstate(invalid="ignore", divide="ignore"):
        ends = np.sort(np.abs(values[:, [0, 2]]), axis=1)
        narrow = ends[:, 1] <= math.exp(WIDEST_DETERMINED) * ends[:, 0]
    fine = (status == DETERMINED) | (status == NOT_DETERMINED)
    if name in ("adhesion", "indentation"):
        fine |= apart
    return np.asarray(fine & narrow)

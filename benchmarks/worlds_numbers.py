"""What the rows of many simulated worlds come to: the numbers of the page.

A number is a share or a median over so many answers, with what it is of and over which answers it was taken.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.models import contact_model
from overtone.demo import demo_probe
from overtone.inversion.priors import complete_priors, interval_width, of_single_pixels, shared_priors
from overtone.population.refit import LIKELY
from worlds_limit import PROPERTIES, STATED
from worlds_scores import CALIBRATIONS, CHECKED, KINDS, NOISES, NULLS, SEVERAL, WRONG
from worlds_setpoints import READINGS

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MATERIALS = ("PS", "LDPE", "third")
INTERPHASE = "interphase"
NINETY = 2.0 * 1.6448536269514722
UNLIKELY = 0.01
DEEP = 0.1
NEAR_NORMAL = 1.0
"""90 % width that the information limit gives ln of a modulus, below which a linear limit means something."""
_RADIUS = demo_probe().tip.radius
_ALONE = complete_priors(of_single_pixels(STATED), contact_model("dmt-viscous"), _RADIUS)
PRIORS = shared_priors(STATED, _ALONE, _RADIUS)
WIDTHS = {name: interval_width(PRIORS[name]) for name in PROPERTIES}
"""Of the 90 % interval of what is known beforehand; of ln of modulus and adhesion, of the loss tangent itself."""


class Number(NamedTuple):
    """A number of the page."""

    section: str
    of: str
    """Property, harmonic or method."""
    over: str
    """Which answers."""
    number: str
    value: float
    answers: int
    """That it was taken over."""


class Rows:
    """Rows of the table of answers, by column."""

    def __init__(self, rows: Sequence[Mapping[str, str]]) -> None:
        self.rows = list(rows)

    def __len__(self) -> int:
        return len(self.rows)

    def text(self, name: str) -> npt.NDArray[np.str_]:
        """Return a column as it is written."""
        return np.array([row.get(name) or "" for row in self.rows], dtype=str)

    def value(self, name: str) -> Array:
        """Return a column as numbers, NaN where there is none."""
        return np.array([float(row.get(name) or math.nan) for row in self.rows], dtype=float)

    def where(self, mask: Mask) -> Rows:
        """Return some of the rows."""
        return Rows([row for row, kept in zip(self.rows, mask, strict=True) if kept])

    def kind(self, *kinds: str) -> Rows:
        """Return the rows of worlds of some kinds that were inverted."""
        return self.where(np.isin(self.text("kind"), kinds) & (self.text("error") == ""))

    def equal(self, **values: object) -> Rows:
        """Return the rows in which columns have these values."""
        mask = np.ones(len(self), bool)
        for name, value in values.items():
            mask &= self.text(name) == str(value)
        return self.where(mask)


GROUPS: Mapping[str, Mapping[str, object]] = {
    "all": {},
    **{f"noise {noise} pm": {"noise": noise} for noise in NOISES},
    **{f"{name} calibration": {"calibration": name} for name in CALIBRATIONS},
    "without reference": {"reference": 0},
    "with reference": {"reference": 1},
    **{name: {"material": name} for name in MATERIALS},
}
"""What the answers for materials are split by."""


class Ends(NamedTuple):
    """Intervals of the median of a property, of several materials."""

    held: Mask
    known: Mask
    """Whether there is an interval."""
    narrow: Mask
    """Whether it is under half as wide as what is known beforehand."""
    log_width: Array


def ends_of(rows: Rows, name: str) -> Ends:
    """Return what the intervals of a property hold."""
    low, high, truth = (rows.value(f"{name}_{end}") for end in ("lower", "upper", "true"))
    known = np.isfinite(low) & np.isfinite(high)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_width = np.log(high / low)
    width = high - low if name == "loss_tangent" else log_width
    return Ends(
        known & (low <= truth) & (truth <= high), known, known & (width < 0.5 * WIDTHS[name]), log_width
    )


def numbers_of(rows: Rows) -> list[Number]:
    """Return all numbers of the page."""
    found: list[Number] = []
    for part in (_coverage, _pixels, _limits, _wrong, _nulls, _estimators, _predictions, _setpoints, _runs):
        found += part(rows)
    return found


def share(section: str, of: str, over: str, number: str, mask: Mask) -> Number:
    """Return a share."""
    return Number(section, of, over, number, float(mask.mean()) if mask.size else math.nan, mask.size)


def median(section: str, of: str, over: str, number: str, values: Array) -> Number:
    """Return a median of what is known."""
    fine = values[~np.isnan(values)]
    return Number(section, of, over, number, float(np.median(fine)) if fine.size else math.nan, fine.size)


def resolved(rows: Rows) -> Rows:
    """Return the rows of materials whose phase was found and is one material."""
    return rows.where((rows.value("found") == 1) & (rows.value("merged") == 0))


def of_materials(rows: Rows) -> Rows:
    """Return the rows of worlds that are what the model takes for granted."""
    some = rows.kind("three")
    return some.where(np.isin(some.text("material"), MATERIALS))


def _coverage(rows: Rows) -> list[Number]:
    found = []
    for over, values in GROUPS.items():
        some = of_materials(rows).equal(**values)
        whole, merged = some.value("found") == 1, some.value("merged") == 1
        found += [
            share("coverage", "phase", over, "resolved", whole & ~merged),
            share("coverage", "phase", over, "merged", whole & merged),
            share("coverage", "phase", over, "not found", ~whole),
        ]
        for part, mine in (("", resolved(some)), (" merged", some.where(whole & merged))):
            for name in PROPERTIES:
                ends = ends_of(mine, name)
                wide = ends.known & ~ends.narrow
                found += [
                    share("coverage", name, over, f"narrow{part}", ends.held[ends.narrow]),
                    share("coverage", name, over, f"wide{part}", ends.held[wide]),
                ]
                if name == "modulus":
                    flagged = mine.value("determined")[wide] < 0.5
                    found.append(share("coverage", name, over, f"wide flagged{part}", flagged))
        ratio = resolved(some).equal(reference=1)
        ratio = ratio.where((ratio.text("material") != "PS") & np.isfinite(ratio.value("ratio_true")))
        truth = ratio.value("ratio_true")
        held = (ratio.value("ratio_lower") <= truth) & (truth <= ratio.value("ratio_upper"))
        found.append(share("coverage", "ratio of moduli", over, "narrow", held))
    return found


def _pixels(rows: Rows) -> list[Number]:
    found = []
    for material in (*MATERIALS, INTERPHASE):
        for reference in (0, 1):
            some = rows.kind("three").equal(material=material, reference=reference)
            over = f"{material}, {'with' if reference else 'without'} reference"
            for name in PROPERTIES:
                count = some.value(f"pixel_{name}_count")
                pooled = some.value(f"pixel_{name}_pooled")
                for number, base in (("held", count), ("held_alone", count), ("pooled_held", pooled)):
                    held, total = np.nansum(some.value(f"pixel_{name}_{number}")), np.nansum(base)
                    value = float(held / total) if total else math.nan
                    found.append(Number("pixels", name, over, number, value, int(total)))
                for number in ("width", "width_alone"):
                    found.append(median("pixels", name, over, number, some.value(f"pixel_{name}_{number}")))
    return found


def _limits(rows: Rows) -> list[Number]:
    found = []
    for over, values in GROUPS.items():
        some = resolved(of_materials(rows)).equal(**values)
        normal = NINETY * some.value("modulus_limit") < NEAR_NORMAL
        for name in PROPERTIES:
            ends = ends_of(some, name)
            ratio = ends.log_width / (NINETY * some.value(f"{name}_limit"))
            found.append(median("limit", name, over, "narrow", ratio[ends.narrow]))
            if name == "modulus":
                found.append(median("limit", name, over, "near normal", ratio[ends.narrow & normal]))
    return found


PURE = 0.95
"""Share of one material in a phase, from which it is a pure one."""
FLAGS: Mapping[str, Callable[[Rows], Mask]] = {
    "misfit probability": lambda rows: rows.value("misfit_probability") < UNLIKELY,
    "status": lambda rows: rows.value("poor_fit") > 0.5,
    "verdict": lambda rows: rows.value("verdict_misfit") == 1,
    "better law": lambda rows: rows.value("law_gain") > LIKELY,
    "law as good": lambda rows: np.abs(rows.value("law")) > 0.5 * ends_of(rows, "modulus").log_width,
}
"""What warns of a wrong model."""
ANY = "any"


def flags_of(rows: Rows) -> dict[str, Mask]:
    """Return which materials anything warns of."""
    flags = {name: flag(rows) for name, flag in FLAGS.items()}
    return flags | {ANY: np.any(list(flags.values()), axis=0)}


def off_by(rows: Rows) -> Array:
    """Return how far the median of ln E is off, in widths of its interval."""
    off = np.log(rows.value("modulus_median") / rows.value("modulus_true"))
    return np.asarray(off / ends_of(rows, "modulus").log_width)


def under_best_conditions(rows: Rows, kind: str) -> Rows:
    """Return the resolved materials of a kind of world, with the noise and calibration of the wrong models."""
    return resolved(rows.kind(kind).equal(noise=NOISES[0], calibration=CALIBRATIONS[0])).equal(error="")


def _wrong(rows: Rows) -> list[Number]:
    found = []
    for kind in ("three", *WRONG):
        for reference in (0, 1):
            some = under_best_conditions(rows, kind).equal(reference=reference)
            over = f"{kind}, {'with' if reference else 'without'} reference"
            for name in PROPERTIES:
                ends = ends_of(some, name)
                found.append(share("wrong model", name, over, "covered", ends.held[ends.known]))
            off, flags = off_by(some), flags_of(some)
            far, farther = np.abs(off) > 0.5, np.abs(off) > 1.0
            found.append(median("wrong model", "modulus", over, "bias over interval", off))
            found.append(share("wrong model", "modulus", over, "moved", far))
            found.append(share("wrong model", "modulus", over, "moved farther", farther))
            found.append(share("wrong model", ANY, over, "warns of moved farther", flags[ANY][farther]))
            for name, flag in flags.items():
                found.append(share("wrong model", name, over, "warns of moved", flag[far]))
                found.append(share("wrong model", name, over, "warns", flag))
    return found


def one_a_world(rows: Rows) -> Rows:
    """Return the first row of each world without a reference."""
    seen: set[tuple[str, str]] = set()
    mask = []
    for row in rows.rows:
        key = (row["kind"], row["seed"])
        mask.append(row["reference"] == "0" and key not in seen)
        if mask[-1]:
            seen.add(key)
    return rows.where(np.array(mask, bool))


def _nulls(rows: Rows) -> list[Number]:
    found = []
    for kind in NULLS:
        for over, values in list(GROUPS.items())[: 1 + len(NOISES) + len(CALIBRATIONS)]:
            some = one_a_world(rows.kind(kind)).equal(**values)
            phases, whole = some.value("phases"), some.value("resolved_phases")
            found += [
                share("nulls", kind, over, "no phase", phases == 0),
                share("nulls", kind, over, "one phase", phases == 1),
                share("nulls", kind, over, "more phases", phases > 1),
                share("nulls", kind, over, "two resolved", whole > 1),
                share("nulls", kind, over, "one resolved", whole == 1),
            ]
    ends = ends_of(resolved(rows.kind("homogeneous")), "modulus")
    found.append(share("nulls", "homogeneous", "all", "covered", ends.held[ends.known]))
    return found


METHODS = {
    "least-squares": "error_fit",
    "pixel alone": "error_alone",
    "pixel": "error_pixel",
    "material": "error_material",
}


def by_depth(rows: Rows) -> dict[str, Rows]:
    """Return the materials of worlds by how deep they are indented."""
    some = of_materials(rows).equal(reference=0)
    some = some.where(np.isfinite(some.value("error_fit")) & (some.value("merged") == 0))
    deep = some.value("Delta") > DEEP
    return {"deep": some.where(deep), "shallow": some.where(~deep)}


def _estimators(rows: Rows) -> list[Number]:
    found = []
    for depth, part in by_depth(rows).items():
        for over, values in list(GROUPS.items())[: 1 + len(NOISES) + len(CALIBRATIONS)]:
            some = part.equal(**values)
            errors = {name: some.value(column) for name, column in METHODS.items()}
            over = f"{depth}, {over}"
            for name, error in errors.items():
                found.append(median("least-squares", name, over, "median error", error))
            for name in ("pixel", "material"):
                value = (
                    float(np.nanmedian(errors["least-squares"]) / np.nanmedian(errors[name]))
                    if len(some)
                    else math.nan
                )
                found.append(Number("least-squares", name, over, "times better", value, len(some)))
            answers = some.value("answers").sum() / some.value("compared").sum() if len(some) else math.nan
            found.append(Number("least-squares", "least-squares", over, "answers", float(answers), len(some)))
    return found


def _predictions(rows: Rows) -> list[Number]:
    found = []
    for kind in ("three", *WRONG):
        whole = resolved(rows.kind(kind))
        groups = {"all": {}} if kind in WRONG else GROUPS
        for over, values in groups.items():
            some = whole.equal(**values)
            every = []
            for name in CHECKED:
                inside = some.value(f"check_{name}")
                inside = inside[np.isfinite(inside)]
                every.append(inside)
                found.append(share("prediction", name, f"{kind}, {over}", "inside", inside == 1))
            found.append(share("prediction", "all", f"{kind}, {over}", "inside", np.concatenate(every) == 1))
    return found


def _setpoints(rows: Rows) -> list[Number]:
    """Return how often the readings of a third set-point are as the first two say, by how pure the phase is."""
    whole = rows.kind(SEVERAL).equal(error="")
    pure = whole.value("purity") > PURE
    found = []
    for over, some in (("all", whole), ("pure", whole.where(pure)), ("mixed", whole.where(~pure))):
        every = []
        for name in READINGS:
            inside = some.value(f"predicted_{name}")
            inside = inside[np.isfinite(inside)]
            every.append(inside)
            found.append(share("set-points", name, over, "inside", inside == 1))
        found.append(share("set-points", "all", over, "inside", np.concatenate(every) == 1))
    return found


def _runs(rows: Rows) -> list[Number]:
    found = []
    for kind in KINDS:
        mine = rows.where(rows.text("kind") == kind)
        worlds = len(set(mine.text("seed")))
        some = one_a_world(rows.kind(kind))
        found += [
            Number("runs", kind, "all", "worlds", float(worlds), worlds),
            median("runs", kind, "all", "seconds", some.value("seconds")),
            median("runs", kind, "all", "cpu", some.value("cpu")),
            Number("runs", kind, "all", "no answer", float((mine.text("error") != "").sum()), worlds),
        ]
    return found


def write_numbers(numbers: Iterable[Number], path: Path) -> None:
    """Write numbers as text that a spreadsheet can read."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Number._fields)
        writer.writerows(number._replace(value=float(f"{number.value:.5g}")) for number in numbers)


def read_numbers(path: Path) -> list[Number]:
    """Return what `write_numbers` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.reader(file))[1:]
    return [Number(a, b, c, d, float(value), int(answers)) for a, b, c, d, value, answers in lines]

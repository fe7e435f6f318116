"""Tables of the page on simulated worlds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from worlds_limit import PROPERTIES
from worlds_numbers import (
    ANY,
    FLAGS,
    GROUPS,
    INTERPHASE,
    MATERIALS,
    METHODS,
    Number,
)
from worlds_scores import (
    CALIBRATIONS,
    CHECKED,
    KINDS,
    NOISES,
    NULLS,
    WRONG,
)
from worlds_setpoints import READINGS

FEWEST = 8
GOAL = (0.85, 0.95)
TITLES = {"modulus": "modulus", "adhesion": "adhesion", "loss_tangent": "loss tangent"}
SPLIT = [f"noise {n} pm" for n in NOISES] + [f"{name} calibration" for name in CALIBRATIONS]


class Numbers:
    """Numbers of the page by what they are of."""

    def __init__(self, numbers: Iterable[Number]) -> None:
        self.found: dict[tuple[str, ...], Number] = {number[:4]: number for number in numbers}

    def one(self, section: str, of: str, over: str, number: str) -> Number:
        """Return a number."""
        return self.found[section, of, over, number]

    def percent(self, *key: str, digits: int = 0) -> str:
        """Return a share [%], a dash where there is none."""
        value = self.found[key].value
        return f"{100 * value:.{digits}f}" if math.isfinite(value) else "-"

    def covered(self, *key: str) -> str:
        """Return a coverage, its binomial error and of how many it is."""
        row = self.found[key]
        if row.answers < FEWEST:
            return f"- ({row.answers})"
        error = math.sqrt(max(row.value * (1.0 - row.value), 0.09 / row.answers) / row.answers)
        return f"{100 * row.value:.0f} +- {100 * error:.0f} ({row.answers})"

    def value(self, *key: str, digits: int = 2) -> str:
        """Return a median with so many digits behind the point."""
        row = self.found[key]
        return f"{row.value:.{digits}f}" if math.isfinite(row.value) else "-"


def lines_of(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body))


def phases_table(numbers: Numbers) -> str:
    """Return how often materials were found."""
    states = ("resolved", "merged", "not found")
    body = []
    for over in GROUPS:
        count = numbers.one("coverage", "phase", over, states[0]).answers
        body.append([over, str(count), *(numbers.percent("coverage", "phase", over, s) for s in states)])
    return lines_of(["worlds", "materials", "found and resolved", "found, merged", "not found"], body)


def coverage_table(numbers: Numbers, part: str = "") -> str:
    """Return what the intervals of materials hold."""
    body = []
    for over in GROUPS:
        cells = [over]
        for width in ("narrow", "wide"):
            cells += [numbers.covered("coverage", n, over, f"{width}{part}") for n in PROPERTIES]
        if not part:
            cells.append(numbers.covered("coverage", "ratio of moduli", over, "narrow"))
        body.append(cells)
    head = ["worlds", *(f"{TITLES[n]}, {width}" for width in ("narrow", "wide") for n in PROPERTIES)]
    return lines_of(head if part else [*head, "ratio to the reference"], body)


def outside(numbers: Numbers) -> str:
    """Return which coverages of narrow intervals miss the goal."""
    missed = []
    for over in GROUPS:
        for name in PROPERTIES:
            row = numbers.one("coverage", name, over, "narrow")
            if row.answers >= FEWEST and not GOAL[0] <= row.value <= GOAL[1]:
                missed.append(f"{TITLES[name]} ({over}) {100 * row.value:.1f} %")
    if not missed:
        return "No coverage of narrow intervals is outside 85 to 95 %."
    return f"Narrow intervals outside 85 to 95 %: {', '.join(missed)}."


def flagged(numbers: Numbers) -> str:
    """Return what becomes of wide intervals."""
    row = numbers.one("coverage", "modulus", "all", "wide flagged")
    if not row.answers:
        return "No interval of a modulus is wide."
    return f"Of the {row.answers} wide moduli {100 * row.value:.0f} % are not determined in most pixels."


def pixel_table(numbers: Numbers) -> str:
    """Return what the intervals of pixels hold."""
    body = []
    for material in (*MATERIALS, INTERPHASE):
        for reference in ("without", "with"):
            over = f"{material}, {reference} reference"
            for name in PROPERTIES:
                key = ("pixels", name, over)
                body.append(
                    [
                        material,
                        reference,
                        TITLES[name],
                        str(numbers.one(*key, "held").answers),
                        f"{numbers.percent(*key, 'held')} ({numbers.percent(*key, 'pooled_held')})",
                        numbers.percent(*key, "held_alone"),
                        numbers.value(*key, "width"),
                        numbers.value(*key, "width_alone"),
                    ]
                )
    head = [
        "pixels of",
        "reference",
        "property",
        "pixels",
        "pooled",
        "unpooled",
        "width pooled",
        "width unpooled",
    ]
    return lines_of(head, body)


def limit_table(numbers: Numbers) -> str:
    """Return widths over the information limit."""
    body = []
    for over in GROUPS:
        cells = [over]
        for name in PROPERTIES:
            keys = ["narrow", "near normal"] if name == "modulus" else ["narrow"]
            for key in keys:
                count = numbers.one("limit", name, over, key).answers
                cells.append(f"{numbers.value('limit', name, over, key)} ({count})")
        body.append(cells)
    return lines_of(["worlds", "modulus", "modulus, limit narrow", "adhesion", "loss tangent"], body)


def wrong_table(numbers: Numbers) -> str:
    """Return what wrong models do."""
    body = []
    for kind in ("three", *WRONG):
        for reference in ("without", "with"):
            over = f"{kind}, {reference} reference"
            body.append(
                [
                    kind,
                    reference,
                    *(numbers.covered("wrong model", name, over, "covered") for name in PROPERTIES),
                    numbers.value("wrong model", "modulus", over, "bias over interval"),
                    numbers.covered("wrong model", "modulus", over, "moved"),
                    *(numbers.percent("wrong model", name, over, "warns of moved") for name in (*FLAGS, ANY)),
                    numbers.covered("wrong model", "modulus", over, "moved farther"),
                    numbers.percent("wrong model", ANY, over, "warns of moved farther"),
                ]
            )
    head = [
        "sample",
        "reference",
        *TITLES.values(),
        "bias of ln E",
        "moved",
        *FLAGS,
        ANY,
        "farther",
        "any of them",
    ]
    return lines_of(head, body)


def alarms_table(numbers: Numbers) -> str:
    """Return how often anything warns."""
    body = []
    for kind in ("three", *WRONG):
        for reference in ("without", "with"):
            over = f"{kind}, {reference} reference"
            count = numbers.one("wrong model", ANY, over, "warns").answers
            warns = [numbers.percent("wrong model", name, over, "warns") for name in (*FLAGS, ANY)]
            body.append([kind, reference, str(count), *warns])
    return lines_of(["sample", "reference", "materials", *FLAGS, ANY], body)


def nulls_table(numbers: Numbers) -> str:
    """Return how many phases were found where there are none."""
    body = []
    for kind in NULLS:
        for over in ("all", *SPLIT):
            key = ("nulls", kind, over)
            count = numbers.one(*key, "one phase").answers
            shares = ("no phase", "one phase", "more phases", "one resolved", "two resolved")
            body.append([kind, over, str(count), *(numbers.percent(*key, s, digits=1) for s in shares)])
    head = [
        "sample",
        "worlds",
        "number",
        "no phase [%]",
        "one [%]",
        "more [%]",
        "one resolved [%]",
        "two or more resolved [%]",
    ]
    return lines_of(head, body)


def least_squares_table(numbers: Numbers) -> str:
    """Return errors of the published estimator and of this method."""
    body = []
    for depth in ("shallow", "deep"):
        for over in ("all", *SPLIT):
            key = f"{depth}, {over}"
            count = numbers.one("least-squares", "least-squares", key, "answers").answers
            errors = [numbers.value("least-squares", name, key, "median error") for name in METHODS]
            better = [
                numbers.value("least-squares", name, key, "times better", digits=1)
                for name in ("pixel", "material")
            ]
            body.append([depth, over, str(count), *errors, *better])
    head = ["contact", "worlds", "materials", *METHODS, "least-squares over pixel", "over material"]
    return lines_of(head, body)


def prediction_table(numbers: Numbers) -> str:
    """Return how many harmonics lie where the others predict them."""
    groups = [f"three, {over}" for over in GROUPS] + [f"{kind}, all" for kind in WRONG]
    body = []
    for over in groups:
        every = numbers.covered("prediction", "all", over, "inside")
        body.append([over, *(numbers.percent("prediction", n, over, "inside") for n in CHECKED), every])
    return lines_of(["worlds", *CHECKED, "all"], body)


def setpoints_table(numbers: Numbers) -> str:
    """Return how many mean readings of a third set-point lie where the first two say."""
    body = []
    for over in ("all", "pure", "mixed"):
        every = numbers.covered("set-points", "all", over, "inside")
        shares = (numbers.percent("set-points", n, over, "inside") for n in READINGS)
        body.append([over, *shares, every])
    titles = [name.replace("_real", ", real").replace("_imag", ", imaginary") for name in READINGS]
    return lines_of(["phases", *titles, "all"], body)


def times(numbers: Numbers) -> str:
    """Return how long a scan takes."""
    body = []
    for kind in KINDS:
        wall = numbers.value("runs", kind, "all", "seconds", digits=1)
        cpu = numbers.value("runs", kind, "all", "cpu", digits=1)
        body.append([kind, wall, cpu])
    return (
        "Median time of `map_properties` for a scan [s], with as many scans at a time as cores:\n\n"
        + lines_of(["sample", "elapsed", "on all cores together"], body)
    )

"""The page on simulated worlds: text and tables, every number of which comes from `worlds_numbers`."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from overtone.plots import png_bytes
from worlds_figures import figures_of
from worlds_numbers import (
    DEEP,
    LIKELY,
    PURE,
    UNLIKELY,
    WIDTHS,
    Rows,
    numbers_of,
    one_a_world,
    read_numbers,
    write_numbers,
)
from worlds_scores import (
    INTERPHASE_PIXELS,
    KINDS,
    NOISES,
    NULLS,
    PIXELS,
    REFERENCE_ERROR,
    SEVERAL,
    SHAPE,
    SMALL,
    WRONG,
)
from worlds_setpoints import SETPOINTS
from worlds_simulated import BETWEEN_WORLDS, SPREAD
from worlds_simulated import INTERPHASE as INTERPHASE_WIDTH
from worlds_tables import (
    TITLES,
    Numbers,
    alarms_table,
    coverage_table,
    flagged,
    least_squares_table,
    limit_table,
    nulls_table,
    outside,
    phases_table,
    pixel_table,
    prediction_table,
    setpoints_table,
    times,
    wrong_table,
)

WIDTH = 120

PAGE = """# Do the intervals of a whole scan hold?

`map_properties(method="population")` pools the pixels of a phase and states one interval for each material. Such an
interval is as wide as what the calibration leaves open, however many pixels there are, and it should hold the truth in
90 of 100 scans. This page simulates scans of which the truth is known, inverts them and counts.
`python benchmarks/worlds.py` makes the page, its figures and `worlds.csv` again; every number is from that run.

A world is a sample drawn from stated priors, under a lever and an instrument that are off by what their calibration
states: {worlds}. Scans have {size} pixels ({small} for all but three materials).
Each of PS, LDPE and a third material has its median
drawn about typical values (standard deviations of ln: {between}), properties that scatter by {spread} % from
pixel to pixel, and interphases {interphase} pixels wide. Noise of A0 is {noises} pm, calibration tight or loose (a
zero of A0 known to 3 or 30 pm, k to 5 % and R to 10 % in both), one combination a world in turn. The inversion is
`dmt-viscous`; of every material it is told that its modulus is log-normal about 0.45 GPa with a factor of 4, and its
adhesion about 5.7 nN with a factor of 2.8, as those of all worlds together are; all else by default. With a
reference it is told the modulus of PS, off by {reference_error} % (one standard deviation), and half of its pixels.

## 1. Coverage

A material is found where the phase that holds most of its pixels is for more than half made of it; a phase that the
result calls merged is not pooled and counts apart. Shares of materials [%]:

{phases}

How often the 90 % interval of the material's median holds the true median [%], with the binomial standard error and the
number of intervals in brackets. Narrow intervals are under half as wide as that of the prior (ln E: {width_E},
ln F_ad: {width_F}, loss tangent: {width_tan}), the goal is 85 to 95 %; of wide ones at least 85 %. The three materials
of a scan share its errors, so the true standard errors are up to 1.7 times those.

{coverage}

{outside}

{flagged} Each material of a world is drawn from a narrower distribution than the prior of the inversion, which does not
know which is which: a right posterior holds the truth in 90 of 100 draws of its prior, and in these worlds as often
only where data and calibration say more than the prior does.

Of merged phases, whose numbers the result calls not resolved:

{merged}

![Coverage of the intervals of materials](images/worlds-coverage.png)

Single pixels, {pixels} a material and world and {interphase_pixels} of the interphase. Covered [%] by the pooled and by
the unpooled interval; in brackets those of pooled pixels alone. Widths are medians, of ln E, or over the true value:

{pixel_table}

## 2. Width against the information limit

Median of the width of the interval of ln over 3.29 times the least standard deviation that any unbiased estimate can
have: Cramer and Rao for the mean harmonics of all materials together, with the same calibration and priors, by
differences of the simulator at the truth. Goal: at most 1.5. Narrow intervals only. The limit is linear and knows no
bounds: adhesion and loss that are not negative make intervals narrower than it where it is wide, so the column beside
it takes the moduli whose limit is narrow (90 % width of ln E under 1).

{limit}

![Width of the intervals over the information limit](images/worlds-width.png)

## 3. A wrong model

The same inversion of samples that obey another law: JKR, a standard linear solid, a tip that is a blunted cone (tight
calibration, 5 pm). `three` is the right model under these conditions. Bias is median minus truth of ln E, over the
width of the interval; moved means off by more than half of that width. The last columns are shares [%] of the moved
ones that something warns of: a misfit probability below {unlikely}, the status `model_does_not_fit` in most
pixels, a verdict that names a misfit, another law of contact that fits better (ln of odds above {likely:g}), or one
that fits as well and changes the modulus by more than half of the width. Farther means off by more than all of it.

{wrong}

The same warnings among all materials, moved or not [%]. That another law fits as well is no false alarm where the model
is right: then it is not known to be.

{alarms}

![Bias of wrong models](images/worlds-wrong.png)

## 4. Nothing to find

Samples of one material, and samples without phases whose properties change evenly over the scan. Goal: a false
extra phase in at most 1 %.

{nulls}

{false_phases}

![Phases found where there is one material or none](images/worlds-null.png)

## 5. Against least squares

The published estimator (`dmt`, harmonics 0, 1, 2) on up to 200 pixels of each material, without a reference: median
abs ln(E/E_true), and how many times smaller it is pooled. Deep contacts have an indentation of more than {deep} of
2 A1. Expected: 10 times for deep and 4 times for shallow ones.

{least_squares}

![Errors of least squares and of this method](images/worlds-least-squares.png)

## 6. Prediction of what was left out

Each mean harmonic of a phase against the 90 % interval that the others predict for it under the model: share inside
[%], goal about 90 for the right model.

{prediction}

![Harmonics inside of their predicted intervals](images/worlds-prediction.png)

## 7. Prediction of another set-point

Two set-points of {setpoints} of the free amplitude are fitted as a stack, and the mean readings of each phase at the
third are simulated from draws of the posterior, the feedback holding the amplitude there: share of readings inside of
the 90 % interval of the simulations [%]. In a pure phase {pure:.0f} % of the pixels or more are one material.

{setpoints_table}

## 8. Time

{times}

{problems}
"""


def false_phases(rows: Rows, numbers: Numbers) -> str:
    """Return in which worlds there were too many phases, and what the one material is worth."""
    said = []
    for kind in NULLS:
        some = one_a_world(rows.kind(kind))
        seeds = some.text("seed")[some.value("phases") > 1]
        said.append(f"{kind}: {', '.join(seeds[:20]) or 'none'}{' ...' if len(seeds) > 20 else ''}")
    covered = numbers.covered("nulls", "homogeneous", "all", "covered")
    text = f"Seeds with more than one phase: {'; '.join(said)}. Intervals of the modulus of the resolved homogeneous "
    return f"{text}materials hold the truth in {covered} %."


def problems(rows: Rows) -> str:
    """Return which worlds had no answer."""
    bad = rows.where(rows.text("error") != "")
    if not len(bad):
        return "Every world was answered."
    told = [
        f"- {r['kind']} {r['seed']}{' with reference' if r['reference'] == '1' else ''}: {r['error']}"
        for r in bad.rows
    ]
    return "\n".join(
        [f"Without an answer ({len(bad)}):", "", *told[:20], *(["- ..."] if len(told) > 20 else [])]
    )


def wrapped(text: str) -> str:
    """Return a page with the lines of its paragraphs of one length."""
    blocks = text.rstrip("\n").split("\n\n")
    plain = (block if block[:1] in "#|!-" else textwrap.fill(block, WIDTH) for block in blocks)
    return "\n\n".join(plain) + "\n"


def page(rows: Rows, numbers: Numbers) -> str:
    """Return the whole page."""
    counts = {k: numbers.one("runs", k, "all", "worlds").answers for k in KINDS}
    values: Mapping[str, object] = {
        "worlds": f"{counts['three']} of three materials, {counts['homogeneous']} homogeneous ones, "
        f"{counts['gradient']} gradients, "
        + ", ".join(f"{counts[k]} {k}" for k in WRONG)
        + f", {counts[SEVERAL]} at three set-points",
        "size": " x ".join(map(str, SHAPE)),
        "small": " x ".join(map(str, SMALL)),
        "between": ", ".join(f"{TITLES[n]} {sd:g}" for n, sd in BETWEEN_WORLDS.items()),
        "spread": f"{100 * SPREAD[0]:.0f} to {100 * SPREAD[1]:.0f}",
        "interphase": f"{INTERPHASE_WIDTH[0]:g} to {INTERPHASE_WIDTH[1]:g}",
        "noises": ", ".join(map(str, NOISES)),
        "reference_error": f"{100 * REFERENCE_ERROR:.0f}",
        "width_E": f"{WIDTHS['modulus']:.1f}",
        "width_F": f"{WIDTHS['adhesion']:.1f}",
        "width_tan": f"{WIDTHS['loss_tangent']:.1f}",
        "phases": phases_table(numbers),
        "coverage": coverage_table(numbers),
        "outside": outside(numbers),
        "flagged": flagged(numbers),
        "merged": coverage_table(numbers, " merged"),
        "pixels": str(PIXELS),
        "interphase_pixels": str(INTERPHASE_PIXELS),
        "pixel_table": pixel_table(numbers),
        "limit": limit_table(numbers),
        "unlikely": f"{UNLIKELY:g}",
        "wrong": wrong_table(numbers),
        "alarms": alarms_table(numbers),
        "nulls": nulls_table(numbers),
        "false_phases": false_phases(rows, numbers),
        "deep": f"{DEEP:g}",
        "least_squares": least_squares_table(numbers),
        "prediction": prediction_table(numbers),
        "likely": LIKELY,
        "setpoints": " and ".join(f"{share:g}" for share in SETPOINTS[:2]) + f" (third: {SETPOINTS[2]:g})",
        "pure": 100 * PURE,
        "setpoints_table": setpoints_table(numbers),
        "times": times(numbers),
        "problems": problems(rows),
    }
    return wrapped(PAGE.format_map(values))


def write_page(rows: Sequence[Mapping[str, str]], docs: Path) -> None:
    """Write numbers, page and figures."""
    some = Rows(rows)
    if len(set(some.text("version"))) > 1:
        print("the table holds answers of several versions of the package")
    write_numbers(numbers_of(some), docs / "worlds.csv")
    # what is on the page is what is in the file
    numbers = Numbers(read_numbers(docs / "worlds.csv"))
    (docs / "worlds.md").write_text(page(some, numbers), encoding="utf-8")
    (docs / "images").mkdir(exist_ok=True)
    for name, figure in figures_of(some, numbers.found).items():
        (docs / "images" / f"worlds-{name}.png").write_bytes(png_bytes(figure))
    print(phases_table(numbers), coverage_table(numbers), nulls_table(numbers), sep="\n\n")

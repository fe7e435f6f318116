"""Make the figures and the table of the page on validation: eqs 6 and 19 of the paper over its own ranges.

Run by hand, ``python docs/validation.py``; a minute. The cases are seeded, so that the numbers come out again.
"""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ellipe, ellipk

import overtone as ot
from overtone.plots import png_bytes
from overtone.plots.canvas import new_figure
from overtone.plots.categories import PALETTE
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, TITLE_SIZE

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

FOLDER = Path(__file__).parent
SEED, COUNT = 2020, 1000
N_MAX = 40
RADIUS, POISSON_RATIO, TIP_MODULUS, A0 = 10e-9, 0.3, 130e9, 0.2e-9
HARMONICS = range(4)
# black, blue, orange, green of Okabe and Ito; told apart by their marks too
COLOURS, MARKS = ("#000000", PALETTE[0], PALETTE[5], PALETTE[2]), ("o", "s", "^", "D")
METHODS = {
    "eq6": "eqs 6",
    "eq19": "eqs 19, 19c corrected",
    "eq19_printed": "eqs 19 as printed",
    "eq19_eq11": "eqs 19 corrected, indentation by eq 11",
    "dmt": "exact tail, bare cosine",
    "dmt_2_3": "exact tail, motion with harmonics 2 and 3",
    "held": "eqs 10 and 19 solved for the amplitude",
}


class Cases(NamedTuple):
    """Conditions, one an element, in SI units."""

    modulus: Array
    adhesion: Array
    free_amplitude: Array
    stiffness: Array
    quality_factor: Array
    setpoint: Array


class States(NamedTuple):
    """Repulsive steady states, one an element; harmonics along the last axis."""

    state: npt.NDArray[np.int64]
    """What was found, as `ot.hold_amplitude` has it; 0 for a state."""
    A0: Array
    A1: Array
    phi1: Array
    Z: Array
    indentation: Array
    """The largest [m]."""
    higher: Complex
    """Harmonics of the motion n = 2, 3, ... counted from the phase of the first [m]."""
    contact_time: Array


def sampled(count: int = COUNT, seed: int = SEED) -> Cases:
    """Return conditions spread over the ranges of section 3 of the paper."""
    random = np.random.default_rng(seed)

    def even(low: float, high: float) -> Array:
        return np.asarray(random.uniform(low, high, count))

    def even_log(low: float, high: float) -> Array:
        return np.asarray(np.exp(random.uniform(math.log(low), math.log(high), count)))

    return Cases(
        modulus=even_log(0.01e9, 10e9),
        adhesion=even(0.0, 50e-9),
        free_amplitude=even(50e-9, 100e-9),
        stiffness=even_log(0.5, 40.0),
        quality_factor=even_log(100.0, 600.0),
        setpoint=even(0.2, 0.9),
    )


def fig_4() -> Cases:
    """Return the conditions of figs 4, 6 and 7 of the paper at every set-point."""
    setpoint = np.round(np.linspace(0.1, 0.95, 35), 4)
    one = np.ones_like(setpoint)
    return Cases(1e9 * one, 20e-9 * one, 85e-9 * one, 26.0 * one, 456.0 * one, setpoint)


def setup(cases: Cases, i: int, model: str) -> tuple[ot.Probe, ot.Sample]:
    """Return probe and sample of a case. The motion does not depend on the frequency; 300 kHz."""
    probe = ot.Probe.simple(
        stiffness=cases.stiffness[i],
        frequency=300e3,
        quality_factor=cases.quality_factor[i],
        radius=RADIUS,
        tip_modulus=TIP_MODULUS,
        drive_frequency=300e3,
        free_amplitude=cases.free_amplitude[i],
    )
    sample = ot.sample(
        model,
        modulus=cases.modulus[i],
        poisson_ratio=POISSON_RATIO,
        adhesion=cases.adhesion[i],
        intermolecular_distance=A0,
    )
    return probe, sample


def solved(cases: Cases, n_max: int = N_MAX) -> States:
    """Return the repulsive steady state of every case."""
    size = cases.modulus.size
    columns = {
        name: np.full(size, np.nan) for name in ("A0", "A1", "phi1", "Z", "indentation", "contact_time")
    }
    higher, code = np.full((size, n_max - 1), np.nan, complex), np.zeros(size, np.int64)
    for i in range(size):
        state = ot.hold_amplitude(
            *setup(cases, i, "dmt"), setpoint=cases.setpoint[i], n_max=n_max, keep=n_max
        )
        code[i] = state["state"]
        for name, column in columns.items():
            column[i] = state[name]
        for n in range(2, n_max + 1):
            higher[i, n - 2] = state[f"A{n}"] * np.exp(1j * (n * state["phi1"] - state[f"phi{n}"]))
    return States(code, higher=higher, **columns)


def chosen(cases: Cases, states: States) -> tuple[Cases, States]:
    """Return the cases that tap: a repulsive state that leaves the surface."""
    found = (states.state == 0) & (states.contact_time < 1.0)
    return Cases(*(column[found] for column in cases)), States(*(column[found] for column in states))


def contact(cases: Cases) -> dict[str, Any]:
    """Return the parameters of the force law, as `ot.force_harmonics` takes them."""
    return {
        "modulus": cases.modulus,
        "adhesion": cases.adhesion,
        "radius": RADIUS,
        "poisson_ratio": POISSON_RATIO,
        "tip_modulus": TIP_MODULUS,
        "intermolecular_distance": A0,
    }


def eqs_6(cases: Cases, states: States) -> Complex:
    """Return CONS_n - i DISS_n, n = 0..3, by eqs 6a-g as they are printed, at resonance."""
    k, Q, free = cases.stiffness, cases.quality_factor, cases.free_amplitude
    phi, A1 = states.phi1, states.A1
    columns = [k * states.A0 + 0j]
    drive = k * free / Q
    columns.append(-drive * np.cos(phi) - 1j * drive * (np.sin(phi) - A1 / free))
    for n in (2, 3):
        amplitude, angle = np.abs(states.higher[:, n - 2]), np.angle(states.higher[:, n - 2])
        cons = k * amplitude * ((1 - n**2) * np.cos(angle) - n / Q * np.sin(angle))
        diss = k * amplitude * ((n**2 - 1) * np.sin(angle) - n / Q * np.cos(angle))
        columns.append(cons - 1j * diss)
    return np.stack(columns, axis=-1)


def eqs_19(cases: Cases, amplitude: Array, indentation: Array, *, printed: bool) -> Array:
    """Return CONS_n, n = 0..3, by eqs 19a-d; 19c as printed, or with gamma/(2 beta) in its first term.

    NaN where the attraction reaches the far end of the motion, for which they are not made.
    """
    plane = (1.0 - 0.3**2) / TIP_MODULUS + (1.0 - POISSON_RATIO**2) / cases.modulus
    strength = 4.0 / 3.0 * math.sqrt(RADIUS) / plane * amplitude**1.5 / math.pi
    gamma = cases.adhesion / (strength * math.pi)
    ratio = 2.0 * A0 / amplitude  # gamma/beta, with m = Fad/(2 a0)
    beta = gamma / ratio
    D = indentation / (2.0 * amplitude)
    K, E = ellipk(D), ellipe(D)
    with np.errstate(invalid="ignore"):
        theta_1, theta_2 = np.arccos(2 * D - 1), np.arccos(2 * D - 1 + ratio)
        alpha = np.sqrt(4 * D * (1 - D) - 2 * (2 * D - 1) * ratio - ratio**2)
    width = 2 * np.sqrt(D * (1 - D))
    half = ratio if printed else ratio / 2
    parts = [
        gamma * (theta_2 - math.pi)
        + 4 * math.sqrt(2) / 3 * (K * (3 * D**2 - 5 * D + 2) + E * (4 * D - 2))
        + beta * ((2 * D - 1) * (theta_2 - theta_1) + width - alpha),
        gamma * alpha
        + 8 * math.sqrt(2) / 5 * (K * (D**2 - 3 * D + 2) + E * (-2 * D**2 + 2 * D - 2))
        + beta * (theta_1 - theta_2 + (1 - 2 * D) * (width - alpha)),
        4 / 3 * gamma * (2 * D - 1 + half) * alpha
        + 8
        * math.sqrt(2)
        / 35
        * (K * (8 * D**3 - 13 * D**2 + 3 * D + 2) + E * (-16 * D**3 + 24 * D**2 - 4 * D - 2))
        + 8 / 3 * beta * D * (1 - D) * (width - alpha),
        2 / 3 * gamma * (2 + 12 * D * (D - 1) + 3 * (2 * D - 1) * ratio + ratio**2) * alpha
        + 8
        * math.sqrt(2)
        / 315
        * (
            K * (128 * D**4 - 272 * D**3 + 159 * D**2 - 13 * D - 2)
            + E * (-256 * D**4 + 512 * D**3 - 270 * D**2 + 14 * D + 2)
        )
        + 8 / 3 * beta * D * (-2 * D**2 + 3 * D - 1) * (width - alpha),
    ]
    return strength[:, None] * np.stack(parts, axis=-1)


def held(cases: Cases) -> Array:
    """Return CONS_n, n = 0..3, of a motion by eq 10 under the force of eqs 19 that has the amplitude of the case.

    Its indentation is what the balance of the first harmonic asks for, as in an inversion.
    """
    values = np.full((cases.modulus.size, 4), np.nan)
    for i in range(len(values)):
        state = ot.hold_amplitude(*setup(cases, i, "dmt-linear"), setpoint=cases.setpoint[i], n_max=1)
        values[i] = state["F_cons"]
    return values


def forces(cases: Cases, states: States) -> dict[str, Array]:
    """Return CONS_n, n = 0..3, of the true motion (``direct``) and by every method."""
    signs = (-1.0) ** np.arange(2, 2 + states.higher.shape[1])
    at_pi = states.A1 - states.Z - states.A0 - (signs * states.higher.real).sum(axis=1)
    on_motion = {"amplitude": states.A1, "indentation": at_pi, **contact(cases)}
    bare = {"amplitude": states.A1, "indentation": states.indentation, **contact(cases)}
    return {
        "direct": ot.force_harmonics("dmt", higher=states.higher, **on_motion).real,
        "eq6": eqs_6(cases, states).real,
        "eq19": eqs_19(cases, states.A1, states.indentation, printed=False),
        "eq19_printed": eqs_19(cases, states.A1, states.indentation, printed=True),
        "eq19_eq11": ot.force_harmonics(
            "dmt-linear", **{**bare, "indentation": states.A1 - states.Z - states.A0}
        ).real,
        "dmt": ot.force_harmonics("dmt", **bare).real,
        "dmt_2_3": ot.force_harmonics("dmt", higher=states.higher[:, :2], **on_motion).real,
        "held": held(cases),
    }


def errors(found: dict[str, Array]) -> dict[str, Array]:
    """Return the error of every method relative to each harmonic itself (case, n)."""
    return {name: found[name] / found["direct"] - 1.0 for name in METHODS}


PARTS = {
    "all": (0.0, math.inf),
    "< 1": (0.0, 1.0),
    "1 to 4": (1.0, 4.0),
    "4 to 20": (4.0, 20.0),
    "> 20": (20.0, math.inf),
}
LARGEST = "largest"
GROUPED = ("eq19", "dmt_2_3", "held")


class Row(NamedTuple):
    """A line of the table: how large an error is in some of the cases."""

    method: str
    part: str
    """Which cases, by their adhesion over the drive force."""
    harmonic: str
    """0 to 3, or the largest error of the four."""
    cases: int
    median: float
    p90: float
    p99: float
    maximum: float
    within_5: float
    within_10: float


def over_drive(cases: Cases) -> Array:
    """Return the adhesion over the drive force [1]."""
    return cases.adhesion * cases.quality_factor / (cases.stiffness * cases.free_amplitude)


def table(cases: Cases, off: dict[str, Array]) -> list[Row]:
    """Return how large the errors are [1], rounded to what is written."""
    ratio, rows = over_drive(cases), []
    for name, error in off.items():
        sizes = {str(n): np.abs(error[:, n]) for n in HARMONICS} | {LARGEST: np.abs(error).max(axis=1)}
        for part, (low, high) in PARTS.items():
            for harmonic, size in sizes.items():
                some = size[(ratio >= low) & (ratio < high) & np.isfinite(size)]
                said = [
                    *np.quantile(some, [0.5, 0.9, 0.99]),
                    some.max(),
                    (some < 0.05).mean(),
                    (some < 0.1).mean(),
                ]
                rows.append(Row(name, part, harmonic, some.size, *(float(f"{value:.3g}") for value in said)))
    return rows


def write_table(rows: list[Row], path: Path) -> None:
    """Write the table as text that a spreadsheet can read."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])


def read_table(path: Path) -> list[Row]:
    """Return what `write_table` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.reader(file))[1:]
    return [Row(*line[:3], int(line[3]), *map(float, line[4:])) for line in lines]


def markdown(rows: list[Row]) -> tuple[str, str]:
    """Return the two tables of the page: by harmonic, and by adhesion over the drive force."""
    kept = {(row.method, row.part, row.harmonic): row for row in rows}
    by_harmonic = ["| method | F0 | F1 | F2 | F3 |", "|---|---|---|---|---|"]
    for name, title in METHODS.items():
        cells = [_cell(kept[name, "all", str(n)]) for n in HARMONICS]
        by_harmonic.append(f"| {title} | {' | '.join(cells)} |")
    counts = [f"{part}, {kept['eq6', part, LARGEST].cases} cases" for part in PARTS]
    by_adhesion = [f"| method | {' | '.join(counts)} |", "|---|---|---|---|---|---|"]
    for name in GROUPED:
        cells = [_cell(kept[name, part, LARGEST]) for part in PARTS]
        by_adhesion.append(f"| {METHODS[name]} | {' | '.join(cells)} |")
    return "\n".join(by_harmonic) + "\n", "\n".join(by_adhesion) + "\n"


def _cell(row: Row) -> str:
    """Write median, 90th percentile and the share within 5 % [%]."""
    sizes = [f"{100 * size:.2g}" if size < 1.0 else f"{100 * size:.0f}" for size in (row.median, row.p90)]
    return f"{sizes[0]} / {sizes[1]} ({100 * row.within_5:.0f})"


def write_page(tables: tuple[str, str], path: Path) -> None:
    """Put the tables where the page has had them: each begins with "method" and ends before an empty line."""
    text = path.read_text(encoding="utf-8")
    old = re.findall(r"^\| method \| .+?\n(?=\n)", text, re.M | re.S)
    for before, after in zip(old, tables, strict=True):
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")


# --- figures ----------------------------------------------------------------------------------------------------


def _figure(width: float, height: float) -> Figure:
    figure = new_figure(width, height)
    figure.set_dpi(150)
    return figure


def _dress(axes: Axes, x: str, y: str, title: str = "") -> None:
    axes.set_xlabel(x, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, fontsize=LABEL_SIZE)
    axes.set_title(title, fontsize=TITLE_SIZE, loc="left")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def approach_figure(cases: Cases, found: dict[str, Array]) -> Figure:
    """Return figs 4 and 6 of the paper, with their errors below."""
    figure = _figure(9.0, 6.6)
    panels = figure.subplots(2, 2, sharex=True, height_ratios=(3, 2))
    off = errors(found)
    columns = (
        ("eq6", "(a) eqs 6 from observables, as in fig. 4", "eqs 6"),
        ("eq19", "(b) eqs 19 from properties, as in fig. 6", "eqs 19"),
    )
    for (top, bottom), (name, title, label) in zip(panels.T, columns, strict=True):
        for n in HARMONICS:
            size = 1e9 * np.abs(found["direct"][:, n])
            top.plot(cases.setpoint, size, "-", color=COLOURS[n], linewidth=1.2, label=f"$F_{n}$, direct")
        for n in HARMONICS:
            size = 1e9 * np.abs(found[name][:, n])
            top.plot(cases.setpoint, size, MARKS[n], **_points(n), label=f"$F_{n}$, {label}")
        _dress(top, "", "size of the force harmonic [nN]", title)
        top.set_ylim(0.0, 8.5)
        top.legend(fontsize=TICK_SIZE, ncols=2, frameon=False, loc="upper right")
        for n in HARMONICS:
            error = np.maximum(np.abs(off[name][:, n]), 1e-15) if name == "eq6" else 100 * off[name][:, n]
            bottom.plot(cases.setpoint, error, MARKS[n], **{**_points(n), "linestyle": "-", "linewidth": 0.6})
        if name == "eq6":
            bottom.set_yscale("log")
            bottom.set_ylim(1e-15, 1e-9)
        else:
            printed = 100 * off["eq19_printed"][:, 2]
            bottom.plot(
                cases.setpoint, printed, ":", color=COLOURS[2], linewidth=1.6, label="$F_2$, 19c as printed"
            )
            bottom.legend(fontsize=TICK_SIZE, frameon=False, loc="upper right")
            bottom.set_ylim(0.0, 10.0)
        unit = "relative error" if name == "eq6" else "relative error [%]"
        _dress(bottom, "set-point ratio $A_1/A_{1,\\mathrm{far}}$", unit)
    figure.tight_layout()
    return figure


def _points(n: int) -> dict[str, Any]:
    return {"color": COLOURS[n], "markersize": 4, "mfc": "none", "linestyle": "none"}


def distribution_figure(off: dict[str, Array]) -> Figure:
    """Return what share of the cases has an error below a size, for every harmonic."""
    styles = {
        "eq19_eq11": (PALETTE[4], "-", 1.4),
        "eq19": (PALETTE[0], "-", 2.6),
        "eq19_printed": ("#000000", ":", 1.6),
        "dmt": (PALETTE[1], "-", 1.2),
        "dmt_2_3": (PALETTE[2], "-.", 1.6),
        "held": (PALETTE[5], "--", 1.6),
    }
    figure = _figure(9.0, 6.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for n, axes in zip(HARMONICS, panels.flat, strict=True):
        for name, (colour, line, width) in styles.items():
            if name == "eq19_printed" and n != 2:  # the other three are printed as they should be
                continue
            size = np.sort(np.abs(off[name][:, n]))
            size = size[np.isfinite(size)]
            share = np.arange(1, size.size + 1) / size.size
            axes.semilogx(100 * size, 100 * share, line, color=colour, linewidth=width, label=METHODS[name])
        axes.axvline(5.0, color="0.6", linewidth=0.8)
        axes.text(5.0, 101.0, "5 %", fontsize=TICK_SIZE, color="0.4", ha="center")
        x = "size of the relative error [%]" if n > 1 else ""
        y = "share of cases below [%]" if n % 2 == 0 else ""
        _dress(axes, x, y, f"({'abcd'[n]}) $F_{n}$")
        axes.set_xlim(1e-3, 1e3)
        axes.set_ylim(0.0, 100.0)
    handles, labels = panels[1, 0].get_legend_handles_labels()
    figure.tight_layout(rect=(0.0, 0.09, 1.0, 1.0))
    figure.legend(handles, labels, fontsize=LABEL_SIZE, ncols=2, frameon=False, loc="lower center")
    return figure


def dependence_figure(cases: Cases, states: States, found: dict[str, Array]) -> Figure:
    """Return where three ways of writing the force fail: with adhesion above the drive force."""
    off = errors(found)
    shown = {
        "eq19": "(a) eqs 19",
        "dmt_2_3": "(b) exact tail, harmonics 2, 3",
        "held": "(c) eqs 10 and 19 solved",
    }
    figure = _figure(9.0, 3.6)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for axes, (name, title) in zip(panels, shown.items(), strict=True):
        points = axes.scatter(
            over_drive(cases),
            100 * np.abs(off[name]).max(axis=1),
            s=7,
            c=states.contact_time,
            cmap="cividis",
            vmin=0.0,
            vmax=1.0,
            linewidths=0,
        )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(1e-3, 1e5)
        axes.axhline(5.0, color="0.6", linewidth=0.8)
        y = "largest error of $F_0$ to $F_3$ [%]" if name == "eq19" else ""
        x = "adhesion over drive force" if name == "dmt_2_3" else ""
        _dress(axes, x, y, title)
    figure.subplots_adjust(left=0.08, right=0.88, bottom=0.16, top=0.91, wspace=0.07)
    bar = figure.colorbar(points, cax=figure.add_axes((0.9, 0.16, 0.015, 0.75)))
    bar.set_label("share of the period in contact", fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    return figure


def main() -> None:
    """Write the figures and the table."""
    curve = fig_4()
    along = solved(curve)
    images = FOLDER / "images"
    pictures = {"validation-approach": approach_figure(curve, forces(curve, along))}
    cases, states = chosen(everything := sampled(), solved(everything))
    found = forces(cases, states)
    pictures["validation-errors"] = distribution_figure(errors(found))
    pictures["validation-where"] = dependence_figure(cases, states, found)
    for name, figure in pictures.items():
        (images / f"{name}.png").write_bytes(png_bytes(figure))
    rows = table(cases, errors(found))
    write_table(rows, FOLDER / "validation.csv")
    write_page(markdown(rows), FOLDER / "validation.md")


if __name__ == "__main__":
    main()

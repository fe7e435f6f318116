"""``overtone simulate``: what a probe and a material make of each other, without a microscope."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from overtone.cli.options import ProbeOptions, open_probe, open_sample
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError, OvertoneWarning
from overtone.units import display_unit, format_quantity, parse_quantity

simulate = App(name="simulate", help="Simulate what a probe does over a material.")

_FIGURES = {".png": "png", ".svg": "svg", ".pdf": "pdf"}
# Columns of the table of numbers: fixed units, so that tables compare.
_COLUMNS = {"A1": "nm", "phi1": "deg", "A0": "pm", "A2": "pm", "phi2": "deg", "A3": "pm", "phi3": "deg"}
_COLUMNS |= {"indentation": "nm", "contact_time": "1", "peak_force": "nN", "pull_force": "nN"}
_COLUMNS |= {"dissipation": "eV", "virial": "eV", "state": "1", "jump": "1"}
_MOST_POINTS = 100_000
_LOWEST_SETPOINT = 0.1
_HIGHEST = 1.2  # of the free amplitude, and farther where attraction reaches farther
_REACH = {"intermolecular_distance": 10.0, "rupture_distance": 2.0}  # how far the sample reaches
_FARTHER = (1.5, 2.0, 3.0, 5.0, 10.0)
_THERMAL = 4e-21  # J: an energy far below is nothing
_DIFFERENT = 1e-6  # of the free amplitude: farther apart the two sweeps are not in one state

Progress = Callable[[str, int, int], None]


@simulate.command
def curve(
    *,
    probe: ProbeOptions,
    sample: str,
    z: str | None = None,
    points: int = 100,
    method: str = "steady",
    speed: str | None = None,
    bandwidth: str | None = None,
    branches: Annotated[bool, Parameter(negative=())] = False,
    harmonics: int = 10,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    csv: Path | None = None,
    plot: Path | None = None,
) -> None:
    """Simulate an approach curve: the base sinks towards a material and rises again.

    Parameters
    ----------
    probe : ProbeOptions
        The probe.
    sample : str
        Contact model and parameters, "dmt, modulus=2 GPa, poisson_ratio=0.35, adhesion=8 nN", or a TOML file.
    z : str
        Heights of the base, lowest and highest, such as "5 nm to 100 nm"; unless given from the set-point 0.1
        to 1.2 times the free amplitude.
    points : int
        How many heights.
    method : str
        steady: infinitely slow. transient: at a speed, read through a lock-in.
    speed : str
        Speed of the base for transient, for example "100 nm/s".
    bandwidth : str
        Bandwidth of the lock-in for transient, for example "2 kHz".
    branches : bool
        Find every steady state as well, stable and unstable.
    harmonics : int
        Harmonics of the motion that act back on the force.
    output : Path
        Result, a netCDF file.
    csv : Path
        Table of the sweeps as text, a row for each direction and height.
    plot : Path
        Figure (.png, .svg, .pdf).
    """
    from overtone import provenance
    from overtone.readings import Reading, with_reading

    _check_paths({"--output": output, "--csv": csv, "--plot": plot}, {Path(probe.probe), Path(sample)})
    rates = _rates(method, speed, bandwidth)
    bounds = _bounds(z) if z is not None else None
    if not 2 <= points <= _MOST_POINTS:
        raise OvertoneError("--points is out of range", expected=f"2 to {_MOST_POINTS}", got=str(points))
    with _kept_warnings() as said:
        lever, material = open_probe(probe), open_sample(sample)
        heights, remark = _heights(lever, material, bounds, points)
        with progress_bar() as update:
            result, states = _run(lever, material, heights, method, rates, harmonics, branches, update)
    result = with_reading(provenance.add_finding(result, *said), Reading(lever, corrected=True))
    written = _write(result, states, lever, material, output, csv, plot)
    console = Console(highlight=False)
    _print_summary(console, result, states, lever, material, method, remark)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True, markup=False)


# --- what was asked for ---------------------------------------------------------------------------


def _check_paths(outputs: dict[str, Path | None], inputs: set[Path]) -> None:
    """Refuse outputs that could not be written, or would replace an input or each other."""
    endings = {"--output": (".nc",), "--csv": (".csv",), "--plot": tuple(_FIGURES)}
    seen: dict[Path, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        if path.suffix.lower() not in endings[option]:
            raise OvertoneError(
                f"{path.name} is no name for {option}",
                expected=f"a name that ends in {' or '.join(endings[option])}",
            )
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir():
            raise OvertoneError(f"{path} is a folder", expected="the name of a file")
        if path.resolve() in seen or path.resolve() in {given.resolve() for given in inputs}:
            raise OvertoneError(f"{path} is taken", expected="a name of its own for each file")
        seen[path.resolve()] = option


def _rates(method: str, speed: str | None, bandwidth: str | None) -> dict[str, Any]:
    """Return speed [m/s] and bandwidth [Hz] as far as the method takes them."""
    rates = {
        name: parse_quantity(text, unit, f"--{name}")
        for name, text, unit in (("speed", speed, "m/s"), ("bandwidth", bandwidth, "Hz"))
        if text is not None
    }
    if method == "steady" and rates:
        raise OvertoneError(
            f"--{next(iter(rates))} is for sweeps in time", got="--method steady", hint="--method transient"
        )
    if method == "transient" and "speed" not in rates:
        raise OvertoneError("a sweep in time needs a speed", hint='--speed "100 nm/s"')
    return rates


def _bounds(text: str) -> tuple[float, float]:
    """Return the lowest and the highest height [m]."""
    low_text, to, high_text = text.partition(" to ")
    if not to or not low_text.strip() or not high_text.strip():
        raise OvertoneError("--z is no range", expected='text such as "5 nm to 100 nm"', got=repr(text))
    low, high = (parse_quantity(part, "m", "--z") for part in (low_text, high_text))
    if not low < high:
        raise OvertoneError(
            "--z is no range", expected='the lower height first, such as "5 nm to 100 nm"', got=repr(text)
        )
    return low, high


def _heights(lever: Any, material: Any, bounds: tuple[float, float] | None, points: int) -> tuple[Any, str]:
    """Return the heights [m], and how they were chosen where they were not given."""
    import numpy as np

    low, high, remark = (*bounds, "") if bounds else _fitting_bounds(lever, material)
    return np.linspace(high, low, points), remark


def _fitting_bounds(lever: Any, material: Any) -> tuple[float, float, str]:
    """Return heights from where the tip hardly moves any more to where it hardly feels the sample."""
    import math

    from overtone.dynamics.hold import hold_amplitude
    from overtone.dynamics.steady import steady_states

    free = lever.drive.free_amplitude
    lowest = float(hold_amplitude(lever, material, setpoint=_LOWEST_SETPOINT)["Z"])
    low_text = f"the set-point {_LOWEST_SETPOINT:g}"
    if not math.isfinite(lowest) or lowest >= free:
        lowest, low_text = _LOWEST_SETPOINT * free, f"{_LOWEST_SETPOINT:g} A1far"
    reach = max(ranges * float(material.values.get(name, 0.0)) for name, ranges in _REACH.items())
    highest = max(_HIGHEST * free, free + reach)
    for factor in _FARTHER:
        # a contact that holds on while the base rises may reach far beyond the free amplitude
        if steady_states(lever, material, z=highest).sizes["branch"] == 1:
            break
        highest = max(highest, factor * free)
    low, high = float(f"{lowest:.3g}"), float(f"{highest:.3g}")
    remark = f"from {low_text} to {high / free:.3g} A1far, chosen; --z gives others"
    return low, high, remark


# --- the work -------------------------------------------------------------------------------------


@contextmanager
def _kept_warnings() -> Iterator[list[str]]:
    """Collect what is warned of as sentences, each once."""
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OvertoneWarning)
        yield said
    for warning in caught:
        if issubclass(warning.category, OvertoneWarning):
            text = f"{warning.category.__name__}: {warning.message}"
            said.append(text if text.endswith(".") else text + ".")
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    said[:] = dict.fromkeys(said)


def _run(
    lever: Any,
    material: Any,
    heights: Any,
    method: str,
    rates: dict[str, Any],
    harmonics: int,
    branches: bool,
    update: Progress,
) -> tuple[Any, Any]:
    """Return the sweeps, and every steady state where it was asked for."""
    from overtone.dynamics.curve import approach_curve
    from overtone.dynamics.steady import steady_states

    if method == "steady":
        update("approach curve", 0, 1)
    result = approach_curve(
        lever,
        material,
        z=heights,
        method=method,
        n_max=harmonics,
        progress=partial(update, "approach curve"),
        **rates,
    )
    states = None
    if branches:
        update("all states", 0, 1)
        states = steady_states(
            lever, material, z=heights, n_max=harmonics, progress=partial(update, "all states")
        )
    return result, states


# --- what is printed ------------------------------------------------------------------------------


def _print_summary(
    console: Console, result: Any, states: Any, lever: Any, material: Any, method: str, remark: str
) -> None:
    import numpy as np

    from overtone import provenance

    console.print(f"[bold]{escape(_described(material))}[/]", soft_wrap=True)
    console.print(_described_probe(lever), markup=False, soft_wrap=True)
    heights = result["z"].values
    step = float(heights[0] - heights[1])
    console.print(
        f"Z from {format_quantity(heights.max(), 'm')} down to {format_quantity(heights.min(), 'm')}"
        + (f" ({remark})" if remark else "")
        + f", {heights.size} heights {format_quantity(step, 'm')} apart",
        markup=False,
        soft_wrap=True,
    )
    directions = [str(name) for name in result["direction"].values]
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for heading in ("", *directions):
        table.add_column(heading, overflow="fold")
    for label, read in _ROWS.items():
        cells = [read(result.sel(direction=name), lever) for name in directions]
        if any(cells):
            table.add_row(label, *(escape(cell or "-") for cell in cells))
    console.print()
    console.print(table)
    console.print()
    apart = _hysteresis(result, lever) if method == "steady" else _lag(result)
    console.print("- " + apart, markup=False, soft_wrap=True)
    if states is not None:
        count = (states["stable"] & np.isfinite(states["A1"])).sum("branch").values
        console.print("- " + _coexistence(heights, count), markup=False, soft_wrap=True)
    for sentence in provenance.findings(result):
        console.print(f"- {sentence}", markup=False, soft_wrap=True)


def _described(material: Any) -> str:
    units = {q.name: q.unit for q in material.model.parameters}
    values = (f"{name} {format_quantity(float(v), units[name])}" for name, v in material.values.items())
    return f"{material.model.key}: {', '.join(values)}"


def _described_probe(lever: Any) -> str:
    mode = lever.cantilever.modes[0]
    radius = "-" if lever.tip.radius is None else format_quantity(lever.tip.radius, "m")
    modes = "" if len(lever.cantilever.modes) == 1 else f", {len(lever.cantilever.modes)} modes"
    return (
        f"k {format_quantity(mode.stiffness, 'N/m')}, f {format_quantity(mode.frequency, 'Hz', 5)}, "
        f"Q {mode.quality_factor:.4g}{modes}, R {radius}, read as {lever.detector.kind}; driven at "
        f"{format_quantity(lever.drive.frequency, 'Hz', 5)} to A1far {format_quantity(lever.drive.free_amplitude, 'm')}"
    )


def _setpoints(sweep: Any, lever: Any) -> str:
    setpoint = sweep["A1"].values / lever.drive.free_amplitude
    return f"{_least(setpoint):.3g} .. {_most(setpoint):.3g}"


def _jumps(sweep: Any, lever: Any) -> str:
    """Say where the motion jumped, in the order in which the sweep came there."""
    if "jump" not in sweep:
        return ""
    from overtone.plots.curve import jumps_of

    texts = []
    for before, after in jumps_of(sweep):
        Z, A = sweep["z"].values, sweep["A1"].values
        unit = display_unit(float(abs(Z).max()), "m")
        between = f"{Z[before] * unit.factor:.4g} .. {Z[after] * unit.factor:.4g} {unit.label}"
        change = A[after] - A[before]
        texts.append(f"Z {between}: A1 {'+' if change > 0.0 else ''}{format_quantity(change, 'm')}")
    return "\n".join(texts) or "none"


def _largest(name: str, sweep: Any, lever: Any) -> str:
    if name not in sweep:
        return ""
    value = _most(sweep[name].values)
    if value <= (0.01 * _THERMAL if name == "dissipation" else 0.0):
        return "none"
    if name == "contact_time":
        return f"{100.0 * value:.3g} % of a period"
    return format_quantity(value, sweep[name].attrs["units"])


def _strongest_pull(sweep: Any, lever: Any) -> str:
    return format_quantity(_least(sweep["pull_force"].values), "N") if "pull_force" in sweep else ""


def _lost(sweep: Any, lever: Any) -> str:
    """Say at how many heights there is no state, and why."""
    import numpy as np

    from overtone.report.shares import flags

    state, lost = sweep["state"], ~np.isfinite(sweep["A1"].values)
    counts = {meaning: int((lost & (state.values == flag)).sum()) for flag, meaning in flags(state).items()}
    return ", ".join(f"{count} {meaning}" for meaning, count in counts.items() if count) or "none"


_ROWS: dict[str, Callable[[Any, Any], str]] = {
    "set-point A1/A1far": _setpoints,
    "jumps": _jumps,
    "deepest indentation": partial(_largest, "indentation"),
    "strongest repulsion": partial(_largest, "peak_force"),
    "strongest attraction": _strongest_pull,
    "longest contact": partial(_largest, "contact_time"),
    "largest loss per cycle": partial(_largest, "dissipation"),
    "heights without a state": _lost,
}


def _most(values: Any) -> float:
    import numpy as np

    return float(np.max(values[np.isfinite(values)], initial=-np.inf))


def _least(values: Any) -> float:
    return -_most(-values)


def _hysteresis(result: Any, lever: Any) -> str:
    """Say over which heights the two sweeps are in different states."""
    import numpy as np

    Z = result["z"].values
    there, back = (result["A1"].isel(direction=k).values for k in range(2))
    apart = np.abs(there - back) > _DIFFERENT * lever.drive.free_amplitude
    if not apart.any():
        both = np.isfinite(there) & np.isfinite(back)
        return "no hysteresis" + ("." if both.all() else " where both sweeps have a state.")
    low, high = float(Z[apart].min()), float(Z[apart].max())
    step, most = float(Z[0] - Z[1]), float(np.nanmax(np.abs(there - back)))
    text = (
        f"hysteresis: from Z = {format_quantity(low, 'm', 4)} to {format_quantity(high, 'm', 4)} approach and "
        f"retract differ, by up to {format_quantity(most, 'm')} in A1; {format_quantity(high - low + step, 'm')} "
        f"wide, give or take the {format_quantity(step, 'm')} between heights"
    )
    if apart[0]:
        text += "; they still differ at the highest height, so begin higher (--z)"
    return text + "."


def _lag(result: Any) -> str:
    """Say how far apart the two sweeps in time are: the lag of lever and lock-in, and hysteresis."""
    import numpy as np

    there, back = (result["A1"].isel(direction=k).values for k in range(2))
    apart = np.abs(there - back)
    if not np.isfinite(apart).any():
        return "no height at which both sweeps were read."
    worst = int(np.nanargmax(apart))
    text = (
        f"approach and retract differ by up to {format_quantity(float(apart[worst]), 'm')} in A1, at Z = "
        f"{format_quantity(float(result['z'][worst]), 'm', 4)}; a slower sweep tells lag from hysteresis"
    )
    if "travel_per_memory" in result.attrs:
        travel = format_quantity(float(result.attrs["travel_per_memory"]), "m")
        text += f" (the base moves by {travel} while the lever forgets)"
    return text + "."


def _coexistence(heights: Any, count: Any) -> str:
    """Say at which heights more than one state is stable."""
    import numpy as np

    several = np.flatnonzero(count > 1)
    if not several.size:
        return "one stable state at most at every height."
    runs = np.split(several, np.flatnonzero(np.diff(several) > 1) + 1)
    ranges = (
        f"Z {format_quantity(heights[run].min(), 'm', 4)} .. {format_quantity(heights[run].max(), 'm', 4)} "
        f"({int(count[run].max())})"
        for run in runs
    )
    return f"more than one stable state at {', '.join(ranges)}."


# --- what is written ------------------------------------------------------------------------------


def _write(
    result: Any,
    states: Any,
    lever: Any,
    material: Any,
    output: Path | None,
    csv: Path | None,
    plot: Path | None,
) -> list[Path]:
    """Write every file that was asked for, or none."""
    from overtone.io.atomic import atomic_path
    from overtone.io.netcdf import save

    written = []
    with ExitStack() as stack:
        if output is not None:
            merged = result
            if states is not None:
                merged = result.merge(states.rename({name: f"{name}_branches" for name in states.data_vars}))
            save(merged.assign_attrs(result.attrs), stack.enter_context(atomic_path(output)))
            written.append(output)
        if csv is not None:
            text = _table_text(result, _described(material))
            stack.enter_context(atomic_path(csv)).write_text(text, encoding="utf-8")
            written.append(csv)
        if plot is not None:
            _draw(result, states, lever, material, stack.enter_context(atomic_path(plot)))
            written.append(plot)
    return written


def _draw(result: Any, states: Any, lever: Any, material: Any, path: Path) -> None:
    from overtone.plots import curve_figure, png_bytes
    from overtone.plots.canvas import TEXTS

    # a number stays on one line with its unit
    parts = f"{_described(material)}; {_described_probe(lever)}".replace(" ", "\N{NO-BREAK SPACE}")
    heading = re.sub("([,;:])\N{NO-BREAK SPACE}", r"\1 ", parts)
    figure = curve_figure(result, states, heading=heading)
    kind = _FIGURES[path.suffix.lower()]
    if kind == "png":
        path.write_bytes(png_bytes(figure))
        return
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    with TEXTS:
        figure.savefig(path, format=kind, metadata=undated)


def _table_text(result: Any, title: str) -> str:
    """Return the sweeps as a table, in the order in which they went through the heights."""
    from overtone._version import __version__
    from overtone.quantities import quantity
    from overtone.units import conversion_factor

    columns = {name: unit for name, unit in _COLUMNS.items() if name in result and "z" in result[name].dims}
    lines = [
        f"# overtone: {__version__}, simulate curve",
        f"# sample: {title}",
        "# direction: 0 approach, 1 retract",
    ]
    lines.append(
        ", ".join(f"{name} ({unit})" for name, unit in {"z": "nm", "direction": "1", **columns}.items())
    )
    for k in range(result.sizes["direction"]):
        sweep = result.isel(direction=k, z=slice(None, None, -1 if k else 1))
        parts: list[Sequence[str]] = [
            [f"{z * 1e9:.10g}" for z in sweep["z"].values],
            [str(k)] * sweep.sizes["z"],
        ]
        for name, unit in columns.items():
            record = quantity(name)
            factor = conversion_factor(unit, record.unit) if record else 1.0
            parts.append([f"{float(value) / factor:.10g}" for value in sweep[name].values])
        lines += [", ".join(row) for row in zip(*parts, strict=True)]
    return "\n".join(lines) + "\n"

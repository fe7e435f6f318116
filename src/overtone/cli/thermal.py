"""``overtone thermal``: the lever from its thermal spectrum."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from overtone.errors import OvertoneError, OvertoneWarning
from overtone.units import display_unit, format_quantity, parse_quantity

_FIGURES = {".png": "png", ".svg": "svg", ".pdf": "pdf"}
_UNIFORM_BEAM = 1.0897


def thermal(
    file: Path,
    /,
    *,
    sensitivity: str | None = None,
    sensitivity_error: str | None = None,
    static: Annotated[bool, Parameter(negative=())] = False,
    static_slope_ratio: float = _UNIFORM_BEAM,
    temperature: str = "295 K",
    between: str | None = None,
    modes: int = 1,
    averages: float | None = None,
    channel: str | None = None,
    unit: str | None = None,
    plot: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
) -> None:
    """Fit k, f1 and Q of a lever to its thermal spectrum, recorded far from the sample and without drive.

    Parameters
    ----------
    file : Path
        Spectrum: a table with units (V/rtHz, V^2/Hz, m/rtHz, m^2/Hz), an Igor wave scaled in Hz, or netCDF.
    sensitivity : str
        For a spectrum in volts, for example "60 nm/V"; dynamic (of the first mode) unless --static.
    sensitivity_error : str
        Its relative standard error, for example "4 %"; the stiffness takes it twice.
    static : bool
        The sensitivity, or the one that a spectrum in metres was made with, is that of a force curve (InvOLS).
    static_slope_ratio : float
        With --static: dynamic over static sensitivity; that of a uniform beam unless given.
    temperature : str
        Temperature of the lever.
    between : str
        Frequencies to fit between, for example "60 kHz to 80 kHz"; about the largest peak unless given.
    modes : int
        How many modes to fit, 1 to 4.
    averages : float
        Averages behind each bin; from the scatter of the bins unless given.
    channel : str
        Column or variable, where the file holds several spectra.
    unit : str
        Unit of the density, where the file states none.
    plot : Path
        Figure of spectrum and fit (.png, .svg, .pdf).
    output : Path
        Lever as part of a probe file (.toml), to which drive and tip are to be added.
    """
    from overtone.instrument.thermal import fit_thermal
    from overtone.io.spectrum import read_spectrum

    _check_paths(file, {"--plot": (plot, tuple(_FIGURES)), "--output": (output, (".toml",))})
    scale = None if sensitivity is None else parse_quantity(sensitivity, "m/V", "--sensitivity")
    error = (
        0.0 if sensitivity_error is None else parse_quantity(sensitivity_error, "1", "--sensitivity-error")
    )
    kelvin = parse_quantity(temperature, "K", "--temperature")
    limits = None if between is None else _limits(between)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OvertoneWarning)
        spectrum = read_spectrum(file, channel=channel, unit=unit)
        fit = fit_thermal(
            spectrum,
            temperature=kelvin,
            sensitivity=scale,
            sensitivity_error=error,
            sensitivity_kind="static" if static else "dynamic",
            static_slope_ratio=static_slope_ratio if static else None,
            between=limits,
            modes=modes,
            averages=averages,
        )
    said = list(dict.fromkeys(str(warning.message) for warning in caught))
    console = Console(highlight=False)
    factor, shown = _shown(fit, scale, static_slope_ratio if static else 1.0)
    _print(console, file, fit, factor, shown, static)
    for sentence in said:
        console.print(f"- {sentence}", markup=False)
    if plot is not None:
        _plot(spectrum, fit, factor, shown, plot)
        console.print(f"wrote {plot}", soft_wrap=True, markup=False)
    if output is not None:
        _write(fit, file, output)
        console.print(f"wrote {output}", soft_wrap=True, markup=False)


def _check_paths(file: Path, outputs: dict[str, tuple[Path | None, tuple[str, ...]]]) -> None:
    """Refuse outputs that could not be written, or would replace the spectrum."""
    for option, (path, endings) in outputs.items():
        if path is None:
            continue
        if path.suffix.lower() not in endings:
            raise OvertoneError(
                f"{path.name} is no name for {option}",
                expected=f"a name that ends in {' or '.join(endings)}",
            )
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir() or path.resolve() == file.resolve():
            raise OvertoneError(f"{path} is taken", expected="the name of a file of its own")


def _limits(text: str) -> tuple[float, float]:
    low_text, to, high_text = text.partition(" to ")
    if to and low_text.strip() and high_text.strip():
        low, high = (parse_quantity(part, "Hz", "--between") for part in (low_text, high_text))
        if low < high:
            return low, high
    raise OvertoneError(
        "--between is no range",
        expected='the lower frequency first, such as "60 kHz to 80 kHz"',
        got=repr(text),
    )


def _shown(fit: Any, scale: float | None, ratio: float) -> tuple[float, str]:
    """Return what turns the root of the spectrum into the unit it is shown in, and that unit."""
    if scale is not None:
        return scale * ratio, "m"
    unit: str = fit.unit[0]
    return (ratio if unit == "m" else 1.0), unit


def _print(console: Console, file: Path, fit: Any, factor: float, unit: str, static: bool) -> None:
    table = Table(title=f"Lever from {file.name}")
    for heading in ("quantity", "value", "standard error", "remark"):
        table.add_column(heading, overflow="fold")
    if fit.stiffness is None:
        table.add_row("stiffness k1", "-", "-", "needs --sensitivity: the spectrum is in volts")
    else:
        remark = "dynamic, of the first mode at the tip" + (", from a static sensitivity" if static else "")
        table.add_row("stiffness k1", *_with_error(fit.stiffness, fit.stiffness_error, "N/m"), remark)
    for number, one in enumerate((fit, *fit.higher), start=1):
        table.add_row(f"resonance f{number}", *_with_error(one.frequency, one.frequency_error, "Hz"), "")
        table.add_row(
            f"quality factor Q{number}",
            *_with_error(one.quality_factor, one.quality_factor_error, "1"),
            f"{one.bins_per_width:.3g} bins in f{number}/Q{number}",
        )
    floor = factor * math.sqrt(fit.floor)
    table.add_row("noise floor", f"{format_quantity(floor, unit)}/√Hz" if floor else "below the peak", "", "")
    console.print(table)
    low, high = (format_quantity(end, "Hz", 6) for end in fit.between)
    console.print(
        f"{fit.bins} bins from {low} to {high}, each worth {fit.averages:.3g} averages; chi2/dof "
        f"{fit.chi2_per_dof:.3g} (expected 1 ± {fit.chi2_error:.2g}); {fit.temperature:g} K.",
        markup=False,
    )


def _with_error(value: float, error: float, unit: str) -> tuple[str, str]:
    """Return a value with the digits that its error leaves, and the error in the same unit."""
    display = display_unit(value, unit)
    shown, spread = value * display.factor, error * display.factor
    if not spread > 0.0:
        return f"{shown:.6g} {display.label}".strip(), "-"
    digits = min(max(1 - math.floor(math.log10(spread)), 0), 9)
    return (
        f"{shown:.{digits}f} {display.label}".strip(),
        f"{spread:.{digits}f} ({100.0 * error / value:.2g} %)",
    )


def _plot(spectrum: Any, fit: Any, factor: float, unit: str, path: Path) -> None:
    from overtone.io.atomic import atomic_path
    from overtone.plots.thermal import thermal_figure

    figure = thermal_figure(spectrum, fit, factor, unit)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=_FIGURES[path.suffix.lower()])


def _write(fit: Any, file: Path, path: Path) -> None:
    from overtone.io.atomic import atomic_path

    if fit.stiffness is None:
        raise OvertoneError(
            "no lever can be written without a stiffness",
            expected="a sensitivity for a spectrum in volts",
            hint='--sensitivity "60 nm/V"',
        )
    lines = [
        f"# From the thermal spectrum {file.name}; standard errors:",
        f"# stiffness {fit.stiffness_error:.2g} N/m, frequency {fit.frequency_error:.2g} Hz, "
        f"quality factor {fit.quality_factor_error:.2g}.",
        "# A probe needs [drive] (frequency, free_amplitude) and [tip] (radius) as well.",
        "[cantilever]",
        f'stiffness = "{fit.stiffness:.6g} N/m"',
        f'frequency = "{fit.frequency:.9g} Hz"',
        f"quality_factor = {fit.quality_factor:.6g}",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")

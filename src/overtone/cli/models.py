"""``overtone models``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from overtone.cli.options import parse_pairs
from overtone.errors import OvertoneError
from overtone.units import parse_quantity


def models(
    key: str | None = None,
    /,
    *,
    values: Annotated[tuple[str, ...], Parameter(name="--set")] = (),
    amplitude: str = "40 nm",
    plot: Path | None = None,
) -> None:
    """List the contact models: what they assume, what they need, where they come from.

    Parameters
    ----------
    key : str
        One model only.
    values : tuple
        A parameter with its unit, for example modulus="1 GPa"; may be repeated. With radius, modulus,
        poisson_ratio and adhesion the Tabor parameter says which adhesive model suits.
    amplitude : str
        Amplitude A1 of the motion in the figure.
    plot : Path
        Figure of one model (.png): its force along a tap, and its harmonics against indentation.
    """
    from overtone.contact.models import contact_model
    from overtone.contact.models import models as contact_models
    from overtone.contact.table import rows

    given = _parse_values(values)
    console = Console(highlight=False)
    for model in contact_models() if key is None else (contact_model(key),):
        console.print(f"[bold]{model.key}[/]  {escape(model.title)}")
        table = Table(box=None, show_header=False, padding=(0, 1), pad_edge=False)
        for label, text in rows(model).items():
            table.add_row(f"  {label}", escape(text))
        console.print(table)
        console.print()
    if {"radius", "modulus", "poisson_ratio", "adhesion"} <= set(given):
        _print_tabor(console, given)
    if plot is not None:
        if key is None:
            raise OvertoneError(
                "a figure shows one model", expected="its key", hint="overtone models dmt --plot dmt.png"
            )
        _plot(key, given, parse_quantity(amplitude, "m", "--amplitude"), plot)
        console.print(f"wrote {plot}", markup=False)


def _parse_values(texts: tuple[str, ...]) -> dict[str, float]:
    """Return --set NAME=VALUE options in SI units."""
    from overtone.contact.models import models as contact_models

    units = {q.name: q.unit for model in contact_models() for q in model.parameters}
    values = {}
    for name, text in parse_pairs(texts, "--set").items():
        if name not in units:
            raise OvertoneError(f"no model has a parameter {name!r}", expected=", ".join(sorted(units)))
        unit = "1" if "^p" in units[name] else units[name]
        values[name] = parse_quantity(text, unit, f"--set {name}")
    return values


def _print_tabor(console: Console, given: Mapping[str, float]) -> None:
    from overtone.contact.validity import adhesion_regime, tabor_parameter

    names = ("radius", "modulus", "poisson_ratio", "adhesion", "intermolecular_distance", "tip_modulus")
    arguments: dict[str, Any] = {name: given[name] for name in names if name in given}
    tabor = float(tabor_parameter(**arguments))
    console.print(f"Tabor parameter {tabor:.2g}: {adhesion_regime(tabor)}.", markup=False)


def _plot(key: str, given: Mapping[str, float], amplitude: float, path: Path) -> None:
    from overtone.io.atomic import atomic_path
    from overtone.plots.model import example_values, model_figure

    if path.suffix.lower() != ".png":
        raise OvertoneError(f"no figure can be written to {path.name}", expected="a name that ends in .png")
    values = example_values(key) | {
        name: value for name, value in given.items() if name in example_values(key)
    }
    figure = model_figure(key, values, amplitude)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")

"""``overtone models``."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table


def models() -> None:
    """List the contact models: what they assume, what they need, where they come from."""
    from overtone.contact.models import models as contact_models

    console = Console(highlight=False)
    for model in contact_models():
        console.print(f"[bold]{model.key}[/]  {escape(model.title)}")
        rows = {
            "force": " + ".join(term.formula for term in model.terms),
            "material": ", ".join(f"{p.name} [{p.unit}]" for p in model.unknowns),
            "needs": ", ".join(p.name for p in model.given if p.default is None),
            "use": "simulation and inversion" if model.invertible else "force and harmonics only",
            "assumes": model.assumptions,
            "source": model.source,
        }
        table = Table(box=None, show_header=False, padding=(0, 1), pad_edge=False)
        for label, text in rows.items():
            table.add_row(f"  {label}", escape(text))
        console.print(table)
        console.print()

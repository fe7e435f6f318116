"""``overtone models``."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table


def models() -> None:
    """List the contact models: what they assume, what they need, where they come from."""
    from overtone.contact.models import models as contact_models

    table = Table(show_lines=True)
    for heading in ("model", "what it is", "looks for", "must be given", "assumes"):
        table.add_column(heading, overflow="fold")
    for model in contact_models():
        use = "" if model.invertible else " (simulation only)"
        needs = ", ".join(p.name for p in model.given if p.default is None)
        finds = ", ".join([*(p.name for p in model.unknowns), "indentation"])
        table.add_row(model.key, f"{model.title}{use}", finds, needs, f"{model.assumptions} [{model.source}]")
    Console().print(table, markup=False)

"""The registry of contact models as text, for pages and terminals."""

from __future__ import annotations

import sys
from pathlib import Path

from overtone.contact.models import BUILT_IN, ContactModel


def rows(model: ContactModel) -> dict[str, str]:
    """Return what there is to say of a model, label to text."""
    needs = [parameter.name for parameter in model.given if parameter.default is None]
    return {
        "force": " + ".join(term.formula for term in model.terms).replace("+ -", "- "),
        "material": ", ".join(f"{parameter.name} [{parameter.unit}]" for parameter in model.unknowns),
        "needs": ", ".join(needs) or "nothing else",
        "use": "simulation and inversion" if model.invertible else "force and harmonics",
        "assumes": model.assumptions,
        "source": model.source,
    }


def markdown() -> str:
    """Return every model of the package as a section of a page."""
    sections = []
    for model in BUILT_IN:
        lines = [f"## `{model.key}`", "", f"{model.title}.", ""]
        lines += [f"- **{label}**: {text}" for label, text in rows(model).items()]
        sections.append("\n".join(lines))
    return "\n\n".join(sections) + "\n"


PAGE = """# Contact models

Written by `python -m overtone.contact.table docs/models.md`; a test holds this page against the registry. Every model
has `ot.force(key, gap, velocity, ...)` and `ot.force_harmonics(key, amplitude=, indentation=, ...)`. How to add one:
[add a contact model](add-a-contact-model.md). Which adhesive model suits a contact is what the Tabor parameter says
(`overtone.contact.validity`): below 0.1 DMT, above 5 JKR, between them Maugis.

"""

if __name__ == "__main__":
    Path(sys.argv[1]).write_text(PAGE + markdown(), encoding="utf-8")

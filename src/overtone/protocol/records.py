"""The content of the protocol: steps and vendors, read from the TOML files beside this module."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

from overtone.errors import OvertoneError


@dataclass(frozen=True)
class Step:
    """One step at the microscope, the same for every vendor.

    Parameters
    ----------
    key : str
        Name by which vendors refer to it.
    title, do, why, check : str
        What it is called, what to do, what it moves, and how to tell that it worked. Names in braces are
        numbers of a probe (`overtone.protocol.numbers.texts`).
    """

    key: str
    title: str
    do: str
    why: str
    check: str


@dataclass(frozen=True)
class VendorStep:
    """How to reach the settings of one step in the software of a vendor.

    Parameters
    ----------
    step : str
        Key of the step.
    do : str
        Menus, fields and names.
    verified : bool
        Whether it was read in a public document or file; none was tried on an instrument.
    source : str
        That document or file; empty where not verified.
    """

    step: str
    do: str
    verified: bool
    source: str


@dataclass(frozen=True)
class Vendor:
    """A microscope, or a lock-in beside one.

    Parameters
    ----------
    key, name, software, files : str
        Name on the command line, name for people, what it runs, and what it saves.
    steps : tuple of VendorStep
        In the order of the protocol; a step without any needs nothing special.
    """

    key: str
    name: str
    software: str
    files: str
    steps: tuple[VendorStep, ...]

    def at(self, step: str) -> tuple[VendorStep, ...]:
        """Return what there is to say of a step."""
        return tuple(entry for entry in self.steps if entry.step == step)


@dataclass(frozen=True)
class Section:
    """Text before or behind the steps."""

    title: str
    text: str


@dataclass(frozen=True)
class Protocol:
    """Everything that is the same for every vendor."""

    title: str
    introduction: str
    steps: tuple[Step, ...]
    closing: tuple[Section, ...]


# The order in which vendors are offered.
_VENDORS = ("asylum", "bruker", "park", "jpk", "nanosurf", "lock-in")


def vendors() -> tuple[str, ...]:
    """Return the names that `vendor` knows.

    Examples
    --------
    >>> vendors()
    ('asylum', 'bruker', 'park', 'jpk', 'nanosurf', 'lock-in')
    """
    return _VENDORS


@functools.cache
def protocol() -> Protocol:
    """Return the steps that are the same for every vendor."""
    table = _table("protocol")
    return Protocol(
        title=table["title"],
        introduction=_clean(table["introduction"]),
        steps=tuple(Step(**_texts(entry)) for entry in table["steps"]),
        closing=tuple(Section(**_texts(entry)) for entry in table["closing"]),
    )


def vendor(key: str) -> Vendor:
    """Return a vendor by name; case does not matter.

    Raises
    ------
    OvertoneError
        If there is none of this name.

    Examples
    --------
    >>> vendor("Asylum").name
    'Asylum Research'
    """
    name = key.strip().casefold()
    if name not in _VENDORS:
        raise OvertoneError(
            f"no protocol for the vendor {key!r}",
            expected=f"one of {', '.join(_VENDORS)}",
            hint="lock-in, for a microscope that is not in this list and an external lock-in",
        )
    return _vendor(name)


@functools.cache
def _vendor(name: str) -> Vendor:
    table = _table(name)
    steps = tuple(
        VendorStep(
            step=entry["step"],
            do=_clean(entry["do"]),
            verified=entry["verified"],
            source=_clean(entry.get("source", "")),
        )
        for entry in table["steps"]
    )
    return Vendor(name, table["name"], table["software"], _clean(table["files"]), steps)


def _table(name: str) -> Mapping[str, Any]:
    file = resources.files("overtone") / "protocol" / f"{name}.toml"
    return tomllib.loads(file.read_text(encoding="utf-8"))


def _texts(entry: Mapping[str, str]) -> dict[str, str]:
    return {name: _clean(text) for name, text in entry.items()}


def _clean(text: str) -> str:
    """Return the text without the white space around it: a TOML string begins and ends as is easiest to read."""
    return text.strip()

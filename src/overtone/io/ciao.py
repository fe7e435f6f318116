"""The header of NanoScope files: lists of parameters, and values that name the sensitivity they are scaled with.

A file begins with text in Latin-1, one parameter a line and one list a part of the instrument. A value such as
``V [Sens. Zsens] (0.0007060985 V/LSB) 46.27417 V`` holds the name of its sensitivity, volts a count and volts; the
sensitivity stands under its own name (``@Sens. Zsens: V 21.65764 nm/V``) in whichever list it belongs to. Without a
unit, as in ``V 1.000000``, it is the placeholder for "never calibrated" and leaves the value in volts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from overtone.io.si import to_si

END = b"\x1a"
MOST_LISTS = 1000
"""Lists beyond these are not parsed, but for the first of them."""
_LAST_LINE = b"\\*File list end"
_LONGEST_HEADER = 1 << 20
_LONGEST_NUMBER = 40
_LONGEST_VALUE = 200
_VALUE = re.compile(
    r"V\s*(?:\[([^\]]*)\])?\s*(?:\(\s*(\S+)[^/]*/LSB\))?\s*([-+]?\d[\d.]*(?:[eE][-+]?\d+)?)(.*)"
)
_SELECTED = re.compile(r'S\s*\[([^\]]*)\]\s*"([^"]*)"')
# As the software writes units that Latin-1, or its own habit, has no plain text for.
_SPELLINGS = {"~m": "um", "º": "deg", "°": "deg"}


@dataclass(frozen=True)
class Value:
    """A parameter with a unit.

    Parameters
    ----------
    number, unit : float, str
        Value in the electronics' own unit, as written.
    sensitivity : str
        Name of what scales it, such as ``Sens. Zsens``; empty where nothing does.
    count : float or None
        Value of one count in the same unit, None where the file states none.
    linked : bool
        Whether it repeats another pass, and the number is not in force.
    """

    number: float
    unit: str
    sensitivity: str = ""
    count: float | None = None
    linked: bool = False


@dataclass(frozen=True)
class Scaling:
    """What turns a number in the electronics' own unit into ``unit``; None where the file states no known one."""

    factor: float
    unit: str | None
    key: str = ""
    """The key of the sensitivity, empty where there is none with a unit."""


class Parameters:
    """One list of a header; the case of a key varies between versions of the software."""

    def __init__(self, title: str, lines: Sequence[tuple[str, str]]) -> None:
        self.title = title
        self._by_key: dict[str, tuple[str, str]] = {}
        for key, text in lines:
            self._by_key.setdefault(key.lower(), (key, text))

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield key and text of every parameter, in the order of the file; of one that comes twice the first."""
        yield from self._by_key.values()

    def text(self, key: str) -> str | None:
        """Return the text of a parameter, None where the list has none."""
        return self._by_key.get(key.lower(), ("", None))[1]

    def find(self, name: str, groups: Sequence[str] = ("2", "1", "4", "")) -> tuple[str, str] | None:
        """Return key and text of a scaled parameter such as ``@2:Z scale``, from the first group that has it."""
        for group in groups:
            found = self._by_key.get(f"@{group}:{name}".lower() if group else f"@{name}".lower())
            if found is not None:
                return found
        return None


class Header:
    """All lists of a header in their order."""

    def __init__(self, lists: Sequence[Parameters]) -> None:
        self.lists = tuple(lists)

    def titled(self, title: str) -> tuple[Parameters, ...]:
        """Return the lists of a title."""
        return tuple(one for one in self.lists if one.title.lower() == title.lower())

    def text(self, key: str) -> str | None:
        """Return the text of a parameter from the first list that has it."""
        return next((text for one in self.lists if (text := one.text(key)) is not None), None)

    def value(self, *names: str, group: str = "2") -> tuple[str, Value] | None:
        """Return key and value of the first of these parameters that the header has, None where it has none.

        Group 2 is the main pass, group 3 the interleaved one.
        """
        groups = (group,) if group == "3" else (group, "1", "")
        for name in names:
            for one in self.lists:
                found = one.find(name, groups)
                value = parse_value(found[1]) if found else None
                if found and value is not None:
                    return found[0], value
        return None

    def scaling(self, unit: str, sensitivity: str) -> Scaling:
        """Return what a number in this unit is multiplied with, and the SI unit that it has then."""
        own = to_si(spelled(unit)) if unit else None
        plain = Scaling(own[0], own[1]) if own else Scaling(1.0, None)
        text = self.text(f"@{sensitivity}") if sensitivity else None
        value = parse_value(text) if text else None
        if value is None or not value.unit:
            return Scaling(plain.factor * (value.number if value else 1.0), plain.unit)
        above, slash, below = value.unit.rpartition("/")
        target, base = to_si(spelled(above)), to_si(spelled(below))
        key = f"@{sensitivity}"
        if slash and target is not None and own is not None and base is not None and own[1] == base[1]:
            return Scaling(own[0] / base[0] * value.number * target[0], target[1], key)
        if slash and target is not None and below == unit:
            return Scaling(value.number * target[0], target[1], key)
        return Scaling(value.number, None, key)


def split_header(content: bytes) -> bytes | None:
    """Return the text at the beginning of a file, None where it has no end."""
    beginning = content[:_LONGEST_HEADER]
    ends = [at for mark in (END, _LAST_LINE) if (at := beginning.find(mark)) >= 0]
    return beginning[: min(ends)] if ends else None


def parse_header(content: bytes) -> Header:
    """Return the lists of a header; lines that are no parameter are passed over."""
    lists: list[Parameters] = []
    title, lines = "", list[tuple[str, str]]()
    for line in content.decode("latin-1").splitlines():
        if line.startswith("\\*"):
            if lines or title:
                lists.append(Parameters(title, lines))
            if len(lists) > MOST_LISTS:
                break
            title, lines = line[2:].strip(), []
        elif line.startswith("\\"):
            key, text = _pair(line[1:])
            if key:
                lines.append((key, text))
    else:
        lists.append(Parameters(title, lines))
    return Header(lists)


def _pair(line: str) -> tuple[str, str]:
    # The colon behind the number of a group, as in @2:Z scale, does not end the key.
    group = 3 if re.match(r"@\d:", line) else 0
    at = line.find(":", group)
    return (line[:at].strip(), line[at + 1 :].strip()) if at > 0 else ("", "")


def parse_value(text: str) -> Value | None:
    """Return a parameter with a unit, None where the text is none."""
    match = _VALUE.fullmatch(text.strip()) if len(text) <= _LONGEST_VALUE else None
    number = number_of(match.group(3)) if match else None
    if match is None or number is None:
        return None
    unit, linked, _ = match.group(4).strip().partition("linked")
    return Value(number, unit.strip(), match.group(1) or "", number_of(match.group(2) or ""), bool(linked))


def parse_selected(text: str) -> tuple[str, str]:
    """Return the internal name and the label of what ``S [name] "label"`` selects; empty where it selects none."""
    match = _SELECTED.match(text[:_LONGEST_VALUE])
    return (match.group(1).strip(), match.group(2).strip()) if match else ("", "")


def spelled(unit: str) -> str:
    """Return a unit as people write it."""
    return _SPELLINGS.get(unit.strip(), unit.strip())


def number_of(text: str) -> float | None:
    """Return a finite number, None where the text is none."""
    if len(text) > _LONGEST_NUMBER:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def raw_metadata(header: Header, of_its_own: str) -> Mapping[str, str]:
    """Return key and text of every parameter, those of the lists with this title told apart by their number."""
    entries: dict[str, str] = {}
    for key, text in _numbered(header, of_its_own.lower()):
        entries.setdefault(key, text)
    return entries


def _numbered(header: Header, title: str) -> Iterator[tuple[str, str]]:
    count = 0
    for one in header.lists:
        if one.title.lower() == title:
            count += 1
        for key, text in one.entries():
            yield (f"image {count}: {key}" if one.title.lower() == title else key), text

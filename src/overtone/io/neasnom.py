"""A neaSNOM measurement: a folder of .gsf files, one a channel, with an .html page of settings.

The files share the beginning of their names; what follows it names the channel: ``Z`` is the
height, ``M0A`` to ``M5A`` and ``M0P`` to ``M5P`` are amplitude and phase of the harmonics of the
tip motion, ``O0A`` and so on those of the optical signal. ``R-`` before the name marks the
backward line, ``raw`` behind it an unprocessed copy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io import gsf
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.si import to_si

_LARGEST_PAGE = 8 << 20
_CAPTIONS = ("Tip Frequency", "Tapping Amplitude")
_PHASE = re.compile(r"[MO]\d+P")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3})+")
_AGREEMENT = 0.02


@dataclass(frozen=True)
class _Set:
    """One measurement: its page of settings and its fields by what follows the common name."""

    page: Path
    fields: Mapping[str, Path]


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the path is a neaSNOM folder, its page of settings or one of its fields."""
    return bool(_pages(path))


def read(path: Path) -> Recording:
    """Read a neaSNOM measurement whole, from its folder, its page of settings or any of its fields.

    The files give no unit for amplitudes. ``M1A`` is taken to be in nanometres where its mean
    agrees with the tapping amplitude of the page within two per cent, and a note says so; all
    other amplitudes stay as they are, without a unit. Phases are in radians.

    Parameters
    ----------
    path : Path
        The folder, its .html page, or one of the .gsf files.

    Raises
    ------
    FileFormatError
        If a file of the set is damaged or the folder holds several measurements.
    """
    measurement = _find(path)
    notes: list[str] = []
    settings = _settings(measurement.page, notes)
    fields = {token: gsf.read_field(file) for token, file in measurement.fields.items()}
    first = fields.get("Z") or next(iter(fields.values()))
    backward = any(token.startswith("R-") for token in fields)
    names = _names(tuple(fields))
    channels = []
    for token, one in fields.items():
        if one.values.shape != first.values.shape:
            notes.append(
                f"{token}: left out, {one.values.shape} pixels where the others have {first.values.shape}"
            )
            continue
        values, unit = _values(names[token], one, settings, notes)
        direction = ("retrace" if token.startswith("R-") else "trace") if backward else None
        channels.append(Channel(names[token], values, unit, direction))
    without_unit = [channel.name for channel in channels if channel.unit is None]
    if without_unit:
        notes.append(f"no unit in the file: {', '.join(without_unit)}")
    rows = gsf.number(first.header.get("YResIncomplete", ""))
    if rows < first.values.shape[0]:
        notes.append(f"the scan is incomplete: {rows:g} of {first.values.shape[0]} lines were recorded")
    return Recording(
        path=path,
        format="neasnom",
        vendor="neasnom",
        dims=("y", "x"),
        coords=_coordinates(first, settings, notes),
        channels=tuple(channels),
        facts=_facts(settings),
        metadata={
            **first.header,
            **{f"{key} {e.unit}".strip(): "; ".join(e.values) for key, e in settings.items()},
        },
        notes=tuple(notes),
    )


# --- the files of a set ---------------------------------------------------------------------------


def _find(path: Path) -> _Set:
    pages = _pages(path)
    if len(pages) != 1:
        raise FileFormatError(
            f"{path.name} is not one neaSNOM measurement",
            expected="one .html page beside its .gsf files",
            got=", ".join(page.name for page in pages[:5]) or "none",
            hint="the .html page of the measurement you mean",
        )
    page = pages[0]
    fields = {file.stem.removeprefix(page.stem).strip(): file for file in _fields(page)}
    if not fields:
        raise FileFormatError(
            f"{page.name} has no channels",
            expected=f"files named {page.stem + ' Z.gsf'!r} and so on in the same folder",
            got="none",
            hint="copy the whole folder of the measurement",
        )
    return _Set(page, fields)


def _pages(path: Path) -> list[Path]:
    if path.is_dir():
        return [page for page in sorted(path.glob("*.html")) if _is_page(page) and _fields(page)]
    if path.suffix.lower() in (".html", ".htm"):
        return [path] if _is_page(path) else []
    if path.suffix.lower() == ".gsf":
        pages = [p for p in path.parent.glob("*.html") if path.name.startswith(f"{p.stem} ") and _is_page(p)]
        return sorted(pages, key=lambda page: len(page.stem))[-1:]
    return []


def _fields(page: Path) -> list[Path]:
    # Not a pattern with the name of the page: it may hold brackets.
    return [file for file in sorted(page.parent.glob("*.gsf")) if file.name.startswith(f"{page.stem} ")]


def _is_page(path: Path) -> bool:
    try:
        if path.stat().st_size > _LARGEST_PAGE:
            return False
        content = path.read_bytes()
    except OSError:
        return False
    return content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"<" and any(
        c.encode() in content for c in _CAPTIONS
    )


def _names(tokens: tuple[str, ...]) -> dict[str, str]:
    # A raw copy bears the plain name only where there is no other field of that name.
    names = {}
    for token in tokens:
        plain = re.sub(r"\s+raw$", "", token)
        names[token] = (plain if plain == token or plain not in tokens else token).removeprefix("R-")
    return names


# --- the page of settings -------------------------------------------------------------------------


@dataclass(frozen=True)
class _Entry:
    unit: str
    """As on the page, in brackets."""
    values: tuple[str, ...]


@dataclass
class _Row:
    cells: list[str] = field(default_factory=list)


class _Table(HTMLParser):
    """Collects the text of the cells of every table row."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.rows: list[_Row] = []
        self.is_whole = True
        """Whether the last row has an end; else the page was cut off, perhaps within a number."""
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "tr":
            self.rows.append(_Row())
            self.is_whole = False
        elif tag in ("td", "th") and self.rows:
            self.rows[-1].cells.append("")
        self._inside = tag in ("td", "th") or (self._inside and tag != "tr")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "tr"):
            self._inside = False
        if tag in ("tr", "table"):
            self.is_whole = True

    def handle_data(self, data: str) -> None:
        if self._inside and self.rows and self.rows[-1].cells:
            self.rows[-1].cells[-1] += data


def _settings(page: Path, notes: list[str]) -> dict[str, _Entry]:
    content = page.read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    table = _Table()
    table.feed(text)
    table.close()
    entries: dict[str, _Entry] = {}
    rows = table.rows
    if not table.is_whole:
        rows = rows[:-1]
        notes.append(f"{page.name} was cut off: settings behind row {len(rows)} of its table are missing")
    for row in rows:
        caption, *cells = [cell.replace("\xa0", " ").strip() for cell in row.cells] or [""]
        if not caption.endswith(":"):
            continue
        unit = next((cell for cell in cells if re.fullmatch(r"\[.*\]", cell)), "")
        values = tuple(cell for cell in cells if cell and cell != unit)
        entries.setdefault(caption.rstrip(": "), _Entry(unit, values))
    return entries


def _quantity(settings: Mapping[str, _Entry], key: str, unit: str, index: int = 0) -> float | None:
    """Return a setting in SI units, None where it is missing, zero or in another unit."""
    entry = settings.get(key)
    if entry is None or len(entry.values) <= index:
        return None
    known = to_si(entry.unit.strip("[]"))
    value = _number(entry.values[index])
    if known is None or known[1] != unit or not math.isfinite(value) or value == 0.0:
        return None
    return value * known[0]


def _number(text: str) -> float:
    """Return a number written with separators of thousands, such as ``237,595.092``."""
    if "," in text and ("." in text or _THOUSANDS.fullmatch(text)):
        decimal_comma = text.rfind(",") > text.rfind(".") > -1
        text = text.replace(".", "") if decimal_comma else text.replace(",", "")
    return gsf.number(text.replace(",", "."))


# --- what it says ---------------------------------------------------------------------------------


def _facts(settings: Mapping[str, _Entry]) -> dict[str, Fact]:
    facts = {}
    for name, key, unit in (
        ("drive_frequency", "Tip Frequency", "Hz"),
        ("setpoint_amplitude", "Tapping Amplitude", "m"),
        ("setpoint_fraction", "Setpoint", "1"),
        ("scale:M1A", "M1A Scaling", "m/V"),
    ):
        value = _quantity(settings, key, unit)
        if value is not None:
            facts[name] = Fact(value, unit, f"{key} {settings[key].unit}")
    return facts


def _values(
    name: str, one: gsf.Field, settings: Mapping[str, _Entry], notes: list[str]
) -> tuple[npt.NDArray[np.float64], str | None]:
    base = name.split()[0]
    if _PHASE.fullmatch(base):
        return one.values, "rad"
    if one.header.get("ZUnits"):
        return gsf.in_si(one, name, notes)
    tapping = _quantity(settings, "Tapping Amplitude", "m")
    finite = one.values[np.isfinite(one.values)]
    mean = float(finite.mean()) if finite.size else math.nan
    if base == "M1A" and tapping is not None and abs(mean * 1e-9 / tapping - 1.0) <= _AGREEMENT:
        notes.append(
            f"{name}: taken to be in nm, because its mean, {mean:.3f}, agrees with the tapping amplitude "
            f"of the page, {tapping * 1e9:.3f} nm"
        )
        return one.values * 1e-9, "m"
    if base == "M1A" and tapping is not None:
        notes.append(
            f"{name}: not taken to be in nm, because its mean, {mean:.3f}, is not the tapping amplitude "
            f"of the page, {tapping * 1e9:.3f} nm"
        )
    return one.values, None


def _coordinates(
    first: gsf.Field, settings: Mapping[str, _Entry], notes: list[str]
) -> dict[str, npt.NDArray[np.float64]]:
    said: list[str] = []
    coords = gsf.pixel_centres(first, said)
    if coords:
        return coords
    key = next((key for key in settings if key.startswith("Scan Area")), "")
    size_x, size_y = _quantity(settings, key, "m", 0), _quantity(settings, key, "m", 1)
    if size_x is None or size_y is None or size_x < 0.0 or size_y < 0.0:
        notes.extend(said)
        return {}
    notes.append("the fields state no usable image size; the scan area of the page was taken")
    return gsf.centres(first.values.shape, size_x, size_y)

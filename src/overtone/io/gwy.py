"""Gwyddion's own files (.gwy): every data field of a file is a channel.

Field number N is ``/N/data``, its title ``/N/data/title``, its metadata ``/N/meta``; row 0 is at the top. What
Gwyddion imported from Asylum's .ibw keeps most of their note in the metadata, so nearly the same is known of it as of
the .ibw.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io import asylum
from overtone.io.gsf import centres
from overtone.io.gwy_container import CONTAINER, MAGIC, OLD_MAGIC, GwyObject, parse
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si
from overtone.quantities import LIFT

FIELD, UNIT = "GwyDataField", "GwySIUnit"
# What overtone writes beside its attributes: its version, whether the channels are as another file holds them, and
# what belongs to one channel alone.
VERSION_KEY, RAW_KEY, OF_CHANNEL = "overtone", "overtone raw channels", "channel: "
_DATA = re.compile(r"/(\d{1,9})/data")
_OTHER_KINDS = re.compile(r"/(?:(brick|surface|xyz|sps|cm)/.*|0/(graph)/graph/.*|(\d+)/(show))")
# Steps of Gwyddion that take the absolute value of a channel away.
_LEVELLING = re.compile(
    r"(?:proc|tool)::\w*?(?:level|flatten|align_rows|line_?match|line_?correct|fix_?zero|zero_mean|median.?bg|revolve|"
    r"trimmed.?mean)",
    re.IGNORECASE,
)
_MOST_LISTED = 8


@dataclass(frozen=True)
class _Field:
    """One data field as the file holds it."""

    index: int
    title: str
    values: npt.NDArray[np.float64]
    size: tuple[float, float] | None
    """Width and height [m], None where the file gives no lengths."""
    unit: str
    """As the file states it."""
    meta: Mapping[str, str]
    log: tuple[str, ...]
    mask: npt.NDArray[np.float64] | None


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins like one of Gwyddion, or of Gwyddion 1."""
    return head.startswith((MAGIC + CONTAINER.encode() + b"\0", OLD_MAGIC + CONTAINER.encode() + b"\0"))


def read(path: Path) -> Recording:
    """Read every data field of a Gwyddion file.

    A title such as ``HeightRetrace`` is split into name and direction, as the labels of an .ibw are. Gwyddion's
    values are in base units whatever prefix the unit bears: ``nm`` means metres there. Fields of another size than
    the commonest are left out, and so are masks, graphs and volumes; notes name them. In files that overtone wrote a
    mask marks pixels without a value, which are NaN here.

    Parameters
    ----------
    path : Path
        The .gwy file.

    Raises
    ------
    FileFormatError
        If the file is damaged or holds no data field.
    """
    root = parse(path, path.read_bytes())
    notes: list[str] = []
    fields = _fields(path, root, notes)
    shape, size = Counter((one.values.shape, one.size) for one in fields).most_common(1)[0][0]
    kept = [one for one in fields if (one.values.shape, one.size) == (shape, size)]
    if len(kept) < len(fields):
        others = [one.title for one in fields if one not in kept]
        notes.append(f"left out, because their size differs from the {len(kept)} others: {_listed(others)}")
    metadata = _common(kept, notes)
    settings = asylum.Settings(metadata)
    ours, raw = VERSION_KEY in metadata, RAW_KEY in metadata
    is_asylum = asylum.is_asylum(settings) and not (ours and not raw)
    channels = tuple(_channel(one, ours, settings if is_asylum else None, notes) for one in kept)
    masked = [one.title for one in kept if one.mask is not None]
    if masked and not ours:
        notes.append(f"masks were not used: {_listed(masked)}")
    if is_asylum:
        # Gwyddion keeps the last of two values of a key, and of some settings none: set-point, flattening.
        notes.extend(asylum.changed_during_the_scan(metadata.items()))
    if size is None:
        notes.append("the file states no usable image size, so there are no coordinates")
    return Recording(
        path=path,
        format="gwy",
        vendor="asylum" if is_asylum else "overtone" if ours and not raw else "gwyddion",
        dims=("y", "x"),
        coords={} if size is None else centres(shape, *size),
        channels=channels,
        facts=asylum.facts_of(settings, {channel.name for channel in channels}) if is_asylum else {},
        resonances=asylum.resonances_of(settings, notes) if is_asylum else (),
        metadata=metadata,
        notes=tuple(notes),
    )


# --- the file -------------------------------------------------------------------------------------


def _fields(path: Path, root: GwyObject, notes: list[str]) -> list[_Field]:
    found = []
    for key, value in root.items.items():
        match = _DATA.fullmatch(key)
        if match and isinstance(value, GwyObject) and value.type == FIELD:
            found.append(_field(path, root.items, match.group(1), value, notes))
    others = Counter(
        next(filter(None, match.groups()[:2]), "presentation")
        for match in map(_OTHER_KINDS.fullmatch, root.items)
        if match
    )
    if others:
        notes.append(f"left out: {', '.join(f'{kind} ({count} entries)' for kind, count in others.items())}")
    if not found:
        raise FileFormatError(
            f"{path.name} holds no image",
            expected="a data field, such as /0/data",
            got=_listed(list(root.items)) or "an empty file",
            hint="a file with images; graphs and volumes are not read",
        )
    return sorted(found, key=lambda one: one.index)


def _field(path: Path, items: Mapping[str, Any], number: str, data: GwyObject, notes: list[str]) -> _Field:
    values = _array(path, f"/{number}/data", data)
    title = items.get(f"/{number}/data/title")
    if not isinstance(title, str) or not title.strip():
        title = f"field {number}"
        notes.append(f"{title}: has no title in the file")
    meta, log, mask = (items.get(f"/{number}/{part}") for part in ("meta", "data/log", "mask"))
    lines = log.items.get("strings") if isinstance(log, GwyObject) else None
    return _Field(
        index=int(number),
        title=title.strip(),
        values=values,
        size=_size(data),
        unit=_stated_unit(data, "si_unit_z"),
        meta={k: v for k, v in meta.items.items() if isinstance(v, str)}
        if isinstance(meta, GwyObject)
        else {},
        log=tuple(line for line in lines if isinstance(line, str)) if isinstance(lines, list) else (),
        mask=_array(path, f"/{number}/mask", mask)
        if isinstance(mask, GwyObject) and mask.type == FIELD
        else None,
    )


def _array(path: Path, key: str, data: GwyObject) -> npt.NDArray[np.float64]:
    rows, columns, values = (data.items.get(name) for name in ("yres", "xres", "data"))
    if not (isinstance(rows, int) and isinstance(columns, int) and rows > 0 and columns > 0):
        raise _damaged(path, f"numbers of pixels in {key}", f"{columns!r} x {rows!r}")
    if not isinstance(values, np.ndarray) or values.dtype != np.float64:
        raise _damaged(path, f"an array of doubles in {key}", "none")
    if values.size != rows * columns:
        raise _damaged(
            path, f"{rows * columns} values for {columns} x {rows} pixels in {key}", f"{values.size}"
        )
    return values.reshape(rows, columns)


def _size(data: GwyObject) -> tuple[float, float] | None:
    width, height = data.items.get("xreal"), data.items.get("yreal")
    known = to_si(_stated_unit(data, "si_unit_xy"))
    if known is None or known[1] != "m" or not (isinstance(width, float) and isinstance(height, float)):
        return None
    return (width, height) if 0.0 < width < math.inf and 0.0 < height < math.inf else None


def _stated_unit(data: GwyObject, key: str) -> str:
    unit = data.items.get(key)
    text = unit.items.get("unitstr") if isinstance(unit, GwyObject) and unit.type == UNIT else ""
    return text.strip() if isinstance(text, str) else ""


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole Gwyddion file",
        expected=expected,
        got=got[:80],
        hint="copy or save the file again",
    )


# --- what it says ---------------------------------------------------------------------------------


def _common(fields: list[_Field], notes: list[str]) -> dict[str, str]:
    """Return the metadata on which all fields that have any agree: fields of several scans may share a file."""
    given = [one.meta for one in fields if one.meta]
    if not given:
        return {}
    common = {k: v for k, v in given[0].items() if all(other.get(k) == v for other in given)}
    differing = [k for k in given[0] if k not in common and not k.startswith(OF_CHANNEL)]
    if differing:
        notes.append(f"not used, because the channels disagree on it: {_listed(differing)}")
    return common


def _channel(one: _Field, ours: bool, settings: asylum.Settings | None, notes: list[str]) -> Channel:
    name, direction = asylum.split_label(one.title)
    factor, unit = _unit(one, notes)
    values = one.values * factor if factor != 1.0 else one.values.copy()
    if ours and one.mask is not None and one.mask.shape == values.shape:
        values[one.mask > 0.0] = math.nan
    levelled = any(map(_LEVELLING.match, one.log))
    stored = asylum.is_flattened(one.index, settings) if settings is not None else None
    return Channel(
        name=name,
        values=values,
        unit=unit,
        direction=direction,
        nap=asylum.is_nap(name) if settings is not None else ours and name.startswith(LIFT),
        flattened=True if levelled else stored,
    )


def _unit(one: _Field, notes: list[str]) -> tuple[float, str | None]:
    """Return the factor to SI and the unit; Gwyddion ignores prefixes, but degrees are degrees."""
    if not one.unit and one.meta.get(f"{OF_CHANNEL}units") == "1":
        return 1.0, "1"
    if not one.unit:
        notes.append(f"{one.title}: the file states no unit")
        return 1.0, None
    known = to_si(one.unit)
    if known is None:
        notes.append(f"{one.title}: the unit {one.unit!r} is not known; values are as in the file")
        return 1.0, None
    factor, unit = known
    exponent = math.log10(factor)
    if factor != 1.0 and math.isclose(exponent, round(exponent), abs_tol=1e-9):
        notes.append(
            f"{one.title}: the unit is {one.unit!r}, of which Gwyddion ignores the prefix: values are in {unit}"
        )
        return 1.0, unit
    return factor, unit


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
    return ", ".join(name[:40] for name in names[:_MOST_LISTED]) + more

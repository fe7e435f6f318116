"""Formats without a reader of their own, through Gwyddion's: the optional library gwyddionpy and its helper process.

The helper turns a file into Gwyddion's own format. It runs with a time limit and bounded memory, only for files that
begin like one of the formats below, and only what the module for that format read counts.

What is believed of it: the values and which row is the top (the tests check Nanonis, WSxM and Agilent by arithmetic
from the raw bytes); the size of the image and heights where the unit is the metre. Any other unit is
believed only where the header of the file, read here, confirms it; else the channel has none, because Gwyddion calls
mV V in some formats and guesses units from names in others.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError, OvertoneError
from overtone.io.gsf import centres
from overtone.io.gwyddion_units import Statement, confirmed, of_agilent, of_nanonis, of_wsxm
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si

_EXTRA = 'pip install "overtone[formats]"'
_SECONDS = 4.0
_LONGEST_HEADER = 1 << 20
# The helper and its libraries take up to 200 MB of addresses, Gwyddion's numbers 8 bytes where files have 2.
_ADDRESSES, _PER_BYTE = 256 << 20, 10
_LARGEST_ANSWER = 64 << 20
_HEIGHTS = ("z", "topography", "height", "zsensor", "z-axis")
_DIRECTION = re.compile(r"(.+?)[ _]*[(\[]?(forward|backward|trace|retrace)[)\]]?", re.IGNORECASE)
_NT_MDT = re.compile(r"\d+([FB]):.+")
_WORDS = {
    "forward": "trace",
    "trace": "trace",
    "backward": "retrace",
    "retrace": "retrace",
    "F": "trace",
    "B": "retrace",
}


def _nothing(header: bytes) -> list[Statement]:
    """Return no statements, where the header is not read here."""
    return []


@dataclass(frozen=True)
class Family:
    """A format that Gwyddion reads: how it begins, and what its header says of units.

    Parameters
    ----------
    vendor : str
        Key of the vendor preset.
    title : str
        Name for people.
    magic : bytes
        First bytes of the file, behind ``offset``.
    module : str
        Gwyddion's module for it.
    statements : callable
        Takes the beginning of the file and returns what it says of each channel, in the order of the file.
    offset : int
        Where the magic lies.
    """

    vendor: str
    title: str
    magic: bytes
    module: str
    statements: Callable[[bytes], list[Statement]] = _nothing
    offset: int = 0


@dataclass(frozen=True)
class _Field:
    """One image as Gwyddion gives it."""

    name: str
    data: npt.NDArray[Any]
    mask: npt.NDArray[np.bool_] | None
    size: tuple[float, float]
    si_unit_xy: str
    si_unit_z: str


_FAMILIES = (
    Family("nanonis", "a Nanonis scan", b":NANONIS_VERSION:", "nanonis", of_nanonis),
    Family("ntmdt", "an NT-MDT file", b"\x01\xb0\x93\xff", "nt-mdt"),
    Family("wsxm", "a WSxM file", b"WSxM file copyright", "wsxmfile", of_wsxm),
    Family("agilent", "an Agilent or Keysight file", b"fileType      Image", "mifile", of_agilent),
    Family("rhk", "an RHK SM4 file", "STiMage".encode("utf-16-le"), "rhk-sm4", offset=2),
    Family("iso28600", "an ISO 28600 file", b"ISO/TC 201 SPM data transfer format", "iso28600"),
    Family("attocube", "an attocube file", b"# Daisy ", "attocube"),
    Family("dme", "a DME file", b"GDEF", "gdeffile"),
    Family("bcr", "a BCR file", b"fileformat = bcrstm", "bcrfile"),
    Family("createc", "a Createc file", b"[Paramet", "createc"),
)


def family_of(head: bytes) -> Family | None:
    """Return the format that a file begins like, None where it is none of these."""
    return next(
        (one for one in _FAMILIES if head[one.offset : one.offset + len(one.magic)] == one.magic), None
    )


def is_installed() -> bool:
    """Tell whether the library and its helper are installed."""
    return all(find_spec(name) is not None for name in ("gwyddionpy", "gwyddionpy_converter"))


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins like a format that Gwyddion reads."""
    return family_of(head) is not None


def read(path: Path) -> Recording:
    """Read the images of a file through Gwyddion's helper.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    FileFormatError
        If the library is not installed, the helper cannot read the file within a few seconds, or it holds no image.
    """
    with path.open("rb") as stream:
        header = stream.read(_LONGEST_HEADER)
    family = family_of(header)
    if family is None:
        raise _refused(path, "a format for Gwyddion", repr(header[:24].decode("latin-1")))
    if not is_installed():
        raise FileFormatError(
            f"{path.name} is {family.title}, which overtone reads through Gwyddion",
            expected="the library gwyddionpy with its converter",
            got="none installed",
            hint=f"{_EXTRA}, or export the file as .gsf or as a table",
        )
    fields, metadata = _converted(path, family)
    statements: Sequence[Statement | None] = family.statements(header)
    if len(statements) != len(fields):
        statements = [None] * len(fields)
    notes = [f"read by Gwyddion ({family.module})"]
    first = next(iter(fields), None)
    if first is None:
        raise _refused(path, "an image", "none; curves and spectra are not read")
    channels = []
    for field, statement in zip(fields, statements, strict=True):
        if field.data.shape != first.data.shape or field.size != first.size:
            notes.append(f"{field.name}: left out, its pixels are not those of {first.name}")
        else:
            channels.append(_channel(field, statement, notes))
    return Recording(
        path=path,
        format="gwyddion",
        vendor=family.vendor,
        dims=("y", "x"),
        coords=_coordinates(first, notes),
        channels=tuple(channels),
        metadata=metadata,
        notes=tuple(notes),
    )


# --- channels -------------------------------------------------------------------------------------


def _channel(field: _Field, statement: Statement | None, notes: list[str]) -> Channel:
    name, direction = field.name, None
    match = _DIRECTION.fullmatch(name) or _NT_MDT.fullmatch(name)
    if match:
        direction = _WORDS[match[match.lastindex or 1].lower() if match.re is _DIRECTION else match[1]]
        name = match[1] if match.re is _DIRECTION else name
    if statement is not None and not _is_of(statement, name, direction):
        statement = None
    if statement is not None:
        name, direction = statement.name, statement.direction or direction
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        values = np.asarray(field.data, dtype=np.float64)
    stated = field.si_unit_z
    known = to_si(stated) if stated else None
    if field.mask is not None and field.mask.any():  # Gwyddion fills them and marks them
        values = np.where(field.mask, np.nan, values)
        notes.append(f"{name}: {field.mask.sum()} pixels are marked as invalid; they are NaN")
    if known is not None:
        if statement is not None:
            believed = confirmed(statement, values, known)
        else:
            believed = known[1] == "m" and name.lower() in _HEIGHTS
        if believed:
            return Channel(name, values * known[0], known[1], direction)
    said = "Gwyddion states none"
    if stated:
        reason = "is not known" if known is None else "is not confirmed by the header of the file"
        said = f"{stated[:40]!r}, which Gwyddion states, {reason}"
    notes.append(f"{name}{f' ({direction})' if direction else ''} has no unit: {said}")
    return Channel(name, values.copy(), None, direction)


def _is_of(statement: Statement, name: str, direction: str | None) -> bool:
    # The second channel of a name has a number in brackets behind it.
    named = name == statement.name or re.fullmatch(re.escape(statement.name) + r" \(\d+\)", name)
    return bool(named) and direction in (None, statement.direction)


def _coordinates(field: _Field, notes: list[str]) -> dict[str, npt.NDArray[np.float64]]:
    if field.si_unit_xy != "m" or not all(0.0 < size < 1.0 for size in field.size):
        notes.append("there is no usable image size, so there are no coordinates")
        return {}
    return centres(field.data.shape, *field.size)


# --- the helper -----------------------------------------------------------------------------------


def _converted(path: Path, family: Family) -> tuple[list[_Field], Mapping[str, str]]:
    """Return the fields and the metadata that the helper finds."""
    from gwyddionpy_converter import binary_path

    size = path.stat().st_size
    with tempfile.TemporaryDirectory(prefix="overtone-") as folder:
        answer, said, failed = (Path(folder, name) for name in ("answer.gwy", "said", "failed"))
        command = [str(binary_path()), str(path.resolve()), str(answer)]
        try:
            # Into files, which the limit on their size bounds, not into memory.
            with said.open("wb") as out, failed.open("wb") as err:
                status = subprocess.run(
                    _bounded(command, size),
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    check=False,
                    timeout=_SECONDS,
                    env=_environment(),
                ).returncode
        except subprocess.TimeoutExpired as expired:  # by now the helper is dead
            raise _refused(
                path, f"{family.title[2:].strip()} that opens in {_SECONDS:g} s", "no end"
            ) from expired
        if status != 0 or not answer.is_file():
            reason = failed.read_bytes()[:4096].decode("utf-8", "replace").strip().splitlines()
            text = reason[0].replace(str(path.resolve()), path.name)[:200] if reason else f"status {status}"
            raise _refused(path, f"{family.title} that Gwyddion reads", text)
        module = _module(said.read_bytes()[:4096])
        if module != family.module:
            raise _refused(
                path, f"{family.title} ({family.module})", f"a file that Gwyddion takes for {module!r}"
            )
        if answer.stat().st_size > _LARGEST_ANSWER + _PER_BYTE * size:
            raise _refused(
                path, "pixels that fit the size of the file", f"{answer.stat().st_size} bytes of them"
            )
        try:
            return _parsed(answer)
        except Exception as error:  # gwyfile states no exceptions for an answer that is not whole
            text = f"{type(error).__name__} ({str(error)[-120:]})"
            raise _refused(path, f"{family.title} that Gwyddion reads", text) from error


def _parsed(answer: Path) -> tuple[list[_Field], Mapping[str, str]]:
    """Return the fields and the metadata of Gwyddion's answer, with the masks, which gwyddionpy leaves out."""
    import gwyddionpy
    import gwyfile

    data = gwyddionpy.parse_gwy(answer)
    container = gwyfile.load(str(answer))
    numbers = sorted(int(match[1]) for key in container if (match := re.fullmatch(r"/(\d+)/data", key)))
    fields = []
    for number, one in zip(numbers, data.channels.values(), strict=True):
        stored = container.get(f"/{number}/mask")
        mask = None if stored is None else np.asarray(stored.data) > 0.5
        if mask is not None and mask.shape != one.data.shape:
            raise ValueError(f"a mask of {mask.shape} for {one.data.shape} pixels")
        fields.append(
            _Field(
                str(one.name),
                np.asarray(one.data),
                mask,
                (float(one.xreal), float(one.yreal)),
                str(one.si_unit_xy),
                str(one.si_unit_z),
            )
        )
    return fields, data.metadata


def _bounded(command: list[str], size: int) -> list[str]:
    """Return a command that runs another one with bounded memory, bounded files and no core dump."""
    if os.name != "posix":
        return command
    limit = (_ADDRESSES + _PER_BYTE * size) // 1024
    blocks = (_LARGEST_ANSWER + _PER_BYTE * size) // 512
    script = 'ulimit -c 0; ulimit -f "$1"; ulimit -v "$2" 2>/dev/null; shift 2; exec "$@"'
    return ["/bin/sh", "-c", script, "sh", str(blocks), str(limit), *command]


def _environment() -> dict[str, str]:
    """Return the environment with a decimal point in numbers, and without modules for windows."""
    environment = {key: value for key, value in os.environ.items() if key != "LC_ALL"}
    return environment | {"LC_NUMERIC": "C", "GTK_MODULES": ""}


def _module(said: bytes) -> str:
    try:
        answer = json.loads(said)
    except ValueError:
        return ""
    return str(answer.get("module", "")) if isinstance(answer, dict) else ""


def _refused(path: Path, expected: str, got: str) -> OvertoneError:
    return FileFormatError(
        f"{path.name} cannot be read",
        expected=expected,
        got=got,
        hint="copy or export the file again, or save it in Gwyddion as .gwy or .gsf",
    )

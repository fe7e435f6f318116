"""Packed Igor experiments (.pxp): the waves in them, each as it would lie in a file of its own.

An experiment is a chain of records, each a type, a version and a length in eight bytes and then its content. A record
of type 3 is a whole .ibw, and records of types 9 and 10 begin and end data folders (Igor's technical note 3). The
chain is walked here, which is short and checks every length; the wave that is wanted goes the way of every .ibw.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from overtone.errors import FileFormatError
from overtone.io import igor
from overtone.io.recording import Recording

SEPARATOR = "::"
_WAVE, _FOLDER_START, _FOLDER_END, _WINDOWS = 3, 9, 10, 11
_LAST_TYPE, _KIND = 127, 0x7FFF
_RECORD = 8
_MOST_RECORDS, _DEEPEST = 100_000, 50
# Where the name of a wave stands in its file, by the version of the file, and how long it may be.
_NAMES = {1: (14, 20), 2: (22, 20), 3: (26, 20), 5: (92, 32)}
# Tables of colours are waves of three or four columns.
_NARROWEST_IMAGE = 5
_MOST_LISTED = 12


@dataclass(frozen=True)
class _Wave:
    """A wave of an experiment: the folders and name that Igor shows, and its bytes."""

    folder: tuple[str, ...]
    name: str
    content: bytes
    layout: igor.Layout | None
    problem: FileFormatError | None = None
    """Why it cannot be read, such as text in it; an experiment may hold many of these beside an image."""

    @property
    def full_name(self) -> str:
        """Name with its folders, as Igor writes it below ``root:``."""
        return ":".join((*self.folder, self.name))

    @property
    def is_image(self) -> bool:
        """Whether it has rows and columns, and the columns have no names, as those of curves have."""
        if self.layout is None:
            return False
        dims = self.layout.dims
        labels = (*self.layout.labels, (), ())[1]
        return len(dims) == 3 or (len(dims) == 2 and min(dims) >= _NARROWEST_IMAGE and not any(labels))


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file is a chain of records to its end, or begins as Igor's experiments do."""
    if any(head.startswith(struct.pack(order + "H", _WINDOWS)) for order in "<>"):
        return True
    # A lone wave begins with 1, 2, 3 or 5, which are kinds of records too, but leads no chain to the end.
    return len(head) >= _RECORD and any(_reaches_the_end(path, order) for order in "<>")


def split(path: Path) -> tuple[Path, str | None]:
    """Return the file and the name of the wave of a path such as ``experiment.pxp::Image0``.

    Examples
    --------
    >>> split(Path("scans/experiment.pxp::Image0"))[1], split(Path("scan.ibw"))[1]
    ('Image0', None)
    """
    stem, separator, wave = path.name.partition(SEPARATOR)
    if not separator or not stem or not wave or path.exists():
        return path, None
    return path.with_name(stem), wave


def read(path: Path, wave: str | None = None) -> Recording:
    """Read one wave of a packed experiment.

    Parameters
    ----------
    path : Path
        The .pxp file.
    wave : str, optional
        Name of the wave, with its folders where the name alone is not enough (``scans:Image0``). Without it the
        experiment has to hold exactly one image, or no image and one wave.

    Raises
    ------
    FileFormatError
        If the file is damaged, holds no such wave, or several and none is named.
    """
    waves = _waves(path, path.read_bytes())
    chosen = _chosen(path, waves, wave)
    if chosen.problem is not None:
        raise chosen.problem
    called = path if wave is None else path.with_name(path.name + SEPARATOR + wave)
    recording = igor.recording_of(called, chosen.content)
    notes = [f"wave {chosen.full_name} of an experiment of {len(waves)}", *recording.notes]
    return Recording(
        path=called,
        format="igor_experiment",
        vendor=recording.vendor,
        dims=recording.dims,
        coords=recording.coords,
        channels=recording.channels,
        facts=recording.facts,
        resonances=recording.resonances,
        metadata=recording.metadata,
        notes=tuple(notes),
    )


# --- which wave -----------------------------------------------------------------------------------


def _chosen(path: Path, waves: Sequence[_Wave], name: str | None) -> _Wave:
    if name is not None:
        wanted = name.removeprefix("root:").lower()
        found = [wave for wave in waves if wanted in (wave.name.lower(), wave.full_name.lower())]
        exact = [wave for wave in found if wave.full_name.lower() == wanted]
        found = exact or found
        if len(found) == 1:
            return found[0]
        raise FileFormatError(
            f"{path.name} holds {f'{len(found)} waves' if found else 'no wave'} {name!r}",
            expected="the name of one wave" if not found else "the name with its folders",
            got=_listed(found or waves) or "no waves",
            hint=_hint(path, (found or waves)[0]) if waves else "another experiment",
        )
    images = [wave for wave in waves if wave.is_image]
    candidates = images or [wave for wave in waves if wave.layout is not None]
    if len(candidates) == 1:
        return candidates[0]
    raise FileFormatError(
        f"{path.name} holds {len(images)} images" if images else f"{path.name} holds no image",
        expected="exactly one, or the name of the wave behind the name of the file",
        got=_listed(candidates) or "no waves",
        hint=_hint(path, candidates[0])
        if candidates
        else "an experiment that was saved packed, with its waves",
    )


def _hint(path: Path, wave: _Wave) -> str:
    return f'"{path.name}{SEPARATOR}{wave.full_name}"'


def _listed(waves: Sequence[_Wave]) -> str:
    parts = [
        f"{wave.full_name} ({' x '.join(map(str, wave.layout.dims)) if wave.layout else 'not readable'})"
        for wave in waves[:_MOST_LISTED]
    ]
    more = [f"{len(waves) - _MOST_LISTED} more"] if len(waves) > _MOST_LISTED else []
    return ", ".join(parts + more)


# --- the file -------------------------------------------------------------------------------------


def _waves(path: Path, content: bytes) -> list[_Wave]:
    """Return every wave; each length is checked against the file first."""
    order = _byte_order(content)
    waves: list[_Wave] = []
    records = at = 0
    folders: list[str] = []
    while at < len(content):
        records += 1
        if records > _MOST_RECORDS:
            raise _damaged(path, f"at most {_MOST_RECORDS} records", "more")
        if at + _RECORD > len(content):
            raise _damaged(path, f"the {_RECORD} bytes before record {records}", f"{len(content) - at}")
        kind, _, size = struct.unpack_from(order + "Hhi", content, at)
        at += _RECORD
        if size < 0 or size > len(content) - at:
            raise _damaged(path, f"{size} bytes of record {records}", f"{len(content) - at}")
        body = content[at : at + size] if kind in (_WAVE, _FOLDER_START) else b""
        at += size
        # The highest bit of a record that a later one replaces is set, so it is none of these kinds.
        if kind == _FOLDER_START:
            folders.append(_text(body)[:64])
            if len(folders) > _DEEPEST:
                raise _damaged(path, f"at most {_DEEPEST} folders within each other", "more")
        elif kind == _FOLDER_END and folders:
            folders.pop()
        elif kind == _WAVE:
            waves.append(_wave(path, tuple(folders), body))
    return waves


def _wave(path: Path, folders: tuple[str, ...], content: bytes) -> _Wave:
    if not igor.sniff(path, content):
        problem = _damaged(path, "a wave in a record of waves", repr(content[:8]))
        return _Wave(folders, "?", content, None, problem)
    version = struct.unpack_from("<h" if content[0] else ">h", content)[0]
    start, length = _NAMES[version]
    name = _text(content[start : start + length])
    try:
        layout = igor.layout_of(
            path.with_name(path.name + SEPARATOR + (name or "?").replace("/", "_")), content
        )
    except FileFormatError as error:
        return _Wave(folders, name, content, None, error)
    return _Wave(folders, name, content, layout)


def _byte_order(content: bytes) -> str:
    """Return the byte order in which the first record is shorter, as a wrong one makes it very long."""
    if len(content) < _RECORD:
        return "<"
    little, big = (struct.unpack_from(order + "I", content, 4)[0] for order in "<>")
    return "<" if little <= big else ">"


def _reaches_the_end(path: Path, order: str) -> bool:
    """Tell whether lengths lead from record to record to the very end of a file, past a wave at least."""
    end, at, holds_waves = path.stat().st_size, 0, False
    with path.open("rb") as stream:
        for _ in range(_MOST_RECORDS):
            if at == end:
                return holds_waves
            stream.seek(at)
            header = stream.read(_RECORD)
            if len(header) < _RECORD:
                return False
            kind, _, size = struct.unpack(order + "Hhi", header)
            if not 0 < kind & _KIND <= _LAST_TYPE or not 0 <= size <= end - at - _RECORD:
                return False
            # Zeros, which data may end with, would make a chain of empty records.
            holds_waves = holds_waves or (kind == _WAVE and igor.sniff(path, stream.read(2)))
            at += _RECORD + size
    return False


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("latin-1")


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole Igor experiment",
        expected=expected,
        got=got,
        hint="copy or save the file again, as a packed experiment",
    )

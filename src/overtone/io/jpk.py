"""JPK images (.jpk): a TIFF with a thumbnail, one page a channel, and the calibration in private tags.

A channel holds integers and several slots, each a way to turn them into a quantity: volts, nominal or
calibrated height, amplitude in metres. The numbers of the tags are those of the header that JPK published
with its first reader. Rows are stored from the bottom, as the thumbnail of a file shows; in a reflected
scan from the top.
"""

from __future__ import annotations

import re
from pathlib import Path

from overtone.errors import FileFormatError
from overtone.io import jpk_header
from overtone.io.jpk_header import Slot
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.tiff import Page, damaged, first_tags, is_tiff, read_pages

_WHAT = "a JPK image"
_SUFFIXES = (".jpk", ".jpk-qi-image")
_ZIP = b"PK\x03\x04"
_ARCHIVE = (b"header.properties", b"segments/", b"shared-data/")

_GRID_U, _GRID_V, _THETA, _REFLECT, _COLUMNS, _ROWS = 32834, 32835, 32836, 32837, 32838, 32839
_ENVIRONMENT, _FEEDBACK, _FEEDBACK_MODE = 32791, 32830, 32816
_STIFFNESS, _CALIBRATED = 32785, 32786
_CHANNEL, _RETRACE, _TITLE = 32848, 32849, 32850
_PARK = 50432
_SLOTS, _DEFAULT_SLOT, _FIRST_SLOT, _SLOT_STEP = 32896, 32897, 32912, 48
# Within a slot, from its name on.
_ENCODER, _UNIT, _SCALING, _MULTIPLIER, _OFFSET = 17, 18, 19, 20, 21
_MOST_SLOTS = 200
# Tags of the whole scan that people look for, by what they mean.
_NAMED = {
    32768: "software",
    32771: "start",
    32772: "name",
    32773: "comment",
    32774: "end",
    32775: "sample",
    32777: "account",
    32816: "feedback mode",
    32817: "p-gain",
    32818: "i-gain",
    32819: "setpoint",
    32832: "grid x0",
    32833: "grid y0",
    32834: "grid u length",
    32835: "grid v length",
    32836: "grid theta",
    32837: "grid reflect",
    32840: "line end",
    32841: "scan rate",
    32843: "motion",
}
# Older files have the settings of the feedback in tags of their own, which mean this in the AC modes only.
_AC_TAGS = {
    32821: "adjust-reference-amplitude-feedback-settings.reference-amplitude",
    32822: "sine-generator-feedback-settings.amplitude",
    32823: "sine-generator-feedback-settings.frequency",
    32824: "sine-generator-feedback-settings.phaseshift",
}
_AC_MODES = ("ac", "intermittent")
_ESCAPE = re.compile(r"\\(?:u([0-9A-Fa-f]{4})|(.))")


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file is a TIFF with JPK's tags, or one of JPK's archives of force curves."""
    if head.startswith(_ZIP):
        return any(name in head for name in _ARCHIVE)
    if not is_tiff(head):
        return False
    tags = first_tags(path)
    # The name decides only where damage hides the tags: then the message speaks of JPK.
    return {_GRID_U, _GRID_V} <= tags or (path.suffix.lower() in _SUFFIXES and _PARK not in tags)


def read(path: Path) -> Recording:
    """Read every channel of a JPK image, trace and retrace.

    A channel is in the quantity that the software had chosen for it. Where that is no length and the channel
    was calibrated as one, it is in metres: an amplitude is in metres where it was calibrated and in volts
    where it was not.

    Parameters
    ----------
    path : Path
        The .jpk file.

    Raises
    ------
    FileFormatError
        If the file is damaged, or is an archive of force curves.
    """
    with path.open("rb") as stream:
        if stream.read(4) == _ZIP:
            raise _archive(path)
    pages = read_pages(path, _WHAT)
    # The thumbnail has calibration tags as well, those of the channel that it shows.
    channel_pages = [page for page in pages if _SLOTS in page.tags and page.text(_CHANNEL) != "thumbnail"]
    if not channel_pages:
        raise FileFormatError(
            f"{path.name} holds no channel of a JPK image",
            expected="pages with the calibration tags of JPK",
            got=f"{len(pages)} without them",
            hint="copy the file again, or save it again in the software of the microscope",
        )
    scan = pages[0]
    notes: list[str] = []
    channels: list[Channel] = []
    amplitude: list[Slot] = []
    for page in channel_pages:
        slots = _slots(path, page)
        if page.text(_CHANNEL) == "amplitude":
            amplitude = amplitude or slots
        channel = _channel(path, page, slots, bool(scan.number(_REFLECT)), notes)
        if channels and channel.values.shape != channels[0].values.shape:
            there, others = channel.values.shape, channels[0].values.shape
            notes.append(f"{channel.name}: left out, {there} pixels where the first has {others}")
            continue
        channels.append(channel)
    settings = _settings(scan)
    facts = jpk_header.probe_facts(settings)
    stiffness = scan.number(_STIFFNESS)
    if stiffness is not None and stiffness > 0.0 and "stiffness" not in facts:
        key = f"spring constant (tag {_STIFFNESS})"
        facts["stiffness"] = Fact(stiffness, "N/m", key, factory_default=not scan.number(_CALIBRATED))
    return Recording(
        path=path,
        format="jpk",
        vendor="jpk",
        dims=("y", "x"),
        coords=jpk_header.coordinates(
            channels[0].values.shape,
            (scan.number(_ROWS), scan.number(_COLUMNS)),
            (scan.number(_GRID_U), scan.number(_GRID_V), scan.number(_THETA)),
            notes,
        ),
        channels=tuple(channels),
        facts=facts | jpk_header.feedback_facts(settings, amplitude, notes),
        resonances=jpk_header.resonances(settings, notes),
        metadata=settings,
        notes=tuple(dict.fromkeys(notes)),
    )


# --- pages ----------------------------------------------------------------------------------------


def _channel(path: Path, page: Page, slots: list[Slot], reflected: bool, notes: list[str]) -> Channel:
    name = page.text(_TITLE) or page.text(_CHANNEL)
    if page.values is None:
        raise damaged(path, _WHAT, f"one number a pixel in channel {name!r}", "colours")
    retrace = page.number(_RETRACE)
    slot = jpk_header.choose_slot(name, slots, page.text(_DEFAULT_SLOT), notes)
    raw = jpk_header.with_sign(page.values, page.text(_FIRST_SLOT + _ENCODER))
    values, unit = jpk_header.in_si(name, raw if reflected else raw[::-1], slot, notes)
    return Channel(name, values, unit, None if retrace is None else "retrace" if retrace else "trace")


def _slots(path: Path, page: Page) -> list[Slot]:
    """Return the calibrated slots of a page; the numbers of each turn raw values, not those of its parent."""
    count = page.number(_SLOTS) or 0.0
    if not 1.0 <= count <= _MOST_SLOTS:
        raise damaged(path, _WHAT, f"one to {_MOST_SLOTS} calibration slots", f"{count:g}")
    slots = []
    for at in range(_FIRST_SLOT, _FIRST_SLOT + int(count) * _SLOT_STEP, _SLOT_STEP):
        multiplier, offset = page.number(at + _MULTIPLIER), page.number(at + _OFFSET)
        if page.text(at + _SCALING) == "LinearScaling" and multiplier and offset is not None:
            slots.append(Slot(page.text(at), page.text(at + _UNIT), multiplier, offset))
    return slots


# --- settings -------------------------------------------------------------------------------------


def _settings(scan: Page) -> dict[str, str]:
    settings = {f"{name} (tag {code})": scan.text(code) for code, name in _NAMED.items() if scan.text(code)}
    for code in (_FEEDBACK, _ENVIRONMENT):
        settings |= _properties(scan.text(code))
    if scan.text(_FEEDBACK_MODE).lower().startswith(_AC_MODES):
        settings |= {key: scan.text(code) for code, key in _AC_TAGS.items() if key not in settings}
    return {key: text for key, text in settings.items() if text}


def _properties(text: str) -> dict[str, str]:
    """Return the entries of a text of properties: ``key : value`` a line, with escaped characters."""
    entries = {}
    for line in text.splitlines():
        key, separator, value = line.partition(" : ")
        if separator:
            entries[key.strip()] = _ESCAPE.sub(_unescaped, value.strip())
    return entries


def _unescaped(match: re.Match[str]) -> str:
    return chr(int(match.group(1), 16)) if match.group(1) else match.group(2)


def _archive(path: Path) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is a JPK archive of force curves, not an image",
        expected="an image (.jpk, .h5-jpk)",
        got="a ZIP archive of curves",
        hint="unpack it: data-image.jpk in it, where there is one, is an image that opens; export curves from "
        "JPK Data Processing as text and make a table (CSV) of them with units in its header",
    )

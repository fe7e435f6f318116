"""What the headers of some formats say of their channels, to hold against what Gwyddion says."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from overtone.io.nanosurf_settings import number
from overtone.io.si import to_si

_AGREEMENT = 1e-3
_MOST_CHANNELS = 1000
# PicoView keeps numbers of 16 bits, whatever the width in which it writes them.
_PICOVIEW_STEPS = 32768.0


@dataclass(frozen=True)
class Statement:
    """What a header says of one channel.

    Parameters
    ----------
    name : str
        Its label.
    unit : str
        Its unit, as the header writes it.
    direction : str or None
        ``trace`` or ``retrace`` where the header says so.
    full_scale : float or None
        End of the converter's range, in ``unit``, for numbers of 16 bits.
    span : float or None
        Largest minus smallest value, in ``unit``.
    """

    name: str
    unit: str
    direction: str | None = None
    full_scale: float | None = None
    span: float | None = None


def confirmed(statement: Statement, values: npt.NDArray[np.float64], known: tuple[float, str]) -> bool:
    """Tell whether a header confirms the unit that was stated for these values.

    Parameters
    ----------
    statement : Statement
        What the header says.
    values : array
        Values in the stated unit.
    known : tuple of float and str
        Factor and SI unit of the stated unit.
    """
    own = to_si(statement.unit)
    finite = values[np.isfinite(values)]
    if own is None or own[1] != known[1] or not finite.size:
        return False
    scale = known[0] / own[0]
    if statement.span is not None:
        return bool(np.isclose(np.ptp(finite) * scale, statement.span, rtol=_AGREEMENT, atol=0.0))
    if statement.full_scale is not None:
        steps = finite * (scale * _PICOVIEW_STEPS / statement.full_scale)
        whole = np.unique(np.rint(steps))
        # Neighbouring numbers occur in every image: with another prefix they would not be one step apart.
        fits = np.abs(steps - np.rint(steps)).max() < _AGREEMENT and np.abs(steps).max() <= _PICOVIEW_STEPS
        return bool(fits and whole.size > 1 and np.diff(whole).min() == 1.0)
    return own[0] == known[0]  # nothing was scaled


def of_nanonis(header: bytes) -> list[Statement]:
    """Return what the table DATA_INFO of a Nanonis scan says, a line for each direction of a channel."""
    text = header[: header.find(b":SCANIT_END:")].decode("latin-1")
    table = text.partition(":DATA_INFO:\n")[2].partition("\n:")[0].splitlines()[1:]
    statements = []
    for line in table[:_MOST_CHANNELS]:
        # Number, name, unit, direction, calibration, offset.
        parts = [part.strip() for part in line.split("\t") if part.strip()]
        if len(parts) != 6:
            continue
        directions = {"both": ("trace", "retrace"), "forward": ("trace",), "backward": ("retrace",)}
        statements += [Statement(parts[1], parts[2], one) for one in directions.get(parts[3].lower(), ())]
    return statements


def of_agilent(header: bytes) -> list[Statement]:
    """Return what the buffers of a PicoView image say; keys have 14 characters."""
    text = header.partition(b"\ndata          ")[0].decode("latin-1")
    statements = []
    for block in text.split("\nbufferLabel   ")[1 : _MOST_CHANNELS + 1]:
        label, *lines = block.splitlines()
        entries = {line[:14].strip(): line[14:].strip() for line in lines}
        direction = entries.get("trace", entries.get("direction", "")).lower()
        scale = number(entries.get("bufferRange", ""))
        if scale > 0.0:
            statements.append(
                Statement(
                    label.strip(),
                    entries.get("bufferUnit", ""),
                    direction if direction in ("trace", "retrace") else None,
                    full_scale=scale,
                )
            )
    return statements


def of_wsxm(header: bytes) -> list[Statement]:
    """Return what a WSxM image says of its one channel."""
    text = header.partition(b"[Header end]")[0].decode("latin-1")
    entries = dict(re.findall(r"^ *([^:\n]{1,80}): *([^\r\n]*)", text, re.MULTILINE))
    value, _, unit = entries.get("Z Amplitude", "").partition(" ")
    span = number(value)
    name = entries.get("Acquisition channel", "")
    direction = {"Forward": "trace", "Backward": "retrace"}.get(entries.get("X scanning direction", ""))
    return [Statement(name, unit.strip(), direction, span=span)] if span > 0.0 and name else []

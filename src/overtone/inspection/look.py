"""A file as it would be opened, whatever has to be chosen chosen, so that everything else about it can be said.

`overtone.open_scan` stops at the first thing it must not decide for somebody. Here the decision is taken for the
moment, kept as a question, and the look goes on.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import xarray as xr

from overtone.errors import OvertoneError
from overtone.io.curves import open_curve
from overtone.io.imaging_mode import Mode, imaging_mode
from overtone.io.observables import observables_of
from overtone.io.recording import Channel, Recording
from overtone.io.selection import OBSERVABLES, Request, channels_for, check_request, choose, one_frame
from overtone.io.vendors import lift_channels, main_channels
from overtone.readings import Reading, parse_reading, reading_of

_HEIGHTS_OF_CURVES = ("ZSnsr", "Raw")
_FIRST = ("trace", "approach")  # taken where nothing else decides


@dataclass(frozen=True)
class Look:
    """A recording with what was chosen of it.

    Parameters
    ----------
    recording : Recording
        As read; of a video one frame.
    request : Request
        As it was made.
    chosen : mapping of str to Channel
        Observable to its channel, all of one line direction.
    directions : tuple of str
        Line directions that have amplitude and phase, where one has to be named; the first is the one looked at.
    opposed : bool
        Whether amplitude and phase were recorded in opposite directions only.
    frames : int
        How many frames there are to choose from; 0 where there is nothing to choose.
    curve : bool
        Whether it is a curve over height.
    mode : Mode or None
        The mode it was recorded in.
    opened : Dataset or None
        The observables, None where they cannot be opened yet.
    refusal : str
        Why not.
    said : tuple of (type, str)
        What was warned of meanwhile.
    """

    recording: Recording
    request: Request
    chosen: Mapping[str, Channel]
    directions: tuple[str, ...]
    opposed: bool
    frames: int
    curve: bool
    mode: Mode | None
    opened: xr.Dataset | None = None
    refusal: str = ""
    said: tuple[tuple[type[Warning], str], ...] = ()

    @property
    def reading(self) -> Reading | None:
        """How the observables were read, or how the file says that they were."""
        if self.opened is not None:
            return reading_of(self.opened)
        return parse_reading(self.recording.metadata) if self.request.probe is None else None


def look_at(recording: Recording, request: Request) -> Look:
    """Look at a recording as somebody wants it read, and go on where they leave something open.

    Raises
    ------
    OvertoneError
        If the request names channels, directions or frames that the recording does not have.
    """
    frames = 0
    if "frame" in recording.dims:
        axis = recording.dims.index("frame")
        count = recording.channels[0].values.shape[axis] if recording.channels else 0
        frames = count if count > 1 and request.frame is None else 0
        recording = one_frame(recording, request.frame or 1)
    else:
        recording = one_frame(recording, request.frame)
    check_request(recording, request)
    curve = _is_curve(recording)
    pool = lift_channels(recording) if request.lift else main_channels(recording)
    ways = {channel.direction for channel in pool if channel.direction}
    if (request.lift and not pool) or (request.direction not in (None, *ways) and not curve):
        choose(recording, request)  # which says what is wrong with that
    if curve and request.direction is None and "approach" in ways:
        request = replace(request, direction="approach")
    chosen, directions, opposed = _assigned(recording, pool, request)
    look = Look(recording, request, chosen, directions, opposed, frames, curve, imaging_mode(recording))
    return _opened(look)


def _is_curve(recording: Recording) -> bool:
    if recording.dims == ("z",):
        return True
    return recording.dims == ("point",) and any(c.name in _HEIGHTS_OF_CURVES for c in recording.channels)


def _assigned(
    recording: Recording, pool: tuple[Channel, ...], request: Request
) -> tuple[dict[str, Channel], tuple[str, ...], bool]:
    """Return the channels of the observables, the directions to choose from, and whether A1 and phi1 are opposed."""
    if request.direction is not None:
        return _found(recording, pool, request, request.direction)[0], (), False
    chosen, twice = _found(recording, pool, request, None)
    mixed = len({c.direction for name, c in chosen.items() if name != "height" and c.direction}) > 1
    if not (twice or mixed):
        return chosen, (), False
    ways = sorted({c.direction for c in pool if c.direction}, key=lambda way: (way not in _FIRST, way))
    by_way = {way: _found(recording, pool, request, way)[0] for way in ways}
    whole = [way for way in ways if {"A1", "phi1"} <= by_way[way].keys()]
    if whole:
        whole.sort(key=lambda way: -len(by_way[way]))
        return by_way[whole[0]], tuple(whole), False
    opposed = {"A1", "phi1"} <= chosen.keys()
    if opposed or not ways:
        return chosen, (), opposed
    return max(by_way.values(), key=len), (), False


def _found(
    recording: Recording, pool: tuple[Channel, ...], request: Request, direction: str | None
) -> tuple[dict[str, Channel], bool]:
    """Return the first channel for each observable, and whether any stands there twice."""
    chosen: dict[str, Channel] = {}
    twice = False
    for observable in OBSERVABLES:
        found = channels_for(recording, pool, request, observable, direction)
        if found:
            chosen[observable] = found[0]
            twice = twice or len(found) > 1
    return chosen, twice


def _opened(look: Look) -> Look:
    """Open what can be opened, and keep what is said of it."""
    request = replace(look.request, frame=None)
    if look.directions:
        request = replace(request, direction=look.directions[0])
    opened: xr.Dataset | None = None
    refusal = ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            opened = _curve(look) if look.curve else observables_of(look.recording, request)
        except OvertoneError as error:
            refusal = str(error)
    said = tuple(dict.fromkeys((w.category, str(w.message)) for w in caught))
    return replace(look, opened=opened, refusal=refusal, said=said)


def _curve(look: Look) -> xr.Dataset:
    request = look.request
    return open_curve(
        look.recording.path,
        probe=request.probe,
        direction=request.direction or "approach",
        channels=request.channels,
        scales=request.scales,
        far_phase=request.far_phase,
        phase_sign=request.phase_sign,
        corrected=request.corrected,
    )

"""Dynamic approach curves as observables over the height of the base.

A curve has one way, towards the sample or back, and heights that fall from first to last, as in
`overtone.approach_curve`. A microscope knows how far its base moves but not where the sample is: z then
grows away from the sample, and its zero is arbitrary.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ChannelError, ChannelWarning, FileFormatError
from overtone.io.observables import observables_of
from overtone.io.opening import kept_warnings, with_history
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.registry import read_channels
from overtone.io.selection import Floats, Request, channel_names, check_request, choose
from overtone.probe import Probe
from overtone.units import format_quantity

DIRECTIONS = ("approach", "retract")
"""Ways of a curve, in the order in which the column ``direction`` of a table counts them."""
ARBITRARY, SURFACE = "arbitrary", "surface"
"""Attribute ``zero`` of z: nobody knows where the sample is, or z = 0 puts the tip of a lever at rest on it."""
FEWEST = 20
"""Points below which a curve is none."""
# The height in an Asylum curve: what the sensor saw, before what the piezo was told.
_HEIGHTS = ("ZSnsr", "ZSensor", "Raw")
_SIGNS = {"1": "approach", "-1": "retract", "0": "dwell"}
_END = 0.05  # share of the points that make an end of a curve
# An end is where the amplitude is lower if it is so by this share and by this many standard errors.
_FALL, _ERRORS = 0.01, 5.0
_STEADY = 0.01  # how closely the far end repeats itself where its amplitude stands for the free one
_ASIDE = {*_HEIGHTS, "Drive", "direction"}


@dataclass(frozen=True)
class _Sweep:
    """One way of a recording, before its heights are in order: points in the order of time."""

    recording: Recording
    """Over ``z``, without coordinates; channels of this way alone."""
    height: Floats
    """As the file has it [m], of either sign."""
    source: str
    """Name of the channel or coordinate that gave the height."""
    in_time: bool
    """Whether the points follow each other in time."""
    way: str | None
    """Approach or retract, None where the file does not say."""
    time: Floats | None = None
    """Since the first point of the file [s]."""


def open_curve(
    path: str | Path,
    *,
    probe: Probe | None = None,
    direction: str = "approach",
    channels: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    far_phase: float | None = None,
    phase_sign: int = 1,
    corrected: bool = False,
) -> xr.Dataset:
    """Open one way of a dynamic approach curve as observables over the height of the base.

    Parameters
    ----------
    path : str or Path
        Asylum force curve (.ibw) with amplitude and phase, netCDF over ``z``, or a table with a column ``z``
        and, where it holds both ways, a column ``direction`` (0 approach, 1 retract).
    probe : Probe, optional
        The probe. Without it, it is built from the file; where the file states no free amplitude, the median
        of the far end is taken, if that is steady.
    direction : str
        ``approach`` or ``retract``.
    channels, scales, far_phase, phase_sign, corrected
        As in `overtone.open_scan`.

    Returns
    -------
    Dataset
        Observables over ``z`` [m], the height of the base, in falling order: from far to near for either way.
        Its attribute ``zero`` is ``arbitrary``, or ``surface`` in what overtone simulated. A0 is as recorded,
        with its offset: the far end of the curve gives its zero. Coordinates ``direction``, where the file
        tells, and ``time`` [s] over z, where it states a sampling rate.

    Raises
    ------
    OvertoneError
        If the file cannot be read, holds no curve or not this way, says nowhere where its ways begin and end,
        has fewer than 20 points with height, amplitude and phase, lacks A1 or phi1 (a static force curve), or
        the amplitude falls towards neither end; and whatever `overtone.open_scan` raises.

    Warns
    -----
    ChannelWarning
        If amplitude and stated way contradict each other, or points without height are left out.
    """
    if direction not in DIRECTIONS:
        raise ChannelError(
            "unknown direction of a curve", expected=" or ".join(DIRECTIONS), got=repr(direction)
        )
    request = Request(
        probe, channels or {}, scales or {}, far_phase, phase_sign, direction, corrected, keep_offset=True
    )
    notes: list[str] = []
    with kept_warnings() as said:
        sweep = _sweep(read_channels(path), request, notes)
        recording = _in_order(sweep, request, notes)
        # From here on there is one way only; a file that names none has nothing to choose from.
        dataset = observables_of(recording, replace(request, direction=sweep.way))
    zero = _zero(recording)
    dataset["z"].attrs["zero"] = zero
    if zero == ARBITRARY:
        notes.append("the zero of z is arbitrary: where the sample is, is not known")
    coords: dict[str, object] = {"direction": sweep.way} if sweep.way else {}
    if "time" in recording.coords:
        attributes = {"units": "s", "long_name": "time since the first point of the file"}
        coords["time"] = ("z", recording.coords["time"], attributes)
    return with_history(
        dataset.assign_coords(coords), "open_curve", path, request, [*recording.notes, *notes, *said]
    )


# --- one way of a recording -----------------------------------------------------------------------


def _sweep(recording: Recording, request: Request, notes: list[str]) -> _Sweep:
    check_request(recording, request)
    if recording.dims == ("z",) and "z" in recording.coords:
        return _stated_heights(recording, request, notes)
    heights = {c.name: c for c in recording.channels if c.name in _HEIGHTS and c.unit == "m"}
    if recording.dims != ("point",) or not heights:
        raise ChannelError(
            f"{recording.path.name} holds no curve over height",
            expected="one column or dimension z in m, or a channel " + " or ".join(_HEIGHTS),
            got=f"{channel_names(recording) or 'no channels'} over {' and '.join(recording.dims)}",
            hint="open_scan for scans, and for points without height",
        )
    choose(recording, replace(request, direction=None))  # what is missing is named before what is odd
    source = next(name for name in _HEIGHTS if name in heights)
    if source == "Raw":
        notes.append(
            "the height z is what the piezo was told (Raw), with its creep and hysteresis: there is no sensor"
        )
    points = _segment(recording, heights[source].values.size, request.direction or "", notes)
    step = recording.facts.get("sampling_step")
    return _Sweep(
        recording=_named(replace(_rows(recording, points), dims=("z",)), request.direction),
        height=heights[source].values[points],
        source=source,
        in_time=True,
        way=request.direction,
        time=None if step is None else step.value * np.arange(points.start, points.stop),
    )


def _stated_heights(recording: Recording, request: Request, notes: list[str]) -> _Sweep:
    """Take the way that was asked for out of a recording whose heights are known as such."""
    height, way = recording.coords["z"], request.direction
    column = next((c for c in recording.channels if c.name == "direction"), None)
    ways = {c.direction for c in recording.channels if c.direction}
    in_time = False  # netCDF has heights in falling order for both ways
    if column is not None:
        if not np.isin(column.values, range(len(DIRECTIONS))).all():
            odd = column.values[~np.isin(column.values, range(len(DIRECTIONS)))][0]
            raise ChannelError(
                f"the column direction of {recording.path.name} is none",
                expected="0 (approach) or 1 (retract) in every row",
                got=f"{odd:g}",
            )
        rows = np.flatnonzero(column.values == DIRECTIONS.index(way or ""))
        if not rows.size:
            raise ChannelError(
                f"{recording.path.name} has no {way}",
                expected=" or ".join(DIRECTIONS[int(k)] for k in np.unique(column.values)),
                got="no row of it in the column direction",
            )
        recording, height, in_time = _rows(recording, rows), height[rows], True
        recording = _named(recording, way)
    elif not ways:
        notes.append(f"the file does not say which way the curve goes; it was taken for the {way}")
        way = None
    elif way in ways:
        kept = tuple(c for c in recording.channels if c.direction in (way, None))
        recording = replace(recording, channels=kept)
    return _Sweep(recording=recording, height=height, source="z", in_time=in_time, way=way)


def _rows(recording: Recording, points: slice | npt.NDArray[np.intp]) -> Recording:
    """Return some points of every channel, without coordinates."""
    kept = [replace(channel, values=channel.values[points]) for channel in recording.channels]
    return replace(recording, channels=tuple(kept), coords={})


def _named(recording: Recording, way: str | None) -> Recording:
    return replace(recording, channels=tuple(replace(c, direction=way) for c in recording.channels))


def _segment(recording: Recording, size: int, way: str, notes: list[str]) -> slice:
    """Return the points of one way, as the keys Indexes and Direction of Asylum's note part them.

    Indexes holds the first point and then the last one of each segment, Direction the way of each segment
    behind one entry without meaning: 1 towards the sample, -1 back, 0 where the base stands still.
    """
    note = {key.lower(): text for key, text in recording.metadata.items()}
    texts = {key: note.get(key.lower(), "").strip().strip(",") for key in ("Indexes", "Direction")}
    stated = "; ".join(f"{key} {text[:60] or 'absent'}" for key, text in texts.items())
    try:
        ends = [int(text) for text in texts["Indexes"].split(",")]
        ways = [_SIGNS[text.strip().removesuffix(".0")] for text in texts["Direction"].split(",")[1:]]
    except (ValueError, KeyError):
        ends, ways = [], []
    rising = all(a < b for a, b in pairwise(ends))
    # Some versions count the last point, some stop behind it.
    if not (ways and len(ends) == len(ways) + 1 and ends[0] == 0 and rising and ends[-1] in (size - 1, size)):
        raise FileFormatError(
            f"{recording.path.name} does not say where approach and retract begin and end",
            expected=f"Indexes from 0 to {size - 1} in its note, and a Direction (1, -1 or 0) for each part",
            got=stated,
            hint="save each way as a table with columns z, A0, A1, phi1 and units",
        )
    starts = [0, *(end + 1 for end in ends[1:-1])]
    parts = zip(starts, ends[1:], ways, strict=True)
    found = [slice(start, min(end + 1, size)) for start, end, name in parts if name == way]
    if not found:
        raise ChannelError(
            f"{recording.path.name} has no {way}",
            expected=" or ".join(dict.fromkeys(name for name in ways if name in DIRECTIONS))
            or "no way at all",
            got=stated,
        )
    if len(found) > 1:
        notes.append(f"the file holds {len(found)} ways of the kind {way}; the first was taken")
    dwells = ways.count("dwell")
    if dwells:
        notes.append(f"parts in which the base stands still were left out: {dwells}")
    return found[0]


# --- heights that fall ----------------------------------------------------------------------------


def _in_order(sweep: _Sweep, request: Request, notes: list[str]) -> Recording:
    """Return the sweep as a recording over z, the height of the base in falling order."""
    recording, name = sweep.recording, sweep.recording.path.name
    chosen = choose(recording, replace(request, direction=sweep.way))
    amplitude, phase = chosen["A1"].values, chosen["phi1"].values
    known = np.isfinite(sweep.height)
    whole = known & np.isfinite(amplitude) & np.isfinite(phase)
    if int(whole.sum()) < FEWEST:
        raise ChannelError(
            f"{name} has too few points for a curve",
            expected=f"at least {FEWEST} points with height, A1 and phi1",
            got=f"{int(whole.sum())} of {sweep.height.size}",
        )
    lost = int((~known).sum())
    if lost:
        warnings.warn(
            f"{lost} of {known.size} points have no height ({sweep.source}) and were left out",
            ChannelWarning,
            stacklevel=2,
        )
    sign = _sign(sweep, amplitude, whole, notes)
    height = sign * sweep.height
    if sweep.in_time and sweep.way is not None:
        _check_way(sweep, height[whole], name)
    points = np.flatnonzero(known)
    order = points[np.argsort(-height[points], kind="stable")]
    aside = _ASIDE - set(request.channels.values())
    ordered = replace(
        recording,
        coords={"z": height[order]} | ({} if sweep.time is None else {"time": sweep.time[order]}),
        channels=tuple(c for c in _rows(recording, order).channels if c.name not in aside),
    )
    return _with_free_amplitude(ordered, chosen["A1"], order, request, notes)


def _sign(sweep: _Sweep, amplitude: Floats, whole: npt.NDArray[np.bool_], notes: list[str]) -> float:
    """Return what turns the height into one that grows away from the sample, where the amplitude is lower."""
    order = np.argsort(sweep.height[whole], kind="stable")
    values = amplitude[whole][order]
    count = max(3, round(_END * values.size))
    low, high = (float(np.median(part)) for part in (values[:count], values[-count:]))
    # Neighbours in time differ by noise, and by the little that the base moved.
    noise = float(np.median(np.abs(np.diff(amplitude[whole])))) / math.sqrt(count)
    if abs(high - low) <= max(_FALL * max(abs(low), abs(high)), _ERRORS * noise):
        raise ChannelError(
            f"in {sweep.recording.path.name} the amplitude falls towards neither end",
            expected=f"an amplitude that is at least {100 * _FALL:g} % lower near the sample",
            got=f"{format_quantity(low, 'm', 4)} at the low end of {sweep.source}, {format_quantity(high, 'm', 4)} at "
            "the high one",
            hint="a curve that reaches the sample",
        )
    fall = f"{format_quantity(max(low, high), 'm')} to {format_quantity(min(low, high), 'm')}"
    if sweep.source == "z":
        if high < low:
            warnings.warn(
                f"the amplitude falls from {fall} where z grows, and z was taken as the height above the sample, as "
                "stated: does it count the other way?",
                ChannelWarning,
                stacklevel=2,
            )
        return 1.0
    notes.append(
        f"the height z is {'minus ' if high < low else ''}{sweep.source}: the amplitude falls from {fall} towards its "
        f"{'high' if high < low else 'low'} end, so the sample is there"
    )
    return -1.0 if high < low else 1.0


def _check_way(sweep: _Sweep, height: Floats, name: str) -> None:
    count = max(1, round(_END * height.size))
    travel = float(np.median(height[-count:]) - np.median(height[:count]))
    if (travel < 0.0) == (sweep.way == "approach"):
        return
    warnings.warn(
        f"{name} calls this the {sweep.way}, but along it the base moves {format_quantity(abs(travel), 'm')} "
        f"{'away from' if travel > 0.0 else 'towards'} the side where the amplitude is lower: the two ways may be "
        "exchanged",
        ChannelWarning,
        stacklevel=2,
    )


def _with_free_amplitude(
    recording: Recording, first: Channel, order: npt.NDArray[np.intp], request: Request, notes: list[str]
) -> Recording:
    """Take the free amplitude from the far end where neither file nor user states one and it is steady."""
    facts = recording.facts
    if (
        request.probe is not None
        or "stiffness" not in facts
        or "free_amplitude" in facts
        or first.unit != "m"
    ):
        return recording
    values = first.values[order]
    count = max(3, round(_END * values.size))
    values = values[np.isfinite(values)]
    far, next_to_it = (float(np.median(part)) for part in (values[:count], values[count : 2 * count]))
    if not abs(next_to_it - far) <= _STEADY * far:
        return recording
    notes.append(
        f"the file states no free amplitude; the median of the far end, {format_quantity(far, 'm', 4)}, was taken"
    )
    fact = Fact(far, "m", "far end of the curve")
    return replace(recording, facts={**facts, "free_amplitude": fact})


def _zero(recording: Recording) -> str:
    """Return where z is zero: known in what overtone simulated, and in a file that says so."""
    stated = recording.metadata.get("zero of z")
    if stated is not None:
        return stated
    if "overtone" in recording.metadata:  # the first line of a simulated table
        return SURFACE
    try:
        entries = json.loads(recording.metadata.get("history", "[]"))
        simulated = any(entry["operation"] == "approach_curve" for entry in entries)
    except (ValueError, TypeError, KeyError):
        simulated = False
    return SURFACE if simulated else ARBITRARY

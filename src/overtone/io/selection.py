"""Which channels of a recording are the observables, in SI units, and which of them cannot be used."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ChannelError, ChannelWarning, UncalibratedWarning
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.vendors import candidates, lift_channels, main_channels
from overtone.probe import Probe
from overtone.quantities import quantity
from overtone.units import format_quantity

HIGHEST = 9
OBSERVABLES = ("height", "A0", *(f"{letter}{n}" for n in range(1, HIGHEST + 1) for letter in ("A", "phi")))
_LARGEST_A0 = 5e-9
# A clipped channel has this share of its pixels, and at least this many, exactly at one end of its range, and
# more of them than at any other value by this factor: a coarse converter repeats every value.
_CLIPPED_SHARE, _CLIPPED_PIXELS, _CLIPPED_FACTOR = 0.01, 20, 5
# Where the other channels stand still as well, by this share of their range, nothing moved and nothing clipped.
_STILL = 1e-6

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Request:
    """How somebody wants a file to be read; see `overtone.io.observables.open_scan`."""

    probe: Probe | None = None
    channels: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, float] = field(default_factory=dict)
    far_phase: float | None = None
    phase_sign: int = 1
    direction: str | None = None
    corrected: bool = False
    lift: bool = False
    """Whether the Nap or Lift pass is wanted instead of the main one."""
    keep_offset: bool = False
    """Whether A0 is kept with whatever offset it has, because the same data give its zero."""
    frame: int | None = None
    """Which frame of a video, from 1."""


def channel_names(recording: Recording) -> str:
    """Return the names of all channels for a message."""
    return ", ".join(dict.fromkeys(channel.name for channel in recording.channels))


def check_request(recording: Recording, request: Request) -> None:
    """Refuse names of channels and observables that do not exist.

    Raises
    ------
    ChannelError
        If an observable or a channel is not known, or the sign of the phase is none.
    """
    if request.phase_sign not in (1, -1):
        raise ChannelError("unknown phase sign", expected="1 (lag) or -1 (lead)", got=str(request.phase_sign))
    for name in request.channels:
        if name not in OBSERVABLES:
            raise ChannelError(
                f"{name!r} is not an observable",
                expected="height, A0, A1, phi1, A2, phi2, ...",
                hint="observable first, then the channel: A2=UserIn0",
            )
    known = {channel.name for channel in recording.channels}
    unknown = [name for name in (*request.channels.values(), *request.scales) if name not in known]
    if unknown:
        raise ChannelError(
            f"{recording.path.name} has no channel {unknown[0]!r}",
            expected=f"one of {channel_names(recording)}",
        )


def one_frame(recording: Recording, frame: int | None) -> Recording:
    """Return one frame, counted from 1, of a recording that holds several; any other recording as it is.

    Raises
    ------
    ChannelError
        If there are several frames and none is named, or the frame does not exist.
    """
    if "frame" not in recording.dims:
        if frame not in (None, 1):
            raise ChannelError(
                f"{recording.path.name} holds no frames",
                got=f"frame {frame}",
                hint="the file without --frame",
            )
        return recording
    axis = recording.dims.index("frame")
    count = recording.channels[0].values.shape[axis] if recording.channels else 0
    if frame is None and count == 1:
        frame = 1
    if frame is None or not 1 <= frame <= count:
        raise ChannelError(
            f"{recording.path.name} is a video of {count} frames",
            expected=f"the number of one, 1 to {count}",
            got="none" if frame is None else str(frame),
            hint="--frame 1",
        )
    return replace(
        recording,
        dims=tuple(dim for dim in recording.dims if dim != "frame"),
        coords={dim: values for dim, values in recording.coords.items() if dim != "frame"},
        channels=tuple(
            replace(channel, values=np.take(channel.values, frame - 1, axis))
            for channel in recording.channels
        ),
    )


def choose(recording: Recording, request: Request) -> dict[str, Channel]:
    """Pick a channel for each observable, all of one pass and one line direction.

    Raises
    ------
    ChannelError
        If the pass or the direction does not exist, a channel is ambiguous, directions mix, or A1 or phi1 is
        missing.

    Warns
    -----
    ChannelWarning
        If a channel was flattened.
    """
    direction = request.direction
    pool = _pass(recording, lift=request.lift)
    directions = {channel.direction for channel in pool if channel.direction}
    if direction is not None and direction not in directions:
        raise ChannelError(
            f"{recording.path.name} has no {direction}",
            expected=" or ".join(sorted(directions)) or "no direction",
        )
    chosen: dict[str, Channel] = {}
    for observable in OBSERVABLES:
        found = channels_for(recording, pool, request, observable, direction)
        if len(found) > 1:
            raise ChannelError(
                f"{recording.path.name} holds {found[0].name} {len(found)} times",
                expected="one line direction",
                got=", ".join(str(c.direction) for c in found),
                hint=" or ".join(f"--direction {c.direction}" for c in found if c.direction),
            )
        if found:
            chosen[observable] = found[0]
    mixed = {c.direction for name, c in chosen.items() if name != "height" and c.direction}
    if len(mixed) > 1:
        whole = [
            way
            for way in mixed
            if all(channels_for(recording, pool, request, o, way) for o in ("A1", "phi1"))
        ]
        raise ChannelError(
            "trace and retrace do not mix",
            expected="observables of one line direction",
            got=", ".join(f"{name}: {c.name} {c.direction}" for name, c in chosen.items()),
            hint=" or ".join(f"--direction {way}" for way in sorted(whole or mixed)),
        )
    flattened = [c.name for name, c in chosen.items() if name != "height" and c.flattened]
    if flattened:
        warnings.warn(
            f"{', '.join(flattened)} was flattened or plane-fitted: its absolute value is lost",
            ChannelWarning,
            stacklevel=2,
        )
    missing = [name for name in ("A1", "phi1") if name not in chosen]
    if missing:
        raise ChannelError(
            f"{recording.path.name} has no channel for {' and '.join(missing)}",
            expected="amplitude and phase of the first harmonic",
            got=channel_names(recording) or "no channels",
            hint=f"name it, --channel {missing[0]}=NAME",
        )
    return chosen


def channels_for(
    recording: Recording, pool: tuple[Channel, ...], request: Request, observable: str, direction: str | None
) -> list[Channel]:
    """Return the channels of the first name for an observable that the pass has in this direction."""
    names = (
        (request.channels[observable],)
        if observable in request.channels
        else candidates(recording, observable, lift=request.lift)
    )
    for name in names:
        found = [
            c for c in pool if c.name == name and (direction is None or c.direction in (direction, None))
        ]
        if found:
            return found
    return []


def _pass(recording: Recording, *, lift: bool) -> tuple[Channel, ...]:
    if not lift:
        return main_channels(recording)
    pool = lift_channels(recording)
    if not pool:
        raise ChannelError(
            f"{recording.path.name} has no Nap or Lift pass",
            expected="channels such as NapAmplitude, or lift_A1 in netCDF",
            got=channel_names(recording) or "no channels",
            hint="the main pass, without lift",
        )
    return pool


def in_si(
    chosen: Mapping[str, Channel], request: Request, facts: Mapping[str, Fact] | None = None
) -> dict[str, Floats]:
    """Return the channels in the SI units of their observables; name those that cannot be used.

    Parameters
    ----------
    chosen : mapping of str to Channel
        Observable to channel, as `choose` found them.
    request : Request
        Its ``scales`` give channels without unit one, and lengths in volts their metres; ``keep_offset`` keeps A0
        with an offset.
    facts : mapping of str to Fact, optional
        Of the recording: ``offset:<channel>``, in the unit of the channel, is added to it; ``scale:<channel>`` [m/V]
        turns volts into the metres that the observable has, unless the request has a scale of its own.

    Raises
    ------
    ChannelError
        If A1 or phi1 has no usable unit, or a scale is given for a channel that needs none.

    Warns
    -----
    ChannelWarning
        If something was added to a channel or it was turned from volts into metres; if one is left out for want of a
        unit or of values, A0 has an offset, or a channel is saturated.
    UncalibratedWarning
        If the sensitivity that turned volts into metres is a factory default.
    """
    scales, facts = request.scales, facts or {}
    values: dict[str, Floats] = {}
    without: list[str] = []
    for name, channel in chosen.items():
        record = quantity(name)
        unit = record.unit if record else None
        in_volts = channel.unit == "V" and unit == "m"
        if channel.name in scales and channel.unit is not None and not in_volts:
            raise ChannelError(
                f"{channel.name} has the unit {channel.unit} in the file",
                got=f"a scale of {scales[channel.name]:g} for it",
                hint="scales are for channels without a unit, and for lengths in volts",
            )
        if channel.name in scales:
            values[name] = _whole(channel, facts) * scales[channel.name]
        elif channel.unit == unit:
            values[name] = _whole(channel, facts)
        elif in_volts and f"scale:{channel.name}" in facts:
            values[name] = _whole(channel, facts) * _sensitivity(channel, facts)
        else:
            stated = "no unit" if channel.unit is None else f"the unit {channel.unit} instead of {unit}"
            if name in ("A1", "phi1"):
                raise ChannelError(
                    f"{name} ({channel.name}) has {stated}",
                    expected=f"a channel in {unit}",
                    hint=f'the metres of one volt, --scale {channel.name}="60 nm/V"'
                    if in_volts
                    else f'a unit in the file, or --scale {channel.name}="1 {"nm" if unit == "m" else "deg"}" '
                    "where it has none",
                )
            zero = ", and a zero that is not known" if name == "A0" else ""
            without.append(f"{name} ({channel.name}: {stated}{zero})")
    if without:
        example = chosen[without[0].split()[0]].name
        warnings.warn(
            f"not used for want of a unit: {', '.join(without)}. Where you know what one count means, say so: "
            f'--scale {example}="1 nm"',
            ChannelWarning,
            stacklevel=2,
        )
    empty = [
        name for name, array in values.items() if not np.isfinite(array).any() and name not in ("A1", "phi1")
    ]
    if empty:
        warnings.warn(
            f"not used, because no pixel has a value: {', '.join(empty)}", ChannelWarning, stacklevel=2
        )
        values = {name: array for name, array in values.items() if name not in empty}
    _warn_saturated(values, chosen)
    mean = float(np.mean(values["A0"][np.isfinite(values["A0"])])) if "A0" in values else 0.0
    if abs(mean) > _LARGEST_A0 and not request.keep_offset:
        warnings.warn(
            f"A0 ({chosen['A0'].name}) averages {format_quantity(mean, 'm')}, where a mean deflection in tapping "
            "mode is picometres: an offset or a set-point is still in it, so it is not used",
            ChannelWarning,
            stacklevel=2,
        )
        del values["A0"]
    return values


def _whole(channel: Channel, facts: Mapping[str, Fact]) -> Floats:
    """Return the values of a channel with what the file keeps apart from them added."""
    offset = facts.get(f"offset:{channel.name}")
    if offset is None or offset.unit != channel.unit:
        return channel.values
    warnings.warn(
        f"{channel.name} stores only A - set-point; the set-point, {format_quantity(offset.value, offset.unit, 4)} "
        f"({offset.key}), was added",
        ChannelWarning,
        stacklevel=3,
    )
    return channel.values + offset.value


def _sensitivity(channel: Channel, facts: Mapping[str, Fact]) -> float:
    """Return the metres of one volt of a channel, as the file states them [m/V]."""
    scale = facts[f"scale:{channel.name}"]
    text = f"{channel.name} is in volts in the file; {scale.key}, {scale.value * 1e9:.4g} nm/V, turned it into metres"
    warnings.warn(text, ChannelWarning, stacklevel=3)
    if scale.factory_default:
        warnings.warn(
            f"{scale.key} is a factory default: {channel.name} was not calibrated, lengths, forces and energies have "
            f'no absolute scale. Where you know it, say so: --scale {channel.name}="60 nm/V"',
            UncalibratedWarning,
            stacklevel=3,
        )
    return scale.value


def drop_unpaired(arrays: dict[str, xr.DataArray]) -> None:
    """Leave out a harmonic that has an amplitude without a phase or a phase without an amplitude."""
    for n in range(2, HIGHEST + 1):
        if (f"A{n}" in arrays) != (f"phi{n}" in arrays):
            arrays.pop(f"A{n}", None)
            arrays.pop(f"phi{n}", None)


# --- saturation -----------------------------------------------------------------------------------


def _warn_saturated(values: Mapping[str, Floats], chosen: Mapping[str, Channel]) -> None:
    for name, array in values.items():
        others = [other for key, other in values.items() if key not in (name, "height")]
        for limit, side in ((np.max, "largest"), (np.min, "smallest")):
            finite = array[np.isfinite(array)]
            end = limit(finite) if finite.size else np.nan
            if not is_clipped(array, end, others):
                continue
            record = quantity(name)
            share = float((array == end).sum()) / finite.size
            warnings.warn(
                f"{name} ({chosen[name].name}) is saturated: {100.0 * share:.3g} % of its pixels sit exactly at its "
                f"{side} value, {format_quantity(float(end), record.unit if record else '1', 4)}; what lay beyond "
                "is lost, and nothing that these pixels give can be trusted",
                ChannelWarning,
                stacklevel=3,
            )


def is_clipped(array: Floats, end: float, others: list[Floats]) -> bool:
    """Tell whether an end of the range is where a converter or an amplifier stopped."""
    at_end = array == end
    count = int(at_end.sum())
    finite = array[np.isfinite(array)]
    if count < _CLIPPED_PIXELS or count <= _CLIPPED_SHARE * finite.size:
        return False
    inner = finite[(finite != finite.min()) & (finite != finite.max())]
    if not inner.size or count < _CLIPPED_FACTOR * int(np.unique(inner, return_counts=True)[1].max()):
        return False
    return any(_spread(other[at_end]) > _STILL * _spread(other) for other in others)


def _spread(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.size else 0.0

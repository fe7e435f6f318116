"""Recorded signals over time: raw traces of the deflection, and of the drive beside it.

A table names its columns with units, ``time [us], deflection [V], drive [V]``; an Igor wave knows its time step; a
netCDF file has the coordinate ``time``. What lock-ins have stored is in `overtone.io.quadratures`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ChannelError, FileFormatError, UnitError
from overtone.io import netcdf
from overtone.io.recording import Channel
from overtone.io.registry import read_channels
from overtone.io.si import to_si

_ROLES = ("deflection", "drive", "time")
_DEFLECTIONS = ("deflection", "defl")
_TIMES = ("time", "t")


def read_trace(
    path: str | Path,
    *,
    channels: Mapping[str, str] | None = None,
    sensitivity: float | None = None,
    sampling_rate: float | None = None,
) -> tuple[xr.DataArray, xr.DataArray | None]:
    """Read a recorded deflection, and the drive where it was recorded beside it.

    Parameters
    ----------
    path : str or Path
        Table of text with units in its header, Igor wave or netCDF file.
    channels : mapping of str to str, optional
        ``deflection``, ``drive`` or ``time`` to the name of a channel. Without it channels of these names count,
        and a single channel besides is the deflection.
    sensitivity : float, optional
        Deflection per volt [m/V], of a deflection in V or without a unit.
    sampling_rate : float, optional
        Samples a second [Hz], for files that do not know.

    Returns
    -------
    deflection : DataArray (time)
        Deflection [m] with a coordinate ``time`` [s].
    drive : DataArray (time) or None
        The drive in the unit of the file; a channel is taken for it only where it is called so.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or holds no trace.
    ChannelError
        If a channel is missing or ambiguous, or nothing says when the samples were taken.
    UnitError
        If the deflection is neither in m nor, with a sensitivity, in V.
    """
    source, wanted = Path(path), dict(channels or {})
    unknown = [role for role in wanted if role not in _ROLES]
    if unknown:
        raise ChannelError(
            f"{unknown[0]!r} is no part of a trace", expected=" or ".join(_ROLES), hint="deflection=Defl"
        )
    columns, step = _columns(source)
    by_name = {column.name: column for column in columns}
    missing = [name for name in wanted.values() if name not in by_name]
    if missing:
        raise ChannelError(
            f"{source.name} has no channel {missing[0]!r}", expected=f"one of {', '.join(by_name)}"
        )
    chosen = {role: by_name[name] for role, name in wanted.items()}
    for role, names in (("time", _TIMES), ("drive", ("drive",))):
        found = [c for c in columns if c.name.lower() in names and c not in chosen.values()]
        if role not in chosen and len(found) == 1:
            chosen[role] = found[0]
    if "deflection" not in chosen:
        chosen["deflection"] = _deflection(source, [c for c in columns if c not in chosen.values()])
    time = _time(source, chosen.get("time"), step, sampling_rate, chosen["deflection"].values.size)
    coords = {"time": xr.DataArray(time, dims="time", attrs={"units": "s", "long_name": "time"})}
    values = _in_metres(source, chosen["deflection"], sensitivity)
    attributes = {
        "units": "m",
        "long_name": "deflection",
        "source": source.name,
        "channel": chosen["deflection"].name,
    }
    deflection = xr.DataArray(values, dims="time", coords=coords, name="deflection", attrs=attributes)
    if "drive" not in chosen:
        return deflection, None
    attributes = {"units": chosen["drive"].unit or "1", "long_name": "drive", "channel": chosen["drive"].name}
    return deflection, xr.DataArray(
        chosen["drive"].values, dims="time", coords=coords, name="drive", attrs=attributes
    )


def _columns(source: Path) -> tuple[list[Channel], float | None]:
    """Return the channels over one dimension, and the time between samples [s] where the file states it."""
    head = b""
    if source.is_file():
        with source.open("rb") as stream:
            head = stream.read(8)
    if netcdf.sniff(source, head):
        # any dimension and whole numbers too, where read_channels takes floats over dimensions that it knows
        dataset = netcdf.load(source)
        columns = [
            _variable(str(name), array)
            for name, array in dataset.variables.items()
            if array.ndim == 1 and array.dtype.kind in "fiu"
        ]
        sizes = {column.values.size for column in columns}
        if len(sizes) != 1:
            got = ", ".join(f"{name}({', '.join(map(str, v.dims))})" for name, v in dataset.variables.items())
            raise _no_trace(source, got or "no variables")
        return columns, None
    recording = read_channels(source)
    if len(recording.dims) != 1:
        raise _no_trace(source, f"channels over {' and '.join(recording.dims)}")
    columns = [*recording.channels]
    columns += [
        Channel(name, values, "m") for name, values in recording.coords.items() if name in recording.dims
    ]
    fact = recording.facts.get("sampling_step")
    return columns, None if fact is None else fact.value


def _variable(name: str, array: xr.Variable) -> Channel:
    stated = str(array.attrs.get("units", "")).strip()
    factor, unit = (to_si(stated) if stated else None) or (1.0, None)
    return Channel(name, array.values.astype(np.float64) * factor, unit)


def _no_trace(source: Path, got: str) -> FileFormatError:
    return FileFormatError(
        f"{source.name} holds no trace",
        expected="channels over one dimension, time",
        got=got,
        hint='a table such as "time [us], deflection [V]", an Igor wave, or a netCDF file over time',
    )


def _deflection(source: Path, columns: Sequence[Channel]) -> Channel:
    named = [column for column in columns if column.name.lower() in _DEFLECTIONS]
    for found in (named, columns):
        if len(found) == 1:
            return found[0]
    raise ChannelError(
        f"{source.name} does not say which channel is the deflection",
        expected="a channel called deflection, or a single one",
        got=", ".join(column.name for column in columns) or "no channel",
        hint="--channel deflection=NAME",
    )


def _time(
    source: Path, column: Channel | None, step: float | None, rate: float | None, size: int
) -> npt.NDArray[np.float64]:
    if rate is not None and not (math.isfinite(rate) and rate > 0.0):
        raise ChannelError("the sampling rate is not positive", expected="a number in Hz", got=str(rate))
    if column is not None:
        if column.unit == "s":
            return column.values
        if rate is None:
            raise UnitError(
                f"the time ({column.name}) has the unit {column.unit}"
                if column.unit
                else f"the time ({column.name}) has no unit",
                expected="seconds, as in time [us]",
                hint="a unit in the header, or --sampling-rate",
            )
    if rate is None and step is None:
        raise ChannelError(
            f"{source.name} does not say when its samples were taken",
            expected='a column such as "time [us]", or the sampling rate',
            hint='--sampling-rate "2 MHz"',
        )
    return np.arange(size, dtype=np.float64) * (1.0 / rate if rate is not None else float(step or 0.0))


def _in_metres(source: Path, channel: Channel, sensitivity: float | None) -> npt.NDArray[np.float64]:
    if sensitivity is not None and not (math.isfinite(sensitivity) and sensitivity != 0.0):
        raise UnitError("the sensitivity is not usable", expected="a number in m/V", got=str(sensitivity))
    if channel.unit == "m" and sensitivity is None:
        return channel.values
    if channel.unit in ("V", None) and sensitivity is not None:
        return channel.values * sensitivity
    if channel.unit == "m":
        raise UnitError(
            f"the deflection ({channel.name}) is in metres already",
            got=f"a sensitivity of {sensitivity:g} m/V for it",
            hint="leave it out",
        )
    raise UnitError(
        f"the deflection ({channel.name}) has "
        + ("no unit" if channel.unit is None else f"the unit {channel.unit}"),
        expected="metres, or volts and a sensitivity" if channel.unit in ("V", None) else "metres or volts",
        got=source.name,
        hint='--sensitivity "60 nm/V"' if channel.unit in ("V", None) else "--channel deflection=NAME",
    )

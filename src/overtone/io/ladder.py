"""Far-field readings at several drive frequencies or drives, from any file with named columns."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import ChannelError, ChannelWarning
from overtone.io.netcdf import load
from overtone.io.recording import Recording
from overtone.io.registry import read_channels
from overtone.io.si import to_si
from overtone.io.vendors import candidates, main_channels
from overtone.quantities import named_array

_BESIDE = {"frequency": "Hz", "drive": "1", "z": "m"}
_OBSERVABLES = ("A0", *(f"{letter}{n}" for n in range(1, 10) for letter in ("A", "phi")))


def open_ladder(path: str | Path, *, phase_sign: int = 1) -> xr.Dataset:
    """Open readings far from the surface: a frequency ladder at constant drive, or a ladder of drives.

    Parameters
    ----------
    path : str or Path
        Table or netCDF with columns ``A1``, ``phi1`` and any of ``A0``, ``A2``, ``phi2``, ... with units, beside
        ``frequency`` (Hz), ``drive`` (relative to the drive of the scan) and ``z`` where they vary.
    phase_sign : int
        1 where stored phases are lags, -1 where they are leads.

    Returns
    -------
    Dataset
        Over ``point``, as the microscope stored it: phases keep their zero, as those of the curve do.

    Raises
    ------
    OvertoneError
        If the file cannot be read, A1 or phi1 is missing, a column has another unit or another length.

    Warns
    -----
    ChannelWarning
        If a higher harmonic lacks its amplitude or its phase.
    """
    if phase_sign not in (1, -1):
        raise ChannelError("phases are lags or leads", expected="phase_sign 1 or -1", got=str(phase_sign))
    recording = read_channels(path)
    channels = main_channels(recording)
    names = {channel.name: channel for channel in channels}
    if len(names) < len(channels):
        raise ChannelError(
            f"{recording.path.name} holds a channel twice",
            expected="one reading of each",
            got="trace and retrace, or approach and retract",
        )
    arrays: dict[str, xr.DataArray] = {}
    for observable in _OBSERVABLES:
        found = next((names[name] for name in candidates(recording, observable) if name in names), None)
        if found is None:
            continue
        sign = phase_sign if observable.startswith("phi") else 1
        array = named_array(observable, sign * found.values.ravel(), ("point",))
        _check_unit(found.name, found.unit, array.attrs["units"])
        arrays[observable] = array
    missing = [name for name in ("A1", "phi1") if name not in arrays]
    if missing:
        raise ChannelError(
            f"{recording.path.name} has no column {' and '.join(missing)}",
            expected="A1 and phi1, and A0, A2, phi2 beside them",
            got=", ".join(names) or "no columns",
        )
    for n in range(2, 10):
        pair = [f"A{n}", f"phi{n}"]
        if sum(name in arrays for name in pair) == 1:
            there, lacking = pair if pair[0] in arrays else pair[::-1]
            warnings.warn(
                f"{recording.path.name} has {there} without {lacking}: harmonic {n} does not count",
                ChannelWarning,
                stacklevel=2,
            )
    beside = {name: (channel.values, channel.unit) for name, channel in names.items() if name in _BESIDE}
    coords = {}
    for name, (values, stated) in (_coordinates(recording) | beside).items():
        _check_unit(name, stated, _BESIDE[name])
        if values.size not in (1, arrays["A1"].size):
            raise ChannelError(
                f"{name} does not fit the readings", expected=str(arrays["A1"].size), got=str(values.size)
            )
        full = np.broadcast_to(values.ravel(), arrays["A1"].shape)
        coords[name] = ("point", np.array(full, dtype=float), {"units": _BESIDE[name]})
    result = xr.Dataset(arrays, coords, {"source": recording.path.name})
    return provenance.record(result, "open_ladder", path=str(path), phase_sign=phase_sign)


def _coordinates(recording: Recording) -> dict[str, tuple[npt.NDArray[np.float64], str | None]]:
    """Return what stands beside the readings as a coordinate, with its unit; of netCDF also a single number."""
    coords: dict[str, tuple[npt.NDArray[np.float64], str | None]] = {
        name: (recording.coords[name], unit) for name, unit in _BESIDE.items() if name in recording.coords
    }
    if recording.format == "netcdf":
        dataset = load(recording.path)
        for name in _BESIDE:
            if name in dataset.variables and name not in coords and dataset[name].dtype.kind in "fiu":
                stated = str(dataset[name].attrs.get("units", "")).strip()
                factor, unit = (to_si(stated) or (1.0, stated)) if stated else (1.0, None)
                coords[name] = np.asarray(dataset[name].values, dtype=float) * factor, unit
    return coords


def _check_unit(name: str, stated: str | None, expected: str) -> None:
    """Refuse a column of another unit; plain numbers need none."""
    if stated != expected and not (stated is None and expected == "1"):
        raise ChannelError(
            f"{name} has the unit {stated or 'none'}", expected=expected, hint="units in the header"
        )

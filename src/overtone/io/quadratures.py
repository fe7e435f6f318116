"""What lock-ins have stored: X and Y, or R and theta, of every harmonic they listened to."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from overtone import provenance
from overtone.errors import ChannelError, PhaseReferenceWarning, UnitError
from overtone.io.observables import coordinates_of
from overtone.io.registry import read_channels
from overtone.quantities import named_array, validate_observables

_QUADRATURE = re.compile(
    r"(?:\S*?demods?[\s./_]*(?P<demodulator>\d+)[\s./_]*(?:sample)?[\s./_]*)?"
    r"(?P<part>x|y|r|theta|phase)_?(?P<order>\d*)",
    re.IGNORECASE,
)


def read_quadratures(path: str | Path, *, demodulators: Mapping[int, int] | None = None) -> xr.Dataset:
    """Read what a lock-in with several demodulators has stored.

    Parameters
    ----------
    path : str or Path
        File of any known format with channels ``X1``, ``Y1`` or ``R1``, ``theta1`` of each harmonic; ``x``, ``y``,
        ``r`` and ``theta`` alone are harmonic 1, and a channel ``A0`` is the mean deflection.
    demodulators : mapping of int to int, optional
        Number of a demodulator to the harmonic it listened to, for channels such as ``demods/1/sample.x``:
        ``{0: 1, 1: 2}``.

    Returns
    -------
    Dataset
        ``X1``, ``Y1``, ... or ``R1``, ``theta1``, ... as `from_quadratures` takes them, in the units of the file.

    Raises
    ------
    FileFormatError
        If the file cannot be read.
    ChannelError
        If it holds no quadratures, or it is not known to which harmonic one belongs.
    """
    recording = read_channels(path)
    arrays: dict[str, xr.DataArray] = {}
    for channel in recording.channels:
        name = _quadrature_name(channel.name, demodulators or {})
        if name is None:
            continue
        if name in arrays:
            raise ChannelError(f"{recording.path.name} holds {name} twice", got=channel.name)
        attributes = {"units": channel.unit or "1", "channel": channel.name}
        arrays[name] = xr.DataArray(channel.values, dims=recording.dims, attrs=attributes)
    if not arrays:
        raise ChannelError(
            f"{recording.path.name} holds no quadratures",
            expected="channels X1 and Y1, or R1 and theta1",
            got=", ".join(channel.name for channel in recording.channels) or "no channel",
        )
    coords = coordinates_of(recording)
    return xr.Dataset(arrays, coords=coords, attrs={"source": recording.path.name})


def _quadrature_name(channel: str, demodulators: Mapping[int, int]) -> str | None:
    if channel == "A0":
        return channel
    match = _QUADRATURE.fullmatch(channel.strip())
    if match is None:
        return None
    order = int(match["order"] or 1)
    if match["demodulator"] is not None and not match["order"]:
        number = int(match["demodulator"])
        if number not in demodulators:
            raise ChannelError(
                f"it is not known which harmonic demodulator {number} listened to ({channel})",
                expected="the harmonic of every demodulator",
                got=str(dict(demodulators)) if demodulators else "none",
                hint=f"demodulators={{{number}: 1, ...}}",
            )
        order = demodulators[number]
    part = match["part"].lower()
    return {"x": "X", "y": "Y", "r": "R"}.get(part, "theta") + str(order)


def from_quadratures(
    signals: xr.Dataset,
    *,
    rms: bool,
    phase_sign: int = -1,
    sensitivity: float | None = None,
    common_oscillator: bool = False,
) -> xr.Dataset:
    """Turn the quadratures of a lock-in into observables.

    A lock-in that multiplies with ``exp(-i n w t)`` stores ``X + i Y = R exp(i theta) = A_n exp(-i phi_n)``, or that
    over sqrt 2: its angle is a lead, where phi is a lag.

    Parameters
    ----------
    signals : Dataset
        ``X1`` and ``Y1``, or ``R1`` and ``theta1`` [rad], of harmonic 1 and any others, in m or V, on any dimensions;
        ``A0``, the mean deflection, where it was measured.
    rms : bool
        Whether X, Y and R are root-mean-square values, as most lock-ins store them, or amplitudes. It has no default:
        it makes a factor of sqrt 2.
    phase_sign : int
        -1 where the stored angles are leads (``X + i Y`` as above), 1 where they are lags.
    sensitivity : float, optional
        Deflection per volt [m/V], for signals in V.
    common_oscillator : bool
        True states that all demodulators multiply with harmonics of one oscillator, ``exp(-i n w t)`` with one and the
        same t. Otherwise the phases of the higher harmonics have unknown offsets.

    Returns
    -------
    Dataset
        ``A1``, ``phi1``, ``A2``, ``phi2``, ... and ``A0`` [m, rad].

    Raises
    ------
    ChannelError
        If a quadrature lacks its partner, or harmonic 1 is missing.
    UnitError
        If a signal is neither in m nor, with a sensitivity, in V.

    Examples
    --------
    >>> signals = xr.Dataset({"X1": ("point", [0.0]), "Y1": ("point", [-1e-9])})
    >>> signals["X1"].attrs["units"] = signals["Y1"].attrs["units"] = "m"
    >>> one = from_quadratures(signals, rms=True)
    >>> print(f"{float(one.A1[0]):.3g} m, lag {float(one.phi1[0]):.3f}")
    1.41e-09 m, lag 1.571
    """
    if phase_sign not in (1, -1):
        raise ChannelError("unknown phase sign", expected="-1 (lead) or 1 (lag)", got=str(phase_sign))
    names = set(map(str, signals.data_vars))
    orders = sorted({int(name[1:]) for name in names if re.fullmatch(r"[XYR]\d+", name)} - {0})
    if 1 not in orders:
        raise ChannelError(
            "there is no harmonic 1",
            expected="X1 and Y1, or R1 and theta1",
            got=", ".join(sorted(names)) or "nothing",
        )
    arrays: dict[str, xr.DataArray] = {}
    if "A0" in names:
        mean = _scaled(signals["A0"], "A0", sensitivity)
        arrays["A0"] = named_array("A0", mean.values, mean.dims, mean.coords)
    for n in orders:
        amplitude, angle = _polar(signals, n, names, sensitivity)
        amplitude = amplitude * (math.sqrt(2.0) if rms else 1.0)
        dims, coords = amplitude.dims, amplitude.coords
        lag = (phase_sign * angle.transpose(*dims).values) % (2.0 * math.pi)
        arrays[f"A{n}"] = named_array(f"A{n}", amplitude.values, dims, coords)
        arrays[f"phi{n}"] = named_array(f"phi{n}", lag, dims, coords)
    result = validate_observables(xr.Dataset(arrays, attrs=dict(signals.attrs)))
    higher = [n for n in orders if n > 1]
    if higher and not common_oscillator:
        said = (
            f"{', '.join(f'phi{n}' for n in higher)} may be referred to oscillators of their own: each then has a "
            "constant offset that is not known, and only amplitudes can be used until it is calibrated"
        )
        warnings.warn(said, PhaseReferenceWarning, stacklevel=2)
        result = provenance.add_finding(result, f"PhaseReferenceWarning: {said}.")
    return provenance.record(
        result,
        "from_quadratures",
        rms=rms,
        phase_sign=phase_sign,
        sensitivity=sensitivity,
        common_oscillator=common_oscillator,
    )


def _polar(
    signals: xr.Dataset, n: int, names: set[str], sensitivity: float | None
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return amplitude as stored, in metres, and angle [rad] of a harmonic."""
    for first, second in (("X", "Y"), ("R", "theta")):
        a, b = f"{first}{n}", f"{second}{n}"
        if a in names and b in names:
            if first == "R":
                if signals[b].attrs.get("units", "rad") != "rad":
                    raise UnitError(f"{b} is not in radians", got=repr(signals[b].attrs["units"]))
                radius, turned = _scaled(signals[a], a, sensitivity), signals[b]
                return abs(radius), turned + np.pi * (radius < 0.0)
            x, y = _scaled(signals[a], a, sensitivity), _scaled(signals[b], b, sensitivity)
            return xr.DataArray(np.hypot(x, y)), xr.DataArray(np.arctan2(y, x))
    have = sorted(names & {f"X{n}", f"Y{n}", f"R{n}", f"theta{n}"})
    raise ChannelError(
        f"harmonic {n} is not whole", expected=f"X{n} and Y{n}, or R{n} and theta{n}", got=" and ".join(have)
    )


def _scaled(array: xr.DataArray, name: str, sensitivity: float | None) -> xr.DataArray:
    unit = array.attrs.get("units")
    if unit == "m":
        return array
    if unit == "V" and sensitivity is not None:
        return array * sensitivity
    raise UnitError(
        f"{name} has " + (f"the unit {unit}" if unit not in (None, "1") else "no unit"),
        expected="m, or V and a sensitivity in m/V",
        hint="sensitivity=60e-9" if unit == "V" else "a unit in the header of the file",
    )

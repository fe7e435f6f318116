"""What a lock-in does to readings that follow each other: a first-order low-pass, and noise that is as slow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.instrument.instrument import Instrument, noise_of
from overtone.instrument.signals import Signals, signals_of, with_signals
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]


def time_constant(instrument: Instrument) -> float:
    """Return that of the lock-in's low-pass [s]: one over four times its noise bandwidth."""
    return 1.0 / (4.0 * instrument.bandwidth)


def low_pass(values: npt.NDArray[Any], decay: Any) -> npt.NDArray[Any]:
    """Return readings behind a first-order low-pass along the last axis, settled before the first of them.

    Parameters
    ----------
    values : array (..., n)
        Real or complex, each held until the next; NaN is passed over, and stays.
    decay : float or array (n,)
        ``exp(-t/tau)`` over the time from one reading to the next.
    """
    decays = np.broadcast_to(np.asarray(decay, dtype=float), values.shape[-1:])
    out = np.array(values)
    state = np.full(values.shape[:-1], np.nan, values.dtype)
    for k in range(values.shape[-1]):
        now = values[..., k]
        moved = np.where(np.isnan(state), now, now + decays[k] * (state - now))
        lost = np.isnan(now)
        state = np.where(lost, state, moved)
        out[..., k] = np.where(lost, now, moved)
    return out


def correlated(shape: Sequence[int], decay: float, generator: np.random.Generator) -> _Floats:
    """Return Gaussian noise of unit variance behind a first-order low-pass along the last axis."""
    white = generator.standard_normal(tuple(shape))
    white[..., 1:] *= math.sqrt((1.0 + decay) / (1.0 - decay))
    return np.asarray(low_pass(white, decay))


def behind_the_lock_in(
    read: xr.Dataset,
    instrument: Instrument,
    probe: Probe,
    decay: Any,
    backwards: bool,
    generator: np.random.Generator,
) -> xr.Dataset:
    """Return readings as the lock-in stores them: filtered in the order of time, with noise.

    Parameters
    ----------
    read : Dataset
        Without noise, the last dimension of A1 the one along which time runs.
    instrument, probe
        Give the noise.
    decay : float or array (n,)
        As in `low_pass`, in the order of time.
    backwards : bool
        Whether time runs against the dimension.
    generator : Generator
        Of the noise, which is correlated as the filter makes it.
    """
    way = slice(None, None, -1 if backwards else 1)
    sigma = noise_of(instrument, probe)
    signals = signals_of(read)
    shape = signals.phasor[1].shape
    memory = float(np.mean(decay))

    def noise(scale: float) -> _Floats:
        return scale * correlated(shape, memory, generator)[..., way]

    def passed(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(low_pass(values[..., way], decay)[..., way])

    mean = passed(signals.mean) + noise(sigma["A0"]) if signals.mean is not None else None
    phasors = {}
    for n, a in signals.phasor.items():
        phasors[n] = passed(a) + noise(sigma[f"A{n}"]) + 1j * noise(sigma[f"A{n}"])
    return with_signals(read, Signals(mean, phasors))

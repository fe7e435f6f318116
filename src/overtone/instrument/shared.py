"""What errors that a whole scan shares do to each pixel: the covariance of a calibration, carried to forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import ObservablesError
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.calibration import Calibration
from overtone.instrument.signals import Signals, in_the_frame_of_the_first
from overtone.instrument.unknowns import probe_with, undo
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]

_PASSES = 6
_STEP = 1e-2  # of a standard deviation


def redo(clean: Signals, values: Mapping[str, float], amplitude: float, **where: Any) -> Signals:
    """Return the readings that `undo` turns into given signals, by iteration: what the instrument adds is small.

    Parameters
    ----------
    clean : Signals
        Free of the instrument, any shape.
    values : mapping
        Every unknown of `overtone.instrument.unknowns.UNKNOWNS`.
    amplitude : float
        A_ref [m].
    **where
        ``height``, ``x``, ``y`` of each reading about the middle of the scan [m].
    """
    read = clean
    for _ in range(_PASSES):
        again = undo(read, values, amplitude, **where)
        mean = None
        if read.mean is not None and clean.mean is not None and again.mean is not None:
            mean = read.mean + (clean.mean - again.mean) * values["gain0"]
        phasor = {}
        for n, a in read.phasor.items():
            turn = np.exp(-1j * n * values["phi1_offset"])
            if f"gain{n}" in values and n > 1:
                turn = turn * values[f"gain{n}"] * np.exp(-1j * values[f"latency{n}"])
            phasor[n] = a + (clean.phasor[n] - again.phasor[n]) * turn
        read = Signals(mean, phasor)
    return read


def first_force(amplitude: Any, phase: Any, probe: Probe) -> npt.NDArray[np.complex128]:
    """Return f_1 = CONS_1 - i DISS_1 [N] of an amplitude [m] and a lag [rad], as `overtone.to_force_harmonics` does."""
    free = probe.drive.free_amplitude * np.exp(1j * (np.asarray(phase) - far_phase(probe)))
    return np.asarray((amplitude - free) / complex(read_receptance(probe, probe.drive.frequency)))


def forces_of(signals: Signals, probe: Probe, orders: Sequence[int]) -> npt.NDArray[np.complex128]:
    """Return CONS_n - i DISS_n of signals [N], orders on the last axis, as `overtone.to_force_harmonics` has them.

    Raises
    ------
    ObservablesError
        If a harmonic is not among the signals.
    """
    missing = sorted(set(orders) - set(signals.orders))
    if missing:
        raise ObservablesError(
            f"harmonic {', '.join(map(str, missing))} was not measured",
            expected=", ".join(map(str, orders)),
            got=", ".join(map(str, signals.orders)),
        )
    receptance = read_receptance(probe, np.array(orders) * probe.drive.frequency)
    first = signals.phasor[1]
    frame = in_the_frame_of_the_first(signals)
    parts = []
    for n, G in zip(orders, receptance, strict=True):
        if n == 0 and signals.mean is not None:
            parts.append((signals.mean / G).real + 0j)
        elif n == 1:
            parts.append(first_force(np.abs(first), -np.angle(first), probe))
        else:
            parts.append(frame[n] / G)
    return np.stack(parts, axis=-1)


def conservative(signals: Signals, probe: Probe, orders: Sequence[int]) -> _Floats:
    """Return CONS_n of signals [N], orders on the last axis; raises as `forces_of` does."""
    return forces_of(signals, probe, orders).real


def shared_forces(
    clean: Signals, calibration: Calibration, orders: Sequence[int], **where: Any
) -> tuple[_Floats, _Floats]:
    """Return what each independent shared error does to the conservative harmonics, and to ln R.

    As `shared_changes`, of which it is the real part.
    """
    changes, radius = shared_changes(clean, calibration, orders, **where)
    return changes.real, radius


def shared_changes(
    clean: Signals, calibration: Calibration, orders: Sequence[int], **where: Any
) -> tuple[npt.NDArray[np.complex128], _Floats]:
    """Return what each independent shared error does to the force harmonics, and to ln R.

    Parameters
    ----------
    clean : Signals
        Corrected, any shape.
    calibration : Calibration
        The one applied, with the covariance that is left.
    orders : sequence of int
        Harmonics.
    **where
        ``height``, ``x``, ``y`` of each reading about the middle of the scan [m].

    Returns
    -------
    forces : array (..., harmonic, source)
        Change of CONS_n - i DISS_n [N] for one standard deviation of each source.
    radius : array (source,)
        Change of ln R with it.

    Notes
    -----
    Sources are the columns of a root of the covariance, so that independent ones of size 1 have it together. To first
    order: an error that moves a signal by as much as it has is beyond that, and leaves nothing determined anyway.
    """
    read = redo(clean, calibration.values, calibration.amplitude, **where)
    root = _root(calibration)

    def forces(at: Mapping[str, float]) -> npt.NDArray[np.complex128]:
        signals = undo(read, at, calibration.amplitude, **where)
        return forces_of(signals, probe_with(calibration.probe, at), orders)

    here = forces(calibration.values)
    changes = np.empty((*here.shape, root.shape[1]), complex)
    for k, column in enumerate(root.T):
        steps = dict(zip(calibration.names, _STEP * column, strict=True))
        there = {name: value + steps.get(name, 0.0) for name, value in calibration.values.items()}
        changes[..., k] = (forces(there) - here) / _STEP
    return changes, relative_changes(calibration, "radius")


def relative_changes(calibration: Calibration, name: str) -> _Floats:
    """Return the change of ln of an unknown with each source (source,) of `shared_changes`; zeros where it is known."""
    root = _root(calibration)
    if name not in calibration.names:
        return np.zeros(root.shape[1])
    return np.asarray(root[calibration.names.index(name)] / calibration.values[name])


def _root(calibration: Calibration) -> _Floats:
    """Return what one standard deviation of each source does to the unknowns (unknown, source)."""
    values, vectors = np.linalg.eigh(calibration.covariance / np.outer(*2 * [_scale(calibration)]))
    root = _scale(calibration)[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root[:, values > 1e-12])


def _scale(calibration: Calibration) -> _Floats:
    spread = np.sqrt(np.diag(calibration.covariance))
    return np.where(spread > 0.0, spread, 1.0)

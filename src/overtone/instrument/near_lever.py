"""The lever as it is just above the sample, from the far part of an approach curve and a frequency ladder."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import xarray as xr

from overtone.errors import ProbeError
from overtone.harmonics import far_phase
from overtone.instrument.curve_parts import FreeLever
from overtone.instrument.far_field import ladder_points
from overtone.instrument.signals import Signals
from overtone.instrument.surface import Ladder, lever_near_surface, resonance_from_ladder
from overtone.instrument.unknowns import NEUTRAL, undo
from overtone.probe import Probe
from overtone.units import format_quantity

_FEWEST_FREQUENCIES = 5
_LEAST_QUALITY_ERROR = 0.003  # what a response that is not quite that of one mode leaves
_OFF = 0.03  # relative, between stated and measured free amplitude


def near_lever(
    free: FreeLever,
    probe: Probe,
    far_field: xr.Dataset | None,
    compression: tuple[float, float],
    findings: list[str],
) -> tuple[Probe, float | None]:
    """Return the lever just above the sample.

    Parameters
    ----------
    free : FreeLever
        Its free motion along the far part of the curve, as read.
    probe : Probe
        As stated.
    far_field : Dataset, optional
        A ladder of drive frequencies, which tells resonance and Q.
    compression : (float, float)
        Share of A1 that the detector loses at the free amplitude, and its standard deviation.
    findings : list of str
        Gets a sentence for everything that is not as stated.

    Returns
    -------
    probe : Probe
        With resonance, Q and free amplitude just above the sample.
    quality_error : float or None
        Relative standard deviation of Q where a ladder told it.
    """
    amplitude, far_end, changes = abs(free.onset), free.far_end, free.changes
    before = replace(probe, drive=replace(probe.drive, free_amplitude=abs(far_end)))
    quality_error = None
    ladder, otherwise = (
        _resonance(far_field, probe, share, amplitude) for share in (compression[0], sum(compression))
    )
    if ladder is not None and ladder.probe is not None:
        mode, stated = ladder.probe.cantilever.modes[0], probe.cantilever.modes[0]
        # a detector that flattens the peak broadens it
        broadened = 0.0 if otherwise is None else otherwise.quality_factor / mode.quality_factor - 1.0
        quality_error = math.hypot(ladder.quality_factor_error / mode.quality_factor, broadened)
        quality_error = max(quality_error, _LEAST_QUALITY_ERROR)
        findings.append(
            f"resonance and Q from the frequency ladder: {mode.frequency / 1e3:.6g} kHz and {mode.quality_factor:.4g}, "
            f"where the probe says {stated.frequency / 1e3:.6g} kHz and {stated.quality_factor:.4g}"
        )
        before = ladder.probe
        far_end = ladder.probe.drive.free_amplitude * np.exp(-1j * (far_phase(before) + ladder.phase_offset))
        changes = True
    near = before
    try:
        if changes:
            lag = far_phase(before) - float(np.angle(free.onset / far_end))
            near = lever_near_surface(before, free_amplitude=amplitude, phase=lag).probe
    except ProbeError:
        changes = False
        findings.append(
            "amplitude and phase change along the far part of the curve as no free lever does: a force of long range, "
            "drift, or a wrong sign of the phase; the lever of the probe was used"
        )
    if changes:
        mode = near.cantilever.modes[0]
        findings.append(
            f"just above the sample the free amplitude is {100 * (amplitude / abs(far_end) - 1):+.2g} % and the phase "
            f"{math.degrees(float(np.angle(far_end / free.onset))):+.2g} deg off the ones far away: "
            f"Q {mode.quality_factor:.4g} and {mode.frequency / 1e3:.6g} kHz were used"
        )
    stated_amplitude = probe.drive.free_amplitude
    if abs(amplitude / stated_amplitude - 1.0) > _OFF:
        findings.append(
            f"the free amplitude on the curve is {format_quantity(amplitude, 'm')}, the probe says "
            f"{format_quantity(stated_amplitude, 'm')}; that of the curve was used"
        )
    return replace(near, drive=replace(near.drive, free_amplitude=amplitude)), quality_error


def _resonance(
    far_field: xr.Dataset | None, probe: Probe, compression: float, amplitude: float
) -> Ladder | None:
    """Return the resonance that a frequency ladder at constant drive shows, None without one."""
    if far_field is None or not ("frequency" in far_field or "frequency" in far_field.coords):
        return None
    points = ladder_points(far_field)
    frequency = np.asarray(far_field["frequency"].broadcast_like(far_field["A1"]).values, dtype=float).ravel()
    known = np.isfinite(frequency) & np.isfinite(points.signals.phasor[1])
    same = np.isclose(points.drive, 1.0, rtol=1e-6) & known
    if np.unique(frequency[same]).size < _FEWEST_FREQUENCIES:
        return None
    values = {**NEUTRAL, "compression": compression}
    first = undo(Signals(None, {1: points.signals.phasor[1][same]}), values, amplitude).phasor[1]
    return resonance_from_ladder(frequency[same], np.abs(first), -np.angle(first), probe=probe)

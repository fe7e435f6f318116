"""Thermal noise of a lever: the floor under every reading, known before anything is measured.

Each mode is shaken by a white force of its own (fluctuation and dissipation), so that the one-sided
spectra of the modes add, each weighted by how strongly the detector sees it:

    S(w) = sum_j (s_j/s_1)^2  4 kB T / (k_j Q_j w_j) / ((1 - x_j^2)^2 + (x_j/Q_j)^2),   x_j = w/w_j

What is returned is ``sqrt(S)``. The noise of a lock-in of noise bandwidth B is then ``sqrt(2 S B)`` on
an amplitude and ``sqrt(S B)`` on A0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import ProbeError
from overtone.probe import SLOPE, Cantilever, Probe

BOLTZMANN = 1.380649e-23
"""J/K, exact."""

ROOM_TEMPERATURE = 295.0
"""K, where none is stated: 22 degrees Celsius."""


def thermal_noise_density(
    probe_or_cantilever: Probe | Cantilever, frequency: Any, temperature: float = ROOM_TEMPERATURE
) -> npt.NDArray[np.float64]:
    """Return the amplitude spectral density of the thermal motion, one-sided.

    Parameters
    ----------
    probe_or_cantilever : Probe or Cantilever
        A probe: what its detector reads. A cantilever: the displacement of the tip.
    frequency : array, any shape
        Frequency [Hz], 0 for the mean deflection.
    temperature : float
        Temperature of the lever [K].

    Returns
    -------
    array, shape of ``frequency``
        Square root of the one-sided power spectral density [m/sqrt(Hz)]: its square, integrated over all
        positive frequencies, is the mean square of the motion.

    Raises
    ------
    ProbeError
        If the temperature is not finite and positive, or a frequency is negative.

    Notes
    -----
    Viscous damping of each mode by itself, a lever far from the sample, no noise of the detector. A mode
    that the cantilever leaves out adds nothing, also where the static stiffness stands for it.

    Examples
    --------
    >>> lever = Cantilever.single_mode(16.4, 162e3, 287)
    >>> [f"{1e15 * density:.3g}" for density in thermal_noise_density(lever, [0, 162e3, 324e3])]
    ['1.84', '529', '0.615']
    """
    if not (math.isfinite(temperature) and temperature > 0.0):
        raise ProbeError("no thermal noise at this temperature", expected="kelvin", got=repr(temperature))
    frequency = np.asarray(frequency, dtype=float)
    if not bool((frequency >= 0.0).all()):
        raise ProbeError(
            "no thermal noise at this frequency", expected="0 or more", got=repr(frequency.min())
        )
    cantilever, weights = _seen(probe_or_cantilever)
    power = np.zeros(frequency.shape)
    for mode, weight in zip(cantilever.modes, weights, strict=True):
        x = frequency / mode.frequency
        width = x / mode.quality_factor
        white = (
            4.0
            * BOLTZMANN
            * temperature
            / (mode.stiffness * mode.quality_factor * 2.0 * math.pi * mode.frequency)
        )
        power += weight**2 * white / ((1.0 - x**2) ** 2 + width**2)
    return np.asarray(np.sqrt(power))


def _seen(probe_or_cantilever: Probe | Cantilever) -> tuple[Cantilever, list[float]]:
    """Return the cantilever and how strongly each of its modes is read."""
    if isinstance(probe_or_cantilever, Cantilever):
        return probe_or_cantilever, [1.0] * len(probe_or_cantilever.modes)
    cantilever = probe_or_cantilever.cantilever
    if probe_or_cantilever.detector.kind != SLOPE:
        return cantilever, [1.0] * len(cantilever.modes)
    return cantilever, [mode.slope_ratio for mode in cantilever.modes]

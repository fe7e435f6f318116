"""Observables and force harmonics of a periodic motion: one complex line in both directions.

With ``a_n = A_n exp(-i phi_n)`` (lag convention), ``f_n = CONS_n - i DISS_n`` and the receptance
``G(w)`` from force to reading,

    f_0 = A0 / G(0)
    f_1 = (A1 - A1far exp(i (phi1 - phi_far))) / G(w)
    f_n = a_n exp(i n phi1) / G(n w)                        n >= 2

which for one mode is eqs 5a-g of Shaik, Reifenberger and Raman, Nanotechnology 31 (2020) 455502
(eqs 6a-g where the drive frequency is the resonance): ``1/G(n w) = k (1 - n^2 r^2 + i n r/Q)``. With
several modes ``G`` sums their answers, each weighted by how strongly the detector sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import ObservablesError
from overtone.probe import SLOPE, STATIC, Cantilever, Probe, format_probe
from overtone.quantities import harmonic_orders, named_array, validate_observables

ATTRACTIVE, UNDETERMINED, REPULSIVE = -1, 0, 1
REGIME_FLAGS = {
    "flag_values": [ATTRACTIVE, UNDETERMINED, REPULSIVE],
    "flag_meanings": "attractive undetermined repulsive",
}


def tip_receptance(cantilever: Cantilever, frequency: Any) -> npt.NDArray[np.complex128]:
    """Return the displacement of the tip per force at the tip, G_tip.

    Parameters
    ----------
    cantilever : Cantilever
        One or more modes.
    frequency : array, any shape
        Frequency [Hz], 0 for the static answer.

    Returns
    -------
    array, shape of ``frequency``
        Receptance [m/N], complex.
    """
    return _receptance(cantilever, frequency, [1.0] * len(cantilever.modes), 1.0)


def read_receptance(probe: Probe, frequency: Any) -> npt.NDArray[np.complex128]:
    """Return the reading of the detector per force at the tip, G_read.

    A displacement detector reads what the tip does; an optical lever weights each mode by
    ``s_j/s_1``, because it reads slope and was calibrated on the first mode; a mean deflection with a sensitivity
    of its own (`Detector.mean_sensitivity`) is what the tip does.

    Parameters
    ----------
    probe : Probe
        Cantilever and detector.
    frequency : array, any shape
        Frequency [Hz].

    Returns
    -------
    array, shape of ``frequency``
        Receptance [m/N], complex.
    """
    cantilever = probe.cantilever
    if probe.detector.kind != SLOPE:
        return tip_receptance(cantilever, frequency)
    weights = [mode.slope_ratio for mode in cantilever.modes]
    read = _receptance(cantilever, frequency, weights, cantilever.static_slope_ratio)
    if probe.detector.mean_sensitivity == STATIC:  # the mean is read as what the tip does
        read = np.where(np.asarray(frequency) == 0.0, tip_receptance(cantilever, frequency), read)
    return read


def _receptance(
    cantilever: Cantilever, frequency: Any, weights: list[float], static_weight: float
) -> npt.NDArray[np.complex128]:
    frequency = np.asarray(frequency, dtype=float)
    total = np.zeros(frequency.shape, dtype=complex)
    static = cantilever.static_stiffness is not None
    if cantilever.static_stiffness is not None:
        total += static_weight / cantilever.static_stiffness
    for mode, weight in zip(cantilever.modes, weights, strict=True):
        x = frequency / mode.frequency
        denominator = 1.0 - x**2 + 1j * x / mode.quality_factor
        # With the static answer known as a whole, a mode adds only what it does beyond its static share:
        # 1/D - 1 = (x^2 - i x/Q)/D, which falls off fast for the modes far above.
        numerator = x**2 - 1j * x / mode.quality_factor if static else 1.0
        total += weight / mode.stiffness * numerator / denominator
    return total


def far_phase(probe: Probe) -> float:
    """Return the phase lag of the first harmonic far from the sample [rad], ``-arg G(w)``.

    For one mode it is ``arg(1 - r^2 + i r/Q)``: 90 degrees only where the drive is at resonance.
    """
    return float(-np.angle(read_receptance(probe, probe.drive.frequency)))


def to_force_harmonics(observables: xr.Dataset, probe: Probe) -> xr.Dataset:
    """Turn observables into force harmonics (eqs 5a-g; any harmonic, any r, any number of modes).

    Parameters
    ----------
    observables : Dataset
        ``A1``, ``phi1`` and any of ``A0``, ``A2``, ``phi2``, ``A3``, ``phi3``, ... as the detector
        reads them [m, rad], any dimensions; phi1 referred to `far_phase` far from the sample.
    probe : Probe
        Cantilever, drive and detector.

    Returns
    -------
    Dataset
        ``F_cons(harmonic)`` and ``F_diss(harmonic)`` [N] over the harmonics that were measured, plus
        ``A1`` and ``phi1``, which the way back needs.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables.

    Notes
    -----
    Assumes a periodic motion and linear dynamics of the lever. The first harmonic holds for any way
    of driving; with an optical lever and a single-mode probe, F_2 comes out 7 to 40 % low, by where tip and spot sit.
    """
    validate_observables(observables)
    orders = harmonic_orders(observables)
    amplitude, phase = observables["A1"], observables["phi1"]
    drive = probe.drive
    receptance = read_receptance(probe, np.array(orders) * drive.frequency)
    forces = []
    for n, G in zip(orders, receptance, strict=True):
        with np.errstate(invalid="ignore"):  # an infinite phase is a lost pixel, as NaN is
            if n == 0:
                reading = observables["A0"] + 0j
            elif n == 1:
                reading = amplitude - drive.free_amplitude * np.exp(1j * (phase - far_phase(probe)))
            else:
                reading = observables[f"A{n}"] * np.exp(1j * (n * phase - observables[f"phi{n}"]))
        forces.append(reading / G)
    harmonic = xr.DataArray(list(orders), dims="harmonic", name="harmonic")
    stacked = xr.concat(forces, dim=harmonic, coords="minimal", compat="override")
    dims, coords = stacked.dims, stacked.coords
    result = xr.Dataset(
        {
            "F_cons": named_array("F_cons", stacked.real, dims, coords),
            "F_diss": named_array("F_diss", -stacked.imag, dims, coords),
            "A1": amplitude,
            "phi1": phase,
        },
        attrs=dict(observables.attrs),
    )
    return provenance.record(result, "to_force_harmonics", probe=format_probe(probe))


def to_observables(force_harmonics: xr.Dataset, probe: Probe) -> xr.Dataset:
    """Turn force harmonics into the observables that the detector would read.

    Parameters
    ----------
    force_harmonics : Dataset
        ``F_cons(harmonic)`` and ``F_diss(harmonic)`` [N] with harmonic 1, and the amplitude ``A1`` [m]
        at which they were taken: force harmonics alone leave two motions open.
    probe : Probe
        Cantilever, drive and detector.

    Returns
    -------
    Dataset
        ``A1``, ``phi1`` and ``A_n``, ``phi_n`` (``A0`` for harmonic 0) of every harmonic given.

    Raises
    ------
    ObservablesError
        If harmonic 1 or A1 is missing, or if no phase can give this force at this amplitude.
    """
    orders = [int(n) for n in force_harmonics["harmonic"].values]
    if 1 not in orders or "A1" not in force_harmonics:
        raise ObservablesError(
            "the motion is not determined",
            expected="harmonic 1 and the amplitude A1",
            got=f"harmonics {orders}",
        )
    force = force_harmonics["F_cons"] - 1j * force_harmonics["F_diss"]
    receptance = dict(
        zip(orders, read_receptance(probe, np.array(orders) * probe.drive.frequency), strict=True)
    )
    amplitude = force_harmonics["A1"]
    free = probe.drive.free_amplitude
    rotor = (amplitude - receptance[1] * force.sel(harmonic=1, drop=True)) / free
    off = float(abs(np.abs(rotor) - 1.0).max())
    if not off < 1e-6:
        raise ObservablesError(
            "force and amplitude contradict each other",
            expected="|A1/G - f_1| equal to the drive force",
            got=f"a relative difference of {off:.2g}",
            hint="the force harmonics of this probe at this amplitude",
        )
    dims, coords = amplitude.dims, amplitude.coords
    phase = (np.arctan2(rotor.imag, rotor.real) + far_phase(probe)) % (2 * np.pi)
    arrays = {"A1": amplitude, "phi1": named_array("phi1", phase, dims, coords)}
    for n in orders:
        reading = receptance[n] * force.sel(harmonic=n, drop=True)
        if n == 0:
            arrays["A0"] = named_array("A0", reading.real, dims, coords)
        elif n >= 2:
            lag = (n * phase - np.arctan2(reading.imag, reading.real)) % (2 * np.pi)
            arrays[f"A{n}"] = named_array(f"A{n}", abs(reading), dims, coords)
            arrays[f"phi{n}"] = named_array(f"phi{n}", lag, dims, coords)
    result = xr.Dataset(arrays, attrs=dict(force_harmonics.attrs) | {"detector": probe.detector.kind})
    return provenance.record(result, "to_observables", probe=format_probe(probe))


def energy(force_harmonics: xr.Dataset, probe: Probe) -> xr.Dataset:
    """Return the energy lost per cycle and the virial: what A1 and phi1 alone determine.

    Parameters
    ----------
    force_harmonics : Dataset
        Result of `to_force_harmonics`.
    probe : Probe
        Needed for the motion in the higher harmonics.

    Returns
    -------
    Dataset
        ``dissipation`` ``-pi sum_n n Im(f_n conj(q_n))`` [J] over the harmonics measured, whose first
        term is ``pi A1 DISS_1``, and ``virial`` ``A1 CONS_1 / 2`` [J] of the first harmonic.
    """
    amplitude = force_harmonics["A1"]
    first = force_harmonics.sel(harmonic=1, drop=True)
    lost = np.pi * amplitude * first["F_diss"]
    for n in force_harmonics["harmonic"].values:
        if n >= 2:
            part = force_harmonics.sel(harmonic=n, drop=True)
            compliance = complex(tip_receptance(probe.cantilever, n * probe.drive.frequency))
            # Im(f conj(G f)) = -Im(G) |f|^2: a passive lever has Im(G) < 0, so what the contact puts into
            # the higher harmonics comes back as heat in the lever and is not lost in the sample.
            share = np.pi * n * compliance.imag * (part["F_cons"] ** 2 + part["F_diss"] ** 2)
            # a correction of a per cent: where that harmonic is lost, the first one still tells the energy
            lost = lost + share.fillna(0.0)
    dims, coords = amplitude.dims, amplitude.coords
    virial = amplitude * first["F_cons"] / 2.0
    return xr.Dataset(
        {
            "dissipation": named_array("dissipation", lost.transpose(*dims), dims, coords),
            "virial": named_array("virial", virial.transpose(*dims), dims, coords),
        }
    )


def regime(
    observables: xr.Dataset,
    probe: Probe,
    alternatives: Sequence[tuple[Probe, float]] = (),
    *,
    noise: float = 0.0,
) -> xr.DataArray:
    """Return whether each pixel feels net attraction or repulsion: the sign of CONS_1, not of phi1 - 90 deg.

    Parameters
    ----------
    observables : Dataset
        A1 and phi1.
    probe : Probe
        The probe in use.
    alternatives : sequence of (Probe, float)
        Other readings of the same data: a probe that may be meant as well, and what to add to phi1 [rad].
        A pixel whose sign they do not share is undetermined.
    noise : float
        Standard deviation of phi1 [rad]; a pixel whose CONS_1 is within two of it from zero is undetermined.

    Returns
    -------
    DataArray
        ``attractive`` (-1, CONS_1 > 0), ``undetermined`` (0) or ``repulsive`` (1) on the dimensions of A1;
        NaN pixels are undetermined.
    """
    pair = observables[["A1", "phi1"]]
    amplitude = pair["A1"]
    forces = [
        to_force_harmonics(pair.assign(phi1=pair["phi1"] + shift), other)["F_cons"].sel(harmonic=1, drop=True)
        for other, shift in [(probe, 0.0), *alternatives]
    ]
    drive_force = probe.drive.free_amplitude / abs(complex(read_receptance(probe, probe.drive.frequency)))
    floor = 2.0 * noise * drive_force
    values = np.zeros(amplitude.shape, np.int8)
    values[np.logical_and.reduce([force.values < -floor for force in forces])] = REPULSIVE
    values[np.logical_and.reduce([force.values > floor for force in forces])] = ATTRACTIVE
    return named_array("regime", values, amplitude.dims, amplitude.coords, **REGIME_FLAGS)

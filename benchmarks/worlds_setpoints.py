"""Two set-points fitted, a third one predicted: does what was inferred of the materials hold where nothing was fitted?

The prediction is a simulation: draws of the materials and of the errors of the instrument from the posterior of a stack
of two scans, the feedback holding the tip at the amplitude of the third, read by the instrument of the draw. The
third scan may have zeros of its own, as the method has it of every further scan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import binary_erosion

import overtone as ot
import overtone.population.population as method
from overtone.instrument.shared import redo
from overtone.instrument.signals import positions, signals_of, with_signals
from overtone.instrument.unknowns import NEUTRAL, probe_with
from overtone.population.evidence import DRIFTING
from overtone.population.table import draws_of
from worlds_limit import STATED
from worlds_simulated import POISSON_RATIO, World

Array = npt.NDArray[np.float64]

SETPOINTS = (0.36, 0.5, 0.66)
"""Fitted, fitted, predicted."""
DRAWS, PIXELS = 40, 48
READINGS = ("A0", "phi1", "A2_real", "A2_imag", "A3_real", "A3_imag")
MODEL = "dmt-viscous"
_EDGE = 2  # pixels of a phase that are left out
_FEWEST = 30


def predictions(made: World, known: Mapping[str, Any]) -> tuple[xr.Dataset, list[dict[str, float]]]:
    """Return the answer from two scans, and by phase whether each mean reading of the third lies where it says.

    Parameters
    ----------
    made : World
        Of three set-points.
    known : mapping
        ``reference`` and ``reference_pixels`` as `overtone.map_properties` takes them; empty without a reference.

    Returns
    -------
    Dataset, list of dict
        The answer, and of each phase ``index`` and for every reading 1 inside, 0 outside of the 90 % interval.
    """
    caught: list[Any] = []
    original = method.laws_of

    def catch(*arguments: Any) -> Any:
        caught.append(arguments)
        return original(*arguments)

    method.laws_of = catch
    try:
        result = ot.map_properties(
            ot.stack_scans(made.scans[:2]),
            made.probe,
            model=MODEL,
            poisson_ratio=POISSON_RATIO,
            method="population",
            noise=made.noise,
            priors=STATED,
            **known,
        )
    finally:
        method.laws_of = original
    materials, question, exponent, _ = caught[0]
    found = []
    for material in materials:
        if material.joint is None or not material.resolved or not material.settled:
            continue
        own = binary_erosion(result["phase"].values == material.index, iterations=_EDGE)
        own &= np.isfinite(made.scans[2]["A1"].values)  # where the third set-point could be held
        if own.sum() < _FEWEST:
            continue
        measured = readings(made.scans[2].where(xr.DataArray(own, dims=("y", "x"))))
        drawn = simulated(made, material, question, exponent, own)
        # the mean of so many pixels is as uncertain as that of those that were drawn
        inside: dict[str, float] = {"index": material.index}
        for name in READINGS:
            values = drawn[name][np.isfinite(drawn[name])]
            if values.size < 0.8 * DRAWS:
                continue
            low, high = np.quantile(values, (0.05, 0.95))
            inside[name] = float(low <= measured[name] <= high)
        found.append(inside)
    return result, found


def readings(scan: xr.Dataset) -> dict[str, float]:
    """Return mean readings of pixels: A0, phi1, and real and imaginary part of A_n exp(-i phi_n)."""
    found = {"A0": float(scan["A0"].mean()), "phi1": float(scan["phi1"].mean())}
    for n in (2, 3):
        phasor = (scan[f"A{n}"] * np.exp(-1j * scan[f"phi{n}"])).mean().item()
        found |= {f"A{n}_real": phasor.real, f"A{n}_imag": phasor.imag}
    return found


def simulated(made: World, material: Any, question: Any, exponent: float, own: Any) -> dict[str, Array]:
    """Return the mean readings of a material at the third set-point for every draw (draw,)."""
    joint, left, random = material.joint, made.calibration, np.random.default_rng(made.seed)
    draws = draws_of(question, material, exponent)
    spread = joint.spreads[material.place].value
    third = made.scans[2]
    y, x = np.nonzero(own)
    some = random.permutation(y.size)[:PIXELS]
    pixels = third.isel(
        y=xr.DataArray(y[some], dims="point"), x=xr.DataArray(x[some], dims="point")
    ).expand_dims("line")
    place = positions(third)._asdict()
    where = {name: np.asarray(part)[y[some], x[some]][None] for name, part in place.items()}
    values: dict[str, list[float]] = {name: [] for name in READINGS}
    for d in np.linspace(0, len(joint.draws.ln_E) - 1, DRAWS).astype(int):
        z = joint.draws.z[d, : len(left.names)]
        errors = dict(NEUTRAL)
        for name, amount in zip(left.names, z, strict=True):
            drift = random.standard_normal() if name in DRIFTING else 0.0
            errors[name] += left.error(name) * (amount + drift)
        lever = probe_with(made.probe, errors)
        scatter = spread[:, None] * random.standard_normal((3, some.size))
        E = math.exp(draws["modulus"][d]) * np.exp(scatter[0])
        solid = ot.sample(
            MODEL,
            modulus=E[None],
            adhesion=(math.exp(draws["adhesion"][d]) * np.exp(scatter[1]))[None],
            viscosity=(math.exp(draws["viscosity"][d]) * np.exp(scatter[0] + scatter[2]))[None],
            poisson_ratio=POISSON_RATIO,
        )
        share = xr.DataArray(pixels["A1"].values / lever.drive.free_amplitude, dims=("y", "x"))
        state = ot.hold_amplitude(lever, solid, setpoint=share)
        clean = state[["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]]
        read = readings(with_signals(clean, redo(signals_of(clean), errors, left.amplitude, **where)))
        for name, value in read.items():
            values[name].append(value)
    return {name: np.array(column) for name, column in values.items()}

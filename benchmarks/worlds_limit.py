"""The information limit: the least standard deviation that any unbiased estimate of a material can have.

Cramer and Rao, with what is known beforehand, linear at the truth. Data are the mean force harmonics of the pixels of
each material,

    y_m = f(ln E_m, ln F_m, ln tan_m, t_m) + C_m z + noise_m

with the independent errors z of the calibration shared by all materials, and noise_m of covariance
``(noise + J Sigma J')/pixels``: that of a reading and the spread within the material, whose indentation follows while
the feedback holds the amplitude. Derivatives are differences of the simulator `overtone.dynamics.indented`, which
shares nothing with the method but the law of force. The radius moves E beside the forces: ln E is what the forces say
plus an exponent times ln R.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import overtone as ot
from overtone.contact.models import contact_model
from overtone.dynamics.indented import Indented, indented_states
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.noise import add_noise
from overtone.instrument.shared import forces_of, shared_changes
from overtone.instrument.signals import Signals, positions, signals_of
from overtone.inversion.pixels import radius_exponent
from overtone.inversion.priors import Prior, complete_priors, of_single_pixels, shared_priors
from worlds_simulated import POISSON_RATIO, Material, World, _solid

Array = npt.NDArray[np.float64]

PROPERTIES = ("modulus", "adhesion", "loss_tangent")
ORDERS = (0, 1, 2, 3)
LOSSY = (1, 2)
N_MAX = 20
STEP = 1e-3
UNKNOWNS = len(PROPERTIES) + 1
"""Of a material: ln of each property, and ln of the indentation."""
NOISY = 2000  # readings from which the noise of forces is taken
EVEN = 1.0 / math.sqrt(12.0)
"""Standard deviation of an even prior of width 1."""
STATED = {"modulus": Prior("log-normal", 0.45e9, 4.0), "adhesion": Prior("log-normal", 5.7e-9, 2.8)}
"""Priors of every material: what the materials of all worlds together are distributed like."""


class Local(NamedTuple):
    """A material of a world about its truth."""

    slopes: Array
    """(datum, UNKNOWNS): of the mean forces [N]."""
    covariance: Array
    """(datum, datum): of their noise and scatter [N^2]."""
    shared: Array
    """(datum, source): what one standard deviation of each error of the instrument adds [N]."""
    prior: Array
    """(UNKNOWNS,): precisions."""


def rows_of(forces: npt.NDArray[np.complex128]) -> Array:
    """Return CONS_0 .. CONS_3, DISS_1, DISS_2 of CONS_n - i DISS_n (..., n)."""
    return np.concatenate([forces[..., list(ORDERS)].real, -forces[..., list(LOSSY)].imag], axis=-1)


def limits(
    made: World, reference: str, reference_error: float
) -> Mapping[tuple[str, bool], Mapping[str, float]]:
    """Return the least standard deviation of ln of each property by material, without and with a reference.

    Parameters
    ----------
    made : World
        Its materials, at the median amplitude and indentation of their own pixels.
    reference : str
        Name of the material whose modulus is known.
    reference_error : float
        Standard deviation of ln of it.
    """
    parts = []
    radius = np.zeros(0)
    for k, material in enumerate(made.materials):
        local, radius = _local(made, k, material)
        parts.append(local)
    exponent = radius_exponent(
        contact_model("dmt-viscous"),
        made.probe,
        {"poisson_ratio": POISSON_RATIO, "intermolecular_distance": 0.2e-9},
    )
    size, sources = UNKNOWNS * len(parts), radius.size
    information = np.zeros((size + sources, size + sources))
    for k, part in enumerate(parts):
        along = np.zeros((part.slopes.shape[0], size + sources))
        along[:, k * UNKNOWNS : (k + 1) * UNKNOWNS] = part.slopes
        along[:, size:] = part.shared
        information += along.T @ np.linalg.solve(part.covariance, along)
        own = np.arange(k * UNKNOWNS, (k + 1) * UNKNOWNS)
        information[own, own] += part.prior
    information[range(size, size + sources), range(size, size + sources)] += 1.0
    found = {}
    for anchored in (False, True):
        total = information.copy()
        if anchored:
            index = [m.name for m in made.materials].index(reference)
            total += np.outer(*2 * [_true_modulus(index, radius, exponent, size)]) / reference_error**2
        scale = 1.0 / np.sqrt(np.diag(total))
        covariance = np.linalg.inv(total * np.outer(scale, scale)) * np.outer(scale, scale)
        for k, material in enumerate(made.materials):
            stiff = _true_modulus(k, radius, exponent, size)
            sd = {"modulus": math.sqrt(stiff @ covariance @ stiff)}
            for i, name in enumerate(PROPERTIES[1:], start=1):
                sd[name] = math.sqrt(covariance[k * UNKNOWNS + i, k * UNKNOWNS + i])
            found[material.name, anchored] = sd
    return found


def _true_modulus(k: int, radius: Array, exponent: float, size: int) -> Array:
    """Return how ln E of a material goes with all unknowns: what forces say, and the radius."""
    along = np.zeros(size + radius.size)
    along[k * UNKNOWNS] = 1.0
    along[size:] = exponent * radius
    return along


def _local(made: World, k: int, material: Material) -> tuple[Local, Array]:
    """Return a material about its truth, and what each source does to ln R."""
    own = made.truth["material"].values == k
    A1 = float(np.nanmedian(made.scan["A1"].values[own]))
    delta = float(np.nanmedian(made.truth["indentation"].values[own]))
    at = np.zeros((1 + 2 * UNKNOWNS, UNKNOWNS))
    for i in range(UNKNOWNS):
        at[1 + 2 * i, i], at[2 + 2 * i, i] = 0.5 * STEP, -0.5 * STEP
    factor = np.exp(at)
    values = {n: getattr(material, n) * factor[:, i] for i, n in enumerate(PROPERTIES)}
    state = indented_states(
        made.probe,
        _solid(**values),
        amplitude=np.full(len(at), A1),
        indentation=delta * factor[:, -1],
        n_max=N_MAX,
    )
    y, drive = rows_of(state.force), np.abs(state.drive)
    slopes = ((y[1::2] - y[2::2]) / STEP).T
    # while the amplitude is held the drive stays what it is, and the indentation follows
    pull = (np.log(drive[1::2]) - np.log(drive[2::2])) / STEP
    follows = -pull[:-1] / pull[-1]
    held = slopes[:, :-1] + np.outer(slopes[:, -1], follows)
    spread = np.array([material.spread[n] for n in PROPERTIES])
    clean = _signals(made.probe, state)
    where = {name: part[own].mean(keepdims=True) for name, part in positions(made.scan)._asdict().items()}
    changes, radius = shared_changes(clean, made.calibration, ORDERS, **where)
    shared = _rows_of_changes(changes[0])
    covariance = (_noise(made, clean) + (held * spread**2) @ held.T) / material.pixels
    return Local(slopes, covariance, shared, _prior(made.probe, material, A1)), radius


def _signals(probe: ot.Probe, state: Indented) -> Signals:
    """Return the readings of the first of some states."""
    reading, drive = state.reading[:1], state.drive[:1]
    phi1 = np.angle(drive * read_receptance(probe, probe.drive.frequency)) + far_phase(probe)
    phasor = {n: reading[:, n] * np.exp(-1j * n * phi1) for n in ORDERS[1:]}
    return Signals(reading[:, 0].real, phasor)


def _rows_of_changes(changes: npt.NDArray[np.complex128]) -> Array:
    """Return changes (harmonic, source) as rows (datum, source)."""
    return np.asarray(rows_of(np.moveaxis(changes, 0, -1)).T)


def _noise(made: World, clean: Signals) -> Array:
    """Return the covariance of the forces of a pixel from noise alone, from so many noisy readings [N^2]."""
    scan = made.scan.isel(y=slice(0, 1), x=slice(0, 1)).squeeze()[[]]
    mean = np.zeros(1) if clean.mean is None else clean.mean
    data = {"A0": np.repeat(mean, NOISY)}
    for n, a in clean.phasor.items():
        data |= {f"A{n}": np.repeat(np.abs(a), NOISY), f"phi{n}": np.repeat(-np.angle(a), NOISY)}
    units = {name: {"units": "m" if name.startswith("A") else "rad"} for name in data}
    flat = scan.drop_attrs().drop_vars(list(scan.coords))
    flat = flat.assign({name: ("reading", values, units[name]) for name, values in data.items()})
    noisy = add_noise(flat, made.noise, seed=made.seed)
    y = rows_of(forces_of(signals_of(noisy), made.probe, ORDERS))
    return np.asarray(np.cov(y.T))


def _prior(probe: ot.Probe, material: Material, A1: float) -> Array:
    """Return precisions of ln of properties and indentation that are as wide as the priors of the inversion."""
    defaults = complete_priors(of_single_pixels(STATED), contact_model("dmt-viscous"), probe.tip.radius)
    priors = shared_priors(STATED, defaults, probe.tip.radius)
    modulus, adhesion, tangent, depth = (priors[n] for n in (*PROPERTIES, "indentation"))
    sd = (
        math.log(modulus.second),
        math.log(adhesion.second),
        EVEN * (tangent.second - tangent.first) / material.loss_tangent,
        EVEN * math.log(2.0 * A1 / depth.first),
    )
    return np.array(sd) ** -2.0

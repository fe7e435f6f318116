"""States of contacts that are not what an inversion takes for granted, held at the amplitude of each pixel.

JKR with a loss is a sum of terms that the package holds itself. The force of a standard linear solid has a history, and
that of a blunted cone is no sum of powers: both are known on a bare cosine, and what the higher harmonics of the motion
change of them, a few per cent, is taken from the contact of dmt-viscous that comes nearest at the same amplitude and
indentation. So a force that is that of dmt-viscous comes out right to 1e-5. Against quadrature of the laws along the
full motion, which the bare cosine misses by 1 to 2 %, the conservative harmonics 0 to 3 are right to 0.04, 0.04, 0.11
and 0.16 % (blunted cone), or 0.14, 0.12, 0.10 and 0.22 % (standard linear solid, its DISS_n to 0.7 % of CONS_n).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

import overtone as ot
from overtone.contact.evaluate import force_harmonics
from overtone.contact.models import ContactModel, contact_model
from overtone.contact.parameters import effective_modulus
from overtone.contact.relaxation import sls_harmonics
from overtone.contact.sample import Sample
from overtone.dynamics.indented import indented_states
from overtone.harmonics import far_phase, read_receptance
from overtone.probe import required_radius

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

N_MAX = 10
"""Harmonics of the motion."""
HALF_ANGLE = math.radians(20.0)
"""Of the cone."""
BLUNT, SLOPE = math.cos(HALF_ANGLE), 1.0 / math.tan(HALF_ANGLE)
"""Radius where the paraboloid ends, in units of R, and slope of the cone."""
OMEGA_TAU = 0.5
"""Relaxation time of the standard linear solid times the frequency of the drive."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
STEPS, BALANCED = 20, (1e-5, 1e-8)
"""Of the search: steps at most, and what is left of the drive before and after the motion is followed once more."""


class Contacts(NamedTuple):
    """Materials at amplitudes, flat."""

    given: Mapping[str, Array]
    """Parameters of dmt-viscous."""
    modulus: Array
    """E* [Pa]."""
    tangent: Array
    """Loss tangent."""
    amplitude: Array
    """A1 [m]."""

    def stiffer(self, times: Array) -> dict[str, Array]:
        """Return the parameters of contacts of the same loss tangent, so many times as stiff."""
        return {**self.given, **{name: self.given[name] * times for name in ("modulus", "viscosity")}}

    def bare(self, indentation: Array, times: Array) -> Complex:
        """Return the harmonics of dmt-viscous on a bare cosine, so many times as stiff [N]."""
        where = {"amplitude": self.amplitude, "indentation": indentation}
        return force_harmonics("dmt-viscous", n_max=N_MAX, **where, **self.stiffer(times))


Force = Callable[[Contacts, Array], tuple[Complex, Array]]
"""Harmonics (point, n) on a bare cosine of an indentation (point,) [N], and how many times as stiff the nearest contact
of dmt-viscous is."""


def jkr_viscous() -> ContactModel:
    """Return the law of JKR with the loss of dmt-viscous."""
    jkr, viscous = contact_model("jkr"), contact_model("dmt-viscous")
    frequency = [q for q in viscous.given if q.name == "frequency"]
    return replace(
        jkr,
        key="jkr-viscous",
        terms=(*jkr.terms, viscous.terms[-1]),
        unknowns=viscous.unknowns,
        given=(*jkr.given, *frequency),
    )


def standard_linear_solid(contacts: Contacts, indentation: Array) -> tuple[Complex, Array]:
    """Return the force of a relaxing solid, under the attraction of dmt until the undeformed surface is left.

    ``E(t) = E_inf + (E_0 - E_inf) exp(-t/tau)`` with ``w tau = x`` has the storage modulus E and the loss tangent t
    at w where ``E_inf = E (1 - t x)`` and ``E_0 = E (1 + t/x)``.
    """
    given, A, x = contacts.given, contacts.amplitude, OMEGA_TAU
    solid = sls_harmonics(
        A,
        indentation,
        N_MAX,
        frequency=given["frequency"],
        radius=given["radius"],
        effective_modulus=contacts.modulus * (1.0 - contacts.tangent * x),
        instantaneous_modulus=contacts.modulus * (1.0 + contacts.tangent / x),
        relaxation_time=x / (2.0 * math.pi * given["frequency"]),
    )
    pull = contact_model("dmt").terms[-1].harmonics(given, A, indentation / (2.0 * A), N_MAX)
    return solid + pull, np.ones(indentation.shape)


def cone_contact(contact_radius: Array) -> tuple[Array, Array]:
    """Return indentation and force of a paraboloid that ends in a cone, in units of R and E* R^2.

    ``delta = a int_0^a f'/sqrt(a^2 - r^2) dr`` and ``F = 2 E* int_0^a r^2 f'/sqrt(a^2 - r^2) dr`` of a profile f(r)
    (Sneddon, Int. J. Eng. Sci. 3 (1965) 47), with ``f' = r/R`` up to ``b = R cos(alpha)`` and ``1/tan(alpha)`` beyond:
    a sphere with its tangent cone, the sphere taken for a paraboloid, as Briscoe, Sebastian and Adams have it
    (J. Phys. D 27 (1994) 1156).
    """
    a, b = np.asarray(contact_radius, dtype=float), BLUNT
    s, angle = np.sqrt(np.maximum(a * a - b * b, 0.0)), np.arccos(np.minimum(b / a, 1.0))
    paraboloid, cone = 2.0 / 3.0 * a**3 - a * a * s + s**3 / 3.0, 0.5 * SLOPE * (a * a * angle + b * s)
    return a * (a - s) + a * SLOPE * angle, 2.0 * (paraboloid + cone)


def blunted_cone(contacts: Contacts, indentation: Array) -> tuple[Complex, Array]:
    """Return the force of a blunted cone: that of the paraboloid, and what the cone changes of it.

    The loss is that of ``E* + eta/2 d/dt`` in place of E*, so that harmonic n of the elastic force is turned by
    ``1 + i n t``, as under the paraboloid.
    """
    R, A = contacts.given["radius"], contacts.amplitude
    unit = contacts.modulus * R**2
    x, force = cone_contact(BLUNT + np.linspace(0.0, 4.0, 4000) ** 2)
    change = force - 4.0 / 3.0 * x**1.5
    cone = 1.0 - (indentation - BLUNT**2 * R) / A  # the cosine of half of the time on it
    end = np.arccos(np.clip(cone, -1.0, 1.0))
    psi = 0.5 * end[:, None] * (1.0 + NODES)
    depth = indentation[:, None] - A[:, None] * (1.0 - np.cos(psi))
    along = unit[:, None] * np.interp(depth / R[:, None], x, change) * WEIGHTS * 0.5 * end[:, None]
    n = np.arange(N_MAX + 1)
    sums = np.stack([(along * np.cos(k * psi)).sum(axis=1) for k in n], axis=1)
    sums *= (-1.0) ** n * np.where(n == 0, 1.0, 2.0) / math.pi
    times = 1.0 + np.interp(indentation / R, x, change) / (4.0 / 3.0 * (indentation / R) ** 1.5)
    paraboloid = contacts.bare(indentation, np.ones(times.shape))
    return paraboloid + sums * (1.0 + 1j * n * contacts.tangent[:, None]), times


def held(
    probe: ot.Probe, solid: Sample, tangent: Array, amplitude: Array, states: xr.Dataset, force: Force
) -> xr.Dataset:
    """Return states at given amplitudes as `overtone.hold_amplitude` does, of a force that is known on a bare cosine.

    Parameters
    ----------
    probe : Probe
        One mode, driven at the tip.
    solid : Sample
        dmt-viscous (y, x).
    tangent, amplitude : array (y, x)
        Loss tangent, and A1 [m].
    states : Dataset
        Those of dmt-viscous at these amplitudes: where the search begins. NaN stays NaN, and where a cone is not
        reached a blunted cone is a paraboloid.
    force : callable
        `standard_linear_solid` or `blunted_cone`.

    Returns
    -------
    Dataset
        ``A0 A1 phi1 A2 phi2 A3 phi3 Z indentation``.
    """
    found = np.isfinite(states["indentation"].values)
    if force is blunted_cone:
        found &= states["indentation"].values > BLUNT**2 * required_radius(probe)
    if not found.any():
        return states
    own = {name: np.broadcast_to(value, found.shape)[found] for name, value in solid.values.items()}
    tip = {
        "radius": probe.tip.radius,
        "tip_modulus": probe.tip.modulus,
        "tip_poisson_ratio": probe.tip.poisson_ratio,
    }
    alike = tip | {"frequency": probe.drive.frequency}
    given = own | {name: np.full(own["modulus"].shape, value) for name, value in alike.items()}
    E = effective_modulus(
        *(given[k] for k in ("modulus", "poisson_ratio", "tip_modulus", "tip_poisson_ratio"))
    )
    contacts = Contacts(given, E, tangent[found], amplitude[found])
    n = np.arange(N_MAX + 1)
    read = read_receptance(probe, n * probe.drive.frequency)
    drive = probe.drive.free_amplitude / abs(read[1])
    delta = states["indentation"].values[found]
    bare, times = force(contacts, delta)
    slope = np.zeros(delta.shape)
    for left in BALANCED:
        near = Sample(solid.model, {name: contacts.stiffer(times)[name] for name in own})
        full = indented_states(probe, near, amplitude=contacts.amplitude, indentation=delta, n_max=N_MAX)
        added = full.force - contacts.bare(delta, times)
        before = at_before = np.full(delta.shape, np.nan)
        for step in range(STEPS):
            f = bare + added
            needed = contacts.amplitude / read[1] - f[:, 1]
            off = needed.real - np.sqrt(np.maximum(drive**2 - needed.imag**2, 0.0))
            if (np.abs(off) < left * drive).all():
                break
            moved = (delta != before) & (step > 0)
            slope = np.divide(off - at_before, delta - before, out=slope, where=moved)
            # a secant; the very first step is only there to make one
            way = np.divide(-off, slope, out=1e-3 * delta, where=slope != 0.0)
            before, at_before, delta = delta, off, delta + np.clip(way, -0.1 * delta, 0.1 * delta)
            bare, times = force(contacts, delta)
    f[np.abs(np.abs(needed) - drive) > 1e-6 * drive] = np.nan
    delta = np.where(np.isfinite(f[:, 1]), delta, np.nan)
    phi1 = np.angle(needed * read[1]) + far_phase(probe)
    motion = read * f  # in the frame of the first harmonic
    higher = ((-1.0) ** n[2:] * motion[:, 2:].real).sum(axis=1)
    values = {"A0": motion[:, 0].real, "A1": contacts.amplitude, "phi1": phi1, "indentation": delta}
    values["Z"] = contacts.amplitude - delta - motion[:, 0].real - higher
    for k in (2, 3):
        turned = k * phi1 - np.angle(motion[:, k])
        values |= {f"A{k}": np.abs(motion[:, k]), f"phi{k}": np.mod(turned, 2.0 * math.pi)}
    result = states[list(values)].copy(deep=True)
    for name, value in values.items():
        result[name].values[found] = np.where(np.isfinite(delta), value, np.nan)
    return result

"""Laws of contact that the model is not, on a bare cosine: what else the materials of a scan may obey.

Each keeps the meaning of the model's parameters where both laws have them: E* (the storage modulus at the drive), the
force that pulls the tip off, and the loss tangent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact import adhesive
from overtone.contact.relaxation import sls_harmonics
from overtone.contact.validity import DMT_LIMIT
from overtone.inversion.columns import WORK_ROWS, Columns, fill_columns
from overtone.kernels import kernel

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

HALF_ANGLE = math.radians(20.0)
"""Of the cone behind the apex of a tip."""
OMEGA_TAU = (0.2, 1.0)
"""Relaxation times of solids times the angular frequency of the drive: those of short and of long contacts."""
_BLUNT, _SLOPE = math.cos(HALF_ANGLE), 1.0 / math.tan(HALF_ANGLE)
_LEAST_LEFT = 0.05  # of the modulus, when all has relaxed
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_TABLE = 4000  # of the force of a cone, up to a contact radius of some R


class Contacts(NamedTuple):
    """Contacts (point,)."""

    E_star: _Floats
    """[Pa]."""
    adhesion: _Floats
    """[N]; 0 for a model without."""
    tangent: _Floats
    """0 for a model without loss."""
    amplitude: _Floats
    """[m]."""
    indentation: _Floats
    """[m]."""


class Surroundings(NamedTuple):
    """What all contacts of a scan have in common."""

    columns: Columns
    """The model."""
    radius: float
    """[m]."""
    omega: float
    """Angular frequency of the drive [rad/s]."""
    n_max: int


class Law(NamedTuple):
    """A law of contact.

    Parameters
    ----------
    key, title : str
        Short, and in words.
    applies : callable
        Takes the surroundings and contacts, tells which of them may obey it (point,).
    harmonics : callable
        Takes the same, returns ``CONS_n - i DISS_n`` (point, n = 0..n_max) [N]; NaN where the law has no such contact.
    of_the_material : bool
        Whether one material may obey it and its neighbour not.
    """

    key: str
    title: str
    applies: Callable[[Surroundings, Contacts], npt.NDArray[np.bool_]]
    harmonics: Callable[[Surroundings, Contacts], _Complex]
    of_the_material: bool = False


def of_the_model(around: Surroundings, contacts: Contacts) -> _Complex:
    """Return the harmonics of the model itself."""
    elastic, attraction = _parts(around, contacts)
    return elastic + attraction


def alternatives(columns: Columns, loss: bool, sticky: bool) -> tuple[Law, ...]:
    """Return the laws that a model may be mistaken for; none where it is not that of a paraboloid."""
    if columns.powers.size != 1 or columns.powers[0] != 1.5:
        return ()
    found = [Law("jkr", "JKR adhesion", _sticks_by_a_neck, _jkr)] if sticky else []
    if loss:
        found += [
            Law(
                f"sls-{x:g}",
                f"a solid that relaxes (w tau {x:g})",
                partial(_relaxes, x),
                partial(_solid, x),
                True,
            )
            for x in OMEGA_TAU
        ]
    return (*found, Law("blunted-cone", "a tip that is a blunted cone", _reaches_the_cone, _blunted_cone))


def _parts(around: Surroundings, contacts: Contacts) -> tuple[_Complex, _Complex]:
    """Return the harmonics of the elastic force with its loss, and of the attraction (point, n)."""
    n = np.arange(around.n_max + 1)
    a, b = (np.empty((contacts.E_star.size, n.size)) for _ in range(2))
    _fill(around.columns, contacts.amplitude, contacts.indentation, a, b)
    lossy = 1.0 + 1j * n * contacts.tangent[:, None]
    elastic = around.columns.contact.factor * contacts.E_star[:, None] * a * lossy
    return elastic, (contacts.adhesion[:, None] * b).astype(complex)


@kernel
def _fill(columns: Columns, amplitude: _Floats, indentation: _Floats, a: _Floats, b: _Floats) -> None:
    """Fill the harmonics (point, n) of the elastic force at S = 1 and of the attraction at F_ad = 1."""
    work = np.zeros((WORK_ROWS, a.shape[1]))
    for i in range(amplitude.shape[0]):
        fill_columns(columns, amplitude[i], indentation[i] / (2.0 * amplitude[i]), a.shape[1] - 1, work)
        a[i], b[i] = work[0], work[2]


# --- JKR ------------------------------------------------------------------------------------------


def _sticks_by_a_neck(around: Surroundings, contacts: Contacts) -> npt.NDArray[np.bool_]:
    """Tell where the Tabor parameter does not speak for DMT."""
    R, a0 = around.radius, around.columns.contact.a0
    work = contacts.adhesion / (2.0 * math.pi * R)
    return np.asarray(np.cbrt(R * work**2 / (contacts.E_star**2 * a0**3)) > DMT_LIMIT)


def _jkr(around: Surroundings, contacts: Contacts) -> _Complex:
    elastic, _ = _parts(around, contacts)
    conservative = adhesive.harmonics(
        "jkr",
        contacts.amplitude,
        contacts.indentation,
        around.n_max,
        effective_modulus=contacts.E_star,
        radius=around.radius,
        work_of_adhesion=contacts.adhesion / (1.5 * math.pi * around.radius),
    )
    return np.asarray(conservative + 1j * elastic.imag)


# --- a solid that relaxes -------------------------------------------------------------------------


def _relaxes(x: float, around: Surroundings, contacts: Contacts) -> npt.NDArray[np.bool_]:
    return np.asarray((contacts.tangent > 0.0) & (contacts.tangent * x < 1.0 - _LEAST_LEFT))


def _solid(x: float, around: Surroundings, contacts: Contacts) -> _Complex:
    """Return the force of a solid with ``E(w) = E (1 + i tan)`` at the drive, under the attraction of the model.

    ``E(t) = E_inf + (E_0 - E_inf) exp(-t/tau)`` has these where ``E_inf = E (1 - tan x)`` and ``E_0 = E (1 + tan/x)``,
    ``x = w tau``.
    """
    _, attraction = _parts(around, contacts)
    found = np.full(attraction.shape, np.nan, complex)
    made = (contacts.tangent > 0.0) & (contacts.tangent * x < 1.0) & (contacts.indentation > 0.0)
    if made.any():
        E, tangent = contacts.E_star[made], contacts.tangent[made]
        found[made] = sls_harmonics(
            contacts.amplitude[made],
            contacts.indentation[made],
            around.n_max,
            frequency=around.omega / (2.0 * math.pi),
            radius=around.radius,
            effective_modulus=E * (1.0 - tangent * x),
            instantaneous_modulus=E * (1.0 + tangent / x),
            relaxation_time=x / around.omega,
        )
    return found + attraction


# --- a blunted cone -------------------------------------------------------------------------------


def cone_contact(contact_radius: _Floats) -> tuple[_Floats, _Floats]:
    """Return indentation and force of a paraboloid that ends in a cone, in units of R and E* R^2.

    Where the slope of a sphere is that of the cone, at ``b = R cos(alpha)``, the cone begins. From Sneddon's
    ``delta = a int f'/sqrt(a^2 - r^2) dr`` and ``F = 2 E* int r^2 f'/sqrt(a^2 - r^2) dr`` (Int. J. Eng. Sci. 3 (1965)
    47), 0 to a, of the profile f; compare Briscoe, Sebastian and Adams, J. Phys. D 27 (1994) 1156.
    """
    a = np.asarray(contact_radius, dtype=float)
    s = np.sqrt(np.maximum(a * a - _BLUNT**2, 0.0))
    angle = np.arccos(np.minimum(_BLUNT / np.maximum(a, _BLUNT), 1.0))
    apex = 2.0 / 3.0 * a**3 - a * a * s + s**3 / 3.0
    return a * (a - s) + a * _SLOPE * angle, 2.0 * (apex + 0.5 * _SLOPE * (a * a * angle + _BLUNT * s))


def _reaches_the_cone(around: Surroundings, contacts: Contacts) -> npt.NDArray[np.bool_]:
    return np.asarray(contacts.indentation > _BLUNT**2 * around.radius)


def _blunted_cone(around: Surroundings, contacts: Contacts) -> _Complex:
    """Return the force of the model, and what the cone takes off it; the loss goes with the elastic force."""
    elastic, attraction = _parts(around, contacts)
    R, A, n = around.radius, contacts.amplitude, np.arange(around.n_max + 1)
    x, force = cone_contact(_BLUNT + np.linspace(0.0, 4.0, _TABLE) ** 2)
    less = force - 4.0 / 3.0 * x**1.5
    end = np.arccos(np.clip(1.0 - (contacts.indentation - _BLUNT**2 * R) / A, -1.0, 1.0))
    psi = 0.5 * end[:, None] * (1.0 + _NODES)
    depth = contacts.indentation[:, None] - A[:, None] * (1.0 - np.cos(psi))
    along = (contacts.E_star * R**2)[:, None] * np.interp(depth / R, x, less, left=0.0)
    along *= _WEIGHTS * 0.5 * end[:, None]
    sums = np.stack([(along * np.cos(k * psi)).sum(axis=1) for k in n], axis=1)
    sums *= (-1.0) ** n * np.where(n == 0, 1.0, 2.0) / math.pi
    return np.asarray(elastic + attraction + sums * (1.0 + 1j * n * contacts.tangent[:, None]))

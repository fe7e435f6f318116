"""Terms as models use them: the law and the harmonics of one term, vectorised, times its coefficient."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact import terms
from overtone.contact.parameters import Values
from overtone.errors import ContactModelError

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
Coefficient = Callable[[Values], Any]
"""Turns the parameters of a model into the coefficient of a term."""


@dataclass(frozen=True)
class Term:
    """One term of a force law.

    Parameters
    ----------
    formula : str
        The law in the symbols of the parameters.
    law : callable
        ``law(values, gap, velocity)``: force [N], broadcast; velocity is d(gap)/dt [m/s].
    harmonics : callable
        ``harmonics(values, amplitude, Delta, n_max)``: CONS_n - i DISS_n [N] on the motion
        ``d = A1 (1 - 2 Delta + cos theta)``, last axis n.
    """

    formula: str
    law: Callable[[Values, _Floats, _Floats], _Floats]
    harmonics: Callable[[Values, _Floats, _Floats, int], _Complex]


def _points(*arrays: Any) -> tuple[tuple[int, ...], list[_Floats]]:
    """Return the common shape of arrays, and each of them flat."""
    wide = np.broadcast_arrays(*(np.asarray(array, dtype=float) for array in arrays))
    return wide[0].shape, [np.ascontiguousarray(array.ravel()) for array in wide]


def power_coefficients(power: Any, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Floats:
    """Return cosine coefficients of ``(-d)^p`` in contact, last axis n [m^p]."""
    shape, (A, D, p) = _points(amplitude, Delta, power)
    h, dh = np.empty((A.size, n_max + 1)), np.empty((A.size, n_max + 1))
    terms.power_block(A, D, p, h, dh)
    return h.reshape(*shape, n_max + 1)


def power_term(formula: str, coefficient: Coefficient, exponent: Callable[[Values], Any]) -> Term:
    """Return ``coefficient (-d)^p`` in contact."""

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        depth = np.maximum(-gap, 0.0)
        return np.asarray(np.where(gap < 0.0, coefficient(values) * depth ** exponent(values), 0.0))

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        shape = power_coefficients(exponent(values), amplitude, Delta, n_max)
        return np.asarray(np.asarray(coefficient(values))[..., None] * shape, dtype=complex)

    return Term(formula, law, harmonics)


def viscous_term(formula: str, coefficient: Coefficient, exponent: Callable[[Values], Any]) -> Term:
    """Return ``-coefficient (-d)^q d'`` in contact, the viscous partner of the power q + 1.

    ``DISS_n = -n w coefficient/(q + 1) [(-d)^(q+1)]_n``: with ``G`` the integral of the shape, the force is
    the time derivative of ``coefficient G(-d)``.
    """

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        depth = np.maximum(-gap, 0.0)
        return np.asarray(
            np.where(gap < 0.0, -coefficient(values) * depth ** exponent(values) * velocity, 0.0)
        )

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        q = exponent(values)
        shape = power_coefficients(np.asarray(q) + 1.0, amplitude, Delta, n_max)
        scale = 2.0 * math.pi * values["frequency"] * coefficient(values) / (np.asarray(q) + 1.0)
        return np.asarray(1j * np.arange(n_max + 1) * np.asarray(scale)[..., None] * shape)

    return Term(formula, law, harmonics)


def adhesion_term(formula: str, tail: int, coefficient: Coefficient) -> Term:
    """Return a constant attraction in contact with a tail outside."""

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        a0 = values.get("intermolecular_distance", np.asarray(1.0))
        outside = np.maximum(gap, 0.0)
        if tail == terms.LINEAR_TAIL:
            shape = np.maximum(1.0 - outside / (2.0 * a0), 0.0)
        elif tail == terms.VAN_DER_WAALS_TAIL:
            shape = (a0 / (a0 + outside)) ** 2
        else:
            shape = np.where(gap <= 0.0, 1.0, 0.0)
        return np.asarray(-coefficient(values) * shape)

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        a0 = values.get("intermolecular_distance", np.asarray(1.0))
        shape, (A, D, reach) = _points(amplitude, Delta, a0)
        h, dh = np.empty((A.size, n_max + 1)), np.empty((A.size, n_max + 1))
        terms.adhesion_block(tail, A, D, reach, h, dh)
        result = np.asarray(coefficient(values))[..., None] * h.reshape(*shape, n_max + 1)
        return np.asarray(result, dtype=complex)

    return Term(formula, law, harmonics)


def branch_term(
    formula: str,
    force: Callable[[Values, _Floats, npt.NDArray[np.bool_]], _Floats],
    harmonics: Callable[[Values, _Floats, _Floats, int], _Complex],
) -> Term:
    """Return a force with one branch for approach and another for retraction, ``force(values, gap, approaching)``.

    A tip at rest counts as approaching.
    """

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        return np.asarray(force(values, gap, np.asarray(velocity <= 0.0)))

    return Term(formula, law, harmonics)


def history_term(
    formula: str, harmonics: Callable[[Values, _Floats, _Floats, int], _Complex], hint: str
) -> Term:
    """Return a force that depends on the whole indentation so far: harmonics, but no law of gap and velocity."""

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        raise ContactModelError("this force depends on its history, not on gap and velocity alone", hint=hint)

    return Term(formula, law, harmonics)


def hysteresis_term(formula: str, coefficient: Coefficient, reach: Coefficient) -> Term:
    """Return an attraction over a reach outside contact, on retraction only.

    The law as a function of gap and velocity takes any retraction as one from contact.
    """

    def law(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        inside = (gap > 0.0) & (gap < reach(values)) & (velocity > 0.0)
        return np.asarray(np.where(inside, -np.asarray(coefficient(values)), 0.0))

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        shape, (A, D, distance) = _points(amplitude, Delta, reach(values))
        cons, diss, dcons, ddiss = (np.empty((A.size, n_max + 1)) for _ in range(4))
        terms.hysteresis_block(A, D, distance, cons, diss, dcons, ddiss)
        result = (cons - 1j * diss).reshape(*shape, n_max + 1)
        return np.asarray(np.asarray(coefficient(values))[..., None] * result)

    return Term(formula, law, harmonics)

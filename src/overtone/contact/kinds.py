"""The kinds of terms that models are made of: the law, its harmonics and its row for compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact import law, terms
from overtone.contact.parameters import Values
from overtone.errors import ContactModelError

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
Coefficient = Callable[[Values], Any]
"""Turns the parameters of a model into the coefficient of a term."""
Law = Callable[[Values, _Floats, _Floats], _Floats]
Row = Callable[[Values], _Floats]


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
    row : callable or None
        ``row(values)``: the term as a row of the table that compiled code reads (`overtone.contact.law`),
        last axis its columns. None where the simulator cannot follow the term.
    """

    formula: str
    law: Law
    harmonics: Callable[[Values, _Floats, _Floats, int], _Complex]
    row: Row | None = None


def _points(*arrays: Any) -> tuple[tuple[int, ...], list[_Floats]]:
    """Return the common shape of arrays, and each of them flat."""
    wide = np.broadcast_arrays(*(np.asarray(array, dtype=float) for array in arrays))
    # copies: numpy marks what it broadcasts to one element, and compiled code warns of the mark
    return wide[0].shape, [array.flatten() for array in wide]


def _row(kind: int, *columns: Any) -> _Floats:
    """Return a row of the table, last axis its columns."""
    wide = np.broadcast_arrays(*(np.asarray(column, dtype=float) for column in columns))
    rows = np.zeros((*wide[0].shape, law.COLUMNS))
    rows[..., 0] = kind
    for k, column in enumerate(wide):
        rows[..., k + 1] = column
    return rows


def _law_of(row: Row) -> Law:
    """Return the law of a row; any retraction from outside counts as one from contact."""

    def force(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        rows = row(values)
        shape = np.broadcast_shapes(rows.shape[:-1], gap.shape, velocity.shape)
        d, v = (np.broadcast_to(array, shape).flatten() for array in (gap, velocity))
        table = np.array(np.broadcast_to(rows, (*shape, law.COLUMNS))).reshape(-1, 1, law.COLUMNS)
        out = np.empty(d.size)
        held = (v > 0.0) & (d < table[:, 0, 2])  # the reach, of the one kind that asks
        law.force_block(np.ascontiguousarray(table), d, v, d <= 0.0, held, out)
        return out.reshape(shape)

    return force


def power_coefficients(power: Any, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Floats:
    """Return cosine coefficients of ``(-d)^p`` in contact, last axis n [m^p]."""
    shape, (A, D, p) = _points(amplitude, Delta, power)
    h, dh = np.empty((A.size, n_max + 1)), np.empty((A.size, n_max + 1))
    terms.power_block(A, D, p, h, dh)
    return h.reshape(*shape, n_max + 1)


def power_term(formula: str, coefficient: Coefficient, exponent: Callable[[Values], Any]) -> Term:
    """Return ``coefficient (-d)^p`` in contact."""

    def row(values: Values) -> _Floats:
        return _row(law.POWER, coefficient(values), exponent(values))

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        shape = power_coefficients(exponent(values), amplitude, Delta, n_max)
        return np.asarray(np.asarray(coefficient(values))[..., None] * shape, dtype=complex)

    return Term(formula, _law_of(row), harmonics, row)


def viscous_term(formula: str, coefficient: Coefficient, exponent: Callable[[Values], Any]) -> Term:
    """Return ``-coefficient (-d)^q d'`` in contact, the viscous partner of the power q + 1.

    ``DISS_n = -n w coefficient/(q + 1) [(-d)^(q+1)]_n``: with ``G`` the integral of the shape, the force is
    the time derivative of ``coefficient G(-d)``.
    """

    def row(values: Values) -> _Floats:
        return _row(law.VISCOUS, coefficient(values), exponent(values))

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        q = exponent(values)
        shape = power_coefficients(np.asarray(q) + 1.0, amplitude, Delta, n_max)
        scale = 2.0 * math.pi * values["frequency"] * coefficient(values) / (np.asarray(q) + 1.0)
        return np.asarray(1j * np.arange(n_max + 1) * np.asarray(scale)[..., None] * shape)

    return Term(formula, _law_of(row), harmonics, row)


def adhesion_term(formula: str, tail: int, coefficient: Coefficient) -> Term:
    """Return a constant attraction in contact with a tail outside."""

    def reach(values: Values) -> Any:
        return values.get("intermolecular_distance", np.asarray(1.0))

    def row(values: Values) -> _Floats:
        return _row(law.ADHESION, coefficient(values), reach(values), tail)

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        shape, (A, D, a0) = _points(amplitude, Delta, reach(values))
        h, dh = np.empty((A.size, n_max + 1)), np.empty((A.size, n_max + 1))
        terms.adhesion_block(tail, A, D, a0, h, dh)
        result = np.asarray(coefficient(values))[..., None] * h.reshape(*shape, n_max + 1)
        return np.asarray(result, dtype=complex)

    return Term(formula, _law_of(row), harmonics, row)


def branch_term(
    formula: str,
    force: Callable[[Values, _Floats, npt.NDArray[np.bool_]], _Floats],
    harmonics: Callable[[Values, _Floats, _Floats, int], _Complex],
    curve: Row | None = None,
) -> Term:
    """Return a force with one branch for approach and another for retraction, ``force(values, gap, approaching)``.

    A tip at rest counts as approaching. ``curve`` gives the fields of the stable branch, for compiled code.
    """

    def signed(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        return np.asarray(force(values, gap, np.asarray(velocity <= 0.0)))

    def row(values: Values) -> _Floats:
        return _row(law.CURVE, *np.moveaxis(curve(values), -1, 0)) if curve is not None else np.empty(0)

    return Term(formula, signed, harmonics, row if curve is not None else None)


def history_term(
    formula: str, harmonics: Callable[[Values, _Floats, _Floats, int], _Complex], hint: str
) -> Term:
    """Return a force that depends on the whole indentation so far: harmonics, but no law of gap and velocity."""

    def unknown(values: Values, gap: _Floats, velocity: _Floats) -> _Floats:
        raise ContactModelError("this force depends on its history, not on gap and velocity alone", hint=hint)

    return Term(formula, unknown, harmonics)


def hysteresis_term(formula: str, coefficient: Coefficient, reach: Coefficient) -> Term:
    """Return an attraction over a reach outside contact, on retraction only."""

    def row(values: Values) -> _Floats:
        return _row(law.NECK, coefficient(values), reach(values))

    def harmonics(values: Values, amplitude: _Floats, Delta: _Floats, n_max: int) -> _Complex:
        shape, (A, D, distance) = _points(amplitude, Delta, reach(values))
        cons, diss, dcons, ddiss = (np.empty((A.size, n_max + 1)) for _ in range(4))
        terms.hysteresis_block(A, D, distance, cons, diss, dcons, ddiss)
        result = (cons - 1j * diss).reshape(*shape, n_max + 1)
        return np.asarray(np.asarray(coefficient(values))[..., None] * result)

    return Term(formula, _law_of(row), harmonics, row)

"""How far the material of a pixel is from that of its phase, to all orders.

Where attraction and repulsion nearly cancel, ten per cent of a property change the force harmonics by more than a
parabola follows. So a pixel is solved for by Newton's method with the law of force itself, once, about a material in
the middle of what its phase may be. For all others that it may be the difference is carried over.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.table import DEEPEST, SHALLOWEST
from overtone.kernels import inner, kernel
from overtone.population.algebra import cholesky, half_square, solve_factored
from overtone.population.forward import (
    ADHESION,
    BY_MODULUS,
    FIRST_DEPTH,
    TANGENT,
    Desk,
    Scene,
    new_desk,
    rows_of_material,
)
from overtone.population.held import PROPERTIES

_Floats = npt.NDArray[np.float64]

_BESIDE = 0.05  # of an unknown, over which the motion is looked at
_PASSES = 8  # of the motion
_STEPS = 30
_HALVINGS = 6
_LONGEST, _LONGEST_DEPTH = 0.4, 0.3  # step of a logarithm, and of t
_SETTLED = 1e-4  # squared length of a step, in standard deviations
_AS_LOW = 1e-2  # the same where arithmetic tells no lower place
_FARTHEST = 2.0  # of ln of a property from its phase


class Centre(NamedTuple):
    """A material that a phase may be, and what its pixels differ by."""

    ln_E: float
    unknowns: _Floats
    """(unknown,): as `overtone.population.forward` orders them."""
    motion: _Floats
    """(datum,): what the harmonics of the motion add to the rows [unit]."""
    by: _Floats
    """(datum, 4): and to their derivatives, which are ordered as those of a row."""
    shift: _Floats
    """(datum,): what the instrument adds [unit]."""
    tilt: _Floats
    """(3, datum): and by how much more per height, x and y [unit/m]."""
    precision: _Floats
    """(datum, datum): of one pixel [unit^-2]."""
    spread: _Floats
    """(PROPERTIES,): standard deviations of ln of the properties within the phase; 0 for what the model lacks."""
    depth: _Floats
    """(scan, PROPERTIES): change of t with them while the amplitude is held."""
    loose: float
    """Standard deviation of t about that, for models whose loss is not known; infinite where the rows of the first
    harmonic, which hold the drive, are among the data."""


@kernel
def of_the_motion(
    scene: Scene, bare: Scene, k: int, x: float, v: _Floats, motion: _Floats, by: _Floats
) -> None:
    """Fill what the harmonics of the motion add to the rows of a material, and how that goes with its unknowns.

    Parameters
    ----------
    scene, bare : Scene
        Of all materials, with the motion and without.
    k : int
        Which.
    x, v : float, array (unknown,)
        The material.
    motion, by : array (datum,), (datum, 4)
        Filled [unit].
    """
    rows, scans = scene.orders.shape[0], scene.amplitude.shape[1]
    desk, other = new_desk(scene), new_desk(bare)
    f, f_bare = np.zeros(rows), np.zeros(rows)
    at, at_middle = v.copy(), np.zeros_like(desk.room.f)
    for s in range(scans):
        block = s * rows
        at_middle[:] = 0.0
        # the middle first, then both sides of each unknown
        for place in range(9):
            at[:], x_there = v, x
            column, step = (place - 1) // 2, _BESIDE if place % 2 else -_BESIDE
            if place > 0:
                x_there += step if column == BY_MODULUS else 0.0
                at[ADHESION] += step if column == 0 else 0.0
                at[TANGENT] += step if column == 1 else 0.0
                at[FIRST_DEPTH + s] += step if column == 2 else 0.0
            desk.room.f[:] = at_middle
            for _ in range(_PASSES):
                rows_of_material(scene, k, s, x_there, at, desk.room, desk.work, f, desk.part)
            if place == 0 and np.isfinite(desk.room.f).all():
                at_middle[:] = desk.room.f
            rows_of_material(bare, k, s, x_there, at, other.room, other.work, f_bare, other.part)
            for r in range(rows):
                # a motion that runs away tells of none
                added = f[r] - f_bare[r] if math.isfinite(f[r]) else motion[block + r] if place else 0.0
                if place == 0:
                    motion[block + r] = added
                elif place % 2:
                    by[block + r, column] = added
                else:
                    by[block + r, column] = (by[block + r, column] - added) / (2.0 * _BESIDE)


@inner
def _rows(
    bare: Scene,
    k: int,
    centre: Centre,
    u: _Floats,
    v: _Floats,
    desk: Desk,
    f: _Floats,
    J: _Floats,
) -> None:
    """Fill the rows of a pixel (datum,) and their derivatives by ln E, ln F_ad, ln tan and t of each scan."""
    rows, scans = bare.orders.shape[0], bare.amplitude.shape[1]
    v[ADHESION], v[TANGENT] = u[1], u[2]
    for s in range(scans):
        v[FIRST_DEPTH + s] = u[PROPERTIES + s]
    J[:] = 0.0
    for s in range(scans):
        block, t = s * rows, PROPERTIES + s
        rows_of_material(bare, k, s, u[0], v, desk.room, desk.work, f[block : block + rows], desk.part)
        for r in range(rows):
            i = block + r
            J[i, 0] = desk.part[r, BY_MODULUS] + centre.by[i, BY_MODULUS]
            J[i, 1] = desk.part[r, 0] + centre.by[i, 0]
            J[i, 2] = desk.part[r, 1] + centre.by[i, 1]
            J[i, t] = desk.part[r, 2] + centre.by[i, 2]
            f[i] += (
                centre.motion[i]
                + centre.by[i, BY_MODULUS] * (u[0] - centre.ln_E)
                + centre.by[i, 0] * (u[1] - centre.unknowns[ADHESION])
                + centre.by[i, 1] * (u[2] - centre.unknowns[TANGENT])
                + centre.by[i, 2] * (u[t] - centre.unknowns[FIRST_DEPTH + s])
            )


@inner
def _cost(centre: Centre, y: _Floats, f: _Floats, off: _Floats, extra: _Floats) -> float:
    """Return minus ln of the density of a pixel, but for a constant."""
    total = 0.0
    for a in range(PROPERTIES):
        if centre.spread[a] > 0.0:
            total += 0.5 * (off[a] / centre.spread[a]) ** 2
    if math.isfinite(centre.loose):
        for s in range(extra.shape[0]):
            total += 0.5 * (extra[s] / centre.loose) ** 2
    return total + half_square(centre.precision, f, y)


@inner
def _part_from(centre: Centre, u: _Floats, off: _Floats, extra: _Floats) -> None:
    """Fill how far the properties are off those of the phase, and t off what holds the amplitude."""
    off[0] = u[0] - centre.ln_E
    off[1] = u[1] - centre.unknowns[ADHESION]
    off[2] = u[2] - centre.unknowns[TANGENT]
    for s in range(extra.shape[0]):
        extra[s] = u[PROPERTIES + s] - centre.unknowns[FIRST_DEPTH + s]
        for a in range(PROPERTIES):
            extra[s] -= centre.depth[s, a] * off[a]


@inner
def _metric(
    centre: Centre,
    turn: _Floats,
    y: _Floats,
    f: _Floats,
    J: _Floats,
    off: _Floats,
    extra: _Floats,
    B: _Floats,
    A: _Floats,
    g: _Floats,
) -> None:
    """Fill the metric of a pixel and the slope of ln of its density; ``turn`` is of t beyond what holds the amplitude.

    B is scratch (datum or more, unknown).
    """
    data, n = J.shape
    for r in range(data):
        for a in range(n):
            total = 0.0
            for q in range(data):
                total += centre.precision[r, q] * J[q, a]
            B[r, a] = total
    for a in range(n):
        g[a] = 0.0
        for r in range(data):
            g[a] += B[r, a] * (y[r] - f[r])
        for b in range(n):
            total = 0.0
            for r in range(data):
                total += J[r, a] * B[r, b]
            A[a, b] = total
    for a in range(PROPERTIES):
        if centre.spread[a] > 0.0:
            A[a, a] += centre.spread[a] ** -2
            g[a] -= off[a] * centre.spread[a] ** -2
        else:
            A[a, :], A[:, a], A[a, a], g[a] = 0.0, 0.0, 1.0, 0.0
    if math.isfinite(centre.loose):
        weight = centre.loose**-2
        for s in range(extra.shape[0]):
            for a in range(n):
                g[a] -= weight * turn[PROPERTIES + s, a] * extra[s]
                for b in range(n):
                    A[a, b] += weight * turn[PROPERTIES + s, a] * turn[PROPERTIES + s, b]


@inner
def _turned_inverse(
    L: _Floats, turn: _Floats, one: _Floats, column: _Floats, half: _Floats, out: _Floats
) -> None:
    """Fill turn (L L')^-1 turn'; one, column (unknown,) and half (unknown or more, unknown) are scratch."""
    n = out.shape[0]
    for b in range(n):
        one[:] = 0.0
        one[b] = 1.0
        solve_factored(L, one, column)
        for a in range(n):
            total = 0.0
            for c in range(n):
                total += turn[a, c] * column[c]
            half[a, b] = total
    for a in range(n):
        for b in range(n):
            total = 0.0
            for c in range(n):
                total += half[a, c] * turn[b, c]
            out[a, b] = total


@kernel
def settle_pixels(
    bare: Scene,
    k: int,
    centre: Centre,
    y: _Floats,
    place: _Floats,
    theta: _Floats,
    covariance: _Floats,
    found: npt.NDArray[np.bool_],
) -> None:
    """Fill where pixels are likeliest about a material that their phase may be.

    Parameters
    ----------
    bare : Scene
        Of all materials, on bare cosines.
    k : int
        Which.
    centre : Centre
        The material.
    y : array (pixel, datum)
        Force harmonics at the mean amplitude of the phase [unit].
    place : array (pixel, 3)
        Height, x and y about those of the phase [m].
    theta : array (pixel, PROPERTIES + scan)
        Filled: ln of the properties about those of the phase, then t of each scan beyond what holds the amplitude.
    covariance : array (pixel, PROPERTIES + scan, PROPERTIES + scan)
        Filled: of them, linear about there.
    found : array (pixel,)
        Filled: whether Newton's method came to rest.
    """
    data, scans = y.shape[1], bare.amplitude.shape[1]
    n = PROPERTIES + scans
    desk = new_desk(bare)
    f, J, v = np.zeros(data), np.zeros((data, n)), centre.unknowns.copy()
    u, there, mine = np.zeros(n), np.zeros(n), np.zeros(data)
    off, extra = np.zeros(PROPERTIES), np.zeros(scans)
    A, g, B, step = np.zeros((n, n)), np.zeros(n), np.zeros((max(data, n), n)), np.zeros(n)
    turn = np.eye(n)
    for s in range(scans):
        for a in range(PROPERTIES):
            turn[PROPERTIES + s, a] = -centre.depth[s, a]
    for i in range(y.shape[0]):
        for r in range(data):
            mine[r] = y[i, r] - centre.shift[r]
            for j in range(3):
                mine[r] -= place[i, j] * centre.tilt[j, r]
        u[0], u[1], u[2] = centre.ln_E, centre.unknowns[ADHESION], centre.unknowns[TANGENT]
        u[PROPERTIES:] = centre.unknowns[FIRST_DEPTH : FIRST_DEPTH + scans]
        _rows(bare, k, centre, u, v, desk, f, J)
        _part_from(centre, u, off, extra)
        cost = _cost(centre, mine, f, off, extra)
        found[i] = False
        for _ in range(_STEPS):
            _metric(centre, turn, mine, f, J, off, extra, B, A, g)
            if not cholesky(A):
                break
            solve_factored(A, g, step)
            length, share = 0.0, 1.0
            for a in range(n):
                length += g[a] * step[a]
                longest = _LONGEST if a < PROPERTIES else _LONGEST_DEPTH
                if abs(step[a]) * share > longest:
                    share = longest / abs(step[a])
            if not math.isfinite(length):
                break
            if length < _SETTLED:
                found[i] = True
                break
            for _ in range(_HALVINGS):
                for a in range(n):
                    there[a] = u[a] + share * step[a]
                    if a >= PROPERTIES:
                        there[a] = min(max(there[a], SHALLOWEST), DEEPEST)
                _rows(bare, k, centre, there, v, desk, f, J)
                _part_from(centre, there, off, extra)
                new = _cost(centre, mine, f, off, extra)
                if new < cost:
                    cost = new
                    u[:] = there
                    break
                share *= 0.5
            else:
                # as low as the arithmetic tells, or lost
                found[i] = length < _AS_LOW
                _part_from(centre, u, off, extra)
                break
        for a in range(PROPERTIES):
            theta[i, a] = off[a]
            found[i] &= abs(off[a]) < _FARTHEST
        theta[i, PROPERTIES:] = extra
        if not found[i]:
            theta[i], covariance[i] = 0.0, np.eye(n)
            continue
        # from the factor of the last step
        _turned_inverse(A, turn, g, step, B, covariance[i])

"""How the harmonics of a pixel go with its material while the feedback holds the amplitude.

A pixel that is stiffer than its phase is indented less, by what keeps amplitude and drive in balance,
``|A1/G - f_1| = F_dr`` (theory of the steady state). So the harmonics of a phase are curved functions of
(ln E, ln F_ad, ln tan), and the mean over its pixels is not that of the median material: it is off by half of the
curvature times the variance of the properties. Small as this is, what is ill-conditioned would amplify it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.table import DEEPEST, SHALLOWEST
from overtone.kernels import kernel, lean
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

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

PROPERTIES = 3
"""ln of the elastic unknown, of the force of adhesion and of the loss tangent."""
_STEPS = 30
_BY_T = 2  # column of the derivatives of a row
_CLOSE = 1e-10
_LONGEST = 0.3
_PART = 0.1  # of ln of a property, from one state to the next
_HALVINGS = 5


@lean
def _drive(scene: Scene, f: _Floats, first: _Floats, still: complex) -> float:
    """Return the squared force of the drive that balances the first harmonic [unit^2]."""
    cons, diss = 0.0, -still.imag
    for r in range(scene.orders.shape[0]):
        if scene.orders[r] == 1:
            if scene.lossy[r]:
                diss = f[r]
            else:
                cons = f[r]
    # f_1 = CONS_1 - i DISS_1; first is A1/G
    return float((first[0] - cons) ** 2 + (first[1] + diss) ** 2)


@lean
def _by(scene: Scene, f: _Floats, part: _Floats, column: int, first: _Floats, still: complex) -> float:
    """Return the derivative of `_drive` by an unknown, a column of the derivatives of the rows [unit^2]."""
    cons, diss, d_cons, d_diss = 0.0, -still.imag, 0.0, 0.0
    for r in range(scene.orders.shape[0]):
        if scene.orders[r] == 1:
            if scene.lossy[r]:
                diss, d_diss = f[r], part[r, column]
            else:
                cons, d_cons = f[r], part[r, column]
    return float(-2.0 * (first[0] - cons) * d_cons + 2.0 * (first[1] + diss) * d_diss)


@lean
def _held(
    scene: Scene,
    k: int,
    scan: int,
    x: float,
    v: _Floats,
    first: _Floats,
    still: complex,
    goal: float,
    uphill: float,
    desk: Desk,
    f: _Floats,
) -> bool:
    """Fill the rows of a material at the indentation that balances the drive, and return whether there is one near.

    ``v`` holds a start and is moved. There may be two: one attractive and one repulsive, between which the drive has a
    summit. The one where it rises with t as ``uphill`` does counts.
    """
    at = FIRST_DEPTH + scan
    for _ in range(_STEPS):
        rows_of_material(scene, k, scan, x, v, desk.room, desk.work, f, desk.part)
        off = _drive(scene, f, first, still) - goal
        slope = _by(scene, f, desk.part, _BY_T, first, still)
        if not slope * uphill > 0.0:
            return False
        step = min(max(-off / slope, -_LONGEST), _LONGEST)
        v[at] = min(max(v[at] + step, SHALLOWEST), DEEPEST)
        if abs(step) < _CLOSE:
            return True
    return False


@kernel
def curvature(
    scene: Scene,
    k: int,
    x: float,
    v: _Floats,
    first: _Floats,
    still: _Complex,
    free: npt.NDArray[np.bool_],
    reach: _Floats,
    f: _Floats,
    J: _Floats,
    H: _Floats,
    depth: _Floats,
    along: _Floats,
) -> None:
    """Fill the rows of a material, and how they go with ln of its properties while the amplitude is held.

    Parameters
    ----------
    scene : Scene
        Of all materials.
    k : int
        Which.
    x, v : float, array (unknown,)
        The material.
    first : array (scan, 2)
        A1/G, real and imaginary part [unit].
    still : array (scan,)
        f_1 as it was measured, for models without loss [unit].
    free : array (PROPERTIES,)
        Properties that the model has.
    reach : array (PROPERTIES,)
        Steps of ln of each, made shorter where no drive could hold the amplitude at their ends. With the square root of
        3 times the scatter of a property, slopes and its own curvature are those of the parabola that fits best over
        it, bends of third order included (Gauss and Hermite's three points). Where no step is short enough, and where
        no row tells the first harmonic, slopes are those at the middle alone, and curvatures zero.
    f, J, H : array (datum,), (datum, PROPERTIES), (datum, PROPERTIES, PROPERTIES)
        Filled [unit], rows of all scans of the material.
    depth : array (scan, PROPERTIES)
        Filled: change of t.
    along : array (datum, scan)
        Filled: change of the rows with t of a scan alone [unit].
    """
    desk = new_desk(scene)
    rows, scans = scene.orders.shape[0], scene.amplitude.shape[1]
    at = v.copy()
    there = np.zeros((2 * PROPERTIES, rows))
    t = np.zeros(2 * PROPERTIES)
    pair = np.zeros(rows)
    J[:], H[:], depth[:], along[:] = 0.0, 0.0, 0.0, 0.0
    steps, found, middle = np.empty(PROPERTIES), np.zeros(PROPERTIES, np.bool_), np.empty((rows, 4))
    for s in range(scans):
        block = s * rows
        steps[:], found[:] = reach, False
        desk.room.f[:] = 0.0
        for _ in range(6):
            rows_of_material(scene, k, s, x, v, desk.room, desk.work, f[block : block + rows], desk.part)
        for r in range(rows):
            along[block + r, s] = desk.part[r, 2]
        here = f[block : block + rows]
        motion = desk.room.f.copy()
        goal = _drive(scene, here, first[s], still[s])
        uphill = _by(scene, here, desk.part, _BY_T, first[s], still[s])
        middle[:] = desk.part
        for i in range(PROPERTIES):
            if not free[i]:
                continue
            for halving in range(_HALVINGS):
                if halving > 0:
                    steps[i] *= 0.5
                found[i] = True
                for side in range(2):
                    step = steps[i] if side == 0 else -steps[i]
                    at[:], desk.room.f[:] = v, motion
                    parts = math.ceil(steps[i] / _PART)
                    for part in range(1, parts + 1):
                        far = step * part / parts
                        x_there = x + far if i == 0 else x
                        at[ADHESION] = v[ADHESION] + far if i == 1 else v[ADHESION]
                        at[TANGENT] = v[TANGENT] + far if i == 2 else v[TANGENT]
                        f_there = there[2 * i + side]
                        found[i] &= _held(
                            scene, k, s, x_there, at, first[s], still[s], goal, uphill, desk, f_there
                        )
                    t[2 * i + side] = at[FIRST_DEPTH + s]
                if found[i]:
                    break
            if not found[i]:
                column = BY_MODULUS if i == 0 else i - 1
                follows = 0.0
                if uphill != 0.0:
                    follows = -_by(scene, here, middle, column, first[s], still[s]) / uphill
                depth[s, i] = follows
                for r in range(rows):
                    J[block + r, i] = middle[r, column] + middle[r, _BY_T] * follows
                continue
            depth[s, i] = (t[2 * i] - t[2 * i + 1]) / (2.0 * steps[i])
            for r in range(rows):
                up, down = there[2 * i, r], there[2 * i + 1, r]
                J[block + r, i] = (up - down) / (2.0 * steps[i])
                H[block + r, i, i] = (up + down - 2.0 * here[r]) / steps[i] ** 2
        for i in range(PROPERTIES):
            for j in range(i):
                if not (found[i] and found[j]):
                    continue
                at[:] = v
                at[FIRST_DEPTH + s] = t[2 * i] + t[2 * j] - v[FIRST_DEPTH + s]
                x_there = x + steps[0] if j == 0 else x
                at[ADHESION] += steps[1] if 1 in (i, j) else 0.0
                at[TANGENT] += steps[2] if i == 2 else 0.0
                desk.room.f[:] = motion
                if not _held(scene, k, s, x_there, at, first[s], still[s], goal, uphill, desk, pair):
                    continue
                for r in range(rows):
                    twist = pair[r] - there[2 * i, r] - there[2 * j, r] + here[r]
                    H[block + r, i, j] = twist / (steps[i] * steps[j])
                    H[block + r, j, i] = H[block + r, i, j]

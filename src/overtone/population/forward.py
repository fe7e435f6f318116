"""The force harmonics of a material, on the motion that the tip makes: what the pixels of a phase have in common.

Of a material ln E, its force of adhesion and its loss tangent count, and at each set-point the indentation that goes
with them. What was measured of all materials of a scan stands together: its errors are not independent of each other,
as they share a calibration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.columns import WORK_ROWS, Columns, adhesive, fill_columns
from overtone.inversion.exact import C_, DELTA_, F_, S_
from overtone.inversion.linear import stiffness
from overtone.inversion.motion import Followed, Room, new_room
from overtone.kernels import inner, lean
from overtone.population.algebra import half_square
from overtone.population.answer import Answer, add_changes, differentiate, new_answer, renew

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

ADHESION, TANGENT, FIRST_DEPTH = 0, 1, 2
"""Unknowns of a material at a given modulus: ln of the force of adhesion over the unit, ln of the loss tangent, then t
of each scan. What a model lacks stays as it is."""

BY_MODULUS = 3
"""Where the derivative by ln E stands among those of a row."""

_TO_REST = 6  # passes of the motion at most
_AT_REST = 1e-7  # units of force


class Scene(NamedTuple):
    """What a scan, or several of one area, have measured of their materials."""

    columns: Columns
    orders: npt.NDArray[np.int64]
    """(row,)."""
    lossy: npt.NDArray[np.bool_]
    """(row,): True for DISS_n."""
    amplitude: _Floats
    """(material, scan): of the tip [m]."""
    followed: Followed
    unit: float
    """Of force [N]."""
    centre: _Floats
    """(datum,): force harmonics in units, material by material, scan by scan; behind them ln E of the references."""
    precision: _Floats
    """(datum, datum): of all of them together, whatever they share integrated out."""
    references: npt.NDArray[np.int64]
    """(reference,): materials whose ln E is a datum."""
    even: bool
    """Whether the prior of adhesion is one of its logarithm: mean and precision are then those of ln F_ad."""


@lean
def rows_of_material(
    scene: Scene, k: int, scan: int, x: float, v: _Floats, room: Room, work: _Floats, f: _Floats, J: _Floats
) -> tuple[float, int]:
    """Fill the rows of a material in a scan, and their derivatives (row, 4): by adhesion, loss, t and ln E.

    ``x`` is ln E, ``v`` as `ADHESION` and what follows it orders them. The derivatives are those on a bare cosine. Of
    the motion f of the room is renewed (`overtone.population.answer.renew`), which also says what is
    returned.
    """
    columns, unit = scene.columns, scene.unit
    A = scene.amplitude[k, scan]
    t = v[FIRST_DEPTH + scan]
    Delta = 1.0 / (1.0 + math.exp(-t))
    by_t = Delta * (1.0 - Delta)
    S, share = stiffness(columns.contact, math.exp(x))
    tangent = math.exp(v[TANGENT]) if columns.loss > 0.0 else 0.0
    F = math.exp(v[ADHESION]) * unit if adhesive(columns) else 0.0
    full = room.b.shape[0] > 0
    lowest, count = math.pi, 0
    if full:
        room.x[S_], room.x[F_], room.x[C_], room.x[DELTA_] = S, F, S * tangent, 2.0 * A * Delta
        lowest, count = renew(A, room.x, columns, scene.followed, room)
        a, da, b, db = room.work[0], room.work[1], room.work[2], room.work[3]
    else:
        fill_columns(columns, A, Delta, work.shape[1] - 1, work)
        a, da, b, db = work[0], work[1], work[2], work[3]
    for r in range(scene.orders.shape[0]):
        n = scene.orders[r]
        if scene.lossy[r]:
            f[r] = -n * S * tangent * a[n] / unit
            J[r, 0], J[r, 1] = 0.0, -n * S * tangent * a[n] / unit
            J[r, 2] = -n * S * tangent * da[n] * by_t / unit
            J[r, BY_MODULUS] = -n * S * share * tangent * a[n] / unit
            if full:
                f[r] -= room.f[n].imag / unit
        else:
            f[r] = (S * a[n] + F * b[n]) / unit
            J[r, 0], J[r, 1], J[r, 2] = F * b[n] / unit, 0.0, (S * da[n] + F * db[n]) * by_t / unit
            J[r, BY_MODULUS] = S * share * a[n] / unit
            if full:
                f[r] += room.f[n].real / unit
    return lowest, count


class Desk(NamedTuple):
    """Scratch of one thread, for so many materials and scans."""

    room: Room
    answer: Answer
    work: _Floats
    added: _Complex
    """(material, scan, harmonic): what the motion added to those of the force, the last time."""
    f: _Floats
    """(datum,)."""
    J: _Floats
    """(datum, unknown)."""
    J_x: _Floats
    """(datum, material): by ln E."""
    E: _Floats
    """(datum, 4): what the harmonics of the motion add to the derivatives of a row."""
    part: _Floats
    """(row, 4)."""
    change: _Floats
    """(row,)."""
    H: _Floats
    """(unknown, unknown)."""
    g: _Floats
    """(unknown,)."""
    g_all: _Floats
    """(unknown + material,): with those of ln E, as is"""
    P: _Floats
    """what the priors add to the metric, and"""
    low: _Floats
    """the bounds."""
    high: _Floats


@inner
def new_desk(scene: Scene) -> Desk:
    """Return scratch."""
    materials, scans = scene.amplitude.shape
    size, m = scene.centre.shape[0], materials * (FIRST_DEPTH + scans)
    n_max = 0
    for r in range(scene.orders.shape[0]):
        n_max = max(n_max, scene.orders[r])
    room = new_room(scene.followed)
    return Desk(
        room,
        new_answer(room),
        np.zeros((WORK_ROWS, n_max + 1)),
        np.zeros((materials, scans, scene.followed.tip.shape[0]), np.complex128),
        np.zeros(size),
        np.zeros((size, m)),
        np.zeros((size, materials)),
        np.zeros((size, 4)),
        np.zeros((scene.orders.shape[0], 4)),
        np.zeros(scene.orders.shape[0]),
        np.zeros((m, m)),
        np.zeros(m),
        np.zeros(m + materials),
        np.zeros(m + materials),
        np.zeros(m + materials),
        np.zeros(m + materials),
    )


@lean
def _put(scene: Scene, k: int, scan: int, desk: Desk) -> None:
    """Put the slopes of a material in a scan, as they were just filled, where they belong."""
    scans, rows = scene.amplitude.shape[1], scene.orders.shape[0]
    start, first = (k * scans + scan) * rows, k * (FIRST_DEPTH + scans)
    for r in range(rows):
        i = start + r
        desk.J[i, first + ADHESION] = desk.part[r, 0] + desk.E[i, 0]
        desk.J[i, first + TANGENT] = desk.part[r, 1] + desk.E[i, 1]
        desk.J[i, first + FIRST_DEPTH + scan] = desk.part[r, 2] + desk.E[i, 2]
        desk.J_x[i, k] = desk.part[r, BY_MODULUS] + desk.E[i, BY_MODULUS]


@lean
def _put_references(scene: Scene, x: _Floats, desk: Desk) -> None:
    """Put ln E of the references behind the rows."""
    of_rows = scene.amplitude.shape[0] * scene.amplitude.shape[1] * scene.orders.shape[0]
    for j in range(scene.references.shape[0]):
        desk.f[of_rows + j] = x[scene.references[j]]
        desk.J_x[of_rows + j, scene.references[j]] = 1.0


@inner
def all_rows(scene: Scene, x: _Floats, v: _Floats, desk: Desk) -> None:
    """Fill f and J of the desk for every material; ``v`` is (material, unknown)."""
    materials, scans = scene.amplitude.shape
    rows = scene.orders.shape[0]
    for k in range(materials):
        for s in range(scans):
            start = (k * scans + s) * rows
            desk.room.f[:] = desk.added[k, s]
            rows_of_material(
                scene, k, s, x[k], v[k], desk.room, desk.work, desk.f[start : start + rows], desk.part
            )
            desk.added[k, s] = desk.room.f
            _put(scene, k, s, desk)
    _put_references(scene, x, desk)


@inner
def all_at_rest(scene: Scene, x: _Floats, v: _Floats, desk: Desk) -> None:
    """Fill f and J of the desk for every material, with the motion at rest and what its harmonics add to slopes."""
    for k in range(x.shape[0]):
        one_at_rest(scene, k, x[k], v[k], desk)
    _put_references(scene, x, desk)


@inner
def one_at_rest(scene: Scene, k: int, x: float, v: _Floats, desk: Desk) -> None:
    """Bring the motion of a material to rest and fill its rows, J, and E of the desk.

    E is small beside the slopes on a bare cosine and not to be neglected: the posterior is long in some directions and
    narrow in others, so that slopes that are off by a per cent point out of it.
    """
    scans, rows = scene.amplitude.shape[1], scene.orders.shape[0]
    room, columns = desk.room, scene.columns
    moves = room.b.shape[0] > 0
    sticky, loss = adhesive(columns), columns.loss > 0.0
    share = stiffness(columns.contact, math.exp(x))[1]
    for s in range(scans):
        start = (k * scans + s) * rows
        f, A = desk.f[start : start + rows], scene.amplitude[k, s]
        lowest, count = math.pi, 0
        for _ in range(_TO_REST):
            room.f[:] = desk.added[k, s]
            lowest, count = rows_of_material(scene, k, s, x, v, room, desk.work, f, desk.part)
            moved = 0.0
            for n in range(room.f.shape[0]):
                moved = max(moved, abs(room.f[n] - desk.added[k, s, n]))
            desk.added[k, s] = room.f
            if moved < _AT_REST * scene.unit:
                break
        if moves:
            count = differentiate(A, room.x, columns, scene.followed, lowest, count, room, desk.answer)
            Delta = 1.0 / (1.0 + math.exp(-v[FIRST_DEPTH + s]))
            for p in range(4):
                if (p == ADHESION and not sticky) or (p == TANGENT and not loss):
                    continue
                elastic = share if p == BY_MODULUS else 0.0
                add_changes(
                    room.x,
                    elastic,
                    1.0 if p == ADHESION else 0.0,
                    1.0 if p == TANGENT else elastic,
                    Delta * (1.0 - Delta) if p == FIRST_DEPTH else 0.0,
                    A,
                    scene.followed,
                    scene.orders,
                    scene.lossy,
                    count,
                    room,
                    desk.answer,
                    desk.change,
                )
                for r in range(rows):
                    slope = desk.change[r] / scene.unit
                    desk.E[start + r, p] = slope if math.isfinite(slope) else 0.0
        _put(scene, k, s, desk)


@lean
def misfit(scene: Scene, f: _Floats) -> float:
    """Return half of the chi-squared of all harmonics."""
    return half_square(scene.precision, f, scene.centre)

"""The force harmonics of a material, on the motion that the tip makes: what the pixels of a phase have in common.

Of a material ln E, its force of adhesion and its loss tangent count, and at each set-point the indentation that goes
with them. Given ln E the others are found by Newton's method against what was measured of all materials of a scan
together, whose errors are not independent of each other: they share a calibration.
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
from overtone.inversion.posterior import Prior
from overtone.inversion.table import DEEPEST, SHALLOWEST
from overtone.kernels import inner, kernel, lean
from overtone.population.algebra import cholesky, solve_factored, squared_length
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
_OPEN = 0.2
"""Curvature of ln of what may vanish, at least: no step is longer than a factor of e or two."""
_STEPS = 25
_CLIMB = 60
_BESIDE = 1e-3  # of a bound
_LEAST = -6.0  # ln of an unknown with which a search begins
_LONGEST, _LONGEST_LOG = 0.5, 1.0  # step of t, and of a logarithm
_SETTLED = 1e-3  # of the squared length of a step, in standard deviations


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
    size = f.shape[0]
    total = 0.0
    for i in range(size):
        row = 0.0
        for j in range(size):
            row += scene.precision[i, j] * (f[j] - scene.centre[j])
        total += 0.5 * (f[i] - scene.centre[i]) * row
    return total


@lean
def log_prior(scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats) -> float:
    """Return ln of the prior density of (ln E, v), but for a constant and for bounds."""
    total = 0.0
    for k in range(x.shape[0]):
        total -= 0.5 * prior.precision * (x[k] - prior.centre) ** 2
        if sticky and scene.even:
            away = v[k, ADHESION] + math.log(scene.unit) - prior.adhesion_mean
            total -= 0.5 * prior.adhesion_precision * away * away
        elif sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            total += v[k, ADHESION] - 0.5 * prior.adhesion_precision * (F - prior.adhesion_mean) ** 2
        if loss:
            total += v[k, TANGENT]
        for s in range(v.shape[1] - FIRST_DEPTH):
            # every ratio of indentations alike
            total -= math.log1p(math.exp(v[k, FIRST_DEPTH + s]))
    return total


@lean
def inside(scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats) -> bool:
    """Tell whether all unknowns are within the bounds of their priors."""
    fine = True
    for k in range(x.shape[0]):
        fine &= prior.log_low < x[k] < prior.log_high
        if sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            fine &= prior.adhesion_low <= F <= prior.adhesion_high
        if loss:
            fine &= math.exp(v[k, TANGENT]) <= prior.tangent_high
        for s in range(v.shape[1] - FIRST_DEPTH):
            fine &= SHALLOWEST < v[k, FIRST_DEPTH + s] < DEEPEST
    return fine


@lean
def bounds(scene: Scene, prior: Prior, sticky: bool, loss: bool, low: _Floats, high: _Floats) -> None:
    """Fill where unknowns may lie, a little inside of the bounds of their priors; in the order of `add_priors`."""
    materials, scans = scene.amplitude.shape
    each = FIRST_DEPTH + scans
    low[:], high[:] = -math.inf, math.inf
    for k in range(materials):
        at = k * each
        if sticky:
            if prior.adhesion_low > 0.0:
                low[at + ADHESION] = math.log(prior.adhesion_low / scene.unit) + _BESIDE
            high[at + ADHESION] = math.log(prior.adhesion_high / scene.unit) - _BESIDE
        if loss:
            high[at + TANGENT] = math.log(prior.tangent_high) - _BESIDE
        for s in range(scans):
            low[at + FIRST_DEPTH + s], high[at + FIRST_DEPTH + s] = SHALLOWEST + _BESIDE, DEEPEST - _BESIDE
        low[materials * each + k] = prior.log_low + _BESIDE
        high[materials * each + k] = prior.log_high - _BESIDE


@lean
def add_priors(
    scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats, g: _Floats, P: _Floats
) -> None:
    """Add the slope of ln of the priors to g, and fill P with what they add to the diagonal of the metric.

    Unknowns in the order v of all materials, then their ln E. P holds no step longer than the priors are wide.
    """
    materials, each = v.shape
    for k in range(materials):
        at = k * each
        if sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            P[at + ADHESION] = _OPEN
            if scene.even:
                away = v[k, ADHESION] + math.log(scene.unit) - prior.adhesion_mean
                g[at + ADHESION] -= prior.adhesion_precision * away
                P[at + ADHESION] += prior.adhesion_precision
            else:
                g[at + ADHESION] += 1.0 - prior.adhesion_precision * (F - prior.adhesion_mean) * F
                P[at + ADHESION] += prior.adhesion_precision * F * F
        else:
            g[at + ADHESION], P[at + ADHESION] = 0.0, 1.0
        if loss:
            g[at + TANGENT] += 1.0
            P[at + TANGENT] = _OPEN
        else:
            g[at + TANGENT], P[at + TANGENT] = 0.0, 1.0
        for s in range(each - FIRST_DEPTH):
            Delta = 1.0 / (1.0 + math.exp(-v[k, FIRST_DEPTH + s]))
            g[at + FIRST_DEPTH + s] -= Delta
            P[at + FIRST_DEPTH + s] = Delta * (1.0 - Delta)
        g[materials * each + k] -= prior.precision * (x[k] - prior.centre)
        P[materials * each + k] = prior.precision + 12.0 / (prior.log_high - prior.log_low) ** 2


@lean
def _hold_back(a: int, here: float, low: _Floats, high: _Floats, H: _Floats, g: _Floats) -> None:
    """Take an unknown out of a step that a bound holds back."""
    if (here <= low[a] and g[a] < 0.0) or (here >= high[a] and g[a] > 0.0):
        H[a, :], H[:, a] = 0.0, 0.0
        H[a, a], g[a] = 1.0, 0.0


@inner
def settle_materials(
    scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats, desk: Desk
) -> float:
    """Move v to where the posterior at given ln E is largest, within bounds; return ln of the mass about it.

    Minus infinity where the search fails.
    """
    materials, scans = scene.amplitude.shape
    each = FIRST_DEPTH + scans
    m, size, rows = materials * each, desk.f.shape[0], scene.orders.shape[0]
    desk.added[:] = 0.0
    bounds(scene, prior, sticky, loss, desk.low, desk.high)
    before = math.inf
    for step in range(_STEPS):
        all_rows(scene, x, v, desk)
        for a in range(m):
            desk.g[a] = 0.0
            for b in range(m):
                desk.H[a, b] = 0.0
        for i in range(size):
            pull = 0.0
            for j in range(size):
                pull += scene.precision[i, j] * (scene.centre[j] - desk.f[j])
            for a in range(m):
                if desk.J[i, a] != 0.0:
                    desk.g[a] += desk.J[i, a] * pull
        # J is zero but for the own columns of a material
        for i in range(size):
            for b in range(m):
                along = 0.0
                first = (b // each) * scans * rows
                for j in range(first, first + scans * rows):
                    along += scene.precision[i, j] * desk.J[j, b]
                for a in range(b + 1):
                    if desk.J[i, a] != 0.0:
                        desk.H[a, b] += desk.J[i, a] * along
        desk.g_all[:m] = desk.g
        add_priors(scene, prior, sticky, loss, x, v, desk.g_all, desk.P)
        desk.g[:] = desk.g_all[:m]
        for a in range(m):
            desk.H[a, a] += desk.P[a]
        for a in range(m):
            for b in range(a):
                desk.H[a, b] = desk.H[b, a]
        for a in range(m):
            here = v[a // each, a % each]
            _hold_back(a, here, desk.low, desk.high, desk.H, desk.g)
        if not cholesky(desk.H):
            return -math.inf
        solve_factored(desk.H, desk.g, desk.g)
        length = squared_length(desk.H, desk.g)
        share = 1.0
        for k in range(materials):
            for s in range(scans):
                far = abs(desk.g[k * each + FIRST_DEPTH + s])
                if far * share > _LONGEST:
                    share = _LONGEST / far
            for a in range(FIRST_DEPTH):
                far = abs(desk.g[k * each + a])
                if far * share > _LONGEST_LOG:
                    share = _LONGEST_LOG / far
        if not math.isfinite(length):
            return -math.inf
        # where steps stop to shrink Newton's method swings about a bend
        if step > 8 and length > 0.5 * before:
            share *= 0.5
        before = length
        for k in range(materials):
            for a in range(each):
                at = k * each + a
                v[k, a] = min(max(v[k, a] + share * desk.g[at], desk.low[at]), desk.high[at])
        if length < _SETTLED:
            break
    if before > 1.0:
        return -math.inf
    all_rows(scene, x, v, desk)
    value = log_prior(scene, prior, sticky, loss, x, v) - misfit(scene, desk.f)
    for a in range(m):
        value -= math.log(desk.H[a, a])
    return value


@kernel
def climb(
    scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats, covariance: _Floats
) -> float:
    """Move all unknowns of all materials to where the posterior is largest; return ln of its density there.

    Levenberg and Marquardt's method; an unknown that a bound holds back stays there while the others move on.
    ``covariance`` (material, material) is filled with that of ln E about the summit.
    """
    desk = new_desk(scene)
    materials, each = v.shape
    m, size = materials * each, desk.f.shape[0]
    all_of = m + materials
    J, H = np.zeros((size, all_of)), np.zeros((all_of, all_of))
    g, P = np.zeros(all_of), np.zeros(all_of)
    x_new, v_new, added = x.copy(), v.copy(), desk.added.copy()
    low, high = np.zeros(all_of), np.zeros(all_of)
    bounds(scene, prior, sticky, loss, low, high)
    for k in range(materials):
        x[k] = min(max(x[k], low[m + k]), high[m + k])
        for a in range(each):
            v[k, a] = min(max(v[k, a], low[k * each + a]), high[k * each + a])
    for _ in range(4):
        all_rows(scene, x, v, desk)
    cost, damping = misfit(scene, desk.f) - log_prior(scene, prior, sticky, loss, x, v), 1e-3
    for _ in range(_CLIMB):
        all_at_rest(scene, x, v, desk)
        added[:] = desk.added
        J[:, :m], J[:, m:] = desk.J, desk.J_x
        H[:] = J.T @ scene.precision @ J
        g[:] = J.T @ (scene.precision @ (scene.centre - desk.f))
        add_priors(scene, prior, sticky, loss, x, v, g, P)
        for a in range(all_of):
            H[a, a] += P[a]
            here = x[a - m] if a >= m else v[a // each, a % each]
            _hold_back(a, here, low, high, H, g)
        if not math.isfinite(H.sum() + g.sum()):
            return -math.inf
        scale = np.sqrt(np.diag(H))
        done = False
        for _ in range(12):
            A = H / np.outer(scale, scale)
            for a in range(all_of):
                A[a, a] += damping
            step = np.linalg.solve(A, g / scale) / scale
            share = 1.0
            for k in range(materials):
                share = min(share, _LONGEST_LOG / max(abs(step[m + k]), _LONGEST_LOG))
                for a in range(FIRST_DEPTH):
                    share = min(share, _LONGEST_LOG / max(abs(step[k * each + a]), _LONGEST_LOG))
                for s in range(each - FIRST_DEPTH):
                    share = min(share, _LONGEST / max(abs(step[k * each + FIRST_DEPTH + s]), _LONGEST))
            for k in range(materials):
                x_new[k] = min(max(x[k] + share * step[m + k], low[m + k]), high[m + k])
                for a in range(each):
                    there_a = v[k, a] + share * step[k * each + a]
                    v_new[k, a] = min(max(there_a, low[k * each + a]), high[k * each + a])
            # from the motion of where it stands: that of a step too far may have run away
            desk.added[:] = added
            for _ in range(2):
                all_rows(scene, x_new, v_new, desk)
            there = misfit(scene, desk.f) - log_prior(scene, prior, sticky, loss, x_new, v_new)
            if there < cost:
                done = cost - there < 1e-4 and share == 1.0
                x[:], v[:] = x_new, v_new
                cost = there
                damping = max(0.2 * damping, 1e-12)
                break
            damping = max(5.0 * damping, 1e-9)
        else:
            done = True
        if done:
            break
    scale = np.sqrt(np.diag(H))
    A = H / np.outer(scale, scale)
    for a in range(all_of):
        A[a, a] += 1e-12
    whole = np.linalg.inv(A)
    for k in range(materials):
        for j in range(materials):
            covariance[k, j] = whole[m + k, m + j] / (scale[m + k] * scale[m + j])
    return -cost


@kernel
def starts_of_material(
    scene: Scene, sticky: bool, loss: bool, ln_E: _Floats, v: _Floats, chi2: _Floats, places: _Floats
) -> None:
    """Fill what fits one material best, linear in all but the indentation, at places t along its valley.

    Parameters
    ----------
    scene : Scene
        Of one material in one scan.
    sticky, loss : bool
        Whether the model has adhesion, and loss.
    ln_E, v, chi2 : array (place,), (place, unknown), (place,)
        Filled; ln E is NaN where no sample is so stiff, or softer than nothing.
    places : array (place,)
        t.
    """
    desk = new_desk(scene)
    rows = scene.orders.shape[0]
    G, h, c = np.empty((3, 3)), np.empty(3), np.empty((rows, 3))
    contact = scene.columns.contact
    x0, v0 = np.zeros(1), np.zeros((1, FIRST_DEPTH + 1))
    for i in range(places.shape[0]):
        v0[0, ADHESION], v0[0, TANGENT] = _LEAST, _LEAST
        v0[0, FIRST_DEPTH] = places[i]
        x0[0] = 18.0
        fine = False
        # the motion of the first pass is that of a material without adhesion
        for _ in range(3):
            desk.added[:] = 0.0
            all_rows(scene, x0, v0, desk)
            S = stiffness(contact, math.exp(x0[0]))[0]
            # f = S a + F b + S tan v + what the harmonics of the motion add
            for r in range(rows):
                phi, tangent = math.exp(v0[0, ADHESION]), math.exp(v0[0, TANGENT])
                c[r, 1] = desk.J[r, ADHESION] / phi
                c[r, 2] = desk.J[r, TANGENT] / (S * tangent)
                c[r, 0] = (desk.f[r] - desk.J[r, ADHESION] - desk.J[r, TANGENT]) / S
            for a in range(3):
                h[a] = 0.0
                for b in range(3):
                    G[a, b] = 0.0
            for r in range(rows):
                for q in range(rows):
                    w = scene.precision[r, q]
                    for a in range(3):
                        h[a] += c[r, a] * w * scene.centre[q]
                        for b in range(3):
                            G[a, b] += c[r, a] * w * c[q, b]
            if not sticky:
                G[1, :], G[:, 1], G[1, 1], h[1] = 0.0, 0.0, 1.0, 0.0
            if not loss:
                G[2, :], G[:, 2], G[2, 2], h[2] = 0.0, 0.0, 1.0, 0.0
            # a motion that runs away, of a material that is none
            if not math.isfinite(G.sum() + h.sum()):
                break
            scale = np.sqrt(np.diag(G))
            for a in range(3):
                for b in range(3):
                    G[a, b] /= scale[a] * scale[b]
                h[a] /= scale[a]
            solution = np.linalg.solve(G + 1e-13 * np.eye(3), h) / scale
            if not solution[0] > 0.0:
                break
            compliance = contact.factor / solution[0] - contact.tip_compliance
            if not compliance > 0.0:
                break
            x0[0] = math.log(contact.sample_factor / compliance)
            v0[0, ADHESION] = math.log(max(solution[1], math.exp(_LEAST)))
            v0[0, TANGENT] = math.log(max(solution[2] / solution[0], math.exp(_LEAST)))
        else:
            fine = True
        if not fine:
            ln_E[i], chi2[i] = math.nan, math.inf
            continue
        all_rows(scene, x0, v0, desk)
        ln_E[i], chi2[i] = x0[0], 2.0 * misfit(scene, desk.f)
        v[i, :] = places[i]
        v[i, :FIRST_DEPTH] = v0[0, :FIRST_DEPTH]

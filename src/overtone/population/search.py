"""Where the posterior of the materials of a scan is largest, and where to begin to look for that."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.linear import stiffness
from overtone.inversion.posterior import Prior
from overtone.kernels import inner, kernel, lean
from overtone.population.algebra import cholesky, solve_factored, squared_length
from overtone.population.beforehand import add_priors, bounds, log_prior
from overtone.population.forward import (
    ADHESION,
    FIRST_DEPTH,
    TANGENT,
    Desk,
    Scene,
    all_at_rest,
    all_rows,
    misfit,
    new_desk,
)

_Floats = npt.NDArray[np.float64]

_STEPS = 25
_CLIMB = 60
_LEAST = -6.0  # ln of an unknown with which a search begins
_LONGEST, _LONGEST_LOG = 0.5, 1.0  # step of t, and of a logarithm
_SETTLED = 1e-3  # of the squared length of a step, in standard deviations


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

"""What a scan has measured of its phases, and how much of it all phases share.

Pixels of a phase are averaged over tiles of the scan. A tile knows its own scatter; what tiles of one phase differ by
beyond it, because neighbours are alike or a line was off, is the statistical error of the phase. What the
calibration leaves uncertain is one vector z of independent unknowns for the whole scan, and moves every tile by its own
known amount, ``y = f + C z + error``. Integrated over z that is one Gaussian for the harmonics of all phases together:
all later steps need of the data is its centre and its precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.instrument.shared import relative_changes
from overtone.instrument.signals import Positions, Signals
from overtone.inversion.pixels import Setting, Shared, in_rows

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.intp]

TILES = 12
"""Tiles along each side of a scan."""
_UNSEEN = 1e-6  # share of the noise
_COMPUTED = 1e-4  # relative accuracy of a computed harmonic
DRIFTING = ("A0_offset", "phi1_offset", "free_amplitude")
"""Unknowns that differ from scan to scan of a stack."""
_FEWEST = 4  # pixels of a phase in a tile that count
_PRIOR_TILES = 4.0  # tiles that the scatter between tiles is worth before it is seen


class Harvest(NamedTuple):
    """Force harmonics of every pixel of a stack of scans."""

    y: _Floats
    """(pixel, scan * row): forces [N]."""
    amplitude: _Floats
    """(pixel, scan): of the tip [m]."""
    usable: npt.NDArray[np.bool_]
    """(pixel,): in every scan."""
    noise: _Floats
    """(scan * row, scan * row): covariance of the noise of an ordinary pixel [N^2]."""


def harvest(settings: Sequence[Setting]) -> Harvest:
    """Return the force harmonics of the pixels of scans of one area."""
    ys, amplitudes, noises = [], [], []
    usable = np.ones(settings[0].amplitudes[0].size, bool)
    for setting in settings:
        h = setting.harmonics(slice(None))
        y = in_rows(h.f, setting.rows)
        usable &= h.usable & np.isfinite(y).all(axis=1)
        ys.append(y)
        amplitudes.append(h.amplitude)
        known = np.flatnonzero(h.usable & np.isfinite(y).all(axis=1))
        some = in_rows(h.errors[known[:: max(1, known.size // 2000)]], setting.rows)
        noises.append(
            np.einsum("prs,pqs->rq", some, some) / max(len(some), 1) if known.size else np.eye(y.shape[1])
        )
    rows = ys[0].shape[1]
    noise = np.zeros((rows * len(ys), rows * len(ys)))
    for i, N in enumerate(noises):
        noise[i * rows : (i + 1) * rows, i * rows : (i + 1) * rows] = N
    return Harvest(np.concatenate(ys, axis=1), np.stack(amplitudes, axis=1), usable, noise)


class Tiles(NamedTuple):
    """Means of the pixels of one phase over the tiles that it is found in."""

    y: _Floats
    """(tile, datum): at the mean amplitudes of the phase [N]."""
    changes: _Floats
    """(tile, datum, source): what each shared error adds to what is concluded from the readings [N]."""
    radius: _Floats
    """(source,): and to ln R of the tip."""
    stiffness: _Floats
    """(source,): and to ln of the stiffness of the lever, of which every force is a multiple."""
    pixels: _Indices
    """(tile,): how many."""
    within: _Floats
    """(datum, datum): covariance of a pixel about its tile [N^2]."""
    between: _Floats
    """(datum, datum): covariance of tiles beyond that [N^2]."""
    amplitude: _Floats
    """(scan,): mean amplitude of the tip [m]."""
    slope: _Floats
    """(datum, scan): of the rows along the amplitude within the phase [N/m]."""
    place: _Floats
    """(tile, 3): mean height, x and y about the middle of the scan [m]."""

    @property
    def covariance(self) -> _Floats:
        """(tile, datum, datum): of each mean but for what tiles share [N^2]."""
        return np.asarray(self.between[None] + self.within[None] / self.pixels[:, None, None])


def tiles_of(settings: Sequence[Setting], data: Harvest, members: _Indices, tile: _Indices) -> Tiles:
    """Return the means of one phase.

    Parameters
    ----------
    settings : sequence of Setting
        Scans of one area.
    data : Harvest
        Their forces.
    members : array
        Pixels of the phase.
    tile : array (pixel,)
        Number of the tile of every pixel.
    """
    scans, size = len(settings), data.y.shape[1]
    y, A = data.y[members], data.amplitude[members]
    middle = A.mean(axis=0)
    # the feedback holds the amplitude a little off at every pixel: not a property of the sample
    slope = np.zeros((size, scans))
    dA = A - middle
    rows = size // scans
    for s in range(scans):
        power = float((dA[:, s] ** 2).sum())
        block = slice(s * rows, (s + 1) * rows)
        if power > len(members) * (1e-6 * middle[s]) ** 2:
            slope[block, s] = dA[:, s] @ (y[:, block] - y[:, block].mean(axis=0)) / power
    y = y - dA @ slope.T
    numbers, inverse, count = np.unique(tile[members], return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse, y[:, j]) / count for j in range(size)], axis=1)
    rest = y - means[inverse]
    freedom = max(len(members) - numbers.size, 1)
    within = rest.T @ rest / freedom
    # scatter far below the noise is none that is seen, and without any there is no inverse
    within = within + (1.0 if len(members) - numbers.size < size else _UNSEEN) * data.noise
    kept = count >= min(_FEWEST, count.max())
    n = count[kept].astype(float)
    chosen = means[kept]
    excess, tiles = beyond_scatter(chosen, n, within), n.size
    typical = within / n.mean()
    between = _positive((tiles - 1) * excess + _PRIOR_TILES * typical * 0.25, within) / (
        tiles - 1 + _PRIOR_TILES
    )
    changes, radius, stiffness = [], np.zeros(0), np.zeros(0)
    place = np.zeros((int(kept.sum()), 3))
    for i, setting in enumerate(settings):
        if setting.shared is None:
            changes.append(np.zeros((int(kept.sum()), rows, 0)))
            continue
        where = Positions(
            *((np.bincount(inverse, part[members]) / count)[kept] for part in setting.shared.where)
        )
        shared = reads_alike(setting.shared, members, where)
        if i == 0:
            place = np.stack([shared.where.height, shared.where.x, shared.where.y], axis=1)
            stiffness = relative_changes(shared.calibration, "stiffness")
        added, radius = sources_of(settings, i, shared)
        changes.append(added)
    radius, stiffness = (
        np.concatenate([part, np.zeros(changes[0].shape[2] - part.size)]) for part in (radius, stiffness)
    )
    return Tiles(
        chosen,
        np.concatenate(changes, axis=1),
        radius,
        stiffness,
        count[kept],
        within,
        between,
        middle,
        slope,
        place,
    )


def sources_of(settings: Sequence[Setting], scan: int, shared: Shared) -> tuple[_Floats, _Floats]:
    """Return what errors add to the rows of some readings (reading, row, source), and to ln R (source of all scans,).

    What the calibration leaves open is one and the same in all scans of a stack; behind it stand, for each scan after
    the first, the zeros of its own: they drift from one scan to the next as far as they may have done before.
    """
    setting = settings[scan]
    turn = setting.harmonics(slice(0, 1)).turn[0]
    turns = np.full(shared.signals.phasor[1].shape, turn if np.isfinite(turn) else 1.0 + 0j)
    of_all, radius = setting.changes(shared, slice(None), turns)
    # an unknown that is larger than believed makes the force larger than concluded
    parts = [-in_rows(of_all, setting.rows)]
    calibration = shared.calibration
    own = [i for i, name in enumerate(calibration.names) if name in DRIFTING]
    for other in range(1, len(settings)):
        names = tuple(calibration.names[i] for i in own)
        variances = np.diag(np.diag(calibration.covariance)[own])
        if other != scan or not own:
            parts.append(np.zeros((*parts[0].shape[:2], int((np.diag(variances) > 0.0).sum()))))
            continue
        alone = shared._replace(calibration=replace(calibration, names=names, covariance=variances))
        parts.append(-in_rows(setting.changes(alone, slice(None), turns)[0], setting.rows))
    return np.concatenate(parts, axis=2), radius


def beyond_scatter(means: _Floats, count: _Floats, within: _Floats) -> _Floats:
    """Return by how much the means of tiles (tile, datum) differ beyond the scatter of their pixels: a covariance.

    From moments, so that it may come out negative where they do not.
    """
    away = means - np.average(means, axis=0, weights=count)
    seen = np.einsum("t,ti,tj->ij", count, away, away)
    spare = count.sum() - (count**2).sum() / count.sum()
    if not spare > 0.0:
        return np.zeros_like(within)
    return np.asarray((seen - max(count.size - 1, 0) * within) / spare)


def scatter_of(tiles: Tiles, z: _Floats) -> _Floats:
    """Return the covariance (datum, datum) of the pixels of a phase about its mean, were it not for the instrument.

    Parameters
    ----------
    tiles : Tiles
        Of the phase.
    z : array (source,)
        What the calibration left open, as far as it is known: it makes tiles differ that are alike.
    """
    away = (tiles.changes - np.average(tiles.changes, axis=0, weights=tiles.pixels)) @ z
    between = beyond_scatter(tiles.y - away, tiles.pixels.astype(float), tiles.within)
    return tiles.within + _positive(between, tiles.within)


def _positive(matrix: _Floats, scale: _Floats) -> _Floats:
    """Return the nearest matrix that is none but positive, in the frame where another is the unit."""
    L = np.linalg.cholesky(scale + 1e-12 * np.diag(np.diag(scale)))
    inner = np.linalg.solve(L, np.linalg.solve(L, matrix).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    part = L @ vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(part @ part.T)


def reads_alike(shared: Shared, members: _Indices, where: Positions) -> Shared:
    """Return places that all read as a phase does in the mean.

    What a shared error does goes with the reading. Counted from the reading of each tile it would follow the scatter of
    the tiles, and seem to explain it.
    """
    signals, count = shared.signals, where.height.size
    return Shared(
        shared.calibration,
        Signals(
            np.full(count, signals.mean[members].mean()) if signals.mean is not None else None,
            {n: np.full(count, a[members].mean()) for n, a in signals.phasor.items()},
        ),
        where,
    )


class Known(NamedTuple):
    """ln of a modulus that is known beforehand."""

    material: int
    value: float
    error: float
    exponent: float
    """Change of ln of the elastic unknown with ln R at a given force."""


class Bend(NamedTuple):
    """What the curvature of the harmonics does to the mean of a phase, see `overtone.population.held`."""

    shift: _Floats
    """(datum,): mean of its pixels less the harmonics of the median material [N]."""
    errors: _Floats
    """(datum, source): what is not known of it, as independent errors [N]."""


class Evidence(NamedTuple):
    """The Gaussian of all phases together, and of z with them."""

    centre: _Floats
    """(datum,): in units, phase by phase, scan by scan; behind them ln of the known moduli."""
    covariance: _Floats
    """(datum, datum)."""
    statistical: _Floats
    """(datum, datum): of it what is not shared."""
    unit: float
    """Of force [N]."""
    mean: _Floats
    """(datum,): as concluded from the readings."""
    changes: _Floats
    """(datum, source): what z adds to that."""
    z_precision: _Floats
    """(source, source): of z without regard to what the phases are made of."""
    z_pull: _Floats
    """(source,): that precision times the mean of z."""
    radius: _Floats
    """(source,): what z does to ln R."""

    @property
    def precision(self) -> _Floats:
        """(datum, datum): inverse of the covariance."""
        return inverse(self.covariance)


def evidence_of(
    phases: Sequence[Tiles], bends: Sequence[Bend], known: Sequence[Known], unknowns: int
) -> Evidence:
    """Return the evidence of phases, with what is known of some moduli.

    Parameters
    ----------
    phases : sequence of Tiles
        What was measured of each.
    bends : sequence of Bend
        Of each.
    known : sequence of Known
        Moduli.
    unknowns : int
        Of a phase: its properties, and t of each scan.

    Notes
    -----
    Every force is a multiple of the stiffness of the lever, 1 + e z, and so is its noise: ln of the unknowns come out
    as sharp from a stiff lever as from a soft one. A Gaussian of one covariance for ``y + C z``, in which C goes with
    the forces, makes them sharper where forces are strong: integrated over p unknowns it would weigh z by
    ``(1 + e z)^-p``, and softer levers would seem likelier the more phases there are. The prior of z has the inverse of
    that, to second order: ln of it is ``p (e z - (e z)^2/2)``.
    """
    size = phases[0].y.shape[1]
    shared = phases[0].changes.shape[2]
    own = bends[0].errors.shape[1]
    sources = shared + own * len(phases)
    n = size * len(phases) + len(known)
    unit = float(np.median(np.abs(phases[0].y)))
    statistical, mean, changes = np.zeros((n, n)), np.zeros(n), np.zeros((n, sources))
    of_lever, radius = np.zeros(sources), np.zeros(sources)
    of_lever[: phases[0].stiffness.size] = phases[0].stiffness
    power = unknowns * len(phases)
    P, b = np.eye(sources) + power * np.outer(of_lever, of_lever), power * of_lever
    radius[: phases[0].radius.size] = phases[0].radius
    for k, tiles in enumerate(phases):
        at = slice(k * size, (k + 1) * size)
        W = np.stack([inverse(C / unit**2) for C in tiles.covariance])
        V = inverse(W.sum(axis=0))
        y, C = (tiles.y - bends[k].shift) / unit, tiles.changes / unit
        statistical[at, at] = V
        mean[at] = V @ np.einsum("tij,tj->i", W, y)
        changes[at, :shared] = V @ np.einsum("tij,tjs->is", W, C)
        # of the forces on the motion no more is known, however many pixels there are
        statistical[at, at] += np.diag((_COMPUTED * mean[at]) ** 2)
        mine = shared + k * own
        changes[at, mine : mine + own] = bends[k].errors / unit
        # tiles that a shared error moves by different amounts tell of it, whatever they are made of
        away, apart = y - mean[at], C - changes[at, :shared]
        P[:shared, :shared] += np.einsum("tis,tij,tjr->sr", apart, W, apart)
        b[:shared] += np.einsum("tis,tij,tj->s", apart, W, away)
    for j, fact in enumerate(known):
        row = size * len(phases) + j
        statistical[row, row] = fact.error**2
        mean[row] = fact.value
        # ln E is what the nominal radius makes of the force, and more
        changes[row] = fact.exponent * radius
    z = inverse(P)
    covariance = statistical + changes @ z @ changes.T
    return Evidence(mean - changes @ (z @ b), covariance, statistical, unit, mean, changes, P, b, radius)


def inverse(matrix: _Floats) -> _Floats:
    """Return the inverse of a covariance, or a precision, whose rows may be of very different sizes."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inner = np.linalg.inv(matrix * np.outer(scale, scale))
    return np.asarray(0.5 * (inner + inner.T) * np.outer(scale, scale))


def z_given(evidence: Evidence, f: _Floats, normals: _Floats) -> _Floats:
    """Return z (draw, source) for draws of all harmonics (draw, datum) and standard normals (draw, source)."""
    own = inverse(evidence.statistical)
    along = evidence.changes.T @ own
    P = evidence.z_precision + along @ evidence.changes
    mean = np.linalg.solve(P, evidence.z_pull[:, None] + along @ (evidence.mean - f).T).T
    L = np.linalg.cholesky(P)
    return np.asarray(mean + np.linalg.solve(L.T, normals.T).T)

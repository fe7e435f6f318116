"""All phases of a scan at once: their materials, the spread within them, and what the calibration left open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.pixels import Setting
from overtone.population.evidence import (
    Bend,
    Evidence,
    Harvest,
    Known,
    Tiles,
    evidence_of,
    scatter_of,
    tiles_of,
)
from overtone.population.held import PROPERTIES, curvature
from overtone.population.materials import Alone, Draws, Question, draw_materials, profiles_of
from overtone.population.spread import TYPICAL, Spread, spread_of

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.intp]

_PASSES = 3
_REACH = (0.05, 0.35)
"""Least and longest step of ln of a property."""
_AT_FIRST = 0.02  # of the scatter of pixels, by which means may be off before their bend is known
_LEAST_ERROR = 0.1  # of a bend: distributions are not quite normal ones
_CORRELATED = 0.3  # standard deviation of the correlation of two properties within a phase


class Response(NamedTuple):
    """How the pixels of a phase go with their properties."""

    f: _Floats
    """(datum,): of the median material [unit]."""
    J: _Floats
    """(datum, PROPERTIES): by ln of each property [unit]."""
    H: _Floats
    """(datum, PROPERTIES, PROPERTIES): the second derivatives."""
    depth: _Floats
    """(scan, PROPERTIES): of t."""
    along: _Floats
    """(datum, scan): by t of a scan alone [unit]."""


@dataclass(frozen=True)
class Joint:
    """What a scan says of its phases.

    Parameters
    ----------
    tiles, spreads, responses : tuple
        Of each phase.
    evidence : Evidence
        Of all.
    alone : tuple of Alone
        Each phase by itself.
    draws : Draws
        Of all together.
    """

    tiles: tuple[Tiles, ...]
    spreads: tuple[Spread, ...]
    responses: tuple[Response, ...]
    evidence: Evidence
    alone: tuple[Alone, ...]
    draws: Draws


class Held(NamedTuple):
    """What keeps the amplitude of a phase, in units of force."""

    first: _Floats
    """(scan, 2): A1/G."""
    still: npt.NDArray[np.complex128]
    """(scan,): f_1 as measured."""


def infer(
    settings: Sequence[Setting],
    data: Harvest,
    members: Sequence[_Indices],
    tile: _Indices,
    question: Question,
    known: Sequence[Known],
    mixed: Sequence[bool],
    seed: int,
) -> Joint | None:
    """Return the joint posterior of phases; None where the model cannot make the forces of one at all.

    Parameters
    ----------
    settings : sequence of Setting
        Scans of one area, with the same rows.
    data : Harvest
        Their forces.
    members : sequence of array
        Pixels of each phase.
    tile : array (pixel,)
        Number of the tile of every pixel.
    question : Question
        Model, harmonics, lever, priors.
    known : sequence of Known
        Moduli of references.
    mixed : sequence of bool
        Phases that may be more than one material: what their tiles differ by is none of the scatter of one.
    seed : int
        Of the draws.
    """
    tiles = tuple(tiles_of(settings, data, pixels, tile) for pixels in members)
    amplitude = np.stack([t.amplitude for t in tiles])
    size = data.y.shape[1]
    free = free_properties(question)
    unknowns, shared = int(free.sum()) + len(settings), tiles[0].changes.shape[2]
    # before the bend of a phase is known its mean is trusted less
    bends = [Bend(np.zeros(size), _root(_AT_FIRST * t.within)) for t in tiles]
    scatter = [np.full(PROPERTIES, TYPICAL) for _ in tiles]
    spreads: list[Spread] = []
    responses: list[Response] = []
    alone: list[Alone] | None = None
    for _ in range(_PASSES):
        evidence = evidence_of(tiles, bends, known, unknowns)
        alone = profiles_of(question, evidence, amplitude, known, alone or ())
        if alone is None:
            return None
        z = np.asarray(np.linalg.solve(evidence.z_precision, evidence.z_pull))[:shared]
        spreads, responses, bends = [], [], []
        for k, t in enumerate(tiles):
            x, v = alone[k].at(0.5)
            response = respond(settings, question, evidence.unit, amplitude, k, t, x, v, free, scatter[k])
            loose = np.zeros((size, 0)) if question.loss else response.along
            spread = spread_of(
                (t.within if mixed[k] else scatter_of(t, z)) / evidence.unit**2,
                data.noise / evidence.unit**2,
                response.J,
                response.H,
                free,
                len(members[k]),
                loose,
            )
            spreads.append(spread)
            scatter[k] = spread.value
            responses.append(response)
            bends.append(_bend(response, spread, evidence.unit))
    evidence = evidence_of(tiles, bends, known, unknowns)
    alone = profiles_of(question, evidence, amplitude, known, alone or ())
    if alone is None:
        return None
    draws = draw_materials(question, evidence, amplitude, known, alone, seed)
    return Joint(tiles, tuple(spreads), tuple(responses), evidence, tuple(alone), draws)


def free_properties(question: Question) -> npt.NDArray[np.bool_]:
    """Return which of the three properties the model has."""
    return np.array([True, question.sticky, question.loss])


def respond(
    settings: Sequence[Setting],
    question: Question,
    unit: float,
    amplitude: _Floats,
    k: int,
    tiles: Tiles,
    x: float,
    v: _Floats,
    free: npt.NDArray[np.bool_],
    scatter: _Floats,
) -> Response:
    """Return how the pixels of a phase about a material go with their properties, as far as these scatter."""
    scans, rows = len(settings), question.rows.orders.size
    scene = question.scene(np.empty(0), np.empty((0, 0)), amplitude, unit, [])
    held = _held(settings, question, tiles, unit)
    f, J = np.zeros(rows * scans), np.zeros((rows * scans, PROPERTIES))
    H = np.zeros((rows * scans, PROPERTIES, PROPERTIES))
    depth = np.zeros((scans, PROPERTIES))
    along = np.zeros((rows * scans, scans))
    reach = np.clip(math.sqrt(3.0) * scatter, *_REACH)
    curvature(scene, k, x, v, held.first, held.still, free, reach, f, J, H, depth, along)
    return Response(f, J, H, depth, along)


def _held(settings: Sequence[Setting], question: Question, tiles: Tiles, unit: float) -> Held:
    rows = question.rows
    first, still = [], []
    for s, setting in enumerate(settings):
        at = setting.orders.index(1)
        # A1/G of what is read; a shaken base adds what its drive does to the reading
        a = tiles.amplitude[s] * setting.reader.reading[0] * setting.reader.stiffness[at] / unit
        first.append([a.real, a.imag])
        mean = tiles.y[:, s * rows.orders.size : (s + 1) * rows.orders.size].mean(axis=0) / unit
        found = {
            bool(lossy): value
            for n, lossy, value in zip(rows.orders, rows.lossy, mean, strict=True)
            if n == 1
        }
        still.append(complex(found.get(False, 0.0), -found.get(True, 0.0)))
    return Held(np.array(first), np.array(still))


def _bend(response: Response, spread: Spread, unit: float) -> Bend:
    """Return by how much the mean of a phase is off its median material, and how sure that is."""
    s = spread.value
    parts = 0.5 * np.einsum("rii,i->ri", response.H, s**2)
    error = np.maximum(2.0 * spread.error, _LEAST_ERROR)
    pairs = [_CORRELATED * response.H[:, i, j] * s[i] * s[j] for i in range(PROPERTIES) for j in range(i)]
    return Bend(
        unit * parts.sum(axis=1), unit * np.concatenate([parts * error, np.stack(pairs, axis=1)], axis=1)
    )


def _root(covariance: _Floats) -> _Floats:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

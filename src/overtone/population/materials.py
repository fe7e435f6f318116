"""The posterior of all materials of a scan together, and of what the calibration left open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from overtone.inversion.columns import Columns, adhesive
from overtone.inversion.forces import Rows
from overtone.inversion.motion import Followed
from overtone.inversion.posterior import Prior
from overtone.population.evidence import Evidence, Known, inverse, z_given
from overtone.population.forward import FIRST_DEPTH, Scene
from overtone.population.sampler import MOST_NODES, profile, walk
from overtone.population.search import climb, starts_of_material

_Floats = npt.NDArray[np.float64]

CHAINS = 2
_AT_ONCE = 2  # materials whose profiles are followed side by side
_ADAPTING, _ROUNDS = 60, 6  # steps of a round in which the walk learns its stride
_LEG, _MOST_LEGS = 400, 12  # steps of a leg of a chain, and legs at most
_STRIDE, _AIM = 0.7, 0.55  # the first stride, and the share of the steps that should be accepted
_ATTEMPTS = 3  # starts of a climb
_KEPT = 128  # draws of each chain that are kept
_PLACES = np.linspace(-8.0, 3.0, 56)  # of t, where a material may begin
_VALLEYS = 4  # places from which a summit is looked for
_WORSE = 60.0  # chi-squared above the least at which a second valley is still looked at
_LOWER = 20.0  # ln of the density below the highest summit at which one does not count
_WELL_MIXED = 1.05
_FEWEST_DRAWS, _ENOUGH_DRAWS = 20.0, 120.0  # independent draws that a walk is worth: at least, and to end it
_BATCHES = 12
MIXED = 1.2
"""Ratio of spreads (between chains and within) beyond which the draws are not those of one distribution."""


@dataclass(frozen=True)
class Question:
    """What is asked of a scan.

    Parameters
    ----------
    columns : Columns
        The model.
    rows : Rows
        Force harmonics in use.
    followed : Followed
        The lever.
    prior : Prior
        Of every material.
    even : bool
        Whether every ratio of forces of adhesion between its bounds is alike beforehand.
    """

    columns: Columns
    rows: Rows
    followed: Followed
    prior: Prior
    even: bool = False

    @property
    def sticky(self) -> bool:
        """Whether the model has adhesion."""
        return bool(adhesive(self.columns))

    @property
    def loss(self) -> bool:
        """Whether it has loss."""
        return self.columns.loss > 0.0

    def scene(
        self, centre: _Floats, precision: _Floats, amplitude: _Floats, unit: float, references: Sequence[int]
    ) -> Scene:
        """Return data as kernels take them; ``amplitude`` is (material, scan)."""
        bare = Followed(self.followed.tip, self.followed.omega, np.empty(0, np.int64), self.followed.nodes)
        return Scene(
            self.columns,
            self.rows.orders,
            self.rows.lossy,
            np.ascontiguousarray(amplitude),
            bare,
            unit,
            np.ascontiguousarray(centre),
            np.ascontiguousarray(precision),
            np.array(list(references), np.int64),
            self.even,
        )


@dataclass(frozen=True)
class Draws:
    """Draws from the posterior of the materials of a scan.

    Parameters
    ----------
    ln_E : array (draw, material)
        At the nominal tip radius.
    unknowns : array (draw, material, unknown)
        As `overtone.population.forward` orders them.
    forces : array (draw, datum)
        Harmonics in units.
    z : array (draw, source)
        What the calibration left open.
    mixing : array (material,)
        Spread of the chains together over that within each; 1 where they agree.
    accepted : float
        Share of the proposals.
    scene : Scene
        What they were drawn from.
    """

    ln_E: _Floats
    unknowns: _Floats
    forces: _Floats
    z: _Floats
    mixing: _Floats
    accepted: float
    scene: Scene


@dataclass(frozen=True)
class Alone:
    """The posterior of one material by itself along ln E.

    Parameters
    ----------
    ln_E : array (node,)
        Rising.
    density, below : array (node,)
        Of ln E, and its integral.
    unknowns : array (node, unknown)
        Where the others are best.
    """

    ln_E: _Floats
    density: _Floats
    below: _Floats
    unknowns: _Floats

    def quantile(self, share: float) -> float:
        """Return ln E below which a share lies."""
        return float(np.interp(share, self.below, self.ln_E))

    def at(self, share: float) -> tuple[float, _Floats]:
        """Return ln E below which a share lies, with the other unknowns there."""
        x = self.quantile(share)
        return x, np.array([np.interp(x, self.ln_E, column) for column in self.unknowns.T])


_Walked = tuple[_Floats, _Floats, _Floats, float]


@dataclass
class _Chain:
    """Where a chain is, its stride, and the legs it has walked."""

    x: _Floats
    v: _Floats
    stride: float
    legs: list[_Walked]


def profiles_of(
    question: Question,
    evidence: Evidence,
    amplitude: _Floats,
    known: Sequence[Known],
    before: Sequence[Alone] = (),
) -> list[Alone] | None:
    """Return the posterior of each material by itself; None where one has no start: the model cannot make its forces.

    Parameters
    ----------
    question : Question
        Model, harmonics, lever, priors.
    evidence : Evidence
        What was measured, materials in the order of ``amplitude``.
    amplitude : array (material, scan)
        Of the tip [m].
    known : sequence of Known
        As the evidence has them.
    before : sequence of Alone
        An earlier answer, from which the search begins as well.
    """
    materials, scans = amplitude.shape
    size = question.rows.orders.size * scans

    def of(k: int) -> Alone | None:
        mine = [*range(k * size, (k + 1) * size)]
        facts = [j for j, fact in enumerate(known) if fact.material == k]
        mine += [materials * size + j for j in facts]
        alone = question.scene(
            evidence.centre[mine],
            inverse(evidence.covariance[np.ix_(mine, mine)]),
            amplitude[k : k + 1],
            evidence.unit,
            [0] * len(facts),
        )
        return _profile_of(question, alone, before[k].at(0.5) if before else None)

    with ThreadPoolExecutor(_AT_ONCE) as threads:
        found = list(threads.map(of, range(materials)))
    parts = [part for part in found if part is not None]
    return parts if len(parts) == materials else None


def draw_materials(
    question: Question,
    evidence: Evidence,
    amplitude: _Floats,
    known: Sequence[Known],
    parts: Sequence[Alone],
    seed: int,
) -> Draws:
    """Return draws from the posterior of all materials; arguments as `profiles_of` has them, and its answer."""
    materials, scans = amplitude.shape
    each = FIRST_DEPTH + scans
    scene = question.scene(
        evidence.centre, evidence.precision, amplitude, evidence.unit, [fact.material for fact in known]
    )
    generators = np.random.default_rng(seed).spawn(CHAINS + 1)
    rows = evidence.centre.size
    common = (scene, question.prior, question.sticky, question.loss)

    def begin(index: int) -> _Chain:
        generator = generators[index]
        # each chain begins on a summit of its own: one and the same, unless there are several
        best, x0, v0 = -math.inf, np.zeros(materials), np.zeros((materials, each))
        for attempt in range(_ATTEMPTS):
            shares = np.full(materials, 0.5)
            if attempt > 0:
                shares = np.asarray(generator.uniform(0.05, 0.95, materials))
            starts = [part.at(share) for part, share in zip(parts, shares, strict=True)]
            x_start = np.array([start[0] for start in starts])
            v_start = np.stack([start[1] for start in starts])
            height = climb(*common, x_start, v_start, np.empty((materials, materials)))
            if height > best + 0.1 or attempt == 0:
                best, x0, v0 = height, x_start, v_start
        chain = _Chain(x0, v0, _STRIDE, [])
        for _ in range(_ROUNDS):
            share = go_on(index, chain, _ADAPTING)[3]
            chain.stride = float(np.clip(chain.stride * np.exp(2.0 * (share - _AIM)), 0.02, 1.5))
        return chain

    def go_on(index: int, chain: _Chain, steps: int) -> _Walked:
        normals = generators[index].standard_normal((steps, materials * (each + 1)))
        uniforms = generators[index].uniform(size=steps)
        x, v, f = np.empty((steps, materials)), np.empty((steps, materials, each)), np.empty((steps, rows))
        share = walk(*common, chain.stride, chain.x, chain.v, normals, uniforms, x, v, f)
        return x, v, f, share

    with ThreadPoolExecutor(CHAINS) as threads:
        chains = list(threads.map(begin, range(CHAINS)))
        for _ in range(_MOST_LEGS):
            for chain, leg in zip(
                chains, threads.map(lambda i: go_on(i, chains[i], _LEG), range(CHAINS)), strict=True
            ):
                chain.legs.append(leg)
            # the first legs lead to where the draws are to be had
            kept = [chain.legs[len(chain.legs) // 3 :] for chain in chains]
            x = np.stack([np.concatenate([leg[0] for leg in legs]) for legs in kept])
            within = x.var(axis=1).mean(axis=0)
            between = x.mean(axis=1).var(axis=0, ddof=1)
            mixing = np.sqrt(1.0 + between / np.maximum(within, 1e-300))
            enough = _independent(x)
            # draws that hang together agree with each other, and with nothing else
            mixing = np.where(enough < _FEWEST_DRAWS, math.inf, mixing)
            if (mixing < _WELL_MIXED).all() and (enough > _ENOUGH_DRAWS).all():
                break
    some = np.linspace(0, x.shape[1] - 1, _KEPT).astype(int)
    ln_E, v, f = (
        np.concatenate([np.concatenate([leg[i] for leg in legs])[some] for legs in kept]) for i in range(3)
    )
    normals = generators[-1].standard_normal((len(ln_E), evidence.z_precision.shape[0]))
    return Draws(
        ln_E,
        v,
        f,
        z_given(evidence, f, normals),
        mixing,
        float(np.mean([leg[3] for legs in kept for leg in legs])),
        scene,
    )


def _independent(x: _Floats) -> _Floats:
    """Return how many independent draws chains (chain, step, material) are worth, from the means of batches."""
    chains, steps, materials = x.shape
    length = steps // _BATCHES
    batches = x[:, : length * _BATCHES].reshape(chains, _BATCHES, length, materials)
    whole = x.reshape(-1, materials).var(axis=0)
    of_means = batches.mean(axis=2).var(axis=1, ddof=1).mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = chains * _BATCHES * whole / of_means
    return np.where(whole > 0.0, np.minimum(found, chains * steps), 0.0)


def _profile_of(question: Question, alone: Scene, hint: tuple[float, _Floats] | None = None) -> Alone | None:
    """Return nodes of ln E of a material alone, density, its integral and the other unknowns; None without a start."""
    each = FIRST_DEPTH + alone.amplitude.shape[1]
    ln_E, v, chi2 = np.empty(_PLACES.size), np.empty((_PLACES.size, each)), np.empty(_PLACES.size)
    rows = alone.orders.size
    first = alone._replace(
        amplitude=np.ascontiguousarray(alone.amplitude[:, :1]),
        centre=alone.centre[:rows].copy(),
        precision=inverse(inverse(alone.precision)[:rows, :rows]),
        references=np.empty(0, np.int64),
    )
    starts_of_material(first, question.sticky, question.loss, ln_E, v, chi2, _PLACES)
    prior = question.prior
    inside = np.isfinite(chi2) & (ln_E > prior.log_low) & (ln_E < prior.log_high)
    if not inside.any() and hint is None:
        return None
    chi2 = np.where(inside, chi2, math.inf)
    padded = np.concatenate([[math.inf], chi2, [math.inf]])
    lowest = np.flatnonzero(inside & (chi2 <= padded[:-2]) & (chi2 <= padded[2:]))
    lowest = lowest[np.argsort(chi2[lowest])]
    summits: list[tuple[float, float, _Floats]] = []
    starts = [(float(ln_E[i]), v[i]) for i in lowest[:_VALLEYS] if chi2[i] <= chi2[lowest[0]] + _WORSE]
    for start, unknowns in ([hint] if hint is not None else []) + starts:
        top, others = np.array([start]), unknowns[None].copy()
        height = climb(alone, prior, question.sticky, question.loss, top, others, np.empty((1, 1)))
        if math.isfinite(height):
            summits.append((height, float(top[0]), others[0]))
    nodes: list[tuple[_Floats, _Floats, _Floats]] = []
    for height, start, others in sorted(summits, key=lambda summit: -summit[0]):
        if height < max(summit[0] for summit in summits) - _LOWER:
            continue
        if any(part[0].min() - 0.1 <= start <= part[0].max() + 0.1 for part in nodes):
            continue
        x, mass = np.empty(2 * MOST_NODES + 2), np.empty(2 * MOST_NODES + 2)
        along = np.empty((2 * MOST_NODES + 2, each))
        count = profile(alone, prior, question.sticky, question.loss, start, others, x, mass, along)
        if count > 2:
            nodes.append((x[:count], mass[:count], along[:count]))
    if not nodes:
        return None
    x, mass, unknowns = (np.concatenate([part[i] for part in nodes]) for i in range(3))
    order = np.argsort(x, kind="stable")
    x, mass, unknowns = x[order], mass[order], unknowns[order]
    fresh = np.concatenate([[True], np.diff(x) > 1e-9])
    x, mass, unknowns = x[fresh], mass[fresh], unknowns[fresh]
    density = np.exp(mass - mass.max())
    steps = 0.5 * (density[1:] + density[:-1]) * np.diff(x)
    below = np.concatenate([[0.0], np.cumsum(steps)])
    return Alone(x, density / below[-1], below / below[-1], unknowns)

"""Every steady state at given heights: the branches of the first harmonic, refined with the higher ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.contact.law import Law
from overtone.contact.sample import Sample
from overtone.dynamics.balance import (
    EXTRAS,
    FOUND,
    HOLD_HEIGHT,
    NO_STATE,
    NOT_CONVERGED,
    Lever,
    balance,
    balance_block,
)
from overtone.dynamics.folds import find_fold, walk_to_height
from overtone.dynamics.manifold import Arc, arcs
from overtone.dynamics.stability import is_stable
from overtone.dynamics.states import Motions, sample_dims, states_dataset
from overtone.dynamics.system import Laws, laws, setup
from overtone.errors import OvertoneError
from overtone.probe import Probe, format_probe
from overtone.quantities import named_variable

_BLOCK = 8  # states a thread takes at a time
_NEAR = 0.02  # of the free amplitude: folds this far outside the heights wanted are looked for
_INSIDE = (0.003, 0.01, 0.03, 0.1)  # of the free amplitude or the branch: where a fold is started from
_SHORTEST_WALK = 1e-4  # of the free amplitude: a state this far from a fold is walked to in eight steps
_SAME = 1e-9  # of the free amplitude: two states nearer than this are one

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class Fold(NamedTuple):
    """Where two branches meet and end."""

    x: _Floats
    b: _Complex


class Branch(NamedTuple):
    """An arc of the first harmonic with the folds of the full motion at its ends, None where it has none."""

    arc: Arc
    low: Fold | None
    high: Fold | None

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest height [m]."""
        return (
            float(self.low.x[3]) if self.low else float(self.arc.height[0]),
            float(self.high.x[3]) if self.high else float(self.arc.height[-1]),
        )


def branches(all_laws: Laws, point: int, lever: Lever, heights: tuple[float, float]) -> list[Branch]:
    """Return the branches that reach into a range of heights [m], the highest first."""
    law = all_laws.at(point)
    free = abs(lever.tip[1]) * lever.force
    found = arcs(law, lever, heights, float(all_laws.pull[point]))
    margin = _NEAR * free
    found = [
        arc for arc in found if arc.height[0] < heights[1] + margin and arc.height[-1] > heights[0] - margin
    ]
    # two arcs share a fold: look for it once, and for all of them on all cores
    meeting: dict[tuple[float, float], list[tuple[Arc, bool]]] = {}
    for arc in found:
        for last in (False, True):
            if arc.folds[last]:
                meeting.setdefault(arc.fold_at(last), []).append((arc, last))
    jobs = list(meeting.items())
    folds: dict[tuple[float, float], Fold | None] = {}

    def search(part: slice) -> None:
        for key, sides in jobs[part]:
            tries = (_fold(arc, last, lever, law) for arc, last in sides)
            folds[key] = next((fold for fold in tries if fold is not None), None)

    run_blocks(search, len(jobs), 1)
    result = []
    for arc in found:
        low, high = (folds[arc.fold_at(last)] if arc.folds[last] else None for last in (False, True))
        result.append(Branch(arc, low, high))
    return result


def _fold(arc: Arc, last: bool, lever: Lever, law: Law) -> Fold | None:
    """Find the fold of the full motion next to the end of an arc, from a state of the full motion inside it."""
    k = -1 if last else 0
    free = abs(lever.tip[1]) * lever.force
    for inside in _INSIDE:
        height = arc.height[k] + (-inside if last else inside) * min(free, np.ptp(arc.height))
        x = _seeds(Branch(arc, None, None), np.array([height]))[0]
        b, f, extras = np.zeros_like(lever.tip), np.empty_like(lever.tip), np.empty(EXTRAS)
        held = np.array([HOLD_HEIGHT, height, 0.0, 0.0])
        if balance(x, b, held, lever, law, f, extras)[0] != FOUND:
            continue
        along = np.array([arc.gap[k], arc.amplitude[k]]) - x[:2]
        step = float(np.hypot(*along))
        if step > 0.0 and find_fold(x, b, along / step, 0.3 * step, last, lever, law, f, extras) == FOUND:
            return Fold(x, b)
    return None


def states_on(found: Sequence[Branch], heights: _Floats, lever: Lever, law: Law) -> Motions:
    """Return the states (height, branch)."""
    states = Motions.missing((heights.size, len(found)), lever.tip.size)
    inside = np.zeros(states.status.shape, bool)
    for j, branch in enumerate(found):
        low, high = branch.ends
        inside[:, j] = (heights >= low) & (heights <= high)
        states.x[inside[:, j], j] = _seeds(branch, heights[inside[:, j]])
    _solve(states, inside, heights, lever, law)
    free = abs(lever.tip[1]) * lever.force
    off = np.full(inside.shape, np.inf)
    for j, branch in enumerate(found):
        off[:, j], near = _distance(states.x[:, j], _seeds(branch, heights), free)
        states.status[inside[:, j] & ~near, j] = NOT_CONVERGED
    _tell_apart(states, off, free)
    for j, branch in enumerate(found):
        for i in np.flatnonzero(inside[:, j] & (states.status[:, j] == NOT_CONVERGED)):
            _walk(states, int(i), j, heights, branch, lever, law, free)
    return states


def _distance(x: _Floats, seeds: _Floats, free: float) -> tuple[_Floats, npt.NDArray[np.bool_]]:
    """Return how far states are from where they began [m], and whether that is near enough to be theirs."""
    off = np.abs(x[..., :2] - seeds[..., :2]).max(axis=-1)
    return off, np.asarray(off < 0.05 * free + 0.3 * seeds[..., 1])


def _tell_apart(states: Motions, off: _Floats, free: float) -> None:
    """Call a state not converged where another branch has the same one and began nearer to it."""
    status, x = states.status, states.x
    for i in range(status.shape[1]):
        for j in range(i + 1, status.shape[1]):
            both = (status[:, i] == FOUND) & (status[:, j] == FOUND)
            same = both & (np.abs(x[:, i, :2] - x[:, j, :2]).max(axis=1) < _SAME * free)
            farther = off[:, i] > off[:, j]
            status[same & farther, i] = NOT_CONVERGED
            status[same & ~farther, j] = NOT_CONVERGED


def _solve(states: Motions, where: npt.NDArray[np.bool_], heights: _Floats, lever: Lever, law: Law) -> None:
    """Solve the balance at the heights (height, branch) where wanted, in place and on all cores."""
    some = states.at(where)
    held = np.zeros((len(some.status), 4))
    held[:, 0], held[:, 1] = HOLD_HEIGHT, np.broadcast_to(heights[:, None], where.shape)[where]
    signs = np.zeros(len(held))

    def block(part: slice) -> None:
        x, b, f, extras, status = some.at(part)
        balance_block(x, b, held[part], lever, law, f, extras, status, signs[part])

    run_blocks(block, len(held), _BLOCK)
    states.put(where, some)


def _seeds(branch: Branch, heights: _Floats) -> _Floats:
    """Return states (height, 4) on the arc of a branch, its ends stretched to the folds of the full motion.

    Next to a fold a state changes as the root of the distance to it, so the arc is read over an angle.
    """
    arc, (low, high) = branch.arc, branch.ends
    span = max(high - low, 1e-300)

    def angle(fraction: _Floats) -> _Floats:
        return np.asarray(np.arcsin(np.sqrt(np.clip(fraction, 0.0, 1.0))))

    own = angle((arc.height - arc.height[0]) / (arc.height[-1] - arc.height[0]))
    wanted = angle((heights - low) / span)
    x = np.stack([np.interp(wanted, own, y) for y in (arc.gap, arc.amplitude, arc.phase)], axis=1)
    return np.concatenate([x, heights[:, None]], axis=1)


def _walk(
    states: Motions, i: int, j: int, heights: _Floats, branch: Branch, lever: Lever, law: Law, free: float
) -> None:
    """Find a state that was missed by stepping to it along the branch, from a neighbour or a fold, in place."""
    arc, height = branch.arc, float(heights[i])
    seed = _seeds(branch, heights[i : i + 1])[0]
    starts = []
    for fold, end, inner in ((branch.low, 0, 1), (branch.high, -1, -2)):
        if fold is not None:
            away = np.array([arc.gap[inner] - arc.gap[end], arc.amplitude[inner] - arc.amplitude[end]])
            # the full motion may leave its fold the other way
            starts += [(fold.x, fold.b, away), (fold.x, fold.b, -away)]
    good = np.flatnonzero(states.status[:, j] == FOUND)
    if good.size:
        near = good[np.argmin(np.abs(heights[good] - height))]
        starts.append((states.x[near, j], states.b[near, j], seed[:2] - states.x[near, j, :2]))
    others = states.x[i, states.status[i] == FOUND, :2]
    starts.sort(key=lambda start: abs(float(start[0][3]) - height))
    for start, motion, towards in starts:
        x, b = start.copy(), motion.copy()
        size = float(np.hypot(*towards))
        if not size > 0.0:
            continue
        length = max(float(np.hypot(*(seed[:2] - x[:2]))), _SHORTEST_WALK * free)
        along, where = towards / size, (i, j)
        reached, _ = walk_to_height(
            x, b, along, length, height, lever, law, states.f[where], states.extras[where]
        )
        new = not (np.abs(others - x[:2]).max(axis=-1) < _SAME * free).any()
        if reached == FOUND and new and _distance(x, seed, free)[1]:
            states.x[where], states.b[where], states.status[where] = x, b, FOUND
            return


def checked_heights(z: Any) -> _Floats:
    """Return heights as an array of one dimension.

    Raises
    ------
    OvertoneError
        If there are none, or if one is not a finite number.
    """
    try:
        heights = np.atleast_1d(np.asarray(z, dtype=float))
    except (TypeError, ValueError) as error:
        raise OvertoneError("heights are not numbers", expected="values of Z [m]", got=repr(z)) from error
    if heights.ndim != 1 or heights.size == 0:
        raise OvertoneError(
            "no heights", expected="one or more values of Z in a row [m]", got=str(heights.shape)
        )
    if not np.isfinite(heights).all():
        raise OvertoneError("heights are not finite", got=str(heights[~np.isfinite(heights)][0]))
    return heights


def check_range(heights: _Floats, probe: Probe) -> None:
    """Refuse heights that are metres in nanometres or the like.

    Raises
    ------
    OvertoneError
        If a height is beyond a thousand free amplitudes.
    """
    reach = 1000.0 * probe.drive.free_amplitude
    if (np.abs(heights) > reach).any():
        raise OvertoneError(
            "heights are out of reach",
            expected=f"values of Z within {reach * 1e6:.3g} um of the surface, a thousand free amplitudes",
            got=f"{heights[np.argmax(np.abs(heights))]:g} m",
            hint="Z in metres: 80e-9 for 80 nm",
        )


def steady_states(
    probe: Probe | Sequence[Probe],
    sample: Sample,
    *,
    z: Any,
    n_max: int = 10,
    keep: int = 3,
    dims: tuple[str, ...] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return every steady state at given heights: all branches, stable and unstable.

    Parameters
    ----------
    probe : Probe or sequence of Probe
        Any number of modes, any drive frequency, driven at tip or base. A sequence adds a first dimension
        ``probe``.
    sample : Sample
        A material of any model that can be simulated, or arrays of materials.
    z : array (z,)
        Heights Z of the base above the surface [m]: the gap of a lever at rest that feels no force.
    n_max : int
        Harmonics of the motion that act back on the force, ``keep`` at least; 10 gives A2 to 5e-5 and A3 to
        1e-4, 20 to 2e-6.
    keep : int
        Harmonics in the result.
    dims : tuple of str, optional
        Dimension names of the sample's arrays.
    progress : callable, optional
        Called with (materials done, materials in all).

    Returns
    -------
    Dataset
        Over the dimensions of the sample, ``z`` and ``branch``: observables as the detector reads them,
        ``F_cons`` and ``F_diss`` [N], ``indentation`` [m], ``contact_time`` (share of a period),
        ``peak_force``, ``pull_force`` [N], ``dissipation``, ``virial`` [J], ``stable`` and ``state``. A branch
        is a stretch between two folds; where it does not exist ``state`` is ``no_state`` and the rest NaN.
        ``not_converged`` and ``touches_more_than_once`` say why a state is missing that ought to be there.

    Raises
    ------
    OvertoneError
        If there are no heights, if one is not finite or out of reach, or n_max or keep are out of range.
    ContactModelError
        If the model's force cannot be followed (a relaxing solid).

    Notes
    -----
    States with the period of the drive that touch the surface once a period. Branches are found from the first
    harmonic, on a grid of amplitude and closest gap that is a few per cent wide, and refined with the higher
    ones; a branch that owes its existence to higher harmonics, or a pair of folds nearer to each other than
    the grid, may be missed, and so may small amplitudes in deep contact of levers of low Q. A contact with
    hysteresis is taken as held only if the motion itself makes it: the states of a neck that was made once and
    is only stretched and never broken since are not among the branches.

    Sources: theory of harmonic balance as in Shaik, Reifenberger and Raman, Nanotechnology 31 (2020) 455502,
    eqs 1 to 5, with every harmonic of the motion kept instead of eq 10.

    Examples
    --------
    >>> import overtone as ot
    >>> probe = ot.Probe.simple(stiffness=26, frequency=303e3, quality_factor=456, radius=10e-9,
    ...                         drive_frequency=303e3, free_amplitude=85e-9)
    >>> states = steady_states(probe, ot.sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9), z=78e-9)
    >>> [round(float(A) * 1e9, 2) for A in states.A1.squeeze("z")]
    [78.8, 82.49, 80.52]
    >>> states.stable.values.ravel().tolist()
    [True, True, False]
    """
    if not isinstance(probe, Probe):
        each = [
            steady_states(p, sample, z=z, n_max=n_max, keep=keep, dims=dims, progress=progress) for p in probe
        ]
        if not each:
            raise OvertoneError("no probes", expected="one or more")
        most = max(states.sizes["branch"] for states in each)
        filler = {"state": NO_STATE, "stable": False}
        even = [
            states.pad(branch=(0, most - states.sizes["branch"]), constant_values=filler) for states in each
        ]
        result = xr.concat(even, dim="probe")
        return result.assign_attrs(each[0].attrs)
    heights = checked_heights(z)
    check_range(heights, probe)
    check_orders(n_max, keep)
    all_laws = laws(probe, sample)
    device = setup(probe, max(n_max, keep))
    points = all_laws.table.shape[0]
    parts = []
    for point in range(points):
        found = branches(all_laws, point, device.lever, (float(heights.min()), float(heights.max())))
        parts.append(states_on(found, heights, device.lever, all_laws.at(point)))
        if progress is not None:
            progress(point + 1, points)
    states = _side_by_side(parts, device.lever.tip.size)
    stable = is_stable(device, all_laws, states)
    wide = (*sample.shape, *states.status.shape[1:])
    along = (*sample_dims(sample.shape, dims), "z", "branch")
    coords = {"z": ("z", heights, {"units": "m", "long_name": "height of the base"})}
    result = states_dataset(device, states.reshaped(wide), along, coords, keep)
    result["stable"] = named_variable("stable", stable.reshape(wide), along)
    return provenance.record(
        result, "steady_states", probe=format_probe(probe), model=sample.model.key, n_max=max(n_max, keep)
    )


def _side_by_side(parts: Sequence[Motions], orders: int) -> Motions:
    """Return states (point, height, branch) of points with different numbers of branches, empty ones left out."""
    most = max(1, *(part.status.shape[1] for part in parts))
    states = Motions.missing((len(parts), parts[0].status.shape[0], most), orders)
    for point, part in enumerate(parts):
        states.put((point, slice(None), slice(part.status.shape[1])), part)
    used = np.flatnonzero((states.status != NO_STATE).any(axis=(0, 1)))
    return states.at((slice(None), slice(None), used if used.size else [0]))


def check_orders(n_max: int, keep: int) -> None:
    """Refuse numbers of harmonics that make no sense.

    Raises
    ------
    OvertoneError
        If n_max is not between 1 and 200 or keep is below 1.
    """
    if not 1 <= n_max <= 200 or keep < 1:
        raise OvertoneError(
            "numbers of harmonics are out of range",
            expected="1 <= n_max <= 200 and keep >= 1",
            got=f"n_max = {n_max}, keep = {keep}",
        )

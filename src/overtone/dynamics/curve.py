"""Approach curves: the states that a sweep of the base goes through, there and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample
from overtone.dynamics.balance import LOWEST
from overtone.dynamics.stability import is_stable, motion_in
from overtone.dynamics.states import Motions, sample_dims, states_dataset
from overtone.dynamics.steady import branches, check_orders, check_range, checked_heights, states_on
from overtone.dynamics.system import Laws, Setup, laws, setup
from overtone.dynamics.transient import settle, sweep
from overtone.errors import OvertoneError
from overtone.probe import Probe, format_probe
from overtone.quantities import named_variable

_METHODS = ("steady", "transient")
_BAND = 0.1  # of the drive frequency
DIRECTIONS = ("approach", "retract")

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class _Follower:
    """The branches of one material, solved when a sweep comes to them."""

    def __init__(self, device: Setup, all_laws: Laws, sample: Sample, point: int, heights: _Floats) -> None:
        self.device, self.lever, self.heights = device, device.lever, heights
        self.sample = Sample(
            sample.model, {name: value.ravel()[point] for name, value in sample.values.items()}
        )
        self.laws = all_laws.only([point])
        between = float(heights.min()), float(heights.max())
        self.branches = branches(self.laws, 0, self.lever, between)
        self._solved: dict[int, tuple[Motions, npt.NDArray[np.bool_]]] = {}

    def states(self, branch: int) -> tuple[Motions, npt.NDArray[np.bool_]]:
        """Return the states of a branch at every height, and whether a motion stays in them."""
        if branch not in self._solved:
            found = states_on([self.branches[branch]], self.heights, self.lever, self.laws.at(0))
            stable = is_stable(self.device, self.laws, found.at(None))
            self._solved[branch] = found.at((slice(None), 0)), stable[0, :, 0]
        return self._solved[branch]

    def holds(self, branch: int, height: int) -> bool:
        """Return whether a motion can stay on a branch at a height."""
        low, high = self.branches[branch].ends
        return low <= self.heights[height] <= high and bool(self.states(branch)[1][height])

    def next_branch(self, height: int, before: Motions | None) -> int | None:
        """Return the branch that the motion goes to at a height, from another state or from rest far away."""
        candidates = [k for k in range(len(self.branches)) if self.holds(k, height)]
        if len(candidates) < 2:
            return candidates[0] if candidates else None
        start = None  # the free motion
        if before is not None:
            start = motion_in(self.device, self.laws, before.at(None), np.zeros(1, np.intp))
        rest = settle(self.device.probe, self.sample, Z=self.heights[[height]], start=start, method="relax")
        rest = rest.isel(Z=0)
        if int(rest["state"]) != 0:
            return None
        ends = np.array([float(rest["A1"]), -float(rest["indentation"])])
        there = [self.states(k)[0] for k in candidates]
        off = [np.abs([s.x[height, 1], s.extras[height, LOWEST]] - ends).max() for s in there]
        return candidates[int(np.argmin(off))]

    def follow(self, order: npt.NDArray[np.intp], start: int | None) -> list[int | None]:
        """Return the branch at each height in an order of heights, beginning on one if it can."""
        branch, path = start, []
        before: Motions | None = None
        for height in [int(k) for k in order]:
            if branch is None or not self.holds(branch, height):
                branch = self.next_branch(height, before)
            path.append(branch)
            if branch is not None:
                before = self.states(branch)[0].at(height)
        return path


def approach_curve(
    probe: Probe,
    sample: Sample,
    *,
    z: Any,
    method: str = "steady",
    speed: float | None = None,
    bandwidth: float | None = None,
    n_max: int = 10,
    keep: int = 3,
    dims: tuple[str, ...] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return what a sweep of the base towards the sample and back goes through.

    Parameters
    ----------
    probe : Probe
        Any number of modes, any drive frequency, driven at tip or base.
    sample : Sample
        A material, or for ``steady`` arrays of materials.
    z : array (z,)
        Heights Z of the base [m], in any order; the sweep begins at the highest, in the state of a tip that
        came from far away.
    method : str
        ``steady``: infinitely slow, by harmonic balance; the motion stays on its branch to the fold and jumps.
        ``transient``: time integration at a speed, read through a lock-in.
    speed : float, for ``transient``
        Of the base [m/s].
    bandwidth : float, for ``transient``
        Of the lock-in [Hz]; a tenth of the drive frequency unless given.
    n_max, keep : int
        Harmonics of the motion that act back on the force (``steady``), and harmonics in the result.
    dims : tuple of str, optional
        Dimension names of the sample's arrays.
    progress : callable, optional
        Called with (done, all).

    Returns
    -------
    Dataset
        Over the dimensions of the sample, ``direction`` (approach, retract) and ``z`` (falling): what
        `steady_states` has, and for ``steady`` also ``jump``: whether the motion jumped since the height before.

    Raises
    ------
    OvertoneError
        If there are no heights or they are out of reach, the method is unknown, or a transient sweep lacks a
        speed.

    Notes
    -----
    At the end of a branch the motion goes to the only other stable state, and where there are several to the
    one in which time integration from the last state ends.
    """
    heights = np.unique(checked_heights(z))[::-1]
    check_range(heights, probe)
    check_orders(n_max, keep)
    if method not in _METHODS:
        raise OvertoneError(
            "unknown method of an approach curve", expected=" or ".join(_METHODS), got=repr(method)
        )
    if method == "transient":
        return _transient(probe, sample, heights, speed, bandwidth, keep, progress)
    if speed is not None or bandwidth is not None:
        raise OvertoneError(
            "a steady approach curve has no speed and no bandwidth",
            hint='method="transient" for a sweep in time',
        )
    all_laws = laws(probe, sample)
    device = setup(probe, max(n_max, keep))
    points, size = all_laws.table.shape[0], heights.size
    states = Motions.missing((points, 2, size), device.lever.tip.size)
    jump = np.zeros((points, 2, size), bool)
    for point in range(points):
        follower = _Follower(device, all_laws, sample, point, heights)
        down = np.arange(size)
        there = follower.follow(down, None)
        back = follower.follow(down[::-1], there[-1])
        for direction, (path, order) in enumerate(((there, down), (back, down[::-1]))):
            for step, (branch, height) in enumerate(zip(path, order, strict=True)):
                before = path[step - 1] if step else None
                jump[point, direction, height] = None not in (before, branch) and branch != before
                if branch is not None:
                    states.put((point, direction, height), follower.states(branch)[0].at(height))
        if progress is not None:
            progress(point + 1, points)
    wide = (*sample.shape, 2, size)
    along = (*sample_dims(sample.shape, dims), "direction", "z")
    coords = {
        "direction": ("direction", list(DIRECTIONS)),
        "z": ("z", heights, {"units": "m", "long_name": "height of the base"}),
    }
    curve = states_dataset(device, states.reshaped(wide), along, coords, keep)
    curve["jump"] = named_variable("jump", jump.reshape(wide), along)
    return provenance.record(
        curve, "approach_curve", probe=format_probe(probe), model=sample.model.key, method=method, n_max=n_max
    )


def _transient(
    probe: Probe,
    sample: Sample,
    heights: _Floats,
    speed: float | None,
    bandwidth: float | None,
    keep: int,
    progress: Callable[[int, int], None] | None,
) -> xr.Dataset:
    """Sweep down and up in time; the start of the way back is the end of the way there."""
    if sample.shape:
        raise OvertoneError(
            "a transient approach curve takes one material",
            got=f"arrays of shape {sample.shape}",
            hint='one call for each, or method="steady"',
        )
    if speed is None:
        raise OvertoneError(
            "a transient approach curve needs a speed",
            expected="speed of the base [m/s]",
            hint="speed=100e-9",
        )
    band = bandwidth if bandwidth is not None else _BAND * probe.drive.frequency
    there, end = sweep(probe, sample, z=heights, speed=speed, bandwidth=band, n_max=keep, progress=progress)
    back, _ = sweep(
        probe, sample, z=heights[::-1], speed=speed, bandwidth=band, n_max=keep, start=end, progress=progress
    )
    curve = xr.concat([there, back.sel(z=heights)], dim="direction", combine_attrs="override")
    curve = curve.assign_coords(direction=list(DIRECTIONS))
    return provenance.record(
        curve,
        "approach_curve",
        probe=format_probe(probe),
        model=sample.model.key,
        method="transient",
        speed=speed,
    )

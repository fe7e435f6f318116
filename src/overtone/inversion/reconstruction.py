"""The force over the gap from an approach curve, without a contact model.

On the motion ``d = D + A (1 + cos theta)``, D the closest gap, the first force harmonic of all amplitudes is
inverted by the formula of Sader and Jarvis, Appl. Phys. Lett. 84 (2004) 1801. Their frequency shift is
``Omega = -CONS_1/(2 k A)``; the stiffness drops out of ``W = 2 k Omega = -CONS_1/A``:

    F(D) = int_D^oo { [1 + sqrt(A)/(8 sqrt(pi (t - D)))] W - d(A^(3/2) W)/dt / sqrt(2 (t - D)) } dt

with A inside the derivative, because ``sqrt(A) CONS_1`` is what depends on the gap alone where the force is
short of range. The mean force has the same limit, so that Abel's inversion of A0 is a second, independent force:

    F(D) = -1/pi int_D^oo d(pi sqrt(2 A) CONS_0)/dt / sqrt(t - D) dt

and a damping ``F = -Gamma(d) d'`` follows from DISS_1 as Sader et al., Nanotechnology 16 (2005) S94, derive it:
``Gamma = -1/w dS/dD``, S the first formula with ``W = DISS_1/A``.

These formulas are good to some per cent on a bare cosine, and the tip does not move on one: where the lever is soft
against the contact its higher harmonics move the closest gap and the force by ten per cent. So the formulas serve
as approximate inverses in an iteration: the force found is put on the motion that it makes, with the higher
harmonics that the lever answers, and what its harmonics lack of those measured is inverted and added.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.errors import CurveWarning, InversionError
from overtone.harmonics import (
    ATTRACTIVE,
    REGIME_FLAGS,
    REPULSIVE,
    read_receptance,
    tip_receptance,
    to_force_harmonics,
)
from overtone.inversion.approach import FEWEST, Curve, rows_in_order, scatter_of, single_line, uninterrupted
from overtone.inversion.half_integrals import cubics, half_integrals, on_motion
from overtone.probe import Probe, format_probe
from overtone.quantities import named_array
from overtone.units import format_quantity

RECONSTRUCTED, BEYOND_JUMP, FAR_END = 0, 1, 2
_STATUS_FLAGS = {
    "flag_values": [RECONSTRUCTED, BEYOND_JUMP, FAR_END],
    "flag_meanings": "reconstructed beyond_a_jump rests_on_the_far_end",
}

_POOLED_SIGMA = 2.0
_NEGLIGIBLE = 0.01
_ROUNDS, _SLOW, _CLOSED = 12, 0.9, 1e-5
_MOST_HARMONICS = 60
_BLOCK = 16

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class _Lever:
    """What the inversion needs of the probe."""

    tip: _Complex
    """G_tip at 0, w, 2 w, ..."""
    speed: float
    """Angular drive frequency [rad/s]."""
    reads_mean: bool
    """Whether A0 was measured."""


def _prepared(line: xr.Dataset, height: _Floats, probe: Probe, lever: _Lever, findings: list[str]) -> Curve:
    """Return the curve with what the inversion starts from: force harmonics over ``Z + A0 - A1``."""
    force = to_force_harmonics(line, probe)
    cons, diss = (force[name].sel(harmonic=1).values for name in ("F_cons", "F_diss"))
    if lever.reads_mean:
        mean = force["F_cons"].sel(harmonic=0).values
    else:
        mean = -cons / 2.0
        findings.append(
            "A0 was not measured. The mean deflection in the gap is the one that the force implies (by the formulas "
            "alone: half of the first force harmonic, the limit of a short contact)."
        )
    amplitude = line["A1"].values
    nothing = np.zeros_like(amplitude)
    return Curve(
        base=height - amplitude,
        height=height,
        amplitude=amplitude,
        cons=cons,
        diss=diss,
        mean=mean,
        gap=height - amplitude + lever.tip[0].real * mean,
        force=nothing,
        mean_force=nothing,
        damping=nothing,
        heat=nothing,
        motion=np.zeros((amplitude.size, lever.tip.size)),
        count=np.ones_like(amplitude),
        stretch=np.zeros(amplitude.size, np.int64),
    )


def _sader_jarvis(curve: Curve, cons: _Floats) -> _Floats:
    A, t, hole = curve.amplitude, curve.gap, curve.hole
    W = -cons / A
    result = np.empty_like(t)
    half_integrals(
        t, cubics(t, W, hole), cubics(t, np.sqrt(A) * W, hole), cubics(t, A**1.5 * W, hole), result
    )
    return result


def _abel(curve: Curve, mean: _Floats) -> _Floats:
    t = curve.gap
    g = np.pi * np.sqrt(2.0 * curve.amplitude) * mean
    nothing = np.zeros((t.size - 1, 4))
    result = np.empty_like(t)
    half_integrals(t, nothing, nothing, cubics(t, g, curve.hole), result)
    return result * math.sqrt(2.0) / math.pi  # the kernel divides by sqrt(2), Abel by pi


def _damping(curve: Curve, diss: _Floats, speed: float) -> _Floats:
    """Return the damping whose first harmonic is ``diss``: the slope of the force of ``-diss``."""
    potential = cubics(curve.gap, _sader_jarvis(curve, -diss), curve.hole)
    h = np.diff(curve.gap)
    starts = potential[:, 1]
    ends = starts + h * (2.0 * potential[:, 2] + 3.0 * h * potential[:, 3])
    # at a point the two sides agree, but for a hole
    slope = np.concatenate([starts, ends[-1:]])
    return -slope / speed


def _on_its_motion(curve: Curve, law: _Floats, damping: _Floats, speed: float) -> tuple[_Floats, _Floats]:
    """Return CONS_n (point, n) and DISS_1 that a law and a damping make on the motion of the curve."""
    cons, diss = np.empty_like(curve.motion), np.empty_like(curve.gap)
    force, loss = (cubics(curve.gap, values, curve.hole) for values in (law, damping))

    def run(rows: slice) -> None:
        on_motion(
            curve.gap, force, loss, speed, curve.amplitude, curve.motion, rows.start, rows.stop, cons, diss
        )

    run_blocks(run, curve.gap.size, _BLOCK)
    return cons, diss


def _conservative(curve: Curve, law: _Floats) -> _Floats:
    return _on_its_motion(curve, law, np.zeros_like(law), 0.0)[0]


def _set_in_motion(curve: Curve, lever: _Lever) -> Curve:
    """Return the curve over the gap of the motion that its force makes."""
    cons = _conservative(curve, curve.force)
    signs = (-1.0) ** np.arange(lever.tip.size)
    curve.motion = signs * lever.tip.real * cons
    curve.motion[:, :2] = 0.0
    if not lever.reads_mean:
        curve.mean = cons[:, 0]
    curve.gap = curve.base + lever.tip[0].real * curve.mean + curve.motion.sum(axis=1)
    # what the contact puts into the higher harmonics of the lever and the lever turns into heat
    orders = np.arange(lever.tip.size)
    curve.heat = -((orders * lever.tip.imag * cons**2)[:, 2:]).sum(axis=1) / curve.amplitude
    return curve.pooled()


def _missing(measured: _Floats, found: _Floats, amplitude: _Floats) -> _Floats:
    """Return what the harmonics of a force lack of those measured.

    What is measured at the far end comes from beyond it; the formulas take it as constant, so this does, too.
    """
    rest = measured - found
    return np.asarray(rest - rest[-1] * np.sqrt(amplitude[-1] / amplitude))


def _by_formula(curve: Curve, lever: _Lever) -> Curve:
    """Return the curve with the forces of the formulas as they are printed, on a bare cosine."""
    curve.force = _sader_jarvis(curve, curve.cons)
    curve.damping = _damping(curve, curve.diss, lever.speed)
    if lever.reads_mean:
        curve.mean_force = _abel(curve, curve.mean)
    return curve


def _closure(curve: Curve, cons: _Floats) -> float:
    """Return what the force leaves of CONS_1, as a share of it."""
    rest = _missing(curve.cons, cons[:, 1], curve.amplitude)
    return math.sqrt(np.mean(rest**2) / (np.mean(curve.cons**2) or 1.0))


def _refined(curve: Curve, lever: _Lever) -> tuple[Curve, float]:
    """Return the curve with forces whose harmonics on their own motion are those measured, and what is left."""
    best, left = curve, math.inf
    for _ in range(_ROUNDS):
        curve = _set_in_motion(curve, lever)
        cons, diss = _on_its_motion(curve, curve.force, curve.damping, lever.speed)
        closure = _closure(curve, cons)
        if not closure < _SLOW * left:
            break
        best, left = curve.take(slice(None)), closure
        if closure < _CLOSED:
            break
        A = curve.amplitude
        curve.force = curve.force + _sader_jarvis(curve, _missing(curve.cons, cons[:, 1], A))
        loss = _missing(curve.diss - curve.heat, diss, A)
        curve.damping = curve.damping + _damping(curve, loss, lever.speed)
        if lever.reads_mean:
            mean = _conservative(curve, curve.mean_force)[:, 0]
            curve.mean_force = curve.mean_force + _abel(curve, _missing(curve.mean, mean, A))
    return best, left


def reconstruct_force(
    curve: xr.Dataset,
    probe: Probe,
    *,
    refine: bool = True,
    n_max: int = 10,
    resolution: float | None = None,
) -> xr.Dataset:
    """Return the force between tip and sample over the closest gap, without a contact model.

    Parameters
    ----------
    curve : Dataset
        One approach or retract curve, simulated or measured: ``A1``, ``phi1`` and, where it was measured,
        ``A0`` [m, rad] as the detector reads them over one dimension, and there the height of the base ``Z``
        (or ``z``) [m], larger farther away. Rows in any order, unequally spaced, NaN where something is missing.
        It has to begin where the force has decayed.
    probe : Probe
        Cantilever, drive and detector; no tip radius is needed.
    refine : bool
        Put the force on the motion that it makes and correct it until its harmonics are those measured.
        False leaves the formulas of Sader and Jarvis and of Abel as they are printed, over ``Z + A0 - A1``.
    n_max : int
        Harmonics of the tip's motion that count when refining; they are those with which the lever of the probe
        answers the force, not measured ones. 1 takes the motion as a bare cosine.
    resolution : float, optional
        Rows whose gaps are closer than this [m] are averaged. Twice the scatter of the gap unless given: a
        force is a slope over the gap, and points closer than their scatter have none.

    Returns
    -------
    Dataset
        Over ``gap`` [m], the closest gap in a cycle, from the nearest to the farthest: ``force`` [N] from A1 and
        phi1; ``force_mean`` [N] from A0, where that was measured; ``damping`` [N s/m], the loss as that of
        a force -Gamma(d) d'; ``dissipation`` [J] per cycle; ``truncation`` [N], about what a force that decays
        beyond the far end would add; ``regime`` (attractive, undetermined, repulsive), ``status`` (reconstructed,
        beyond_a_jump, rests_on_the_far_end), ``A1`` and ``Z``. Without dimension: ``closure``, the share of
        CONS_1 that the force on its motion leaves unexplained, and with A0 its gain ``A0_gain`` and offset
        ``A0_offset`` [m] against the mean deflection that ``force`` implies.
        The attribute ``accuracy`` says what to expect, ``findings`` what was done to the curve.

    Raises
    ------
    ObservablesError
        If the dataset keeps not the contract of observables, has no height, or is not one curve.
    InversionError
        If too few rows are left, the height runs the wrong way, or an argument is out of range.

    Warns
    -----
    CurveWarning
        If the far end is not free, the amplitude jumps, or the iteration stays away from the data.

    Notes
    -----
    From far to near the gap falls until about A1/A1far = 0.57 and then turns back although the base goes on;
    there the curve is cut. Where the amplitude jumps, no state lies between the gaps on both sides, and what is
    nearer than the hole rests on a straight line across it. Assumed: a force of the gap, the same on the way in
    and out, but for the damping, whose law holds for viscous losses only; a lever that answers as the probe says.
    The deflection is taken for the motion over the sample: a shaken base adds about A1far/Q to it, which counts
    in liquids. Z, A1 and A0 enter the gap as they are: an error of 1 % in A1 shifts it by 1 % of the fall of A1.

    Examples
    --------
    >>> import overtone as ot
    >>> probe = ot.Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287, radius=10e-9,
    ...                         drive_frequency=161.8e3, free_amplitude=94e-9)
    >>> material = ot.sample("hertz", modulus=94e6, poisson_ratio=0.35)
    >>> states = [ot.hold_amplitude(probe, material, setpoint=1 - 0.4 * x**4) for x in np.linspace(0.05, 1, 30)]
    >>> found = reconstruct_force(xr.concat(states, "z"), probe)
    >>> true = ot.force("hertz", found.gap, radius=10e-9, modulus=94e6, poisson_ratio=0.35)
    >>> print(f"{found.force[0]:.3g} N, {found.force[0] / true[0] - 1:.1%} off")
    1.83e-08 N, -0.2% off
    """
    if not 1 <= n_max <= _MOST_HARMONICS:
        raise InversionError(
            "n_max is out of range",
            expected=f"1 to {_MOST_HARMONICS} harmonics of the motion",
            got=str(n_max),
        )
    if resolution is not None and not 0.0 <= resolution < math.inf:
        raise InversionError("the resolution is no length", expected="0 m or more", got=f"{resolution} m")
    findings: list[str] = []
    line, height, place = single_line(curve)
    line, height = rows_in_order(line, height, probe, findings)
    lever = _Lever(
        tip_receptance(probe.cantilever, np.arange(n_max + 1) * probe.drive.frequency),
        2.0 * math.pi * probe.drive.frequency,
        "A0" in line,
    )
    rows = _prepared(line, height, probe, lever, findings)
    measured = rows.gap.size
    scatter = scatter_of(height, rows.gap)
    floor = 2.0 * scatter_of(height, rows.cons)
    rows = uninterrupted(rows, scatter, findings)
    used, reach = rows.gap.size, (rows.amplitude[0], rows.amplitude[-1])
    resolution = _POOLED_SIGMA * scatter if resolution is None else resolution
    rows = rows.pooled(resolution)
    if rows.gap.size < FEWEST:
        raise InversionError(
            "too few points for a force curve",
            expected=f"{FEWEST} points or more at different gaps",
            got=f"{rows.gap.size} points from {used} of {measured} rows",
            hint="a finer resolution, or a curve that begins farther from the sample",
        )
    rows = _by_formula(rows, lever)
    if refine:
        rows, closure = _refined(rows, lever)
    else:
        moved = _set_in_motion(rows.take(slice(None)), lever)
        closure = _closure(moved, _conservative(moved, moved.force))
    free = probe.drive.free_amplitude
    findings.insert(
        0,
        f"{used} of {measured} rows were used, from A1/A1far = {reach[1] / free:.4g} to {reach[0] / free:.4g}, "
        f"as {rows.gap.size} points over the gap.",
    )
    result = _dataset(rows, lever, floor)
    if lever.reads_mean:
        result = result.assign(_mean_against_force(rows, probe))
    result["closure"] = named_array("closure", closure, ())
    for doubt in _doubts(rows, closure, refine=refine):
        findings.append(doubt)
        warnings.warn(doubt, CurveWarning, stacklevel=2)
    result.attrs = dict(curve.attrs) | {
        "accuracy": _REFINED if refine else _PLAIN,
        "resolution": resolution,
        "height_from": place,
    }
    result = provenance.add_finding(result, *findings)
    return provenance.record(
        result,
        "reconstruct_force",
        probe=format_probe(probe),
        refine=refine,
        n_max=n_max,
        resolution=resolution,
    )


_REFINED = (
    "With exact data 0.1 % of the largest force, more within two points of a kink such as the onset of an adhesive "
    "contact. Not in this number: noise, errors of Z, A0 and A1, which shift the gap, and modes of the lever that the "
    "probe does not know."
)
_PLAIN = (
    "Formulas on a bare cosine: 0.3 to 5 % low (force) and 0.2 to 3 % high (force_mean) for indentations of 2 to 25 % "
    "of A1. Harmonics of the motion are left out: that adds up to 15 % where the peak force over the stiffness of the "
    "lever is not small against the indentation."
)


def _dataset(curve: Curve, lever: _Lever, floor: float) -> xr.Dataset:
    gap = named_array("gap", curve.gap, ("gap",))
    coords = {"gap": gap.variable, "Z": named_array("Z", curve.height, ("gap",)).variable}
    tail = math.sqrt(curve.amplitude[-1]) * abs(curve.cons[-1])
    distance = np.maximum(curve.gap[-1] - curve.gap, curve.gap[-1] - curve.gap[-2])
    truncation = tail / np.sqrt(2.0 * distance)
    status = np.full(curve.gap.size, RECONSTRUCTED, np.int8)
    status[truncation > 10.0 * _NEGLIGIBLE * np.abs(curve.force).max()] = FAR_END
    status[curve.stretch < curve.stretch[-1]] = BEYOND_JUMP
    regime = np.zeros(curve.gap.size, np.int8)
    regime[curve.cons > floor] = ATTRACTIVE
    regime[curve.cons < -floor] = REPULSIVE
    over_gap = {"force": curve.force, "damping": curve.damping, "truncation": truncation}
    if lever.reads_mean:
        over_gap["force_mean"] = curve.mean_force
    arrays = {name: named_array(name, values, ("gap",)) for name, values in over_gap.items()}
    lost = np.pi * curve.amplitude * (curve.diss - curve.heat)
    arrays["dissipation"] = named_array("dissipation", lost, ("gap",))
    arrays["A1"] = named_array("A1", curve.amplitude, ("gap",))
    arrays["regime"] = named_array("regime", regime, ("gap",), None, **REGIME_FLAGS)
    arrays["status"] = named_array("status", status, ("gap",), None, **_STATUS_FLAGS)
    return xr.Dataset(arrays, coords=coords)


def _mean_against_force(curve: Curve, probe: Probe) -> dict[str, xr.DataArray]:
    """Return gain and offset of the mean deflection read against the one that the force implies."""
    static = float(read_receptance(probe, 0.0).real)
    implied, read = static * _conservative(curve, curve.force)[:, 0], static * curve.mean
    middle, level = (np.average(values, weights=curve.count) for values in (implied, read))
    spread = np.sum(curve.count * (implied - middle) ** 2)
    gain = np.sum(curve.count * (implied - middle) * (read - level)) / spread if spread > 0.0 else math.nan
    return {
        "A0_gain": named_array("A0_gain", gain, ()),
        "A0_offset": named_array("A0_offset", level - gain * middle, ()),
    }


def _doubts(curve: Curve, closure: float, *, refine: bool) -> list[str]:
    """Return what makes a result doubtful."""
    doubts = []
    flow = np.sqrt(curve.amplitude) * np.abs(curve.cons)
    share = float(flow[-1] / (flow.max() or 1.0))
    if share > _NEGLIGIBLE:
        doubts.append(
            f"The force has not decayed at the far end: there sqrt(A1) CONS_1 is {share:.1%} of its largest value. "
            "See truncation; a curve that begins farther away, or a phase referred to the free lever, would help."
        )
    for near in np.flatnonzero(curve.hole):
        low, high = (format_quantity(float(gap), "m") for gap in curve.gap[near : near + 2])
        doubts.append(
            f"The amplitude jumps: no state lies between the gaps {low} and {high}. Nearer than that the force rests "
            "on a straight line across the hole."
        )
    if refine and not closure < _NEGLIGIBLE:
        doubts.append(
            f"The force on its motion leaves {closure:.1%} of the first force harmonic unexplained: noise, a jump, "
            "or a lever that is not the probe's."
        )
    return doubts


# Symbol-free records of what this module returns: unit and meaning.

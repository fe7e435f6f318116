"""Steady states by harmonic balance: the periodic motion under the exact force, with its higher harmonics.

At a fixed amplitude A1 the mean gap g is the only large unknown. On the motion
``d(theta) = g + A1 cos theta + Re sum_{n>=2} b_n exp(i n theta)`` the force has harmonics f_n, the lever
answers ``b_n = G_tip(n w) f_n``, and the drive force closes the balance: ``|A1/G_tip(w) - f_1| = F_dr``.
The force is sampled by Gauss-Legendre pieces that end at contact, where it is not smooth, and that grow
away from it, because the attraction decays over a0 while the motion spans hundreds of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import Sample
from overtone.contact.terms import (
    CONTACT_ONLY,
    LINEAR_TAIL,
    NO_ADHESION,
    adhesion_harmonics,
    adhesion_shape,
    sphere_force,
    sphere_harmonics,
)
from overtone.errors import OvertoneError
from overtone.harmonics import read_receptance, tip_receptance, to_observables
from overtone.kernels import inner, kernel
from overtone.probe import Probe, format_probe, required_radius
from overtone.quantities import named_array

FOUND, NO_STATE, NOT_CONVERGED = 0, 1, 2
_STATUS_FLAGS = {
    "flag_values": [FOUND, NO_STATE, NOT_CONVERGED],
    "flag_meanings": "found no_state not_converged",
}

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_CONTACT_NODES, _CONTACT_WEIGHTS = np.polynomial.legendre.leggauss(24)
_WIDEST_PIECE = 6.0  # phase of the highest harmonic that one piece of ten nodes spans [rad]
_ITERATIONS = 60
_GAP_TOLERANCE = 1e-18

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@inner
def _gap(theta: float, g: float, amplitude: float, b: _Complex) -> tuple[float, float]:
    """Return the gap and its derivative by theta."""
    turn = complex(math.cos(theta), math.sin(theta))
    d, slope, power = g + amplitude * turn.real, -amplitude * turn.imag, turn
    for n in range(2, b.shape[0]):
        power *= turn
        d += b[n].real * power.real - b[n].imag * power.imag
        slope -= n * (b[n].real * power.imag + b[n].imag * power.real)
    return d, slope


@inner
def _crossing(level: float, inside: float, outside: float, g: float, amplitude: float, b: _Complex) -> float:
    """Return the phase between ``inside`` (gap below the level) and ``outside`` where the gap meets it."""
    if _gap(outside, g, amplitude, b)[0] <= level:
        return outside
    low, high = inside, outside
    x = 0.5 * (low + high)
    for _ in range(80):
        d, slope = _gap(x, g, amplitude, b)
        if d < level:
            low = x
        else:
            high = x
        step = (d - level) / slope if slope != 0.0 else math.inf
        guess = x - step
        if not min(low, high) < guess < max(low, high):
            guess = 0.5 * (low + high)
        if abs(guess - x) < 1e-15:
            return guess
        x = guess
    return x


@inner
def _add_sample(
    theta: float,
    weight: float,
    g: float,
    amplitude: float,
    b: _Complex,
    tail: int,
    Lambda: float,
    adhesion: float,
    a0: float,
    f: _Complex,
) -> None:
    """Add the force at one phase to the harmonics."""
    turn = complex(math.cos(theta), math.sin(theta))
    d, power = g + amplitude * turn.real, turn
    for n in range(2, b.shape[0]):
        power *= turn
        d += b[n].real * power.real - b[n].imag * power.imag
    force = (sphere_force(d, Lambda) - adhesion * adhesion_shape(tail, d, a0)) * weight / math.pi
    f[0] += 0.5 * force
    back, power = turn.conjugate(), complex(force, 0.0)
    for n in range(1, f.shape[0]):
        power *= back
        f[n] += power


@inner
def _force_harmonics(
    g: float,
    amplitude: float,
    b: _Complex,
    tail: int,
    Lambda: float,
    adhesion: float,
    a0: float,
    f: _Complex,
) -> float:
    """Fill the force harmonics on the motion; return the smallest gap."""
    f[:] = 0.0
    bottom = math.pi
    for _ in range(3):
        h = 1e-5
        _, left = _gap(bottom - h, g, amplitude, b)
        _, right = _gap(bottom + h, g, amplitude, b)
        if right > left:
            bottom -= 0.5 * (left + right) / ((right - left) / (2.0 * h))
    closest, _ = _gap(bottom, g, amplitude, b)
    for side in (-1.0, 1.0):
        far = bottom + side * math.pi
        start = bottom
        if closest < 0.0:
            start = _crossing(0.0, bottom, far, g, amplitude, b)
            reach = start - bottom
            # theta = start - reach s^2 turns the (-d)^(3/2) onset of contact into a smooth s^3
            for k in range(_CONTACT_NODES.shape[0]):
                s = 0.5 * (1.0 + _CONTACT_NODES[k])
                weight = _CONTACT_WEIGHTS[k] * abs(reach) * s
                theta = start - reach * s * s
                _add_sample(theta, weight, g, amplitude, b, tail, Lambda, adhesion, a0, f)
        if adhesion == 0.0 or tail == CONTACT_ONLY or start == far:
            continue
        end = far
        if tail == LINEAR_TAIL:
            if closest >= 2.0 * a0:
                continue
            end = _crossing(2.0 * a0, start, far, g, amplitude, b)
        _, slope = _gap(start, g, amplitude, b)
        # first piece: where the gap has grown by about a0, linearly from contact or quadratically from the bottom
        width = math.sqrt(2.0 * (a0 + max(closest, 0.0)) / amplitude)
        if closest < 0.0:
            width = min(width, a0 / max(abs(slope), 1e-300))
        widest = _WIDEST_PIECE / max(f.shape[0] - 1, 10)
        left_edge = start
        while left_edge != end:
            right_edge = left_edge + side * min(width, widest)
            if side * (right_edge - end) > -1e-12:
                right_edge = end
            half, middle = 0.5 * (right_edge - left_edge), 0.5 * (right_edge + left_edge)
            for k in range(_NODES.shape[0]):
                theta = middle + half * _NODES[k]
                _add_sample(theta, abs(half) * _WEIGHTS[k], g, amplitude, b, tail, Lambda, adhesion, a0, f)
            left_edge = right_edge
            width *= 2.0
    return closest


@inner
def _first_guess(
    indentation: float,
    amplitude: float,
    tail: int,
    Lambda: float,
    adhesion: float,
    a0: float,
    receptance: complex,
    drive_force: float,
    work: _Floats,
) -> tuple[float, float]:
    """Return ``|A1/G - f_1| - F_dr`` and its slope by indentation from the closed form of a bare cosine."""
    Delta = indentation / (2.0 * amplitude)
    sphere_harmonics(amplitude, Delta, 1, work[0], work[1])
    force, change = Lambda * work[0, 1], Lambda * work[1, 1]
    if tail != NO_ADHESION:
        adhesion_harmonics(tail, amplitude, Delta, a0, 1, work[2], work[3])
        force += adhesion * work[2, 1]
        change += adhesion * work[3, 1]
    balance = amplitude / receptance - force
    size = abs(balance)
    return size - drive_force, -balance.real * change / (size * 2.0 * amplitude)


@inner
def _hold(
    amplitude: float,
    tail: int,
    Lambda: float,
    adhesion: float,
    a0: float,
    receptance: _Complex,
    drive_force: float,
    f: _Complex,
) -> tuple[float, float, int]:
    """Find the repulsive state at a fixed amplitude: the balance of largest indentation.

    Fill f with the force harmonics; return the mean gap, the indentation and a status.
    """
    work = np.empty((4, 2))
    arguments = (amplitude, tail, Lambda, adhesion, a0, receptance[1], drive_force, work)
    deep = 1.98 * amplitude
    shallow = deep
    found = False
    if _first_guess(deep, *arguments)[0] > 0.0:
        while shallow > 1e-6 * amplitude:
            shallow = 0.8 * deep
            if _first_guess(shallow, *arguments)[0] < 0.0:
                found = True
                break
            deep = shallow
    if not found:
        return math.nan, math.nan, NO_STATE
    for _ in range(40):
        middle = 0.5 * (deep + shallow)
        if _first_guess(middle, *arguments)[0] > 0.0:
            deep = middle
        else:
            shallow = middle
    g = amplitude - 0.5 * (deep + shallow)
    b = np.zeros(f.shape[0], np.complex128)
    closest = 0.0
    for _ in range(_ITERATIONS):
        closest = _force_harmonics(g, amplitude, b, tail, Lambda, adhesion, a0, f)
        change = 0.0
        for n in range(2, f.shape[0]):
            new = receptance[n] * f[n]
            change = max(change, abs(new - b[n]))
            b[n] = new
        off = abs(amplitude / receptance[1] - f[1]) - drive_force
        depth = amplitude - g
        _, slope = _first_guess(depth, *arguments)
        step = off / slope if slope > 0.0 else math.copysign(0.1 * depth, off)
        step = min(max(step, -0.2 * depth), 0.2 * depth)
        g += step
        if abs(step) < _GAP_TOLERANCE and change < _GAP_TOLERANCE:
            return g, -closest, FOUND
    return g, -closest, NOT_CONVERGED


@kernel
def _hold_block(
    amplitude: float,
    tail: int,
    Lambda: _Floats,
    adhesion: _Floats,
    a0: _Floats,
    receptance: _Complex,
    drive_force: float,
    force: _Complex,
    gap: _Floats,
    indentation: _Floats,
    status: npt.NDArray[np.int8],
) -> None:
    for pixel in range(Lambda.shape[0]):
        gap[pixel], indentation[pixel], status[pixel] = _hold(
            amplitude, tail, Lambda[pixel], adhesion[pixel], a0[pixel], receptance, drive_force, force[pixel]
        )


def hold_amplitude(
    probe: Probe,
    sample: Sample,
    *,
    setpoint: float,
    dims: tuple[str, ...] | None = None,
    n_max: int = 10,
    keep: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return the repulsive steady state at a fixed amplitude, as a feedback loop holds it.

    Parameters
    ----------
    probe : Probe
        Any number of modes, any drive frequency.
    sample : Sample
        A material, or arrays of them.
    setpoint : float
        A1 / A1far, between 0 and 1.
    dims : tuple of str, optional
        Dimension names of the sample's arrays; ``("y", "x")`` for two dimensions unless given.
    n_max : int
        Harmonics of the motion that act back on the force; 10 gives A2 to 5e-5, 20 to 2e-6.
    keep : int
        Harmonics of the motion in the result.
    progress : callable, optional
        Called with (states done, states in all).

    Returns
    -------
    Dataset
        ``A0 .. A<keep>`` and phases as the detector reads them, ``indentation`` [m] (maximum indentation
        on the full motion), ``Z`` [m] (height of the base that holds the amplitude), ``F_cons`` and
        ``F_diss`` [N] of the force itself, and ``state`` (found, no_state, not_converged). A state that is
        not found is NaN.

    Raises
    ------
    OvertoneError
        If the set-point is not between 0 and 1, or the probe has no tip radius.

    Notes
    -----
    Conservative force laws. Of several coexisting states the one of largest indentation is taken. Assumes
    that the drive acts on the tip through the first mode, ``F_dr = A1far / |G_read(w)|`` there.
    """
    if not 0.0 < setpoint < 1.0:
        raise OvertoneError("the set-point is out of reach", expected="0 < A1/A1far < 1", got=str(setpoint))
    radius = required_radius(probe)
    tail = _tail(sample)
    shape = sample.shape
    dims = dims or (("y", "x") if len(shape) == 2 else tuple(f"dim_{i}" for i in range(len(shape))))
    E_star = effective_modulus(
        sample.values["modulus"], sample.values["poisson_ratio"], probe.tip.modulus, probe.tip.poisson_ratio
    )
    Lambda = np.ascontiguousarray((4.0 / 3.0 * E_star * math.sqrt(radius)).ravel())
    none = np.zeros(shape)
    adhesion = np.ascontiguousarray(sample.values.get("adhesion", none).ravel())
    a0 = np.ascontiguousarray(sample.values.get("intermolecular_distance", none + 1.0).ravel())
    amplitude = setpoint * probe.drive.free_amplitude
    frequencies = np.arange(n_max + 1) * probe.drive.frequency
    receptance = tip_receptance(probe.cantilever, frequencies)
    # A1 is what the detector reads; near resonance it is the motion of the tip to a part in ten thousand
    receptance[1] = read_receptance(probe, probe.drive.frequency)
    drive_force = probe.drive.free_amplitude / abs(receptance[1])
    count = Lambda.size
    force = np.zeros((count, n_max + 1), complex)
    gap, indentation = np.empty(count), np.empty(count)
    status = np.empty(count, np.int8)

    def run(block: slice) -> None:
        _hold_block(
            amplitude,
            tail,
            Lambda[block],
            adhesion[block],
            a0[block],
            receptance,
            drive_force,
            force[block],
            gap[block],
            indentation[block],
            status[block],
        )

    run_blocks(run, count, 256, progress)
    lost = status != FOUND
    force[lost], gap[lost], indentation[lost] = math.nan, math.nan, math.nan
    harmonic = xr.DataArray(np.arange(n_max + 1), dims="harmonic")
    coords = {"harmonic": harmonic}
    spectrum = np.moveaxis(force, -1, 0).reshape((n_max + 1, *shape))
    forces = xr.Dataset(
        {
            "F_cons": named_array("F_cons", spectrum.real, ("harmonic", *dims), coords),
            "F_diss": named_array("F_diss", -spectrum.imag, ("harmonic", *dims), coords),
            "A1": named_array("A1", np.where(lost, math.nan, amplitude).reshape(shape), dims),
        }
    )
    states = to_observables(forces.sel(harmonic=slice(0, keep)), probe)
    mean = receptance[0].real * force[:, 0].real
    states["indentation"] = named_array("indentation", indentation.reshape(shape), dims)
    states["Z"] = (dims, (gap - mean).reshape(shape), {"units": "m", "long_name": "height of the base"})
    states["state"] = (dims, status.reshape(shape), dict(_STATUS_FLAGS))
    states = states.merge(forces[["F_cons", "F_diss"]])
    return provenance.record(
        states,
        "hold_amplitude",
        probe=format_probe(probe),
        model=sample.model.key,
        setpoint=setpoint,
        n_max=n_max,
    )


def _tail(sample: Sample) -> int:
    """Return the adhesive tail of a sample that the solver knows."""
    if sample.model.tail is None:
        raise OvertoneError(
            f"steady states of model {sample.model.key!r} are not available",
            expected="a conservative paraboloid: hertz, dmt-contact, dmt-linear or dmt",
            hint="the conservative model nearest to it",
        )
    return sample.model.tail

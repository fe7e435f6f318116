"""Viscoelastic contact of a paraboloid: a standard linear solid tapped once per cycle.

The effective modulus relaxes as ``E*(t) = E_inf + (E_0 - E_inf) exp(-t/tau)``. On the motion
``d = A1 (u1 - cos psi)`` the indentation ``-d`` grows until ``psi = 0`` and shrinks after it. While the
contact radius ``a`` grows, ``a^2 = R (-d)`` and (Lee and Radok 1960)

    F(t) = 4/3 sqrt(R) int^t E*(t - s) d((-d)^(3/2))/ds ds.

While it shrinks, ``a(t)`` is what it was at an earlier time ``s(t)`` with (Ting 1966, one maximum of a)

    int_s(t)^t E*(t - q) d(-d)/dq dq = 0,    F(t) = 4/3 sqrt(R) int^s(t) E*(t - q) d((-d)^(3/2))/dq dq,

and contact ends where ``s`` has gone back to its beginning, below the undeformed surface. Read the other
way round, the ring of contact made at ``s`` is released at a time ``p(s)``, so that the harmonics are one
integral over the rings, ``int d((-d)^(3/2)) int_s^p(s) E*(q - s) exp(i n q) dq``: the inner integral and the
condition for p are elementary, and nothing is convolved. With ``sin(s/2) = -sqrt(Delta) sin(phi)`` the square
roots at both ends of the outer integral are gone.

One release per ring: write f(p) for Ting's integral over (s, p), positive at p = 0 and negative at p = -s.
Where ``f' = 0``, ``f'' = -E_0 cos p - E_inf sin p/(w tau)`` in units of the amplitude; it changes sign once in
(0, pi), so f has no minimum before that point and no maximum after it, hence one zero, and the released
surface does not meet the tip again before the next cycle.

References
----------
E. H. Lee and J. R. M. Radok, "The contact problem for viscoelastic bodies", J. Appl. Mech. 27 (1960) 438: the
elastic solution with a hereditary integral in place of the modulus, for a contact radius that grows.
T. C. T. Ting, "The contact stresses between a rigid indenter and a viscoelastic half-space", J. Appl. Mech.
33 (1966) 845: the continuation past one maximum of the contact radius.
"""

# compiled kernels: Numba checks their types, mypy sees an untyped decorator
# mypy: allow-untyped-decorators, no-warn-return-any

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import ContactModelError
from overtone.kernels import inner, kernel

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_WIDEST_PIECE = 4.0  # phase of the highest harmonic that one piece spans [rad]
_MOST_HALVINGS = 26  # pieces that short weigh less than rounding
_ITERATIONS = 200
_STEP = 1e-9  # a Newton step this short, relative, leaves an error of its square
_FORGOTTEN = 100.0  # exp(-100) of a stress is left
_SLOWEST, _FASTEST = 1e-12, 1e12  # 1/(w tau) beyond these differs from its limit by less than rounding


@inner
def _sine_defect(angle: float) -> float:
    """Return ``angle - sin(angle)`` without cancellation."""
    if abs(angle) > 0.5:
        return angle - math.sin(angle)
    square = angle * angle
    term = angle * square / 6.0
    total = term
    for k in range(2, 9):
        term *= -square / ((2.0 * k) * (2.0 * k + 1.0))
        total += term
    return total


@inner
def _ramp_response(x: float) -> float:
    """Return ``1 - (1 + x) exp(-x)`` without cancellation, x >= 0."""
    if x > 0.5:
        return -math.expm1(-x) - x * math.exp(-x)
    term = 0.5 * x * x
    total = term
    for k in range(3, 16):
        term *= -x * (k - 1.0) / (k * (k - 2.0))
        total += term
    return total


@inner
def _memory(p: float, rise_p: float, s: float, rise_s: float, rate: float) -> float:
    """Return ``int_s^p exp(-rate (p - q)) (-sin q) dq``, the part of Ting's integral that fades.

    ``rise = 1 - cos`` of the two angles. The elementary form, with its terms of first and second order in
    the angles taken out, so that it stays exact for shallow contact.
    """
    lag = rate * (p - s)
    decay = math.exp(-lag)
    total = decay * rise_s - rise_p + rate * p * math.expm1(-lag) + _ramp_response(lag)
    total += rate * (_sine_defect(p) - decay * _sine_defect(s))
    return total / (1.0 + rate * rate)


@inner
def _rise(angle: float) -> float:
    """Return ``1 - cos(angle)``."""
    half = math.sin(0.5 * angle)
    return 2.0 * half * half


@inner
def _release(s: float, rise_s: float, rate: float, excess: float, guess: float) -> float:
    """Return the phase p in (0, -s) at which the ring of contact made at s < 0 is released.

    Newton's method kept inside a bracket; the zero is the only one.
    """
    low, high, p = 0.0, -s, guess
    for _ in range(_ITERATIONS):
        rise_p = _rise(p)
        memory = _memory(p, rise_p, s, rise_s, rate)
        value = rise_s - rise_p + excess * memory
        if value > 0.0:
            low = p
        else:
            high = p
        slope = -(1.0 + excess) * math.sin(p) - rate * excess * memory
        step = -value / slope
        following = p + step
        if abs(step) <= _STEP * p and 0.0 <= following <= -s:
            return following
        if not low < following < high:
            following = 0.5 * (low + high)
            if not low < following < high:
                return p
        p = following
    return p


@inner
def _contact_made(p: float, Delta: float, rate: float, excess: float) -> float:
    """Return ``1 - cos s`` of the ring that is released at p > 0; negative once contact is lost.

    Ting's integral is concave in this unknown's cosine, so Newton's method from the elastic answer
    ``s = -p`` moves away from it in one direction only.
    """
    rise_p = _rise(p)
    edge = 2.0 * Delta
    start = -2.0 * math.asin(math.sqrt(Delta))
    if rise_p >= edge or edge - rise_p + excess * _memory(p, rise_p, start, edge, rate) <= 0.0:
        return -1.0
    rise_s = rise_p
    for _ in range(_ITERATIONS):
        s = -2.0 * math.asin(math.sqrt(0.5 * rise_s))
        value = rise_s - rise_p + excess * _memory(p, rise_p, s, rise_s, rate)
        step = -value / (1.0 + excess * math.exp(-rate * (p - s)))
        rise_s = min(max(rise_s + step, rise_p), edge)
        if abs(step) <= _STEP * rise_s:
            break
    return rise_s


@inner
def _edges(near: int, far: int) -> _Floats:
    """Return edges of pieces of (0, 1) that halve towards 0 and towards 1."""
    edges = np.empty(near + far + 3)
    edges[0], edges[near + far + 2] = 0.0, 1.0
    for j in range(near + 1):
        edges[near + 1 - j] = 0.5**j * 0.5
    for j in range(1, far + 1):
        edges[near + 1 + j] = 1.0 - 0.5**j * 0.5
    return edges


@inner
def _halvings(scale: float) -> int:
    """Return how often to halve to come down to 1/scale."""
    return min(_MOST_HALVINGS, math.ceil(math.log2(1.0 + scale)))


@inner
def _reduced_force(psi: float, Delta: float, rate: float, excess: float) -> float:
    """Return the force at psi in (-pi, pi) in units of ``4/3 E_inf sqrt(R) A1^(3/2)``."""
    edge = 2.0 * Delta
    depth = math.sqrt(Delta)
    if abs(psi) >= 2.0 * math.asin(depth):
        return 0.0
    rise = _rise(psi) if psi <= 0.0 else _contact_made(psi, Delta, rate, excess)
    if rise < 0.0 or rise >= edge:
        return 0.0
    s = psi if psi <= 0.0 else -2.0 * math.asin(math.sqrt(0.5 * rise))
    reach = edge - rise
    # sin(q/2) = -sqrt(Delta) cos(chi) from chi = 0, where contact begins
    last = math.atan2(math.sqrt(reach), math.sqrt(rise))
    beginning = 2.0 * math.asin(depth)
    total = 0.0
    edges = _edges(_halvings(1.0 / math.sqrt(1.0 - Delta)), _halvings(rate * (s + beginning)))
    for piece in range(edges.shape[0] - 1):
        a, b = last * edges[piece], last * edges[piece + 1]
        if rate * (psi + 2.0 * math.asin(depth * math.cos(b))) > _FORGOTTEN:
            continue
        half = 0.5 * (b - a)
        for j in range(_NODES.shape[0]):
            chi = a + half * (1.0 + _NODES[j])
            cosine, sine = math.cos(chi), math.sin(chi)
            lag = psi + 2.0 * math.asin(depth * cosine)
            total += half * _WEIGHTS[j] * cosine * sine * sine * math.exp(-rate * lag)
    return reach * math.sqrt(reach) + excess * 3.0 * edge * math.sqrt(edge) * total


@inner
def _reduced_harmonics(Delta: float, rate: float, excess: float, out: _Complex) -> None:
    """Fill ``f_n`` in units of ``4/3 E_inf sqrt(R) A1^(3/2)``."""
    n_max = out.shape[0] - 1
    depth = math.sqrt(Delta)
    out[:] = 0.0
    near = _halvings(depth * rate * math.pi)
    far = _halvings(1.0 / math.sqrt(1.0 - Delta))
    edges = _edges(near, far)
    share = 1.0  # of the elastic release p = -s
    for piece in range(edges.shape[0] - 1):
        a, b = 0.5 * math.pi * edges[piece], 0.5 * math.pi * edges[piece + 1]
        width = 2.0 * (math.asin(depth * math.sin(b)) - math.asin(depth * math.sin(a)))
        parts = 1 + int(n_max * width / _WIDEST_PIECE)
        half = 0.5 * (b - a) / parts
        for node in range(parts * _NODES.shape[0]):
            part, j = divmod(node, _NODES.shape[0])
            phi = a + half * (2.0 * part + 1.0 + _NODES[j])
            sine, cosine = math.sin(phi), math.cos(phi)
            s = -2.0 * math.asin(depth * sine)
            p = _release(s, 2.0 * Delta * sine * sine, rate, excess, -s * share)
            share = p / -s
            x = p - s
            weight = half * _WEIGHTS[j] * sine * cosine * cosine
            fade = math.expm1(-rate * x)
            out[0] += weight * (x - excess * fade / rate)
            middle, turn = 1.0 + 0.0j, 1.0 + 0.0j
            step_middle = complex(math.cos(0.5 * (s + p)), math.sin(0.5 * (s + p)))
            step_turn = complex(math.cos(0.5 * x), math.sin(0.5 * x))
            for n in range(1, n_max + 1):
                middle *= step_middle
                turn *= step_turn
                steady = 2.0 * turn.imag / n
                fading = (turn * fade + complex(0.0, 2.0 * turn.imag)) / complex(-rate, n)
                out[n] += weight * middle * (steady + excess * fading)
    scale = 3.0 * (2.0 * Delta) ** 1.5 / math.pi
    for n in range(n_max + 1):
        out[n] = (0.5 * scale if n == 0 else scale) * out[n].conjugate()
        scale = -scale


@kernel
def _forces(Delta: _Floats, rate: _Floats, excess: _Floats, psi: _Floats, out: _Floats) -> None:
    """Fill the reduced force of every contact (rows) at every psi (columns)."""
    for i in range(Delta.shape[0]):
        for j in range(psi.shape[0]):
            out[i, j] = _reduced_force(psi[j], Delta[i], rate[i], excess[i]) if Delta[i] > 0.0 else 0.0


@kernel
def _harmonics(Delta: _Floats, rate: _Floats, excess: _Floats, out: _Complex) -> None:
    """Fill the reduced harmonics of every contact (rows)."""
    for i in range(Delta.shape[0]):
        if Delta[i] > 0.0:
            _reduced_harmonics(Delta[i], rate[i], excess[i], out[i])
        else:
            out[i] = 0.0


@kernel
def _residues(Delta: _Floats, rate: _Floats, excess: _Floats, out: _Floats) -> None:
    """Fill the depth of the dent at the next contact after many equal cycles, in units of the indentation."""
    for i in range(Delta.shape[0]):
        out[i] = 0.0
        if Delta[i] > 0.0:
            beginning = 2.0 * math.asin(math.sqrt(Delta[i]))
            p = _release(-beginning, 2.0 * Delta[i], rate[i], excess[i], beginning)
            # the depth at loss, by Ting's condition
            left = -excess[i] * _memory(p, _rise(p), -beginning, 2.0 * Delta[i], rate[i]) / (2.0 * Delta[i])
            creep = rate[i] / (1.0 + excess[i])
            left *= math.exp(-creep * (2.0 * math.pi - beginning - p))
            out[i] = left / -math.expm1(-2.0 * math.pi * creep)


def _reduce(
    amplitude: Any,
    indentation: Any,
    frequency: Any,
    radius: Any,
    effective_modulus: Any,
    instantaneous_modulus: Any,
    relaxation_time: Any,
) -> tuple[tuple[int, ...], _Floats, _Floats, _Floats, _Floats, _Floats]:
    """Check the parameters; return their common shape, and flat Delta, 1/(w tau), E_0/E_inf - 1, force, delta."""
    positive = {
        "amplitude": (amplitude, "m"),
        "frequency": (frequency, "Hz"),
        "radius": (radius, "m"),
        "effective_modulus": (effective_modulus, "Pa"),
        "instantaneous_modulus": (instantaneous_modulus, "Pa"),
        "relaxation_time": (relaxation_time, "s"),
    }
    given = {name: np.asarray(value, dtype=float) for name, (value, _) in positive.items()}
    for name, (_, unit) in positive.items():
        if not (np.all(np.isfinite(given[name])) and np.all(given[name] > 0.0)):
            raise ContactModelError(f"{name} is out of range", expected=f"finite numbers > 0 {unit}")
    given["indentation"] = np.asarray(indentation, dtype=float)
    if not np.all(np.isfinite(given["indentation"])):
        raise ContactModelError("indentation is out of range", expected="finite numbers [m]")
    try:
        arrays = dict(zip(given, np.broadcast_arrays(*given.values()), strict=True))
    except ValueError as error:
        raise ContactModelError(
            "shapes do not fit",
            expected="arrays that broadcast",
            got=", ".join(f"{name} {array.shape}" for name, array in given.items()),
        ) from error
    shape = arrays["amplitude"].shape
    A, delta, f, R, E, E0, tau = (
        np.ascontiguousarray(arrays[name]).reshape(-1)
        for name in (
            "amplitude",
            "indentation",
            "frequency",
            "radius",
            "effective_modulus",
            "instantaneous_modulus",
            "relaxation_time",
        )
    )
    if np.any(E0 < E):
        raise ContactModelError(
            "instantaneous_modulus is out of range",
            expected="at least effective_modulus, the modulus after long times",
            hint="swap the two, or set them equal for an elastic sample",
        )
    Delta = delta / (2.0 * A)
    if np.any(Delta >= 1.0):
        raise ContactModelError(
            "permanent contact",
            expected="an indentation below twice the amplitude: the surface recovers out of contact",
            got=f"indentation/(2 amplitude) = {float(np.max(Delta)):.6g}",
        )
    rate = np.clip(1.0 / (2.0 * np.pi * f * tau), _SLOWEST, _FASTEST)
    return shape, Delta, rate, E0 / E - 1.0, 4.0 / 3.0 * E * np.sqrt(R * A) * A, delta


def sls_force_history(
    amplitude: Any,
    indentation: Any,
    *,
    frequency: Any,
    radius: Any,
    effective_modulus: Any,
    instantaneous_modulus: Any,
    relaxation_time: Any,
    phases: Any,
) -> npt.NDArray[np.float64]:
    """Return the force of a paraboloid on a standard linear solid over the cycle [N].

    Parameters
    ----------
    amplitude, indentation : array
        A1 and delta_max of the motion ``d = A1 (1 - 2 Delta + cos theta)``, ``Delta = delta_max/(2 A1)`` [m].
        An indentation of zero or less is no contact and gives no force.
    frequency : array
        Of the motion [Hz].
    radius : array
        Of the tip [m].
    effective_modulus, instantaneous_modulus : array
        E* after long times (E_inf) and at once (E_0 >= E_inf) [Pa].
    relaxation_time : array
        tau of ``E*(t) = E_inf + (E_0 - E_inf) exp(-t/tau)`` [s]; the creep time is ``tau E_0/E_inf``.
    phases : array
        theta [rad], taken modulo 2 pi; the tip approaches on (0, pi) and retracts on (pi, 2 pi).

    Returns
    -------
    array
        Force, positive where the sample repels; the shape of the parameters, then that of ``phases``.

    Raises
    ------
    ContactModelError
        If a parameter is not a finite number in its range, if ``E_0 < E_inf``, if the contact is permanent
        (``Delta >= 1``), or if the shapes do not fit.

    Notes
    -----
    Lee-Radok while the contact radius grows, Ting while it shrinks; contact ends before the tip is back at the
    undeformed surface. Taken for granted: small strain and an indentation well below the radius, a tip that
    does not relax (stiff against the sample, or part of E*), a constant Poisson's ratio, no adhesion, no
    inertia of the sample, and a surface that has recovered before the next cycle, which ``sls_residual``
    tests. The dent closes with the creep time ``tau E_0/E_inf``: where that comes near the period or exceeds
    it, dents add up over the cycles, and the result is that of the first tap on a fresh place.

    Examples
    --------
    >>> sample = dict(frequency=70e3, radius=20e-9, effective_modulus=1e9, instantaneous_modulus=3e9)
    >>> force = sls_force_history(50e-9, 2e-9, relaxation_time=1e-6, phases=[3.0, 3.3, 4.0], **sample)
    >>> (force / 1e-9).round(2)
    array([29.9 , 13.58,  0.  ])
    """
    shape, Delta, rate, excess, force, _ = _reduce(
        amplitude,
        indentation,
        frequency,
        radius,
        effective_modulus,
        instantaneous_modulus,
        relaxation_time,
    )
    theta = np.asarray(phases, dtype=float)
    if not np.all(np.isfinite(theta)):
        raise ContactModelError("phases are out of range", expected="finite numbers [rad]")
    psi = np.mod(theta, 2.0 * np.pi).reshape(-1) - np.pi
    out = np.empty((Delta.size, psi.size))
    _forces(Delta, rate, excess, psi, out)
    out *= force[:, None]
    return out.reshape(shape + theta.shape)


def sls_harmonics(
    amplitude: Any,
    indentation: Any,
    n_max: int,
    *,
    frequency: Any,
    radius: Any,
    effective_modulus: Any,
    instantaneous_modulus: Any,
    relaxation_time: Any,
) -> npt.NDArray[np.complex128]:
    """Return the force harmonics of a paraboloid on a standard linear solid [N].

    Parameters
    ----------
    amplitude, indentation, frequency, radius, effective_modulus, instantaneous_modulus, relaxation_time : array
        As for `sls_force_history`; they broadcast.
    n_max : int
        Highest harmonic.

    Returns
    -------
    array, the shape of the parameters and a last axis n = 0..n_max
        ``f_n = CONS_n - i DISS_n``: cosine and sine coefficients of the force in theta. The energy lost per
        cycle is ``pi A1 DISS_1``.

    Raises
    ------
    ContactModelError
        As `sls_force_history`, and if ``n_max`` is not a whole number >= 0.

    Notes
    -----
    Validity as for `sls_force_history`. The limits are Hertz contact, with E_inf for ``tau`` far below the
    contact time and with E_0 for ``tau`` far above it.

    Examples
    --------
    >>> sample = dict(frequency=70e3, radius=20e-9, effective_modulus=1e9, instantaneous_modulus=3e9)
    >>> f = sls_harmonics(50e-9, 2e-9, 2, relaxation_time=1e-6, **sample)
    >>> (f.real / 1e-9).round(3), (f.imag / 1e-9).round(3)
    (array([ 1.984, -3.945,  3.876]), array([ 0.   , -0.11 ,  0.217]))
    >>> round(float(-f[1].imag) * 3.14159 * 50e-9 / 1.602e-19)  # energy lost per cycle [eV]
    108
    """
    try:
        order = operator.index(n_max)
    except TypeError:
        order = -1
    if order < 0:
        raise ContactModelError("n_max is out of range", expected="a whole number >= 0", got=repr(n_max))
    shape, Delta, rate, excess, force, _ = _reduce(
        amplitude,
        indentation,
        frequency,
        radius,
        effective_modulus,
        instantaneous_modulus,
        relaxation_time,
    )
    out = np.empty((Delta.size, order + 1), dtype=complex)
    _harmonics(Delta, rate, excess, out)
    out *= force[:, None]
    return out.reshape((*shape, order + 1))


def sls_residual(
    amplitude: Any,
    indentation: Any,
    *,
    frequency: Any,
    radius: Any,
    effective_modulus: Any,
    instantaneous_modulus: Any,
    relaxation_time: Any,
) -> npt.NDArray[np.float64]:
    """Return the depth of the dent that is left when the tip comes back, tap after tap [m].

    After contact the surface under the apex rises with the creep time, ``u ~ exp(-t E_inf/(tau E_0))``,
    from its depth where contact was lost; what is left of many cycles with the pressure of the first adds up.
    `sls_force_history` and `sls_harmonics` take this dent for closed: where it is not small against the
    indentation they describe the first tap only, and the depth here is an estimate.

    Parameters
    ----------
    amplitude, indentation, frequency, radius, effective_modulus, instantaneous_modulus, relaxation_time : array
        As for `sls_force_history`; they broadcast. The depth does not depend on the radius.

    Returns
    -------
    array
        Depth below the undeformed surface when the next contact is due; zero without contact.

    Raises
    ------
    ContactModelError
        As `sls_force_history`.

    Examples
    --------
    >>> sample = dict(frequency=70e3, radius=20e-9, effective_modulus=1e9, instantaneous_modulus=3e9)
    >>> (sls_residual(50e-9, 2e-9, relaxation_time=[1e-6, 1e-3], **sample) / 1e-12).round(1)
    array([  8.6, 239.9])
    """
    shape, Delta, rate, excess, _, delta = _reduce(
        amplitude,
        indentation,
        frequency,
        radius,
        effective_modulus,
        instantaneous_modulus,
        relaxation_time,
    )
    out = np.empty(Delta.size)
    _residues(Delta, rate, excess, out)
    return (out * delta).reshape(shape)

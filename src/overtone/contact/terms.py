"""Terms of the tip-sample force: the law of one term, and its harmonics in closed form.

The motion is ``d = A1 (u1 - cos psi)`` with ``u1 = 1 - 2 Delta``, ``Delta = delta_max/(2 A1)`` and
``psi = theta - pi`` (eq 13 of Shaik, Reifenberger and Raman 2020); the tip is in contact for
``|psi| < c1 = arccos u1``. Harmonics are cosine coefficients in ``theta``, so harmonic n of a term
carries ``(-1)^n`` against its coefficient in ``psi``. Delta may have any value: negative out of
contact, 1 and more in permanent contact. Scalars in, scalars out, SI units. Kernels and their
helpers share this file: the compiler's disk cache notices edits in one file only.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.kernels import kernel

# Shape of the adhesive force against the gap, in units of the force of adhesion.
NO_ADHESION = 0
LINEAR_TAIL = 1  # eq 17: falls linearly to zero at d = 2 a0
VAN_DER_WAALS_TAIL = 2  # eq 15: (a0 / (a0 + d))^2
CONTACT_ONLY = 3  # nothing outside contact

_SERIES_LIMIT = 0.1
_EXTRA_ORDERS = 20  # above the highest order wanted, where the downward recurrence starts from nothing
_UPWARD_LIMIT = -1.1  # below this u1 the recurrence in n runs downwards
_WIDE_POWER = 0.5
_POLYNOMIAL = 0.05
_SHORT_RAMP = 1e-3  # range of the attraction over the amplitude below which differences would cancel

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)

_Floats = npt.NDArray[np.float64]


def _series_coefficients(order: int, power: float, count: int = 18) -> list[float]:
    """Return the coefficients of `_power_series` behind ``Delta^(p + 1/2)``."""
    term = math.sqrt(math.pi) * 2.0**power * math.gamma(power + 1.0) / math.gamma(power + 1.5)
    coefficients = []
    for k in range(count):
        coefficients.append(term)
        term *= (0.5 - order + k) * (0.5 + order + k) / ((power + 1.5 + k) * (1.0 + k))
    return coefficients


# columns: K_0 and K_1 of the power 3/2, then of 1/2
_SPHERE_SERIES = np.array([_series_coefficients(n, p) for p in (1.5, 0.5) for n in (0, 1)]).T.copy()


# --- laws -------------------------------------------------------------------------------------------------------


@kernel
def power_force(gap: float, coefficient: float, exponent: float) -> float:
    """Return ``coefficient (-d)^p`` in contact, nothing outside [N]."""
    if gap >= 0.0:
        return 0.0
    if exponent == 1.5:
        return -coefficient * gap * math.sqrt(-gap)
    return float(coefficient * (-gap) ** exponent)


@kernel
def sphere_force(gap: float, Lambda: float) -> float:
    """Return the Hertz force of a paraboloid, ``Lambda (-d)^(3/2)`` in contact [N]."""
    return power_force(gap, Lambda, 1.5)


@kernel
def tail_shape(tail: int, gap: float, a0: float) -> float:
    """Return the attractive force outside contact (gap >= 0) in units of F_ad."""
    if tail == LINEAR_TAIL:
        return max(0.0, 1.0 - gap / (2.0 * a0))
    if tail == VAN_DER_WAALS_TAIL:
        ratio = a0 / (a0 + gap)
        return ratio * ratio
    return 0.0


@kernel
def tail_slope(tail: int, gap: float, a0: float) -> float:
    """Return the derivative of `tail_shape` by the gap [1/m]."""
    if tail == LINEAR_TAIL:
        return -0.5 / a0 if gap < 2.0 * a0 else 0.0
    if tail == VAN_DER_WAALS_TAIL:
        ratio = a0 / (a0 + gap)
        return -2.0 * ratio * ratio / (a0 + gap)
    return 0.0


@kernel
def adhesion_shape(tail: int, gap: float, a0: float) -> float:
    """Return the attractive force in units of F_ad: 1 in contact, the tail outside."""
    if tail != NO_ADHESION and gap <= 0.0:
        return 1.0
    return tail_shape(tail, gap, a0)


# --- where contact is -------------------------------------------------------------------------------------------


@kernel
def contact_angle(Delta: float) -> float:
    """Return ``c1 = arccos(1 - 2 Delta)`` without the cancellation of that form at small Delta."""
    if Delta <= 0.0:
        return 0.0
    if Delta >= 1.0:
        return math.pi
    return 2.0 * math.asin(math.sqrt(Delta))


@kernel
def _weight(order: int) -> float:
    """Return what turns ``int_0^pi f cos(n psi) dpsi`` into the n-th cosine coefficient in theta."""
    if order == 0:
        return 1.0 / math.pi
    return 2.0 / math.pi if order % 2 == 0 else -2.0 / math.pi


# --- powers of the indentation ----------------------------------------------------------------------------------


@kernel
def _elliptic(m: float) -> tuple[float, float]:
    """Return the complete elliptic integrals K and E of parameter m < 1 (arithmetic-geometric mean)."""
    a, b, power, total = 1.0, math.sqrt(1.0 - m), 0.5, 0.5 * m
    while a - b > 1e-8 * a:  # the next step squares the difference
        c = 0.5 * (a - b)
        a, b = 0.5 * (a + b), math.sqrt(a * b)
        power *= 2.0
        total += power * c * c
    c = 0.5 * (a - b)
    total += 2.0 * power * c * c
    K = math.pi / (a + b)
    return K, K * (1.0 - total)


@kernel
def _power_series(order: int, power: float, Delta: float) -> float:
    """Sum ``sqrt(pi) 2^p Gamma(p+1)/Gamma(p+3/2) Delta^(p+1/2) 2F1(1/2-n, 1/2+n; p+3/2; Delta)``."""
    term, total = 1.0, 1.0
    for k in range(200):
        term *= (0.5 - order + k) * (0.5 + order + k) / ((power + 1.5 + k) * (1.0 + k)) * Delta
        total += term
        if abs(term) < 1e-17 * abs(total):
            break
    ratio = math.exp(math.lgamma(power + 1.0) - math.lgamma(power + 1.5))
    return float(math.sqrt(math.pi) * 2.0**power * ratio * Delta ** (power + 0.5) * total)


@kernel
def _power_by_quadrature(order: int, power: float, Delta: float) -> float:
    """Integrate ``(cos psi - u1)^p cos(n psi)`` over contact by the double exponential rule.

    Serves any power above -1 where the series is slow; the rule puts its nodes where the integrand has its branch
    point, and the distance to it is formed without cancellation.
    """
    c1 = contact_angle(Delta)
    step, total = 1.0 / 16.0, 0.0
    for k in range(-64, 65):
        t = k * step
        u = 0.5 * math.pi * math.sinh(t)
        if abs(u) > 300.0:
            continue
        # psi = c1 (1 - to_end), to_end from 1 to 0
        to_end = 1.0 / (1.0 + math.exp(2.0 * u))
        psi = c1 / (1.0 + math.exp(-2.0 * u))
        left = c1 * to_end
        if Delta < 1.0:
            base = 2.0 * math.sin(0.5 * left) * math.sin(0.5 * (c1 + psi))
        else:
            base = 2.0 * (Delta - 1.0) + 2.0 * math.sin(0.5 * left) ** 2
        slope = 0.5 * math.pi * math.cosh(t) / math.cosh(u) ** 2
        if base > 0.0 or power == 0.0:
            total += base**power * math.cos(order * psi) * slope
    return 0.5 * c1 * step * total


@kernel
def _sphere_start(Delta: float) -> tuple[float, float, float, float]:
    """Return K_0 and K_1 of the powers 3/2 and 1/2 for Delta > 0.

    Beyond ``_SERIES_LIMIT`` by elliptic integrals, of parameter Delta or, in permanent contact, 1/Delta;
    K_1 from K_0 by parts: ``(p + 1) K_1^p = p ((1 - u1^2) K_0^(p-1) - u1 K_0^p)``.
    """
    if Delta < _SERIES_LIMIT:
        K0, K1, root0, root1 = 0.0, 0.0, 0.0, 0.0
        for k in range(_SPHERE_SERIES.shape[0] - 1, -1, -1):
            K0 = K0 * Delta + _SPHERE_SERIES[k, 0]
            K1 = K1 * Delta + _SPHERE_SERIES[k, 1]
            root0 = root0 * Delta + _SPHERE_SERIES[k, 2]
            root1 = root1 * Delta + _SPHERE_SERIES[k, 3]
        return K0 * Delta * Delta, K1 * Delta * Delta, root0 * Delta, root1 * Delta
    u1 = 1.0 - 2.0 * Delta
    if Delta < 1.0:
        EK, EE = _elliptic(Delta)
        complement = 1.0 - Delta
        K0 = 4.0 * math.sqrt(2.0) / 3.0 * (EK * complement * (2.0 - 3.0 * Delta) - EE * 2.0 * u1)
        root0 = 2.0 * math.sqrt(2.0) * (EE - complement * EK)
    elif Delta == 1.0:
        K0, root0 = 8.0 * math.sqrt(2.0) / 3.0, 2.0 * math.sqrt(2.0)
    else:
        m = 1.0 / Delta
        EK, EE = _elliptic(m)
        root0 = 2.0 * math.sqrt(2.0 * Delta) * EE
        K0 = 4.0 * Delta * math.sqrt(2.0 * Delta) / 3.0 * (2.0 * (2.0 - m) * EE - (1.0 - m) * EK)
    K1 = 0.6 * (4.0 * Delta * (1.0 - Delta) * root0 - u1 * K0)
    return K0, K1, root0, K0 + u1 * root0


@kernel
def _fill_orders(first: float, second: float, power: float, u1: float, n_max: int, out: _Floats) -> None:
    """Fill ``out`` from its first two orders by the recurrence in n.

    ``(n + p + 1) K_{n+1} = 2 n u1 K_n - (n - p - 1) K_{n-1}``: upwards while the tip taps. Deep in permanent
    contact the K_n fall off with n while another solution grows, so the recurrence runs downwards there.
    """
    out[0] = first
    if n_max >= 1:
        out[1] = second
    if u1 >= _UPWARD_LIMIT:
        for n in range(1, n_max):
            out[n + 1] = (2.0 * n * u1 * out[n] - (n - power - 1.0) * out[n - 1]) / (n + power + 1.0)
        return
    above, here = 0.0, 1e-300
    start = n_max + _EXTRA_ORDERS + int(20.0 / math.sqrt(-1.0 - u1))
    for n in range(start, 1, -1):
        if n <= n_max:
            out[n] = here
        above, here = here, ((n + power + 1.0) * above - 2.0 * n * u1 * here) / (power + 1.0 - n)
        if abs(here) > 1e200:
            above, here = above * 1e-200, here * 1e-200
            for k in range(n, n_max + 1):
                out[k] *= 1e-200
    scale = second / here  # here is now order 1
    for n in range(2, n_max + 1):
        out[n] *= scale


@kernel
def sphere_integrals(Delta: float, n_max: int, K: _Floats, dK: _Floats) -> None:
    """Fill K_n and dK_n/dDelta of ``int_0^c1 (cos psi - u1)^(3/2) cos(n psi) dpsi``, n = 0..n_max.

    ``dK_n^(3/2)/dDelta = 3 K_n^(1/2)``.
    """
    if Delta <= 0.0:
        for n in range(n_max + 1):
            K[n], dK[n] = 0.0, 0.0
        return
    u1 = 1.0 - 2.0 * Delta
    K0, K1, root0, root1 = _sphere_start(Delta)
    _fill_orders(K0, K1, 1.5, u1, n_max, K)
    _fill_orders(root0, root1, 0.5, u1, n_max, dK)
    for n in range(n_max + 1):
        dK[n] *= 3.0


@kernel
def _power_integral(order: int, power: float, Delta: float) -> float:
    """Return K_n of any power p >= 0 for Delta > 0."""
    if (power == 1.0 or power == 2.0) and Delta > _POLYNOMIAL:  # in cos psi, whose terms no longer cancel
        u1 = 1.0 - 2.0 * Delta
        here = _constant_integral(order, Delta)[0]
        below, above = _constant_integral(abs(order - 1), Delta)[0], _constant_integral(order + 1, Delta)[0]
        if power == 1.0:
            return 0.5 * (below + above) - u1 * here
        outer = 0.25 * (
            _constant_integral(abs(order - 2), Delta)[0] + _constant_integral(order + 2, Delta)[0]
        )
        return outer + (0.5 + u1 * u1) * here - u1 * (below + above)
    if Delta < _WIDE_POWER:
        return _power_series(order, power, Delta)
    return _power_by_quadrature(order, power, Delta)


@kernel
def _constant_integral(order: int, Delta: float) -> tuple[float, float]:
    """Return ``int_0^c1 cos(n psi) dpsi`` and its derivative by Delta, infinite at Delta = 0 and 1."""
    if Delta <= 0.0:
        return 0.0, 0.0
    if Delta > 1.0:
        return (math.pi if order == 0 else 0.0), 0.0
    c1 = contact_angle(Delta)
    inside = c1 if order == 0 else (0.0 if Delta == 1.0 else math.sin(order * c1) / order)
    return inside, 2.0 * math.cos(order * c1) / math.sin(c1)


@kernel
def power_harmonics(
    amplitude: float, Delta: float, power: float, n_max: int, h: _Floats, dh: _Floats
) -> None:
    """Fill the harmonics of ``(-d)^p`` in contact and their derivative by Delta [m^p], any p >= 0.

    For p = 0 the derivative ``2 cos(n c1)/sin c1`` is infinite where contact begins (Delta = 0) and where it
    becomes permanent (Delta = 1).
    """
    if Delta <= 0.0:
        for n in range(n_max + 1):
            h[n], dh[n] = 0.0, 0.0
        return
    if power == 1.5:
        sphere_integrals(Delta, n_max, h, dh)
    elif power == 0.0:
        for n in range(n_max + 1):
            h[n], dh[n] = _constant_integral(n, Delta)
    elif power == 1.0:
        for n in range(n_max + 1):
            h[n] = _power_integral(n, power, Delta)
            dh[n] = 2.0 * _constant_integral(n, Delta)[0]
    else:
        for n in range(n_max + 1):
            h[n] = _power_integral(n, power, Delta)
            dh[n] = 2.0 * power * _power_integral(n, power - 1.0, Delta)
    scale = amplitude**power
    for n in range(n_max + 1):
        h[n] *= scale * _weight(n)
        dh[n] *= scale * _weight(n)


@kernel
def sphere_harmonics(amplitude: float, Delta: float, n_max: int, h: _Floats, dh: _Floats) -> None:
    """Fill the harmonics of ``(-d)^(3/2)`` in contact and their derivative by Delta [m^1.5]."""
    sphere_integrals(Delta, n_max, h, dh)
    scale = amplitude * math.sqrt(amplitude)
    for n in range(n_max + 1):
        h[n] *= scale * _weight(n)
        dh[n] *= scale * _weight(n)


# --- adhesion ---------------------------------------------------------------------------------------------------


@kernel
def adhesion_harmonics(
    tail: int, amplitude: float, Delta: float, a0: float, n_max: int, h: _Floats, dh: _Floats
) -> None:
    """Fill the harmonics of an adhesive force of -1 in contact with its tail outside, and d/dDelta.

    With a tail the force is continuous in the gap, so its derivative is that of the tail alone. Without one
    (CONTACT_ONLY) it is infinite where contact begins or becomes permanent.
    """
    if tail == NO_ADHESION:
        for n in range(n_max + 1):
            h[n], dh[n] = 0.0, 0.0
        return
    if tail == LINEAR_TAIL:
        linear_adhesion_harmonics(amplitude, Delta, a0, n_max, h, dh)
        return
    if tail == VAN_DER_WAALS_TAIL:
        van_der_waals_harmonics(amplitude, Delta, a0, n_max, h, dh)
        return
    for n in range(n_max + 1):
        inside, slope = _constant_integral(n, Delta)
        h[n], dh[n] = -_weight(n) * inside, -_weight(n) * slope


@kernel
def linear_adhesion_harmonics(
    amplitude: float, Delta: float, a0: float, n_max: int, h: _Floats, dh: _Floats
) -> None:
    """Fill the harmonics of the attraction of eq 17 per F_ad, and their derivative by Delta.

    ``-1`` in contact, ``-1 + d/(2 a0)`` for 0 < d < 2 a0. Where the ramp reaches further than the motion it is
    cut at the far turning point, not extended.
    """
    ramp = 2.0 * a0 / amplitude
    c1, c2 = contact_angle(Delta), contact_angle(Delta + 0.5 * ramp)
    u2 = 1.0 - 2.0 * Delta - ramp
    for n in range(n_max + 1):
        if n == 0:
            inside, reached = c1, c2
        else:
            inside = 0.0 if c1 == math.pi else math.sin(n * c1) / n
            reached = 0.0 if c2 == math.pi else math.sin(n * c2) / n
        if ramp > _SHORT_RAMP:
            total, slope = _ramp_integral(n, u2, c2) - _ramp_integral(n, u2, c1), reached - inside
        else:
            total, slope = _short_ramp(n, Delta, ramp, c1, c2)
        h[n] = _weight(n) * (total / ramp - inside)
        dh[n] = -2.0 * _weight(n) * slope / ramp


@kernel
def _ramp_integral(n: int, u2: float, c: float) -> float:
    """Return the antiderivative of ``(u2 - cos psi) cos(n psi)`` at psi = c."""
    if n == 0:
        return u2 * c - math.sin(c)
    if n == 1:
        return u2 * math.sin(c) - 0.5 * c - 0.25 * math.sin(2.0 * c)
    return u2 * math.sin(n * c) / n - 0.5 * (
        math.sin((n - 1) * c) / (n - 1) + math.sin((n + 1) * c) / (n + 1)
    )


@kernel
def _short_ramp(n: int, Delta: float, ramp: float, c1: float, c2: float) -> tuple[float, float]:
    """Integrate ``(u2 - cos psi) cos(n psi)`` and ``cos(n psi)`` over a ramp too short for a difference.

    Gauss-Legendre, in which every factor is formed from the distance to c2, where it vanishes.
    """
    # sin((c2 - c1)/2) sin((c2 + c1)/2) = (cos c1 - cos c2)/2, whose terms would cancel
    difference = min(max(Delta + 0.5 * ramp, 0.0), 1.0) - min(max(Delta, 0.0), 1.0)
    half_sum = math.sin(0.5 * (c1 + c2))
    width = 2.0 * math.asin(min(difference / half_sum, 1.0)) if half_sum > 0.5 * difference else c2 - c1
    short = min(
        2.0 - 2.0 * Delta - ramp, 0.0
    )  # u2 - cos c2, not zero where the far turning point cuts the ramp
    total, slope = 0.0, 0.0
    for k in range(_NODES.shape[0]):
        back = width * 0.5 * (1.0 + _NODES[k])
        part = 0.5 * width * _WEIGHTS[k] * math.cos(n * (c2 - back))
        total += part * (short - 2.0 * math.sin(c2 - 0.5 * back) * math.sin(0.5 * back))
        slope += part
    return total, slope


@kernel
def van_der_waals_harmonics(
    amplitude: float, Delta: float, a0: float, n_max: int, h: _Floats, dh: _Floats
) -> None:
    """Fill the harmonics of the attraction of eq 15 per F_ad, and their derivative by Delta.

    ``-1`` in contact, ``-(a0/(a0 + d))^2`` outside: with ``b = u1 + a0/A1`` the integrals
    ``J_n, I_n, M_n = int_c1^pi cos(n psi) / (b - cos psi)^(1, 2, 3) dpsi``. Their first members in the
    variable ``t = tan(psi/2)`` are regular through b = 1; higher orders follow by
    ``J_{n+1} = 2 b J_n - J_{n-1} + 2 sin(n c1)/n`` and its derivatives by b.
    """
    reach = a0 / amplitude
    if Delta >= 1.0:
        for n in range(n_max + 1):
            h[n], dh[n] = (-1.0 if n == 0 else 0.0), 0.0
        return
    excess = reach - 2.0 * Delta  # b - 1
    b = 1.0 + excess
    if Delta <= 0.0:
        # The tip never touches: a full turn, in closed form at every order.
        root = math.sqrt(excess * (b + 1.0))
        rho, power = 1.0 / (b + root), 1.0
        for n in range(n_max + 1):
            I = math.pi * power * (b / root + n) / root**2
            M = 0.5 * math.pi * power * (3.0 * b * b / root**2 + 3.0 * n * b / root + n * n - 1.0) / root**3
            h[n] = -_weight(n) * reach * reach * I
            dh[n] = -4.0 * _weight(n) * reach * reach * M
            power *= rho
        return
    c1 = contact_angle(Delta)
    t1 = math.sqrt(Delta / (1.0 - Delta))
    S1, S2, S3 = _tail_integrals(excess / (b + 1.0), t1, reach / ((b + 1.0) * Delta))
    beta, bp = excess / (b + 1.0), b + 1.0
    J = 2.0 / bp * S1
    I = 2.0 / bp**2 * (S1 + (1.0 - beta) * S2)
    M = 2.0 / bp**3 * (S1 + 2.0 * (1.0 - beta) * S2 + (1.0 - beta) ** 2 * S3)
    free = math.pi - c1 if Delta < 0.5 else 2.0 * math.asin(math.sqrt(1.0 - Delta))
    J_next, I_next, M_next = b * J - free, b * I - J, b * M - I
    # sin(n c1) by its own recurrence: one sine instead of one an order
    u1 = 1.0 - 2.0 * Delta
    below, sine = 0.0, 2.0 * math.sqrt(Delta * (1.0 - Delta))
    for n in range(n_max + 1):
        inside = c1 if n == 0 else below / n
        h[n] = -_weight(n) * (reach * reach * I + inside)
        dh[n] = -4.0 * _weight(n) * reach * reach * M
        k = n + 1
        J_new = 2.0 * b * J_next - J + 2.0 * sine / k
        I_new = 2.0 * b * I_next - I - 2.0 * J_next
        M_new = 2.0 * b * M_next - M - 2.0 * I_next
        J, I, M = J_next, I_next, M_next
        J_next, I_next, M_next = J_new, I_new, M_new
        below, sine = sine, 2.0 * u1 * sine - below


@kernel
def _tail_integrals(beta: float, t1: float, closeness: float) -> tuple[float, float, float]:
    """Return ``int_t1^inf dt / (beta + t^2)^k`` for k = 1, 2, 3, beta > -t1^2.

    ``closeness = 1 + beta/t1^2`` is given apart, because it is what is left of two terms near -1.
    """
    y = beta / (t1 * t1)
    if abs(y) < 0.05:
        A, B, C, term = 0.0, 0.0, 0.0, 1.0
        for k in range(16):
            A += term / (2 * k + 1)
            B += (k + 1) * term / (2 * k + 3)
            C += 0.5 * (k + 1) * (k + 2) * term / (2 * k + 5)
            term *= -y
        return A / t1, B / t1**3, C / t1**5
    if beta > 0.0:
        root = math.sqrt(beta)
        S1 = math.atan2(root, t1) / root
    else:
        x = math.sqrt(-y)
        S1 = 0.5 * math.log((1.0 + x) ** 2 / closeness) / (x * t1)
    edge = t1 * t1 * closeness  # t1^2 + beta
    S2 = (S1 - t1 / edge) / (2.0 * beta)
    S3 = (3.0 * S2 - t1 / edge**2) / (4.0 * beta)
    return S1, S2, S3


# --- hysteresis -------------------------------------------------------------------------------------------------


@kernel
def hysteresis_harmonics(
    amplitude: float,
    Delta: float,
    reach: float,
    n_max: int,
    cons: _Floats,
    diss: _Floats,
    dcons: _Floats,
    ddiss: _Floats,
) -> None:
    """Fill CONS_n and DISS_n of an attraction of -1 over 0 < d < reach on retraction only, and their d/dDelta.

    Only where contact was made (Delta > 0); a reach beyond the far turning point is cut there, and the
    energy lost is less. The harmonics are those of a neck or a capillary that forms at contact.
    """
    for n in range(n_max + 1):
        cons[n], diss[n], dcons[n], ddiss[n] = 0.0, 0.0, 0.0, 0.0
    if not 0.0 < Delta < 1.0:
        return
    c1, c2 = contact_angle(Delta), contact_angle(Delta + 0.5 * reach / amplitude)
    rate1, rate2 = 2.0 / math.sin(c1), 2.0 / math.sin(c2) if c2 < math.pi else 0.0
    cons[0] = -(c2 - c1) / (2.0 * math.pi)
    dcons[0] = -(rate2 - rate1) / (2.0 * math.pi)
    for n in range(1, n_max + 1):
        middle, half = 0.5 * n * (c1 + c2), 0.5 * n * (c2 - c1)
        scale = -0.5 * _weight(n)
        cons[n] = scale / n * 2.0 * math.cos(middle) * math.sin(half)
        diss[n] = scale / n * 2.0 * math.sin(middle) * math.sin(half)
        dcons[n] = scale * (math.cos(n * c2) * rate2 - math.cos(n * c1) * rate1)
        ddiss[n] = scale * (math.sin(n * c2) * rate2 - math.sin(n * c1) * rate1)


# --- blocks -----------------------------------------------------------------------------------------------------


@kernel
def power_block(amplitude: _Floats, Delta: _Floats, power: _Floats, h: _Floats, dh: _Floats) -> None:
    """Fill harmonics (point, n) of `power_harmonics` for every point."""
    for i in range(amplitude.shape[0]):
        power_harmonics(amplitude[i], Delta[i], power[i], h.shape[1] - 1, h[i], dh[i])


@kernel
def adhesion_block(
    tail: int, amplitude: _Floats, Delta: _Floats, a0: _Floats, h: _Floats, dh: _Floats
) -> None:
    """Fill harmonics (point, n) of `adhesion_harmonics` for every point."""
    for i in range(amplitude.shape[0]):
        adhesion_harmonics(tail, amplitude[i], Delta[i], a0[i], h.shape[1] - 1, h[i], dh[i])


@kernel
def hysteresis_block(
    amplitude: _Floats,
    Delta: _Floats,
    reach: _Floats,
    cons: _Floats,
    diss: _Floats,
    dcons: _Floats,
    ddiss: _Floats,
) -> None:
    """Fill harmonics (point, n) of `hysteresis_harmonics` for every point."""
    for i in range(amplitude.shape[0]):
        hysteresis_harmonics(
            amplitude[i], Delta[i], reach[i], cons.shape[1] - 1, cons[i], diss[i], dcons[i], ddiss[i]
        )

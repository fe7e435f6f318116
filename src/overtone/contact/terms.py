"""Terms of the tip-sample force: the law of one term, and its harmonics in closed form.

The motion is ``d = A1 (u1 - cos psi)`` with ``u1 = 1 - 2 Delta``, ``Delta = delta_max/(2 A1)`` and
``psi = theta - pi`` (eq 13 of Shaik, Reifenberger and Raman 2020); the tip is in contact for
``|psi| < c1 = arccos u1``. Harmonics are cosine coefficients in ``theta``, so harmonic n of a term
carries ``(-1)^n`` against its coefficient in ``psi``. Scalars in, scalars out, SI units. Kernels and
their helpers share this file: the compiler's disk cache notices edits in one file only.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from overtone.kernels import KERNEL

# Shape of the adhesive force against the gap, in units of the force of adhesion.
NO_ADHESION = 0
LINEAR_TAIL = 1  # eq 17: falls linearly to zero at d = 2 a0
VAN_DER_WAALS_TAIL = 2  # eq 15: (a0 / (a0 + d))^2

_SERIES_LIMIT = 0.1
_AGM_STEPS = 7


@njit(**KERNEL)
def sphere_force(gap: float, Lambda: float) -> float:
    """Return the Hertz force of a paraboloid, ``Lambda (-d)^(3/2)`` in contact [N]."""
    if gap >= 0.0:
        return 0.0
    return Lambda * (-gap) * math.sqrt(-gap)


@njit(**KERNEL)
def adhesion_shape(tail: int, gap: float, a0: float) -> float:
    """Return the attractive force in units of F_ad: 1 in contact, the tail outside."""
    if tail == NO_ADHESION:
        return 0.0
    if gap <= 0.0:
        return 1.0
    if tail == LINEAR_TAIL:
        return max(0.0, 1.0 - gap / (2.0 * a0))
    ratio = a0 / (a0 + gap)
    return ratio * ratio


@njit(**KERNEL)
def _elliptic(m: float) -> tuple[float, float]:
    """Return the complete elliptic integrals K and E of parameter m < 1 (arithmetic-geometric mean)."""
    a, b, power, total = 1.0, math.sqrt(1.0 - m), 0.5, 0.5 * m
    for _ in range(_AGM_STEPS):
        c = 0.5 * (a - b)
        a, b = 0.5 * (a + b), math.sqrt(a * b)
        power *= 2.0
        total += power * c * c
    K = math.pi / (2.0 * a)
    return K, K * (1.0 - total)


@njit(**KERNEL)
def _power_series(order: int, power: float, prefactor: float, Delta: float) -> float:
    """Sum ``prefactor Delta^(p + 1/2) 2F1(1/2 - n, 1/2 + n; p + 3/2; Delta)`` for small Delta."""
    term, total = 1.0, 1.0
    for k in range(40):
        term *= (0.5 - order + k) * (0.5 + order + k) / ((power + 1.5 + k) * (1.0 + k)) * Delta
        total += term
        if abs(term) < 1e-17 * abs(total):
            break
    return float(prefactor * Delta ** (power + 0.5) * total)


# sqrt(pi) 2^p Gamma(p + 1) / Gamma(p + 3/2) for p = 1/2 and p = 3/2
_ROOT_PREFACTOR = math.sqrt(math.pi) * math.sqrt(2.0) * math.gamma(1.5) / math.gamma(2.0)
_SPHERE_PREFACTOR = math.sqrt(math.pi) * 2.0**1.5 * math.gamma(2.5) / math.gamma(3.0)


@njit(**KERNEL)
def sphere_integrals(
    Delta: float, n_max: int, K: npt.NDArray[np.float64], dK: npt.NDArray[np.float64]
) -> None:
    """Fill K_n and dK_n/dDelta of ``int_0^c1 (cos psi - u1)^(3/2) cos(n psi) dpsi``, n = 0..n_max.

    Valid for 0 < Delta < 1 (intermittent contact). Near Delta = 0 the elliptic form cancels, so K_0
    and K_1 come from their hypergeometric series there; higher orders follow by the upward recurrence
    ``(n + p + 1) K_{n+1} = 2 n u1 K_n - (n - p - 1) K_{n-1}``, and ``dK_n^(3/2)/dDelta = 3 K_n^(1/2)``.
    """
    u1 = 1.0 - 2.0 * Delta
    if Delta < _SERIES_LIMIT:
        K0 = _power_series(0, 1.5, _SPHERE_PREFACTOR, Delta)
        K1 = _power_series(1, 1.5, _SPHERE_PREFACTOR, Delta)
        root0 = _power_series(0, 0.5, _ROOT_PREFACTOR, Delta)
        root1 = _power_series(1, 0.5, _ROOT_PREFACTOR, Delta)
    else:
        EK, EE = _elliptic(Delta)
        complement = 1.0 - Delta
        K0 = 4.0 * math.sqrt(2.0) / 3.0 * (EK * complement * (2.0 - 3.0 * Delta) - EE * 2.0 * u1)
        K1 = (
            -4.0
            * math.sqrt(2.0)
            / 5.0
            * (EK * complement * (2.0 - Delta) - 2.0 * EE * (1.0 - Delta * complement))
        )
        root0 = 2.0 * math.sqrt(2.0) * (EE - complement * EK)
        root1 = K0 + u1 * root0  # cos psi = (cos psi - u1) + u1
    K[0] = K0
    dK[0] = 3.0 * root0
    if n_max >= 1:
        K[1] = K1
        dK[1] = 3.0 * root1
    below, here = root0, root1
    for n in range(1, n_max):
        K[n + 1] = (2.0 * n * u1 * K[n] - (n - 2.5) * K[n - 1]) / (n + 2.5)
        below, here = here, (2.0 * n * u1 * here - (n - 1.5) * below) / (n + 1.5)
        dK[n + 1] = 3.0 * here


@njit(**KERNEL)
def sphere_harmonics(
    amplitude: float, Delta: float, n_max: int, h: npt.NDArray[np.float64], dh: npt.NDArray[np.float64]
) -> None:
    """Fill the harmonics of ``(-d)^(3/2)`` in contact and their derivative by Delta [m^1.5]."""
    sphere_integrals(Delta, n_max, h, dh)
    scale = amplitude * math.sqrt(amplitude) / math.pi
    for n in range(n_max + 1):
        h[n] *= scale
        dh[n] *= scale
        scale = -2.0 * scale if n == 0 else -scale


@njit(**KERNEL)
def _linear_tail_integral(n: int, u2: float, c: float) -> float:
    """Return the antiderivative of ``(u2 - cos psi) cos(n psi)`` at psi = c."""
    if n == 0:
        return u2 * c - math.sin(c)
    if n == 1:
        return u2 * math.sin(c) - 0.5 * c - 0.25 * math.sin(2.0 * c)
    return u2 * math.sin(n * c) / n - 0.5 * (
        math.sin((n - 1) * c) / (n - 1) + math.sin((n + 1) * c) / (n + 1)
    )


@njit(**KERNEL)
def linear_adhesion_harmonics(
    amplitude: float,
    Delta: float,
    a0: float,
    n_max: int,
    h: npt.NDArray[np.float64],
    dh: npt.NDArray[np.float64],
) -> None:
    """Fill the harmonics of the attraction of eq 17 per F_ad, and their derivative by Delta.

    ``-1`` in contact, ``-1 + d/(2 a0)`` for 0 < d < 2 a0. The sum of the two parts is continuous in
    the gap, so its derivative is that of the ramp alone. Where the ramp reaches further than the
    motion (u2 < -1) it is cut at the far turning point, not extended.
    """
    u1 = 1.0 - 2.0 * Delta
    slope = amplitude / (2.0 * a0)
    u2 = u1 - 1.0 / slope
    c1 = math.acos(min(max(u1, -1.0), 1.0))
    c2 = math.acos(min(max(u2, -1.0), 1.0))
    for n in range(n_max + 1):
        weight = (1.0 if n == 0 else 2.0) / math.pi * (1.0 if n % 2 == 0 else -1.0)
        contact = c1 if n == 0 else math.sin(n * c1) / n
        ramp = c2 - c1 if n == 0 else (math.sin(n * c2) - math.sin(n * c1)) / n
        tail = _linear_tail_integral(n, u2, c2) - _linear_tail_integral(n, u2, c1)
        h[n] = weight * (slope * tail - contact)
        dh[n] = -2.0 * weight * slope * ramp

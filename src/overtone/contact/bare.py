"""Harmonics of a whole law on a bare cosine, for compiled code: closed forms wherever a term has one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from overtone.contact import terms
from overtone.contact.law import ADHESION, CURVE, NECK, POWER
from overtone.kernels import inner

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@inner
def has_closed_form(law: _Floats) -> bool:
    """Return whether every term of a law has its harmonics in closed form."""
    closed = True
    for k in range(law.shape[0]):
        closed = closed and law[k, 0] != CURVE
    return closed


@inner
def bare_harmonics(
    law: _Floats, amplitude: float, indentation: float, omega: float, f: _Complex, work: _Floats
) -> None:
    """Fill CONS_n - i DISS_n on ``d = -indentation + A (1 + cos theta)``; ``work`` is (4, n) at least.

    Only for laws with `has_closed_form`.
    """
    n_max = f.shape[0] - 1
    Delta = indentation / (2.0 * amplitude)
    f[:] = 0.0
    for k in range(law.shape[0]):
        kind, coefficient = law[k, 0], law[k, 1]
        if coefficient == 0.0:
            continue
        if kind == POWER:
            terms.power_harmonics(amplitude, Delta, law[k, 2], n_max, work[0], work[1])
            for n in range(n_max + 1):
                f[n] += coefficient * work[0, n]
        elif kind == ADHESION:
            terms.adhesion_harmonics(int(law[k, 3]), amplitude, Delta, law[k, 2], n_max, work[0], work[1])
            for n in range(n_max + 1):
                f[n] += coefficient * work[0, n]
        elif kind == NECK:
            terms.hysteresis_harmonics(amplitude, Delta, law[k, 2], n_max, work[0], work[1], work[2], work[3])
            for n in range(n_max + 1):
                f[n] += coefficient * complex(work[0, n], -work[1, n])
        else:  # a viscous term is the time derivative of a power one higher
            power = law[k, 2] + 1.0
            terms.power_harmonics(amplitude, Delta, power, n_max, work[0], work[1])
            for n in range(n_max + 1):
                f[n] += complex(0.0, n * omega * coefficient / power * work[0, n])

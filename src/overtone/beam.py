"""Modes of a cantilever beam, from the few numbers that a user can measure.

A uniform beam (Euler and Bernoulli), clamped at x = 0, of length 1, free at its end, with the tip as
a point mass at x = a. With ``lambda^4`` the squared frequency in units of ``E I / (m_beam L^3)``,

    phi'''' = lambda^4 phi,   phi(0) = phi'(0) = phi''(1) = phi'''(1) = 0,
    jump of phi''' at a = (m_tip / m_beam) lambda^4 phi(a)

and every mode is normalised to ``phi(a) = 1``, so that its stiffness is the one that a force at the
tip feels:

    m_j = (int phi^2 dx + m_tip/m_beam) m_beam          k_j = w_j^2 m_j
    Gamma_j = (int phi dx + m_tip/m_beam) m_beam / m_j  s_j = phi'(spot)

The beam ends where Euler and Bernoulli do: shear, the height and the rotary inertia of the tip and
every shape but a constant cross-section are left out. In air that is good to some per cent for
levers with straight edges; in a liquid, and for levers that narrow towards the tip, it is not.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from overtone.errors import ProbeError, ResonanceWarning
from overtone.probe import Cantilever, Mode

_Array = npt.NDArray[np.float64]

MOST_MODES = 20
HEAVIEST_TIP = 10.0
SIXTH_HARMONIC_WIDTH = 0.05


def beam_modes(
    *,
    frequency: float,
    quality_factor: float,
    stiffness: float | None = None,
    static_stiffness: float | None = None,
    count: int = 3,
    tip_position: float = 1.0,
    tip_mass: float = 0.0,
    spot_position: float | None = None,
    higher_frequencies: Sequence[float] | None = None,
    higher_quality_factors: Sequence[float] | None = None,
) -> Cantilever:
    """Return the modes of a uniform beam whose first mode was measured.

    Parameters
    ----------
    frequency, quality_factor : float
        f_1 [Hz] and Q_1 of the first mode, measured where the lever is used.
    stiffness : float
        Stiffness k_1 of the first mode at the tip [N/m], which is what the equipartition of its
        thermal peak, read as displacement of the tip, gives.
    static_stiffness : float
        In place of ``stiffness``: the stiffness against a static force at the tip [N/m]. Thermal
        calibrations that multiply by 0.971, and Sader's method, give it at the free end; it goes as
        ``1/tip_position**3``.
    count : int
        Number of modes, 1 to 20. The static answer stands for all others.
    tip_position : float
        Distance of the tip from the clamp over the length of the beam, 1 at the free end.
    tip_mass : float
        Mass of the tip over mass of the beam, 0 to 10.
    spot_position : float, optional
        Where the laser reads the slope, as a fraction of the length; the tip unless given.
    higher_frequencies : sequence of float, optional
        f_2, f_3, ... as measured [Hz], one for each further mode, where the lever is not quite a
        uniform beam. The modes keep the shapes and masses of the beam: ``k_j = w_j^2 m_j``.
    higher_quality_factors : sequence of float, optional
        Q_2, Q_3, ..., one for each further mode. Unless given, ``Q_j = Q_1 sqrt(w_j/w_1)``.

    Returns
    -------
    Cantilever
        Modes with slope ratios and base participations, static stiffness and static slope ratio.

    Warns
    -----
    ResonanceWarning
        If the second mode lies at six times the first (`warn_of_internal_resonance`).

    Raises
    ------
    ProbeError
        If a number is out of range, if not exactly one stiffness is given, or if the tip sits on a
        node of a mode.

    Notes
    -----
    Uniform beam, no tip mass, tip and spot at the end: ``k_1 = 1.0302 k_static``, ``w_2/w_1 = 6.267``
    (Meirovitch, Analytical Methods in Vibrations, 1967; Melcher, Hu and Raman, Appl. Phys. Lett. 91
    (2007) 053101).

    The quality factors of higher modes follow the drag of a boundary layer, whose damping rate grows
    as the square root of frequency: Sader, J. Appl. Phys. 84 (1998) 64, at Reynolds numbers above
    one. His full expression for common levers in air gives exponents of 0.48 to 0.55 in place of
    0.5. Losses in the clamp and in a coating are left out, and make high modes broader than this.

    Examples
    --------
    >>> lever = beam_modes(stiffness=40.0, frequency=300e3, quality_factor=450.0)
    >>> [round(mode.frequency / 300e3, 3) for mode in lever.modes]
    [1.0, 6.267, 17.547]
    >>> [round(mode.slope_ratio, 3) for mode in lever.modes], round(lever.static_slope_ratio, 4)
    ([1.0, 3.473, 5.702], 1.0897)
    """
    spot = tip_position if spot_position is None else spot_position
    faults = _faults(
        count,
        positive={
            "frequency": frequency,
            "quality_factor": quality_factor,
            "stiffness": stiffness,
            "static_stiffness": static_stiffness,
        },
        fractions={"tip_position": tip_position, "spot_position": spot},
        higher={"higher_frequencies": higher_frequencies, "higher_quality_factors": higher_quality_factors},
    )
    if not 0.0 <= tip_mass <= HEAVIEST_TIP:
        faults.append(f"tip_mass = {tip_mass!r} is not from 0 to {HEAVIEST_TIP:g} masses of the beam")
    if (stiffness is None) == (static_stiffness is None):
        faults.append("not exactly one of stiffness and static_stiffness")
    if faults:
        raise ProbeError(
            "no beam can be made of this",
            got="; ".join(faults),
            hint="SI units, and positions as fractions of the length, 1 at the free end",
        )

    roots = _wavenumbers(count, tip_position, tip_mass)
    coefficients = _shapes(roots, tip_position, tip_mass)
    mass, moment = _inertia(coefficients, roots, tip_position, tip_mass)
    slopes = _evaluate(coefficients, roots, spot, tip_position, 1)[:, 0]

    # Stiffnesses in units of E I / L^3; a force at x = a bends the beam as a cantilever of length a.
    static = 3.0 / tip_position**3
    first = roots[0] ** 4 * mass[0]
    unit = stiffness / first if stiffness is not None else (static_stiffness or 0.0) / static
    reach = min(spot, tip_position)
    static_slope = 1.5 * reach * (2.0 * tip_position - reach) / tip_position**3

    ratios = (roots / roots[0]) ** 2
    if higher_frequencies is not None:
        ratios[1:] = np.asarray(higher_frequencies) / frequency
    quality_factors = quality_factor * np.sqrt(ratios)
    if higher_quality_factors is not None:
        quality_factors[1:] = higher_quality_factors
    modes = tuple(
        Mode(
            stiffness=float(unit * first * ratios[j] ** 2 * mass[j] / mass[0]),
            frequency=float(frequency * ratios[j]),
            quality_factor=float(quality_factors[j]),
            slope_ratio=float(slopes[j] / slopes[0]),
            base_participation=float(moment[j] / mass[j]),
        )
        for j in range(count)
    )
    lever = Cantilever(modes, float(unit * static), float(static_slope / slopes[0]))
    warn_of_internal_resonance(lever)
    return lever


def warn_of_internal_resonance(cantilever: Cantilever) -> None:
    """Warn where the sixth harmonic of a drive at resonance meets the second mode.

    Parameters
    ----------
    cantilever : Cantilever
        One mode never warns.

    Warns
    -----
    ResonanceWarning
        If ``|w_2/w_1 - 6| < 0.05``.

    Examples
    --------
    >>> warn_of_internal_resonance(Cantilever.single_mode(40.0, 300e3, 450.0))
    """
    if len(cantilever.modes) < 2:
        return
    first, second = cantilever.modes[:2]
    ratio = second.frequency / first.frequency
    if abs(ratio - 6.0) < SIXTH_HARMONIC_WIDTH:
        warnings.warn(
            f"the second mode lies at {ratio:.3f} times the first: the sixth harmonic of the contact drives "
            "it, and what the tip then does moves the second force harmonic by per cents. Drive another "
            "lever, or allow for that error",
            ResonanceWarning,
            stacklevel=3,
        )


def _faults(
    count: int,
    positive: Mapping[str, float | None],
    fractions: Mapping[str, float],
    higher: Mapping[str, Sequence[float] | None],
) -> list[str]:
    """Return a sentence for every argument that is out of range."""
    faults = []
    if not (isinstance(count, int) and 1 <= count <= MOST_MODES):
        faults.append(f"count = {count!r} is not a whole number from 1 to {MOST_MODES}")
    for name, value in positive.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            faults.append(f"{name} = {value!r} is not a finite positive number")
    for name, value in fractions.items():
        if not 0.0 < value <= 1.0:
            faults.append(f"{name} = {value!r} is not a fraction of the length")
    for name, values in higher.items():
        if values is not None and len(values) != count - 1:
            faults.append(f"{name} has {len(values)} values for {count - 1} higher modes")
        if values is not None and not all(math.isfinite(value) and value > 0.0 for value in values):
            faults.append(f"{name} are not all finite positive numbers")
    frequencies = [positive.get("frequency") or 0.0, *(higher.get("higher_frequencies") or ())]
    if any(upper <= lower for lower, upper in itertools.pairwise(frequencies)):
        faults.append("higher_frequencies do not rise above that of the first mode")
    return faults


def _functions(wavenumber: _Array, x: float, a: float, order: int) -> _Array:
    """Return five solutions and their derivatives over ``lambda**order``, shape (..., 5).

    Four solve the beam equation everywhere, and none of them grows, so that high modes keep their
    digits; the fifth has a jump of 4 in its third derivative at the tip, the shear of a point mass.
    At the tip itself its far side is meant, which is the free end where the tip sits there.
    """
    z = np.asarray(wavenumber, dtype=float)
    turn = order * np.pi / 2
    distance, side = abs(x - a), 1.0 if x >= a else -1.0
    jump = -(side**order) * ((-1.0) ** order * np.exp(-z * distance) + np.sin(z * distance + turn))
    return np.stack(
        [
            np.cos(z * x + turn),
            np.sin(z * x + turn),
            (-1.0) ** order * np.exp(-z * x),
            np.exp(-z * (1.0 - x)),
            jump,
        ],
        axis=-1,
    )


def _conditions(wavenumber: _Array, a: float, tip_mass: float) -> _Array:
    """Return the matrix of the conditions at clamp, free end and tip, shape (..., 5, 5)."""
    z = np.asarray(wavenumber, dtype=float)
    tip = (tip_mass * z)[..., None] * _functions(z, a, a, 0)
    tip[..., 4] -= 4.0
    ends = [_functions(z, x, a, order) for x, order in ((0.0, 0), (0.0, 1), (1.0, 2), (1.0, 3))]
    return np.stack([*ends, tip], axis=-2)


def _wavenumbers(count: int, a: float, tip_mass: float) -> _Array:
    """Return the lowest roots lambda_j: scanned for changes of sign, then halved to rounding."""
    # A mass lowers every root, but not below the one before it; without it they lie near (j - 1/2) pi.
    grid = np.arange(0.1, (count + 0.1) * np.pi, 0.02)
    sign = np.sign(np.linalg.det(_conditions(grid, a, tip_mass)))
    at = np.flatnonzero(sign[1:] != sign[:-1])[:count]
    low, high, below = grid[at], grid[at + 1], sign[at]
    for _ in range(52):
        middle = 0.5 * (low + high)
        same = np.sign(np.linalg.det(_conditions(middle, a, tip_mass))) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def _shapes(roots: _Array, a: float, tip_mass: float) -> _Array:
    """Return the coefficients of every mode, one a row, with displacement 1 at the tip."""
    null = np.linalg.svd(_conditions(roots, a, tip_mass))[2][:, -1, :]
    at_tip = np.sum(null * _functions(roots, a, a, 0), axis=-1)
    nodes = [f"mode {j + 1}" for j in np.flatnonzero(np.abs(at_tip) < 1e-6 * np.abs(null).max(axis=-1))]
    if nodes:
        raise ProbeError(
            f"the tip sits on a node of {' and '.join(nodes)}",
            expected="a tip that every mode moves",
            got=f"tip_position = {a!r}",
            hint="fewer modes, or the position as measured",
        )
    return np.asarray(null / at_tip[:, None])


def _evaluate(coefficients: _Array, roots: _Array, x: float | _Array, a: float, order: int) -> _Array:
    """Return a derivative of every mode at points of the beam, shape (modes, points)."""
    points = [np.sum(coefficients * _functions(roots, float(p), a, order), axis=-1) for p in np.atleast_1d(x)]
    return np.asarray(np.stack(points, axis=-1) * roots[:, None] ** order)


def _inertia(coefficients: _Array, roots: _Array, a: float, tip_mass: float) -> tuple[_Array, _Array]:
    """Return the mass of every mode and the inertia by which the base drives it, in masses of the beam."""
    nodes, weights = np.polynomial.legendre.leggauss(16 + 4 * len(roots))
    mass = np.full(len(roots), float(tip_mass))
    moment = mass.copy()
    for start, end in ((0.0, a), (a, 1.0)):
        half = 0.5 * (end - start)
        shape = _evaluate(coefficients, roots, start + half * (1.0 + nodes), a, 0)
        mass += half * (shape**2 @ weights)
        moment += half * (shape @ weights)
    return mass, moment

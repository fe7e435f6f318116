"""Adhesive contact beyond DMT: the laws of JKR and of Maugis and Dugdale, and their harmonics by quadrature.

A paraboloid of radius R under the effective modulus E* and the work of adhesion w. Both laws are
quasi-static and at fixed displacement: the lever's own instability belongs to the dynamics, not here.
Where the force against the indentation folds over, the stable branch is followed to the fold:

- on approach the tip feels nothing until it jumps onto the stable branch, at zero gap (JKR) or where the
  gap equals the range ``h0`` of the attraction (Maugis-Dugdale);
- on retraction it holds on to the fold and then lets go. The energy lost per cycle is the area between.

Repulsion is positive, indentation is minus the gap. Sources: Johnson, Kendall and Roberts, Proc. R. Soc.
Lond. A 324 (1971) 301; Maugis, J. Colloid Interface Sci. 150 (1992) 243. Kernels work in units of
``pi w R`` (force) and ``(pi^2 w^2 R / K^2)^(1/3)`` with ``K = 4/3 E*`` (indentation), Maugis's own, in
which JKR is the limit of large ``lambda``; where there is no adhesion, in ``K R^2`` and R.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.errors import ContactModelError
from overtone.kernels import inner, kernel

_LAWS = ("jkr", "maugis")

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_TOLERANCE = 1e-11  # of the piece; halving stops there, and the halves are better than what they check
_DEPTH = 50  # a piece is halved no further: 2^-50 of it is below rounding
_STEPS = 80
_NODES.setflags(write=False)
_WEIGHTS.setflags(write=False)

# a^2 at the fold of JKR, in Maugis's units: a = 6^(-1/3) z^2
_JKR_AREA = 6.0 ** (-2.0 / 3.0)


class Curve(NamedTuple):
    """A law in units of its own: what is needed to follow its stable branch."""

    lam: float
    """Maugis parameter; 0 stands for no adhesion, infinity for JKR."""
    fold: float
    """Indentation at the fold, where the tip lets go."""
    width: float
    """Of the hysteresis: the tip jumps in at the indentation fold + width."""
    onset: float
    """Indentation where contact begins on the stable branch; below, attraction without contact."""
    last: float
    """Angle nu = arcsec(c/a) where contact begins on the stable branch, or at the fold."""
    rim: float
    """Radius of the attracted zone at the fold without contact."""


@inner
def _contact_shapes(nu: float) -> tuple[float, float]:
    """Return ``sin(nu) cos(nu) - nu cos(2 nu)`` and ``nu sin(nu) + cos(nu) - 1``, by series where they cancel."""
    if nu > 0.5:
        return (
            math.sin(nu) * math.cos(nu) - nu * math.cos(2.0 * nu),
            nu * math.sin(nu) + math.cos(nu) - 1.0,
        )
    # sums over k >= 1 of (-1)^(k+1) k (2 nu)^(2k+1)/(2k+1)! and (-1)^(k+1) (2k - 1) nu^(2k)/(2k)!
    square = nu * nu
    wide, narrow = 0.0, 0.0
    wide_term, narrow_term = 4.0 / 3.0 * nu * square, 0.5 * square
    for k in range(1, 10):
        wide += wide_term * k
        narrow += narrow_term * (2 * k - 1)
        wide_term *= -4.0 * square / ((2 * k + 2) * (2 * k + 3))
        narrow_term *= -square / ((2 * k + 1) * (2 * k + 2))
    return wide, narrow


@inner
def _contact(lam: float, nu: float) -> tuple[float, float, float, float]:
    """Return rim radius c, indentation, its slope by nu over cos(nu), and force of Maugis's contact.

    With ``m = c/a = 1/cos(nu)`` and c in place of a his eqs read, without poles at either end,

        (lambda/2) c^2 [sin nu cos nu - nu cos 2 nu] + (4/3) lambda^2 c [nu sin nu + cos nu - 1] = 1
        indentation = (c cos nu)^2 - (4/3) lambda c sin nu
        force = (c cos nu)^3 - lambda c^2 [sin nu cos nu + nu]

    for 0 < nu <= pi/2: small nu is deep in contact, pi/2 its first point (a = 0).
    """
    wide, narrow = _contact_shapes(nu)
    s, k = math.sin(nu), math.cos(nu)
    a, b = 0.5 * lam * wide, 4.0 / 3.0 * lam * lam * narrow
    c = 2.0 / (b + math.sqrt(b * b + 4.0 * a))
    # dc/dnu / cos(nu), from the first equation: the derivatives of its brackets are 2 nu sin 2 nu, nu cos nu
    rate = -nu * c * (2.0 * lam * c * s + 4.0 / 3.0 * lam * lam) / (2.0 * a * c + b)
    ck = c * k
    slope = 2.0 * c * rate * k * k - 2.0 * c * c * s - 4.0 / 3.0 * lam * (rate * s + c)
    force = ck * ck * ck - lam * c * c * (s * k + nu)
    return c, ck * ck - 4.0 / 3.0 * lam * c * s, slope, force


@inner
def _curve(lam: float) -> Curve:
    """Return where a law folds and where contact begins."""
    if lam == 0.0:
        return Curve(lam, 0.0, 0.0, -math.inf, 0.0, 0.0)
    if lam == math.inf:
        return Curve(lam, -3.0 * _JKR_AREA, 3.0 * _JKR_AREA, -math.inf, 0.0, 0.0)
    reach = 2.0 / (math.pi * lam)
    rim = 8.0 * lam / (3.0 * math.pi)
    high = 0.5 * math.pi
    if _contact(lam, high)[2] <= 0.0:  # contact begins on the stable branch; the fold is before it
        onset = _contact(lam, high)[1]
        return Curve(lam, -reach - 0.5 * rim * rim, 0.5 * rim * rim, onset, high, rim)
    low = 0.1 / max(1.0, lam)
    for _ in range(_STEPS):
        middle = math.sqrt(low * high)
        if _contact(lam, middle)[2] < 0.0:
            low = middle
        else:
            high = middle
    fold = _contact(lam, high)[1]
    return Curve(lam, fold, -reach - fold, -math.inf, high, rim)


@kernel
def _curves(lam: npt.NDArray[np.float64], curves: npt.NDArray[np.float64]) -> None:
    """Fill the fields of a curve, a row for each Maugis parameter."""
    for i in range(lam.size):
        if not i or lam[i] != lam[i - 1]:
            lam_, fold, width, onset, last, rim = _curve(lam[i])
        curves[i, 0], curves[i, 1], curves[i, 2] = lam_, fold, width
        curves[i, 3], curves[i, 4], curves[i, 5] = onset, last, rim


@inner
def _read(curves: npt.NDArray[np.float64], i: int) -> Curve:
    """Return a row as a curve."""
    return Curve(curves[i, 0], curves[i, 1], curves[i, 2], curves[i, 3], curves[i, 4], curves[i, 5])


@inner
def _find_contact(curve: Curve, indentation: float, guess: float) -> tuple[float, float]:
    """Return force and angle nu of Maugis's contact on the stable branch (Newton in a bracket)."""
    low, high = 0.0, curve.last
    nu, force = guess, 0.0
    for _ in range(_STEPS):
        _, reached, slope, force = _contact(curve.lam, nu)
        if reached > indentation:
            low = nu
        else:
            high = nu
        step = (indentation - reached) / (slope * math.cos(nu))
        if abs(step) < 4e-16 * nu:
            break
        if low < nu + step < high:
            nu += step
            continue
        middle = 0.5 * (low + high) if low > 0.0 else 0.3 * high
        if middle in (low, high):
            break
        nu = middle
    return force, nu


@inner
def branch(curve: Curve, indentation: float, excess: float, guess: float) -> tuple[float, float]:
    """Return the force on the stable branch, and the angle nu to start the next search from.

    ``excess`` is the indentation above the fold, given apart because the root of it counts.
    """
    excess = max(excess, 0.0)
    if curve.lam == 0.0:
        return excess * math.sqrt(excess), guess
    if curve.lam == math.inf:
        # indentation 6^(-2/3) (z^4 - 4 z), force z^6/6 - z^3, z = 1 + e; Newton falls onto e from above
        target = excess / _JKR_AREA
        e = min(math.sqrt(target / 6.0), math.sqrt(math.sqrt(target)))
        for _ in range(_STEPS):
            step = (((e + 4.0) * e + 6.0) * e * e - target) / (4.0 * ((e + 3.0) * e + 3.0) * e)
            if not step > 2e-16 * e:
                break
            e -= step
        cube = (1.0 + e) ** 3
        return cube * cube / 6.0 - cube, guess
    if indentation < curve.onset:
        c = curve.rim + math.sqrt(2.0 * excess)
        return -0.5 * math.pi * curve.lam * c * c, guess
    return _find_contact(curve, indentation, guess)


@kernel
def _forces(
    indentation: npt.NDArray[np.float64],
    curves: npt.NDArray[np.float64],
    length: npt.NDArray[np.float64],
    unit: npt.NDArray[np.float64],
    approaching: npt.NDArray[np.bool_],
    force: npt.NDArray[np.float64],
) -> None:
    """Fill the force at each indentation [N]."""
    for i in range(indentation.size):
        curve = _read(curves, i)
        x = indentation[i] / length[i]
        limit = curve.fold + curve.width if approaching[i] else curve.fold
        force[i] = 0.0
        if x >= limit:
            force[i] = unit[i] * branch(curve, x, x - curve.fold, 0.5 * curve.last)[0]


@inner
def _angle_of_contact(lam: float, contact_radius: float) -> float:
    """Return nu of Maugis's contact of this radius (bisection: a falls as nu grows)."""
    low, high = 1e-12, 0.5 * math.pi
    if contact_radius <= 0.0:
        return high
    for _ in range(2 * _STEPS):
        middle = math.sqrt(low * high)
        if middle in (low, high):
            break
        if _contact(lam, middle)[0] * math.cos(middle) > contact_radius:
            low = middle
        else:
            high = middle
    return high


@kernel
def _points(
    contact_radius: npt.NDArray[np.float64],
    lam: npt.NDArray[np.float64],
    length: npt.NDArray[np.float64],
    unit: npt.NDArray[np.float64],
    indentation: npt.NDArray[np.float64],
    force: npt.NDArray[np.float64],
) -> None:
    """Fill indentation and force of Maugis's contact [m, N] at each contact radius, in Maugis's unit."""
    for i in range(contact_radius.size):
        _, x, _, f = _contact(lam[i], _angle_of_contact(lam[i], contact_radius[i]))
        indentation[i], force[i] = length[i] * x, unit[i] * f


@inner
def _panel(
    curve: Curve,
    swing: float,
    start: float,
    x0: float,
    excess0: float,
    a: float,
    b: float,
    guess: float,
    sums: npt.NDArray[np.float64],
) -> float:
    """Fill the integrals over phi = start + s^2, s from a to b, of force times cos and sin of n phi.

    ``swing`` is twice the amplitude; x0 and excess0 belong to ``start``. The last column takes the
    integrals of the force without its sign. Returns where to start the next search for the contact.
    """
    last = sums.shape[1] - 1
    for n in range(last + 1):
        sums[0, n] = sums[1, n] = 0.0
    middle, half = 0.5 * (a + b), 0.5 * (b - a)
    for i in range(_NODES.size):
        s = middle + half * _NODES[i]
        step = s * s
        rise = swing * math.sin(0.5 * step) * math.sin(start + 0.5 * step)
        force, guess = branch(curve, x0 + rise, excess0 + rise, guess)
        weighted = force * 2.0 * s * half * _WEIGHTS[i]
        cosine, sine = math.cos(start + step), math.sin(start + step)
        c, d = 1.0, 0.0
        for n in range(last):
            sums[0, n] += weighted * c
            sums[1, n] += weighted * d
            c, d = c * cosine - d * sine, d * cosine + c * sine
        sums[0, last] += abs(weighted)
        sums[1, last] += abs(weighted * sine)
    return guess


@inner
def _copy(source: npt.NDArray[np.float64], target: npt.NDArray[np.float64]) -> None:
    for n in range(source.shape[1]):
        target[0, n], target[1, n] = source[0, n], source[1, n]


@inner
def _piece(
    curve: Curve,
    swing: float,
    start: float,
    x0: float,
    excess0: float,
    span: float,
    guess: float,
    total: npt.NDArray[np.float64],
) -> float:
    """Fill the integrals over a piece without jumps, halving it until they stand still."""
    rows, columns = total.shape
    # sums of the intervals that wait, from last to first; above them the left half at hand, last the right
    sums = np.empty((_DEPTH + 3, rows, columns))
    right = sums[_DEPTH + 2]
    ends = np.empty((_DEPTH + 2, 2))
    depth = np.empty(_DEPTH + 2, dtype=np.int64)
    even, odd = 0.0, 0.0
    for n in range(columns):
        total[0, n] = total[1, n] = 0.0
    ends[0, 0], ends[0, 1], depth[0] = 0.0, math.sqrt(span), -1
    top = 0
    while top >= 0:
        first = depth[top] < 0
        a, b, left = ends[top, 0], ends[top, 1], sums[top + 1]
        middle = b if first else 0.5 * (a + b)
        for half in range(2):
            p, q = (a, middle) if half == 0 else (middle, b)
            guess = _panel(curve, swing, start, x0, excess0, p, q, guess, right if half else left)
        if first:
            _copy(left, sums[0])
            depth[0] = 0
            even, odd = _TOLERANCE * left[0, columns - 1], _TOLERANCE * left[1, columns - 1]
            continue
        agree = True
        for n in range(columns - 1):
            agree &= abs(sums[top, 0, n] - left[0, n] - right[0, n]) <= even
            agree &= abs(sums[top, 1, n] - left[1, n] - right[1, n]) <= odd
        if agree or depth[top] == _DEPTH:
            for row in range(rows):
                for n in range(columns):
                    total[row, n] += left[row, n] + right[row, n]
            top -= 1
            continue
        _copy(right, sums[top])
        ends[top, 0] = middle
        depth[top] += 1
        top += 1
        ends[top, 0], ends[top, 1], depth[top] = a, middle, depth[top - 1]
    return guess


@inner
def _angle(level: float, low: float, swing: float) -> float:
    """Return the angle phi from the upper turning point at which the tip is at an indentation, 0 to pi."""
    below = (level - low) / swing
    if below < 0.5:
        return 2.0 * math.asin(math.sqrt(max(below, 0.0)))
    return math.pi - 2.0 * math.asin(math.sqrt(max(1.0 - below, 0.0)))


@kernel
def _harmonics(
    amplitude: npt.NDArray[np.float64],
    indentation: npt.NDArray[np.float64],
    curves: npt.NDArray[np.float64],
    length: npt.NDArray[np.float64],
    unit: npt.NDArray[np.float64],
    cons: npt.NDArray[np.float64],
    diss: npt.NDArray[np.float64],
) -> None:
    """Fill CONS_n and DISS_n [N], one row each per motion.

    phi runs from the upper turning point: theta = phi on approach, 2 pi - phi on retraction. The stable
    branch counts twice where both directions follow it, and once between fold and jump.
    """
    orders = cons.shape[1]
    total = np.empty((2, orders + 1))
    levels = np.empty(4)
    for i in range(amplitude.size):
        for n in range(orders):
            cons[i, n] = diss[i, n] = 0.0
        curve = _read(curves, i)
        swing, high = 2.0 * amplitude[i] / length[i], indentation[i] / length[i]
        low = high - swing
        jump = curve.fold + curve.width
        if high <= jump:
            continue
        # indentations between which the force is smooth; the last end is the lower turning point
        count = 1
        window = low < curve.fold
        levels[0] = curve.fold if window else low
        if window and curve.width > 0.0:
            levels[count] = jump
            count += 1
        if levels[0] < curve.onset < high:
            levels[count] = curve.onset
            count += 1
            if count == 3 and levels[1] > levels[2]:
                levels[1], levels[2] = levels[2], levels[1]
        guess = 0.5 * curve.last
        for j in range(count):
            start = _angle(levels[j], low, swing)
            excess = levels[j] - curve.fold
            if window and levels[j] == jump:
                excess = curve.width
            if j + 1 == count:
                span = math.pi - start
            else:
                end = _angle(levels[j + 1], low, swing)
                rise = levels[j + 1] - levels[j]
                if levels[j] == curve.fold and levels[j + 1] == jump:
                    rise = curve.width
                span = 2.0 * math.asin(min(1.0, rise / (swing * math.sin(0.5 * (start + end)))))
            once = window and levels[j] < jump
            guess = _piece(curve, swing, start, levels[j], excess, span, guess, total)
            for n in range(orders):
                cons[i, n] += (1.0 if once else 2.0) * total[0, n]
                if once:
                    diss[i, n] -= total[1, n]
        for n in range(orders):
            scale = unit[i] / (math.pi if n else 2.0 * math.pi)
            cons[i, n] *= scale
            diss[i, n] *= scale


def _checked(name: str, value: Any, unit: str, lowest: float, *, open_end: bool) -> npt.NDArray[np.float64]:
    """Return a parameter as an array of finite numbers in its range."""
    array = np.asarray(value, dtype=float)
    if not np.all(np.isfinite(array) & ((array > lowest) if open_end else (array >= lowest))):
        bound = "" if lowest == -math.inf else f" {'>' if open_end else '>='} {lowest:g} {unit}"
        raise ContactModelError(f"{name} is out of range", expected=f"finite numbers{bound}")
    return array


def _material(
    effective_modulus: Any, radius: Any, work_of_adhesion: Any
) -> dict[str, npt.NDArray[np.float64]]:
    return {
        "effective_modulus": _checked("effective_modulus", effective_modulus, "Pa", 0.0, open_end=True),
        "radius": _checked("radius", radius, "m", 0.0, open_end=True),
        "work_of_adhesion": _checked("work_of_adhesion", work_of_adhesion, "J/m^2", 0.0, open_end=False),
    }


def _range(range_of_attraction: Any) -> npt.NDArray[np.float64]:
    return _checked("range_of_attraction", range_of_attraction, "m", 0.0, open_end=True)


def _broadcast(arrays: dict[str, npt.NDArray[Any]]) -> tuple[tuple[int, ...], list[npt.NDArray[Any]]]:
    """Return the common shape, and every array flat in that shape."""
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError as error:
        got = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ContactModelError("shapes do not fit", expected="arrays that broadcast", got=got) from error
    return shape, [np.broadcast_to(array, shape).flatten() for array in arrays.values()]


def _units(
    effective_modulus: npt.NDArray[np.float64],
    radius: npt.NDArray[np.float64],
    work_of_adhesion: npt.NDArray[np.float64],
    range_of_attraction: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return Maugis's parameter (0 without adhesion), and the units of length and force [m, N]."""
    K, w, none = 4.0 / 3.0 * effective_modulus, work_of_adhesion, work_of_adhesion == 0.0
    length = np.cbrt(math.pi * w / K) ** 2 * np.cbrt(radius)
    # 2 sigma0 (R/(pi w K^2))^(1/3) with sigma0 = w/h0; a range of zero is JKR's
    with np.errstate(divide="ignore", invalid="ignore"):
        lam = np.where(none, 0.0, 2.0 * length / (math.pi * range_of_attraction))
    return lam, np.where(none, radius, length), np.where(none, K * radius**2, math.pi * w * radius)


def _table(lam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the curves of these Maugis parameters."""
    curves = np.empty((lam.size, len(Curve._fields)))
    _curves(lam, curves)
    return curves


def jkr_row(effective_modulus: Any, radius: Any, work_of_adhesion: Any) -> npt.NDArray[np.float64]:
    """Return the fields of the curve, its unit of length [m] and of force [N], last axis, for compiled laws."""
    arrays = _material(effective_modulus, radius, work_of_adhesion)
    return _row(arrays | {"range_of_attraction": np.zeros(())})


def maugis_row(
    effective_modulus: Any, radius: Any, work_of_adhesion: Any, range_of_attraction: Any
) -> npt.NDArray[np.float64]:
    """Return the same for a Maugis-Dugdale contact."""
    arrays = _material(effective_modulus, radius, work_of_adhesion)
    return _row(arrays | {"range_of_attraction": _range(range_of_attraction)})


def _row(arrays: dict[str, npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    shape, flat = _broadcast(arrays)
    lam, length, unit = _units(*flat)
    return np.concatenate([_table(lam), length[:, None], unit[:, None]], axis=1).reshape(*shape, -1)


def _force(
    indentation: Any,
    material: dict[str, npt.NDArray[np.float64]],
    range_of_attraction: npt.NDArray[np.float64],
    approaching: Any,
) -> npt.NDArray[np.float64]:
    inwards = np.asarray(approaching)
    if inwards.dtype != np.bool_:
        raise ContactModelError("approaching is not a truth value", expected="bool", got=str(inwards.dtype))
    shape, flat = _broadcast(
        {
            "indentation": _checked("indentation", indentation, "m", -math.inf, open_end=True),
            "approaching": inwards,
            **material,
            "range_of_attraction": range_of_attraction,
        }
    )
    force = np.empty(flat[0].size)
    lam, length, unit = _units(*flat[2:])
    _forces(flat[0], _table(lam), length, unit, flat[1], force)
    return force.reshape(shape)


def jkr_force(
    indentation: Any, *, effective_modulus: Any, radius: Any, work_of_adhesion: Any, approaching: Any
) -> npt.NDArray[np.float64]:
    """Return the force of Johnson, Kendall and Roberts at fixed displacement [N].

    Parametric in the contact radius a (see `jkr_curve`), ``F = 4 E* a^3/(3 R) - sqrt(8 pi w E* a^3)`` and
    ``delta = a^2/R - sqrt(2 pi w a/E*)``, on the stable branch ``a^3 >= a_s^3 = pi w R^2/(8 E*)``. The
    force of adhesion, the largest pull, is ``3/2 pi w R``; contact breaks at ``delta = -3 a_s^2/R``, where
    the pull is 5/6 pi w R. On approach there is no force at a positive gap (attraction of no range), and
    at zero gap the tip jumps onto the branch, where the pull is 4/3 pi w R.

    Valid for Tabor parameters above about 5, contact radii well below R, and slow, elastic contact.

    Parameters
    ----------
    indentation : array
        Minus the gap [m].
    effective_modulus, radius, work_of_adhesion : array, broadcast
        E* [Pa] and R [m], positive; w [J/m^2], not negative (0 is the Hertz contact).
    approaching : bool array, broadcast
        Whether the tip comes from outside, or leaves a contact it has made.

    Raises
    ------
    ContactModelError
        If a parameter is out of range or the shapes do not fit.

    Examples
    --------
    Just before contact breaks, and just before it is made:

    >>> material = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
    >>> [round(float(jkr_force(-0.7e-9, approaching=way, **material)) * 1e9, 3) for way in (False, True)]
    [-3.673, 0.0]
    """
    material = _material(effective_modulus, radius, work_of_adhesion)
    return _force(indentation, material, np.zeros(()), approaching)


def maugis_force(
    indentation: Any,
    *,
    effective_modulus: Any,
    radius: Any,
    work_of_adhesion: Any,
    range_of_attraction: Any,
    approaching: Any,
) -> npt.NDArray[np.float64]:
    """Return the force of Maugis with Dugdale's attraction, at fixed displacement [N].

    A constant attraction ``sigma0 = w/h0`` acts where the surfaces are less than h0 apart: in a ring round
    the contact (Maugis's eqs, see `maugis_curve`), or, before there is contact, in a disc of radius c with

        indentation = c^2/(2 R) - 4 sigma0 c/(pi E*) - h0,    force = -pi c^2 sigma0,

    from the displacement ``4 sigma0 c/(pi E*)`` at the edge of an evenly loaded disc; both meet where the
    displacement ``2 sigma0 c/E*`` at its centre closes the gap. The curve always folds: the tip jumps in at
    a gap of h0 and lets go a little further out, by ``8 R sigma0^2/(pi E*)^2`` where lambda < 0.938 (a loop
    of area proportional to lambda^5, soon invisible), and from the contact itself where lambda is larger.
    The pull is at most 2 pi w R (lambda -> 0, DMT) to 3/2 pi w R (lambda -> infinity, JKR).

    Parameters
    ----------
    indentation : array
        Minus the gap [m], the gap being that of the undeformed surfaces.
    effective_modulus, radius, work_of_adhesion : array, broadcast
        E* [Pa] and R [m], positive; w [J/m^2], not negative (0 is the Hertz contact).
    range_of_attraction : array, broadcast
        h0 = w/sigma0 [m], positive; `dugdale_range` gives it from the intermolecular distance.
    approaching : bool array, broadcast
        Whether the tip comes from outside, or leaves an attraction it has reached.

    Raises
    ------
    ContactModelError
        If a parameter is out of range or the shapes do not fit.

    Examples
    --------
    >>> material = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
    >>> pull = maugis_force([0.0, -0.1e-9], range_of_attraction=0.2e-9, approaching=True, **material)
    >>> [round(float(force) * 1e9, 3) for force in pull]
    [-4.238, -4.477]
    """
    material = _material(effective_modulus, radius, work_of_adhesion)
    return _force(indentation, material, _range(range_of_attraction), approaching)


def jkr_curve(
    contact_radius: Any, *, effective_modulus: Any, radius: Any, work_of_adhesion: Any
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return indentation [m] and force [N] of JKR at a contact radius [m], the unstable part included.

    ``delta = a^2/R - sqrt(2 pi w a/E*)``, ``F = 4 E* a^3/(3 R) - sqrt(8 pi w E* a^3)``.

    Examples
    --------
    >>> delta, force = jkr_curve(2e-9, effective_modulus=1e9, radius=10e-9, work_of_adhesion=0.1)
    >>> round(float(delta) * 1e9, 6), round(float(force) * 1e9, 6)
    (-0.720998, -3.417326)
    """
    a = _checked("contact_radius", contact_radius, "m", 0.0, open_end=False)
    material = _material(effective_modulus, radius, work_of_adhesion)
    _broadcast({"contact_radius": a, **material})
    E, R, w = material.values()
    delta = a * a / R - np.sqrt(2.0 * math.pi * w * a / E)
    force = 4.0 * E * a**3 / (3.0 * R) - np.sqrt(8.0 * math.pi * w * E * a**3)
    return np.asarray(delta), np.asarray(force)


def maugis_curve(
    contact_radius: Any,
    *,
    effective_modulus: Any,
    radius: Any,
    work_of_adhesion: Any,
    range_of_attraction: Any,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return indentation [m] and force [N] of Maugis-Dugdale at a contact radius, the unstable part included.

    In units of ``(pi w R^2/K)^(1/3)`` for the contact radius A, ``(pi^2 w^2 R/K^2)^(1/3)`` for the
    indentation D and ``pi w R`` for the force P, with ``K = 4/3 E*``, ``t = sqrt(m^2 - 1)`` and m the radius
    of the attracted ring over that of the contact (Maugis 1992):

        1 = lambda A^2/2 [t + (m^2 - 2) arcsec m] + 4/3 lambda^2 A [t arcsec m - m + 1]
        P = A^3 - lambda A^2 [t + m^2 arcsec m],    D = A^2 - 4/3 lambda A t

    Parameters are those of `maugis_force`, with w positive; the contact radius [m] may be zero.

    Examples
    --------
    >>> material = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
    >>> delta, force = maugis_curve(2e-9, range_of_attraction=0.2e-9, **material)
    >>> round(float(delta) * 1e9, 6), round(float(force) * 1e9, 6)
    (-0.70681, -3.787965)
    """
    arrays: dict[str, npt.NDArray[Any]] = {
        "contact_radius": _checked("contact_radius", contact_radius, "m", 0.0, open_end=False),
        **_material(effective_modulus, radius, work_of_adhesion),
        "range_of_attraction": _range(range_of_attraction),
    }
    _checked("work_of_adhesion", work_of_adhesion, "J/m^2", 0.0, open_end=True)
    shape, flat = _broadcast(arrays)
    indentation, force = np.empty(flat[0].size), np.empty(flat[0].size)
    lam, length, unit = _units(*flat[1:])
    # a^2 = R indentation in Hertz's contact, and so in these units
    _points(flat[0] / np.sqrt(length * flat[2]), lam, length, unit, indentation, force)
    return indentation.reshape(shape), force.reshape(shape)


def dugdale_range(intermolecular_distance: Any) -> npt.NDArray[np.float64]:
    """Return h0 [m] whose ``sigma0 = w/h0`` is the largest attraction of Lennard-Jones surfaces.

    With z0 the distance of equilibrium of the surfaces, taken to be the intermolecular distance a0, that
    attraction is ``16 w/(9 sqrt(3) z0)``, so ``h0 = 9 sqrt(3)/16 z0 = 0.9743 z0``; it is what makes
    ``lambda = 1.1570 mu`` with Tabor's ``mu = (R w^2/(E*^2 z0^3))^(1/3)`` (Maugis 1992). The tail of eq 17 of
    Shaik, Reifenberger and Raman is that of the limit lambda -> 0 with another choice, ``h0 = 2 a0``.

    Examples
    --------
    >>> round(float(dugdale_range(0.2e-9)) * 1e9, 6)
    0.194856
    """
    z0 = _checked("intermolecular_distance", intermolecular_distance, "m", 0.0, open_end=True)
    return np.asarray(9.0 * math.sqrt(3.0) / 16.0 * z0)


def maugis_parameter(
    *, effective_modulus: Any, radius: Any, work_of_adhesion: Any, range_of_attraction: Any
) -> npt.NDArray[np.float64]:
    """Return ``lambda = 2 sigma0 (R/(pi w K^2))^(1/3)``, ``sigma0 = w/h0``, ``K = 4/3 E*`` (Maugis 1992).

    The pull-off force is DMT's within 3 % below 0.1 and JKR's within 1 % above 5. At a given indentation
    the force comes near DMT's only as the root of lambda: contact pulls the surfaces together by about
    ``(4/3) lambda c``, a fifth of the adhesion at lambda = 0.1. Parameters are those of `maugis_force`.

    Examples
    --------
    >>> material = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
    >>> round(float(maugis_parameter(range_of_attraction=dugdale_range(0.2e-9), **material)), 4)
    2.6852
    """
    material = _material(effective_modulus, radius, work_of_adhesion)
    shape, flat = _broadcast({**material, "range_of_attraction": _range(range_of_attraction)})
    return _units(*flat)[0].reshape(shape)


def harmonics(
    law: str, amplitude: Any, indentation: Any, n_max: int, **parameters: Any
) -> npt.NDArray[np.complex128]:
    """Return the harmonics ``CONS_n - i DISS_n`` of an adhesive law on the bare cosine [N].

    The motion is ``gap = A1 (u1 + cos theta)``, ``u1 = 1 - 2 Delta``, ``Delta = indentation/(2 A1)``: approach
    for theta from 0 to pi, retraction from pi to 2 pi. CONS_n are the cosine and DISS_n the sine
    coefficients of the force in theta (1/2 pi for n = 0, else 1/pi), so ``pi A1 DISS_1`` is the energy lost
    per cycle. Three kinds of motion:

    - never near enough to be caught (JKR: indentation <= 0; Maugis-Dugdale: closest gap >= h0): no force. A
      contact that was made before and that such a motion would not break is not considered;
    - caught and let go once per cycle: hysteresis. JKR loses ``pi w a_s^2 (12/5 4^(1/3) + 2/5)`` per cycle,
      ``a_s^3 = pi w R^2/(8 E*)``, whatever the motion;
    - caught, and never far enough out to be let go, which happens before Delta = 1 because a neck holds
      to negative indentations: the steady state, in contact on one branch all the time, without loss.

    The integral is cut at jump, fold and first contact, the root at each is substituted away, and each
    piece is halved until Gauss-Legendre sums stand still. Accurate to 1e-8 of the largest harmonic and to
    1e-8 of each part of DISS_n.

    Parameters
    ----------
    law : {"jkr", "maugis"}
        `jkr_force` or `maugis_force`.
    amplitude, indentation : array
        A1 and the largest indentation [m].
    n_max : int
        Highest harmonic.
    **parameters : array, broadcast
        ``effective_modulus``, ``radius``, ``work_of_adhesion`` and, for ``"maugis"``,
        ``range_of_attraction``, as in the law.

    Returns
    -------
    complex array
        Shape of the arguments broadcast, then n = 0..n_max.

    Raises
    ------
    ContactModelError
        If the law is unknown, a parameter is missing, unknown or out of range, or shapes do not fit.

    Examples
    --------
    >>> material = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
    >>> f = harmonics("jkr", 40e-9, 3e-9, 2, **material)
    >>> [f"{value * 1e9:.4f}" for value in f]
    ['1.1274+0.0000j', '-2.2429-0.0262j', '2.2065+0.0480j']
    """
    if law not in _LAWS:
        raise ContactModelError("unknown adhesive law", expected=", ".join(_LAWS), got=repr(law))
    names = ["effective_modulus", "radius", "work_of_adhesion"]
    names += ["range_of_attraction"] if law == "maugis" else []
    if set(names) != set(parameters):
        raise ContactModelError(
            f"parameters do not fit law {law!r}", expected=", ".join(names), got=", ".join(parameters)
        )
    if isinstance(n_max, bool) or not isinstance(n_max, int) or n_max < 0:
        raise ContactModelError("n_max is not a harmonic", expected="an integer >= 0", got=repr(n_max))
    reach = parameters.pop("range_of_attraction", None)
    shape, flat = _broadcast(
        {
            "amplitude": _checked("amplitude", amplitude, "m", 0.0, open_end=True),
            "indentation": _checked("indentation", indentation, "m", -math.inf, open_end=True),
            **_material(**parameters),
            "range_of_attraction": _range(reach) if law == "maugis" else np.zeros(()),
        }
    )
    cons = np.empty((flat[0].size, n_max + 1))
    diss = np.empty_like(cons)
    lam, length, unit = _units(*flat[2:])
    _harmonics(flat[0], flat[1], _table(lam), length, unit, cons, diss)
    return (cons - 1j * diss).reshape(*shape, n_max + 1)

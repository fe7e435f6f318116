"""All steady states of the first harmonic at once: a curve in the plane of amplitude and closest gap.

For an amplitude A and a closest gap D the force of a bare cosine is known, and with it the drive that the
motion would need. Where that equals the drive there is, the pair is a steady state, at a height Z that follows:
``|A/G(w) - f_1(A, D)| = F_dr``, ``Z = D + A - G(0) f_0(A, D)``. The curve of that equation holds every branch,
stable or not, and parts of it that no sweep reaches. It is drawn on two sheets, the drive before or behind the
tip, ``Re(A/G - f_1) = +-sqrt(F_dr^2 - Im(A/G - f_1)^2)``: on each the left side crosses the right one, while the
two roots of the square lie too close together for any grid where the contact is stiff. Between two folds of Z
a stretch of the curve, an arc, has one state a height.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import contourpy
import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.contact.bare import bare_harmonics, has_closed_form
from overtone.contact.law import Law
from overtone.dynamics.balance import EXTRAS, Lever, Motion, Sums, force_on_motion
from overtone.kernels import inner, kernel

_AMPLITUDES, _BEYOND = 160, 30  # grid lines up to the free amplitude and a bit, and above
_GAPS = 220
_ROWS = 28  # of them that a thread takes at a time
_FINE = 0.5e-9  # amplitudes are resolved to a few per cent of this, or of themselves [m]
_FINEST = 0.02e-9  # closest gaps are resolved to this near contact, to a tenth of themselves farther out [m]
_EDGE = 1e-9  # of the squared drive: rounding at the edge of a sheet
_LEFT = 1e-6  # of the balance: more is left only where the force jumps, which is no state
_SAME_TIP = 1.5  # grid lines
_NEAR_GRAZING = 0.02  # of the free amplitude: a line that ends this near to grazing goes on without contact
_SMALLEST_TURN = 1e-6  # of the free amplitude: a turn of Z by less is the grid's, not a fold

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
_Index = npt.NDArray[np.intp]


@inner
def bare_force(
    law: Law,
    amplitude: float,
    closest: float,
    omega: float,
    f: _Complex,
    work: _Floats,
) -> None:
    """Fill f_0 and f_1 of a bare cosine, in closed form or by quadrature."""
    if has_closed_form(law.table):
        bare_harmonics(law.table, amplitude, -closest, omega, f, work)
        return
    none, still = np.empty(0, np.complex128), np.zeros(2, np.complex128)
    sums = Sums(f, none, none, np.empty(EXTRAS), np.empty(2, np.complex128))
    force_on_motion(Motion(closest + amplitude, amplitude, still), omega, law, sums)


@inner
def sheet(amplitude: float, f: _Complex, tip: complex, force: float, way: float) -> tuple[float, float]:
    """Return how far the force is from balance on a sheet [N], and by how much DISS_1 exceeds the drive."""
    needed = amplitude / tip - f[1]
    rest = force * force - needed.imag * needed.imag
    return needed.real - way * math.sqrt(max(rest, 0.0)), -rest


@kernel
def needed_force(
    law: Law,
    amplitudes: _Floats,
    gaps: _Floats,
    omega: float,
    tip: complex,
    out: _Complex,
) -> None:
    """Fill the drive that a motion needs, ``A/G - f_1``, on a grid (gap, amplitude) [N]."""
    f, work = np.empty(2, np.complex128), np.empty((4, 2))
    for i in range(gaps.shape[0]):
        for j in range(amplitudes.shape[0]):
            bare_force(law, amplitudes[j], gaps[i], omega, f, work)
            out[i, j] = amplitudes[j] / tip - f[1]


@kernel
def settle_on_sheet(
    law: Law,
    omega: float,
    static: float,
    tip: complex,
    force: float,
    way: float,
    amplitude: _Floats,
    closest: _Floats,
    phase: _Floats,
    height: _Floats,
    left: _Floats,
) -> None:
    """Find the root between the two ends of every grid edge, by halving and the secant in turn.

    ``amplitude`` and ``closest`` hold the ends (point, 2) and get the root in their first column; ``left`` gets
    what is left of the balance relative to the drive, infinite where the edge leaves the sheet.
    """
    f, work = np.empty(2, np.complex128), np.empty((4, 2))
    for i in range(amplitude.shape[0]):
        A0, A1, D0, D1 = amplitude[i, 0], amplitude[i, 1], closest[i, 0], closest[i, 1]
        low, high, outside = 0.0, 1.0, 0.0
        bare_force(law, A0, D0, omega, f, work)
        at_low, _ = sheet(A0, f, tip, force, way)
        bare_force(law, A1, D1, omega, f, work)
        at_high, _ = sheet(A1, f, tip, force, way)
        x, value = 0.5, 0.0
        kept = 0
        for step in range(100):
            x = 0.5 * (low + high)
            if step % 3 and at_high != at_low:  # every third step halves: the sheet ends in a square root
                x = (low * at_high - high * at_low) / (at_high - at_low)
                if not low < x < high:
                    x = 0.5 * (low + high)
            bare_force(law, A0 + x * (A1 - A0), D0 + x * (D1 - D0), omega, f, work)
            value, outside = sheet(A0 + x * (A1 - A0), f, tip, force, way)
            if abs(value) < 1e-12 * force or high - low < 1e-15:
                break
            if (value > 0.0) == (at_high > 0.0):
                high, at_high = x, value
                if kept == 1:
                    at_low *= 0.5
                kept = 1
            else:
                low, at_low = x, value
                if kept == -1:
                    at_high *= 0.5
                kept = -1
        A, D = A0 + x * (A1 - A0), D0 + x * (D1 - D0)
        amplitude[i, 0], closest[i, 0] = A, D
        needed = A / tip - f[1]
        phase[i] = math.atan2(needed.imag, needed.real)
        height[i] = D + A - static * f[0].real
        left[i] = abs(value) / force if outside <= _EDGE * force * force else math.inf


class Arc(NamedTuple):
    """A stretch of the curve of steady states along which the height rises."""

    height: _Floats
    """Z at its points, rising [m]."""
    gap: _Floats
    """Mean gap g [m]."""
    amplitude: _Floats
    """Of the tip [m]."""
    phase: _Floats
    """Of the drive before the tip [rad]."""
    folds: tuple[bool, bool]
    """Whether its lower and its upper end is a fold, not the end of what was searched."""

    def fold_at(self, last: bool) -> tuple[float, float]:
        """Return height and amplitude of an end, which it shares with the arc beyond the fold."""
        k = -1 if last else 0
        return float(self.height[k]), float(self.amplitude[k])


def arcs(law: Law, lever: Lever, heights: tuple[float, float], pull: float) -> list[Arc]:
    """Return every arc of steady states of the first harmonic between two heights [m].

    ``pull`` is a bound of the strongest attraction [N].
    """
    omega, force = lever.omega, lever.force
    static, tip = float(lever.tip[0].real), complex(lever.tip[1])
    free = abs(tip) * force
    # DISS_1 >= 0 bounds the amplitude by that of resonance
    highest = max(force / abs((1.0 / tip).imag), 1.05 * free)
    amplitudes = np.concatenate(
        [
            _FINE * np.sinh(np.linspace(0.0, math.asinh(1.05 * free / _FINE), _AMPLITUDES + 1))[1:],
            np.geomspace(1.05 * free, 1.001 * highest, _BEYOND)[1:] if highest > 1.06 * free else [],
        ]
    )
    # the closest gap is Z - A and what the mean force adds, and off resonance A can exceed the free amplitude
    low = min(heights[0], 0.0) - 1.1 * max(free, highest) - static * pull
    high = max(heights[1], 0.0) + static * pull + 1e-9
    gaps = _FINEST * np.sinh(np.linspace(math.asinh(low / _FINEST), math.asinh(high / _FINEST), _GAPS))
    needed = np.empty((gaps.size, amplitudes.size), complex)
    run_blocks(
        lambda rows: needed_force(law, amplitudes, gaps[rows], omega, tip, needed[rows]), gaps.size, _ROWS
    )
    real = np.sqrt(np.maximum(force**2 - needed.imag**2, 0.0))
    found: list[_Floats] = []
    tips: list[_Floats] = []
    for way in (1.0, -1.0):
        for line in contourpy.contour_generator(z=needed.real - way * real).lines(0.0):
            points = np.asarray(line, dtype=float)
            # a point lies on an edge of the grid, to rounding: the ends of that edge enclose it
            on_line = np.abs(points - np.round(points))
            points = np.where(on_line <= on_line.min(axis=1, keepdims=True), np.round(points), points)
            ends = [(np.floor(points[:, k]).astype(int), np.ceil(points[:, k]).astype(int)) for k in (0, 1)]
            A, D = (
                np.stack([grid[i], grid[j]], 1) for grid, (i, j) in zip((amplitudes, gaps), ends, strict=True)
            )
            phase, height, left = (np.empty(len(points)) for _ in range(3))
            settle_on_sheet(law, omega, static, tip, force, way, A, D, phase, height, left)
            states = np.stack([height, A[:, 0] + D[:, 0], A[:, 0], phase], axis=1)
            closed = len(points) > 2 and bool((points[0] == points[-1]).all())
            for piece, first, last in _runs(left < _LEFT, closed):
                found.append(states[piece])
                # where the sheet ends, the other sheet goes on from the same edge of the grid
                tips.append(
                    np.array([points[k] if k is not None else (np.nan, np.nan) for k in (first, last)])
                )
    lines = _join(found, tips)
    lines = _with_free_states(law, omega, tip, force, gaps[-1], lines)
    result = [arc for line in lines for arc in _split(line, _SMALLEST_TURN * free)]
    # the arc of the largest heights first: what a sweep from far away starts on
    return sorted(result, key=lambda arc: -float(arc.height[-1]))


def _with_free_states(
    law: Law,
    omega: float,
    tip: complex,
    force: float,
    highest: float,
    lines: list[_Floats],
) -> list[_Floats]:
    """Return the lines with the states that feel nothing added, where a law has an end."""
    outermost = law.made if math.isfinite(law.made) else float(law.levels[law.kinks - 1])
    free = abs(tip) * force
    needed = np.empty((2, 1), complex)
    edges = outermost + np.array([1e-9, -1e-6]) * free
    needed_force(law, np.array([free]), edges, omega, tip, needed)
    felt = abs(needed[:, 0] - free / tip) / force
    if felt[0] > 1e-12:
        return lines
    smooth = felt[1] < 1e-3
    start = np.array([outermost + free, outermost + free, free, np.angle(1.0 / tip)])
    apart = np.stack([start, start + np.array([highest, highest, 0.0, 0.0])])
    for i, line in enumerate(lines):
        for ordered in (line, line[::-1]):
            if smooth and (np.abs(ordered[-1, [0, 2]] - free) < _NEAR_GRAZING * free).all():
                return [*lines[:i], np.concatenate([ordered, apart]), *lines[i + 1 :]]
    return [*lines, apart]


def _runs(good: npt.NDArray[np.bool_], closed: bool) -> list[tuple[_Index, int | None, int | None]]:
    """Return stretches of good points, with the bad point before and after each, None at an end of the line."""
    size = good.size - 1 if closed else good.size
    if closed and good[:size].all():
        return [(np.arange(good.size), None, None)]
    start = int(np.flatnonzero(~good[:size])[0]) if closed else 0
    order = (start + np.arange(size + (1 if closed else 0))) % size if closed else np.arange(size)
    runs: list[tuple[_Index, int | None, int | None]] = []
    run: list[int] = []
    before: int | None = None
    for k in [int(k) for k in order]:
        if good[k]:
            run.append(k)
            continue
        if run:
            runs.append((np.array(run), before, k))
        run, before = [], k
    if run:
        runs.append((np.array(run), before, None))
    return runs


def _join(lines: list[_Floats], tips: list[_Floats]) -> list[_Floats]:
    """Join lines end to end where both leave their sheet at the same point of the grid."""
    lines, tips = list(lines), list(tips)
    merged = True
    while merged:
        merged = False
        for i in range(len(lines)):
            for j in range(i + 1, len(lines)):
                for a in (0, 1):
                    for b in (0, 1):
                        if not np.hypot(*(tips[i][a] - tips[j][b])) < _SAME_TIP:
                            continue
                        left, left_tip = (lines[i], tips[i]) if a else (lines[i][::-1], tips[i][::-1])
                        right, right_tip = (lines[j], tips[j]) if not b else (lines[j][::-1], tips[j][::-1])
                        lines[i] = np.concatenate([left, right])
                        tips[i] = np.array([left_tip[0], right_tip[1]])
                        del lines[j], tips[j]
                        merged = True
                        break
                    if merged:
                        break
                if merged:
                    break
            if merged:
                break
    return lines


def _split(line: _Floats, turn: float) -> list[Arc]:
    """Cut a line (point; height, gap, amplitude, phase) at the folds of its height.

    Turns smaller than ``turn`` [m] count as none.
    """
    closed = len(line) > 2 and bool((line[0] == line[-1]).all())
    if closed:  # begin where the height turns
        line = np.roll(line[:-1], -int(np.argmin(line[:-1, 0])), axis=0)
        line = np.concatenate([line, line[:1]])
    height = line[:, 0]
    corners, sign, extreme = [0], 0.0, 0
    for i in range(1, height.size):
        if sign == 0.0:
            if abs(height[i] - height[0]) > turn:
                sign, extreme = math.copysign(1.0, height[i] - height[0]), i
        elif sign * (height[i] - height[extreme]) >= 0.0:
            extreme = i
        elif sign * (height[extreme] - height[i]) > turn:
            corners.append(extreme)
            sign, extreme = -sign, i
    corners.append(height.size - 1)
    pieces = []
    for k in range(len(corners) - 1):
        part = line[corners[k] : corners[k + 1] + 1]
        if len(part) < 2:
            continue
        ends = (closed or k > 0, closed or k + 2 < len(corners))
        if part[0, 0] > part[-1, 0]:
            part, ends = part[::-1], ends[::-1]
        part = part[np.concatenate([[True], np.diff(np.maximum.accumulate(part[:, 0])) > 0.0])]
        height, gap, amplitude, phase = part.T
        pieces.append(Arc(height, gap, amplitude, np.unwrap(phase), ends))
    return pieces

"""Where the drive is in a recorded signal, and its phase at every moment.

The phase is recorded beside the deflection, or follows from the deflection itself, and then a change of phi1 looks
like a change of the drive: the tracks are what may be assumed of it.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from overtone.errors import DistortionWarning, ObservablesError, OvertoneError, PhaseReferenceWarning
from overtone.instrument.lockin import (
    HALF_LOBE,
    LONGEST_PIECE,
    Phase,
    averages,
    kaiser,
    length_for,
    low_pass,
    response,
)
from overtone.instrument.samples import Trace
from overtone.units import format_quantity

NONE, CONSTANT, LINEAR, FOLLOW, DRIVE = "none", "constant", "linear", "follow", "drive"
TRACKS = (NONE, CONSTANT, LINEAR, FOLLOW, DRIVE)

_Floats = npt.NDArray[np.float64]
Spans = Sequence[tuple[float, float]]
"""Start and stop of windows of time [s]."""

# A line is so many times the noise beside it, in power; where the trace had to be cut into short pieces, because
# the drive drifts, a resonance that only noise drives might pass for a line, so it has to stand out farther.
_LINE, _SHORT_LINE = 200.0, 1e4
_SHARPER = (
    4.0  # times as far as in the longest pieces has a line to stand out in shorter ones to be taken from them
)
_STEADY = 5e-3  # rad: phi1 closer to its fit than that, or than five times its noise, is steady
_DROOP = 0.01  # loss of a harmonic that runs away from its frequency


def inside(time: _Floats, spans: Spans) -> npt.NDArray[np.bool_]:
    """Tell which times lie in one of the windows."""
    found = np.zeros(time.shape, dtype=bool)
    for start, stop in spans:
        found |= (time >= start) & (time <= stop)
    return found


# --- the line -------------------------------------------------------------------------------------


def find_line(trace: Trace, near: float | None) -> tuple[float, float]:
    """Find the strongest line of a signal.

    Parameters
    ----------
    trace : Trace
        Recorded drive, or deflection.
    near : float or None
        Where to look, within 5 % [Hz]; everywhere unless given.

    Returns
    -------
    frequency : float
        [Hz].
    contrast : float
        ``A^2/(2 S)`` [Hz], power over the one-sided density of the noise beside it.

    Raises
    ------
    ObservablesError
        If no line stands above the noise.
    """
    longest = min(trace.values.size, LONGEST_PIECE)
    best = chosen = 0.0
    frequency, passed = 0.0, False
    # A drive that drifts over many lines of the longest pieces is sharper in shorter ones.
    for length in dict.fromkeys(max(longest // part, min(longest, 1024)) for part in (1, 4, 16, 64)):
        found = _line_in_pieces(trace, length, near)
        if found is None:
            continue
        position, contrast, noise_width = found
        best = max(best, contrast)
        passed = passed or contrast > (_LINE if length == longest else _SHORT_LINE)
        if contrast * noise_width > chosen * (_SHARPER if chosen else 1.0):
            frequency, chosen = position * trace.rate / length, contrast * noise_width
    if passed:
        return frequency, chosen
    where = "in the trace" if near is None else f"within 5 % of {format_quantity(near, 'Hz', 6)}"
    raise ObservablesError(
        f"no line stands above the noise {where}",
        expected=f"a drive at least {_LINE:g} times the noise beside it, in power",
        got=f"{best:.2g} times at most",
        hint="the drive_frequency, the sampling_rate and the channel may be others",
    )


def _line_in_pieces(trace: Trace, length: int, near: float | None) -> tuple[float, float, float] | None:
    """Return bin and contrast of the strongest line in pieces of this length, and the noise width of a bin [Hz]."""
    size = trace.values.size
    window = kaiser(length)
    starts = np.unique(np.linspace(0, size - length, min(16, -(-size // length))).astype(int))
    pieces = (np.asarray(trace.values[s : s + length], dtype=np.float64) for s in starts)
    power = np.array([np.abs(np.fft.rfft((piece - piece.mean()) * window)) ** 2 for piece in pieces])
    margin = math.ceil(HALF_LOBE) + 1  # bins of a line to one side
    low, high = margin + 1, power.shape[1] - 2
    if near is not None:
        low = max(low, math.floor(0.95 * near * length / trace.rate) - 1)
        high = min(high, math.ceil(1.05 * near * length / trace.rate) + 2)
    if high <= low:
        return None
    centre = low + int(power[:, low:high].mean(axis=0).argmax())
    reach = max(margin, centre // 50)
    found = [_peak(piece, max(low, centre - reach), min(high, centre + reach + 1), margin) for piece in power]
    position, contrast = (float(np.median(part)) for part in zip(*found, strict=True))
    return position, contrast, trace.rate * float((window**2).sum()) / float(window.sum()) ** 2


def _peak(power: _Floats, low: int, high: int, margin: int) -> tuple[float, float]:
    """Return the position of the highest bin, interpolated, and its power over that of the noise beside it."""
    top = low + int(power[low:high].argmax())
    below = power[max(top - 4 * margin, 2) : max(top - margin, 2)]
    around = np.concatenate([below, power[top + margin : top + 4 * margin]])
    floor = float(np.median(around)) / math.log(2.0) if around.size else 0.0
    with np.errstate(divide="ignore"):
        left, middle, right = np.log(power[top - 1 : top + 2])
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if math.isfinite(bend) and bend < 0.0 else 0.0
    height = float(power[top])
    contrast = height / floor if floor > 0.0 else math.inf if height > 0.0 else 0.0
    return top + float(np.clip(shift, -0.5, 0.5)), contrast


# --- the phase ------------------------------------------------------------------------------------


def phase_of_drive(
    source: Trace,
    track: str,
    frequency: float,
    contrast: float,
    *,
    bandwidth: float,
    spans: Spans,
    highest: int,
) -> tuple[Phase, int, int]:
    """Return the phase of the drive, and the first and last of the samples for which it is known.

    Parameters
    ----------
    source : Trace
        Recorded drive with ``track`` "drive", else the deflection.
    track : str
        One of `TRACKS`, see `overtone.demodulate`.
    frequency, contrast : float
        As `find_line` found them [Hz]; with "none" the exact frequency.
    bandwidth : float
        Of the lock-in that the phase is for [Hz].
    spans : sequence of (start, stop)
        When phi1 is steady [s]; the fit finds out where there are none.
    highest : int
        Highest harmonic that is wanted.

    Raises
    ------
    ObservablesError
        If the line does not stand above the noise in any usable bandwidth.
    OvertoneError
        If the windows are too short to tell a frequency.

    Warns
    -----
    PhaseReferenceWarning
        If the phase of the first harmonic moves, so that its zero or its trend is a matter of belief.
    DistortionWarning
        If a harmonic is so far away from where it is looked for that the filter takes of it.
    """
    size, rate = source.values.size, source.rate
    middle, turn = 0.5 * (size - 1), 2.0 * math.pi * frequency / rate
    # Wide, so that a drift is followed far, as long as the noise of the phase stays below 0.15 rad.
    most = min(frequency / 6.0, max(4.0 * bandwidth, (1 << 19) * rate / size))
    width = max(min(most, 0.02 * contrast), min(bandwidth, frequency / 6.0))
    if width > 0.25 * contrast:
        raise ObservablesError(
            "no line stands above the noise in this bandwidth",
            expected="a phase that can be followed, better than 0.5 rad",
            got=f"an error of {math.sqrt(width / contrast):.2g} rad",
            hint="a smaller bandwidth",
        )
    window = low_pass(rate, length_for(rate, width), max(round(0.5 * rate / width), 1))
    slow, centres = averages(source, Phase(middle, (0.0, turn, 0.0)), (1,), window, 0, size)
    angle = np.unwrap(np.angle(slow[0]))
    if track in (DRIVE, FOLLOW):
        return _followed(centres, angle, middle, turn, track)
    u, lag = _thinned(centres, angle, 0.5 * rate / bandwidth)
    time = source.start + u / rate
    if track == NONE:
        start = turn * middle + 2.0 * math.pi * frequency * source.start
        phase = Phase(middle, (math.remainder(start, 2.0 * math.pi), turn, 0.0))
        left = lag
    else:
        degree = 2 if track == LINEAR else 1
        (c0, c1, c2), error, left = _fitted(
            (u - middle) / middle, lag, degree, inside(time, spans), bool(spans)
        )
        phase = Phase(middle, (c0, turn + c1 / middle, c2 / middle**2), error=error)
    _check_droop(left, u / rate, bandwidth, highest)
    return phase, 0, size


def _followed(
    centres: _Floats, angle: _Floats, middle: float, turn: float, track: str
) -> tuple[Phase, int, int]:
    """Return the phase as it was measured; it is known between the first and the last measurement only."""
    from scipy.interpolate import CubicSpline

    if track == FOLLOW:
        warnings.warn(
            "the phase of the first harmonic was taken for that of the drive: phi1 is zero by construction, and only "
            "amplitudes and phi_n - n phi1 mean anything",
            PhaseReferenceWarning,
            stacklevel=2,
        )
    design = np.vander((centres - middle) / middle, 3, increasing=True)
    solution = _least_squares(design, angle)
    c0, c1, c2 = (float(c) for c in solution)
    rest = CubicSpline(centres, angle - design @ solution)
    phase = Phase(middle, (c0, turn + c1 / middle, c2 / middle**2), rest)
    return phase, math.ceil(float(centres[0])), math.floor(float(centres[-1])) + 1


def _thinned(centres: _Floats, angle: _Floats, spacing: float) -> tuple[_Floats, _Floats]:
    """Average phases over about ``spacing`` samples, to 32 points at least and some 20,000 at most."""
    apart = float(centres[1] - centres[0]) if centres.size > 1 else 1.0
    group = max(1, int(min(centres.size / 32, max(spacing / apart, centres.size / 20_000))))
    whole = centres.size // group * group
    return centres[:whole].reshape(-1, group).mean(axis=1), angle[:whole].reshape(-1, group).mean(axis=1)


# --- fits -----------------------------------------------------------------------------------------


def _fitted(
    x: _Floats, angle: _Floats, degree: int, within: npt.NDArray[np.bool_], referred: bool
) -> tuple[tuple[float, float, float], float, _Floats]:
    """Return coefficients of the phase over x, its standard error far from the fit, and what it leaves.

    Without a reference the largest part of the record that one line describes decides.
    """
    design = np.vander(x, degree + 1, increasing=True)
    sigma = 1.4826 * float(np.median(np.abs(np.diff(angle, 2)))) / math.sqrt(6.0) if angle.size > 2 else 0.0
    limit = max(5.0 * sigma, _STEADY)
    if referred:
        used = within
        if used.sum() < degree + 3:
            raise OvertoneError(
                "the reference is too short to tell a frequency",
                expected=f"{degree + 3} points of the phase at least",
                got=f"{int(used.sum())}, which are {1.0 / max(x.size, 1):.2g} of the record apart",
                hint="a longer window, or a larger bandwidth",
            )
        solution = _least_squares(design[used], angle[used])
    else:
        solution = _consensus(design, angle, limit)
        for _ in range(10):
            used = np.abs(angle - design @ solution) <= limit
            if used.sum() < degree + 3:
                used = np.ones(angle.shape, dtype=bool)
            solution = _least_squares(design[used], angle[used])
    left = angle - design @ solution
    _say_what_moves(left, used, limit, degree, referred)
    spread = float(np.sqrt((left[used] ** 2).sum() / max(int(used.sum()) - degree - 1, 1)))
    away = design - design[used].mean(axis=0)
    covariance = np.linalg.pinv(design[used].T @ design[used])
    error = spread * math.sqrt(float(np.einsum("ij,jk,ik->i", away, covariance, away).max(initial=0.0)))
    c0, c1, *rest = (float(c) for c in solution)
    return (c0, c1, rest[0] if rest else 0.0), error, left


def _consensus(design: _Floats, angle: _Floats, limit: float) -> _Floats:
    """Return the line, among those through a few of the points, that most of the points lie on.

    Least squares would be turned by an approach at the end of the record, and so would least absolute deviations.
    """
    terms = design.shape[1]
    few = np.linspace(0, angle.size - 1, min(angle.size, 48 if terms == 2 else 20)).astype(int)
    best = _least_squares(design, angle)
    most = -1
    for some in itertools.combinations(few, terms):
        line = _least_squares(design[list(some)], angle[list(some)])
        count = int((np.abs(angle - design @ line) <= limit).sum())
        if count > most:
            best, most = line, count
    return best


def _least_squares(design: _Floats, angle: _Floats) -> _Floats:
    return np.asarray(np.linalg.lstsq(design, angle, rcond=None)[0], dtype=np.float64)


# --- what is said of it ---------------------------------------------------------------------------


def _say_what_moves(
    left: _Floats, used: npt.NDArray[np.bool_], limit: float, degree: int, referred: bool
) -> None:
    what = "one frequency" if degree == 1 else "a frequency with a linear drift"
    if referred:
        unsteady = float(np.sqrt(np.mean(left[used] ** 2)))
        if unsteady > limit:
            warnings.warn(
                f"phi1 is not steady in the reference: it scatters by {math.degrees(unsteady):.2g} deg about {what}",
                PhaseReferenceWarning,
                stacklevel=2,
            )
        return
    moved = np.abs(left) > limit
    if moved.mean() > 0.02:
        warnings.warn(
            f"the phase of the first harmonic leaves {what} in {100.0 * moved.mean():.0f} % of the record, by up to "
            f"{math.degrees(float(np.abs(left).max())):.3g} deg. That is taken for a change of phi1, and the "
            "rest for steady; if the drive drifts, or phi1 moves in most of the record, it is not: record the drive, "
            "or say where phi1 is steady (reference)",
            PhaseReferenceWarning,
            stacklevel=2,
        )


def _check_droop(deviation: _Floats, time: _Floats, bandwidth: float, highest: int) -> None:
    """Warn where the first harmonic runs away from the drive so fast that the filter takes of the highest one."""
    if deviation.size < 3:
        return
    speed = np.abs(np.diff(deviation)) / np.diff(time) / (2.0 * math.pi)
    fastest = highest * float(np.quantile(speed, 0.95))
    loss = 1.0 - response(fastest / bandwidth)
    if loss > _DROOP:
        warnings.warn(
            f"harmonic {highest} is up to {format_quantity(fastest, 'Hz')} away from where it is looked for, and the "
            f"filter takes {100.0 * loss:.2g} % of it: a larger bandwidth, track='linear' or 'follow', or a "
            "recorded drive",
            DistortionWarning,
            stacklevel=2,
        )

"""The lever near the surface: its resonance and Q there, from what it does at the drive it is used with.

Air squeezed between lever and sample, and forces that reach far, move resonance and Q of the first mode within
micrometres of the surface. At constant drive the free response tells both, for one complex ratio is two numbers:

    a_near / a_far = G_near(w) / G_far(w),   a = A1 exp(-i phi1)

with the stiffness of the mode unchanged and the higher modes left as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from overtone.errors import ObservablesError, ProbeError
from overtone.harmonics import far_phase, read_receptance
from overtone.probe import SLOPE, Cantilever, Mode, Probe

_Array = npt.NDArray[np.float64]
_Phasors = npt.NDArray[np.complex128]

_LEAST_FREQUENCIES = 4
_EVIDENCE = 60.0  # squared signal over squared noise, which a fit to noise alone does not reach
_STEP = 1e-5  # of a quarter turn, for derivatives


@dataclass(frozen=True, eq=False)
class NearSurface:
    """The first mode near the surface.

    Parameters
    ----------
    probe : Probe
        With the resonance and Q of the first mode near the surface, and the free amplitude there.
    frequency, quality_factor : float
        f_1 [Hz] and Q_1 near the surface.
    covariance : array, shape (2, 2)
        Of ``ln f_1`` and ``ln Q_1``, from the errors that were given.
    """

    probe: Probe
    frequency: float
    quality_factor: float
    covariance: _Array

    @property
    def frequency_error(self) -> float:
        """Standard error of f_1 [Hz]."""
        return self.frequency * math.sqrt(float(self.covariance[0, 0]))

    @property
    def quality_factor_error(self) -> float:
        """Standard error of Q_1."""
        return self.quality_factor * math.sqrt(float(self.covariance[1, 1]))


@dataclass(frozen=True, eq=False)
class Ladder:
    """A resonance from the response to a drive of constant strength at several frequencies.

    Parameters
    ----------
    frequency, quality_factor : float
        f_1 [Hz] and Q_1 of the first mode.
    drive : float
        Strength of the drive: force over the stiffness of the first mode [unit of the amplitude], which is
        amplitude at resonance over Q for a single mode.
    phase_offset : float
        What the phase channel reads more than the lag [rad]: to be subtracted from it.
    covariance : array, shape (4, 4)
        Of ``ln f_1``, ``ln Q_1``, ``ln drive`` and ``phase_offset``.
    noise : float
        Standard deviation of each quadrature, given or from the residuals [unit of the amplitude].
    chi2_per_dof : float or None
        About 1 where the model describes the ladder within the noise that was given; None without one.
    probe : Probe or None
        The probe that was given, with resonance, Q and free amplitude of the ladder.
    """

    frequency: float
    quality_factor: float
    drive: float
    phase_offset: float
    covariance: _Array
    noise: float
    chi2_per_dof: float | None
    probe: Probe | None

    @property
    def frequency_error(self) -> float:
        """Standard error of f_1 [Hz]."""
        return self.frequency * math.sqrt(float(self.covariance[0, 0]))

    @property
    def quality_factor_error(self) -> float:
        """Standard error of Q_1."""
        return self.quality_factor * math.sqrt(float(self.covariance[1, 1]))

    @property
    def phase_offset_error(self) -> float:
        """Standard error of the phase offset [rad]."""
        return math.sqrt(float(self.covariance[3, 3]))


def lever_near_surface(
    probe: Probe,
    *,
    free_amplitude: float,
    phase: float,
    amplitude_error: float = 0.0,
    phase_error: float = 0.0,
) -> NearSurface:
    """Return the probe as it is near the surface, from its free response there.

    Parameters
    ----------
    probe : Probe
        As it is far from the surface: resonance, Q and free amplitude there.
    free_amplitude : float
        Amplitude close to the surface but not touching it [m], at the same drive.
    phase : float
        Lag of the first harmonic there [rad], from the same zero as `far_phase`: what the phase channel reads
        there less what it reads far away, plus ``far_phase(probe)``.
    amplitude_error, phase_error : float
        Standard errors of the two [m, rad], with those of the far response in them.

    Returns
    -------
    NearSurface
        With the probe, whose free amplitude and `far_phase` are the near ones.

    Raises
    ------
    ProbeError
        If no passive lever answers so: the phase zero or the amplitude is not that of the far response.

    Notes
    -----
    Assumes a force at the tip of constant strength, and that the tip feels no force of the sample. For a base drive
    the force grows as the square of the frequency shift, which is a per mille or so.
    """
    errors = (amplitude_error, phase_error)
    if not (math.isfinite(phase) and all(0.0 <= error < math.inf for error in errors)):
        raise ProbeError("unusable free response", got=f"phase {phase!r}, errors {errors!r}")

    def solved(amplitude: float, lag: float) -> tuple[float, float]:
        far = probe.drive.free_amplitude * np.exp(-1j * far_phase(probe))
        ratio = amplitude * np.exp(-1j * lag) / far
        near = complex(ratio) * complex(read_receptance(probe, probe.drive.frequency))
        return _first_mode(probe, near)

    near_probe = replace(probe, drive=replace(probe.drive, free_amplitude=free_amplitude))
    frequency, quality = solved(free_amplitude, phase)
    jacobian = np.zeros((2, 2))
    for k, step in enumerate((_STEP * free_amplitude, _STEP)):
        if errors[k] > 0.0:  # else the column is not needed
            up = np.log(solved(free_amplitude + (k == 0) * step, phase + (k == 1) * step))
            down = np.log(solved(free_amplitude - (k == 0) * step, phase - (k == 1) * step))
            jacobian[:, k] = (up - down) / (2.0 * step)
    covariance = jacobian @ np.diag(np.square(errors)) @ jacobian.T
    cantilever = _with_first_mode(probe.cantilever, frequency, quality)
    return NearSurface(replace(near_probe, cantilever=cantilever), frequency, quality, covariance)


def resonance_from_ladder(
    frequency: npt.ArrayLike,
    amplitude: npt.ArrayLike,
    phase: npt.ArrayLike,
    *,
    probe: Probe | None = None,
    noise: float | None = None,
) -> Ladder:
    """Fit resonance, Q, drive and phase offset to the far-field response over a ladder of drive frequencies.

    Parameters
    ----------
    frequency : array, shape (n,)
        Four drive frequencies [Hz] or more, best about three linewidths to either side of the resonance, at
        one strength of the drive.
    amplitude : array, shape (n,)
        Amplitude at each [m or V].
    phase : array, shape (n,)
        Reading of the phase channel at each, as lags from whatever zero [rad].
    probe : Probe, optional
        Lever and detector, whose higher modes are kept; a single mode unless given.
    noise : float, optional
        Standard deviation of each quadrature [unit of the amplitude]; from the residuals unless given.

    Returns
    -------
    Ladder
        With standard errors; its ``probe`` takes the amplitudes for metres.

    Raises
    ------
    ObservablesError
        If there are too few points, some are NaN, or they show no resonance.

    Notes
    -----
    A resonance of the holder, or a lock-in whose delay turns the phase over the ladder, is not in the model;
    ``chi2_per_dof`` shows them where the noise is known.
    """
    f, A, lag = (np.atleast_1d(np.asarray(values, dtype=float)) for values in (frequency, amplitude, phase))
    if f.ndim != 1 or f.shape != A.shape or f.shape != lag.shape:
        raise ObservablesError(
            "the ladder is no list of points", got=f"shapes {f.shape}, {A.shape}, {lag.shape}"
        )
    usable = np.isfinite(f).all() and np.isfinite(A).all() and np.isfinite(lag).all()
    if (
        np.unique(f).size < _LEAST_FREQUENCIES
        or not usable
        or f.min() <= 0.0
        or A.min() < 0.0
        or A.max() == 0.0
    ):
        raise ObservablesError(
            "the ladder cannot be fitted",
            expected=f"{_LEAST_FREQUENCIES} different frequencies or more, amplitudes of 0 or more, no NaN",
            got=f"{np.unique(f).size} frequencies" + ("" if usable else ", some values NaN"),
        )
    if noise is not None and not (math.isfinite(noise) and noise > 0.0):
        raise ObservablesError("unusable noise", expected="a standard deviation above 0", got=repr(noise))
    size = float(A.max())
    a = np.asarray(A / size * np.exp(-1j * lag), dtype=complex)

    def shape(theta: _Array) -> _Phasors:
        return _unit_response(probe, f, float(np.exp(theta[0])), float(np.exp(theta[1])))

    theta = _start(f, a)
    theta, residual, jacobian = _least_squares(shape, theta, a)
    inverse = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    power = float(residual @ residual)
    dof = 2 * f.size - 4
    sigma = math.sqrt(power / dof) if noise is None else noise / size
    # From Re c and Im c to ln |c| and -arg c, which is what the channel reads too much.
    drive = complex(theta[2], theta[3])
    turn = np.eye(4)
    turn[2, 2:] = np.array([drive.real, drive.imag]) / abs(drive) ** 2
    turn[3, 2:] = np.array([drive.imag, -drive.real]) / abs(drive) ** 2
    covariance = turn @ (sigma**2 * inverse) @ turn.T
    f1, Q = (float(np.exp(value)) for value in theta[:2])
    explained = (float(np.vdot(a, a).real) - power) / sigma**2 if sigma > 0.0 else math.inf
    doubtful = (
        explained < _EVIDENCE
        or math.sqrt(float(covariance[0, 0])) * Q > 1.0
        or math.sqrt(float(covariance[1, 1])) > 1.0
    )
    if doubtful or not 0.5 * f.min() < f1 < 2.0 * f.max():
        raise ObservablesError(
            "the ladder shows no resonance",
            expected="frequencies on both sides of it and more than a tenth of a linewidth apart",
            got=f"{f.min():.6g} to {f.max():.6g} Hz",
        )
    fitted = None
    if probe is not None:
        lever = replace(probe, cantilever=_with_first_mode(probe.cantilever, f1, Q))
        first = probe.cantilever.modes[0]
        free = (
            abs(drive) * size * first.stiffness * abs(complex(read_receptance(lever, probe.drive.frequency)))
        )
        fitted = replace(lever, drive=replace(probe.drive, free_amplitude=float(free)))
    return Ladder(
        frequency=f1,
        quality_factor=Q,
        drive=abs(drive) * size,
        phase_offset=float(-np.angle(drive)),
        covariance=covariance,
        noise=sigma * size,
        chi2_per_dof=None if noise is None else power / sigma**2 / dof,
        probe=fitted,
    )


# --- the first mode -------------------------------------------------------------------------------


def _with_first_mode(cantilever: Cantilever, frequency: float, quality_factor: float) -> Cantilever:
    first: Mode = replace(cantilever.modes[0], frequency=frequency, quality_factor=quality_factor)
    return replace(cantilever, modes=(first, *cantilever.modes[1:]))


def _first_mode(probe: Probe, reading: complex) -> tuple[float, float]:
    """Return f_1 and Q_1 with which the receptance at the drive is this one, all else as it is."""
    first = probe.cantilever.modes[0]
    weight = first.slope_ratio if probe.detector.kind == SLOPE else 1.0
    share = weight / first.stiffness
    x = probe.drive.frequency / first.frequency
    far = share / (1.0 - x**2 + 1j * x / first.quality_factor)
    # What is not the resonance of the first mode, its static share included, stays as it is.
    rest = complex(read_receptance(probe, probe.drive.frequency)) - far
    inverse = share / (reading - rest)
    if not (inverse.real < 1.0 and inverse.imag > 0.0):
        raise ProbeError(
            "no lever answers like this near the surface",
            expected="a free response at the drive of the far one, with a lag from the same zero",
            got=f"1 - x^2 = {inverse.real:.3g} and x/Q = {inverse.imag:.3g}",
            hint="subtract what the phase channel reads far away, and add far_phase(probe)",
        )
    x = math.sqrt(1.0 - inverse.real)
    return probe.drive.frequency / x, x / inverse.imag


def _unit_response(probe: Probe | None, f: _Array, frequency: float, quality_factor: float) -> _Phasors:
    """Return the reading per force, times the stiffness of the first mode."""
    if probe is None:
        x = f / frequency
        return np.asarray(1.0 / (1.0 - x**2 + 1j * x / quality_factor))
    lever = replace(probe, cantilever=_with_first_mode(probe.cantilever, frequency, quality_factor))
    return np.asarray(probe.cantilever.modes[0].stiffness * read_receptance(lever, f))


def _start(f: _Array, a: _Phasors) -> _Array:
    """Return where to start: 1/a is linear in 1 and f^2 for a single mode, as far as f varies little."""
    scale = float(f[np.argmax(np.abs(a))])
    x = f / scale
    columns = np.stack([np.ones_like(x), x**2], axis=-1) * a[:, None]
    one, square = np.linalg.lstsq(columns, np.ones_like(a), rcond=None)[0]
    turned = complex(-one / square) if square else 1.0 + 0.0j
    root = turned.real if math.isfinite(turned.real) and turned.real > 0.0 else 1.0
    loss = turned.imag / root
    start = math.sqrt(root)
    quality = min(max(1.0 / loss, 0.6), 1e6) if loss > 0.0 and math.isfinite(loss) else 100.0
    shape = _unit_response(None, f, start * scale, quality)
    drive = complex(np.vdot(shape, a) / np.vdot(shape, shape))
    return np.array([math.log(start * scale), math.log(quality), drive.real, drive.imag])


def _least_squares(
    shape: Callable[[_Array], _Phasors], theta: _Array, a: _Phasors
) -> tuple[_Array, _Array, _Array]:
    """Return parameters, residuals and Jacobian of the best fit; real and imaginary parts one behind the other."""

    def residual(t: _Array) -> _Array:
        difference = a - complex(t[2], t[3]) * shape(t)
        return np.concatenate([difference.real, difference.imag])

    def slopes(t: _Array) -> _Array:
        columns = []
        # ln f1 counts in widths of the peak, of which there are Q.
        for k, step in enumerate((1e-4 * min(math.exp(-t[1]), 1.0), 1e-4, 1e-4, 1e-4)):
            up, down = t.copy(), t.copy()
            up[k] += step
            down[k] -= step
            columns.append((residual(down) - residual(up)) / (2.0 * step))
        return np.stack(columns, axis=-1)

    damping, now = 1e-3, residual(theta)
    for _ in range(100):
        J = slopes(theta)
        normal, gradient = J.T @ J, J.T @ now
        moved = False
        while damping < 1e8:
            change = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-300), gradient)
            trial = theta + np.clip(change, -1.0, 1.0)
            there = residual(trial)
            if there @ there < now @ now:
                gained = (now @ now - there @ there) / (now @ now)
                theta, now, damping, moved = trial, there, max(damping / 10.0, 1e-12), True
                break
            damping *= 5.0
        if not moved or gained < 1e-12:
            break
    return theta, now, slopes(theta)

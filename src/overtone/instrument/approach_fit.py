"""The approach curve on a reference, fitted as a whole: material, gains, latency and zeros in one posterior.

At every height the amplitude is as measured and the indentation is latent; the force of the reference on the full
motion then predicts CONS_1, A0, the higher harmonics and the height. Feeding the measured height in as exact would
bias the modulus by up to 75 %. What the instrument does is unknown too, with the far-field data as its prior, and so
are the lever's own numbers, so that the covariance of all of them together is an answer of the same fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact.models import contact_model
from overtone.contact.sample import OF_THE_PROBE, Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.indented import indented_states
from overtone.errors import CalibrationError
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.latent import Problem, search
from overtone.instrument.material import STARTS, Reference, scale_of
from overtone.instrument.signals import Signals, in_the_frame_of_the_first
from overtone.instrument.unknowns import HIGHER, LEVER, TERMS, distortion_basis, probe_with, undo
from overtone.probe import Probe

__all__ = ["Curve", "Fit", "Reference", "fit_approach"]

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_STEP = 1e-4  # of a prior's width, for differences
_FARTHEST = 5.0  # of the logarithm of a factor
_N_MAX = 6  # A2 to 1e-4, far below any noise
_NANO = 1e-9
# deep ones count by their logarithm: along E the valley is then straight, delta as E^(-2/3)
_DEPTH = 0.05e-9
_TRIAL, _STEPS = 3, 40  # of a search, to choose a start and to end
_LOST = 1e6  # residual of a state that does not converge


@dataclass(frozen=True)
class Curve:
    """What a fit needs of an approach curve: points in contact, in any order.

    Parameters
    ----------
    signals : Signals
        As read (point,).
    height : array (point,)
        Z [m] up to a constant.
    noise : mapping of str to float or array (point,)
        Standard deviations of ``A0``, ``A1``, ``phi1``, ``A2``, ... [m, rad] and of ``height`` [m].
    """

    signals: Signals
    height: _Floats
    noise: Mapping[str, float | _Floats]


@dataclass(frozen=True)
class Fit:
    """Posterior of an approach curve.

    Parameters
    ----------
    names : tuple of str
        Unknowns of the instrument and lever, in the order of the next two.
    values, covariance : array (name,), (name, name)
        Their posterior.
    material : mapping
        Logarithm of each property of the reference to (mean, standard deviation).
    indentation : array (point,)
        delta_max [m].
    chi2, freedom : float
        Sum of squared residuals of the data and how many data are left for each unknown.
    predicted : mapping
        What the fit says was there: ``A0`` and, in the frame of the first harmonic, ``e2``, ``e3`` [m], ``CONS_1`` [N].
    zero : float
        What the heights are off: Z = height - zero [m].
    converged : bool
        Whether the search had settled when it ended.
    """

    names: tuple[str, ...]
    values: _Floats
    covariance: _Floats
    material: Mapping[str, tuple[float, float]]
    indentation: _Floats
    chi2: float
    freedom: int
    predicted: Mapping[str, npt.NDArray[Any]]
    zero: float
    converged: bool


class _Problem:
    """Residuals of a curve and their derivatives; parameters are whitened by their priors."""

    def __init__(
        self,
        curve: Curve,
        probe: Probe,
        reference: Reference,
        amplitude: float,
        names: Sequence[str],
        mean: _Floats,
        covariance: _Floats,
        neutral: Mapping[str, float],
        centre_height: float,
    ) -> None:
        self.curve, self.probe, self.reference, self.amplitude = curve, probe, reference, amplitude
        self.names, self.mean, self.neutral, self.centre = tuple(names), mean, dict(neutral), centre_height
        self.positive = np.array([name in LEVER or name.startswith("gain") for name in names])
        self.root = np.linalg.cholesky(covariance + 1e-18 * np.diag(np.diag(covariance)))
        record = contact_model(reference.model)
        own = [q for q in record.parameters if q.name not in OF_THE_PROBE and q.default is None]
        self.properties = [q.name for q in own if q.name != "poisson_ratio"]
        strangers = [name for name in self.properties if name not in STARTS]
        if strangers or not self.properties:
            raise CalibrationError(
                f"model {reference.model!r} is not for references",
                expected="one whose unknowns are " + ", ".join(STARTS),
                got=" and ".join(strangers) or "none",
                hint="dmt, or dmt-viscous",
            )
        self.viscous = "viscosity" in self.properties
        self.scales = [scale_of(reference, name) for name in self.properties]
        self.points = curve.height.size
        self.orders = [n for n in HIGHER if n in curve.signals.phasor]
        # parameters: instrument and lever, material, zero of the height [nm], indentations over _DEPTH by asinh
        self.at_material = len(names)
        self.at_zero = self.at_material + len(self.properties)
        self.at_depth = self.at_zero + 1
        # these move the amplitude, or the motion that belongs to it
        moving = (*LEVER, "compression")
        self.model_names = [i for i, name in enumerate(names) if name in moving]

    def unpack(self, p: _Floats) -> tuple[dict[str, float], _Floats, float, _Floats]:
        theta = self.mean + self.root @ p[: self.at_material]
        # factors stay positive, however far a step goes
        growth = np.clip((theta - self.mean) / np.where(self.positive, self.mean, 1.0), -_FARTHEST, _FARTHEST)
        theta = np.where(self.positive, self.mean * np.exp(growth), theta)
        values = {**self.neutral, **dict(zip(self.names, map(float, theta), strict=True))}
        material = self.material(p[self.at_material : self.at_zero])
        return values, material, float(p[self.at_zero]) * _NANO, _DEPTH * np.sinh(p[self.at_depth :])

    def material(self, p: _Floats) -> _Floats:
        return np.array([scale.value(float(x)) for scale, x in zip(self.scales, p, strict=True)])

    def sample(self, material: _Floats) -> Sample:
        values = dict(zip(self.properties, map(float, material), strict=True))
        return sample(self.reference.model, poisson_ratio=self.reference.poisson_ratio, **values)

    def predict(
        self, values: Mapping[str, float], material: _Floats, depth: _Floats, amplitude: _Floats
    ) -> Any:
        probe = probe_with(self.probe, values)
        return indented_states(
            probe, self.sample(material), amplitude=amplitude, indentation=depth, n_max=_N_MAX
        )

    def observed(self, values: Mapping[str, float]) -> tuple[Signals, _Complex, _Floats]:
        """Return corrected signals, the force of the first harmonic and its error."""
        signals = undo(self.curve.signals, values, self.amplitude, height=self.curve.height - self.centre)
        probe = probe_with(self.probe, values)
        G = complex(read_receptance(probe, probe.drive.frequency))
        first = signals.phasor[1]
        free = probe.drive.free_amplitude * np.exp(1j * (-np.angle(first) - far_phase(probe)))
        force = (np.abs(first) - free) / G
        noise = self.curve.noise
        errors = np.stack([np.full(first.shape, noise["A1"] / G), -1j * free / G * noise["phi1"]])
        return signals, force, np.sqrt(np.stack([np.sum(errors.real**2, 0), np.sum(errors.imag**2, 0)]))

    def residuals(self, p: _Floats, model: Any = None) -> _Floats:
        values, material, zero, depth = self.unpack(p)
        signals, force, error = self.observed(values)
        if model is None:
            model = self.predict(values, material, depth, np.abs(signals.phasor[1]))
        noise = self.curve.noise
        parts = [(force.real - model.force[:, 1].real) / error[0]]
        if self.viscous:
            parts.append((force.imag - model.force[:, 1].imag) / error[1])
        if signals.mean is not None:
            parts.append((signals.mean - model.reading[:, 0].real) / (noise["A0"] / values["gain0"]))
        frame = in_the_frame_of_the_first(signals)
        for n in self.orders:
            off = (frame[n] - model.reading[:, n]) / (noise[f"A{n}"] / values[f"gain{n}"])
            parts += [off.real, off.imag]
        parts.append((self.curve.height - zero - model.height) / noise["height"])
        data = np.concatenate(parts)
        lost = np.tile(model.status != FOUND, data.size // self.points)
        data[lost] = _LOST
        return np.concatenate([data, p[: self.at_zero]])

    def jacobian(self, p: _Floats) -> _Floats:
        values, material, _, depth = self.unpack(p)
        signals, _, _ = self.observed(values)
        amplitude = np.abs(signals.phasor[1])
        model = self.predict(values, material, depth, amplitude)
        here = self.residuals(p, model)
        J = np.zeros((here.size, p.size))
        lever = set(self.model_names)
        root = np.abs(self.root)
        for j in range(self.at_depth):
            moved = p.copy()
            moved[j] += _STEP
            needs_model = j >= self.at_material and j < self.at_zero
            # a whitened parameter moves every unknown that it is correlated with
            needs_model = needs_model or (j < self.at_material and any(root[i, j] > 0.0 for i in lever))
            there = None if needs_model else model
            J[:, j] = (self.residuals(moved, there) - here) / _STEP
        # each indentation moves its own point only: one evaluation serves all
        step = np.full(self.points, _STEP)
        moved = p.copy()
        moved[self.at_depth :] += step
        change = self.residuals(moved) - here
        rows = (here.size - self.at_zero) // self.points
        for k in range(rows):
            at = slice(k * self.points, (k + 1) * self.points)
            J[at, self.at_depth :] = np.diag(change[at] / step)
        return J


def fit_approach(
    curve: Curve,
    probe: Probe,
    reference: Reference,
    *,
    amplitude: float,
    names: Sequence[str],
    mean: _Floats,
    covariance: _Floats,
    neutral: Mapping[str, float],
    centre_height: float = 0.0,
) -> Fit:
    """Fit an approach curve with latent indentations.

    Parameters
    ----------
    curve : Curve
        Points in contact.
    probe : Probe
        With a tip radius.
    reference : Reference
        What is known of the material.
    amplitude : float
        A_ref [m].
    names, mean, covariance
        Unknowns of instrument and lever to be fitted, and their prior.
    neutral : mapping
        Values of all other unknowns.
    centre_height : float
        Height [m] at which the offset of A0 is quoted.

    Returns
    -------
    Fit
        The best of several starts.

    Raises
    ------
    CalibrationError
        If the contact model has unknowns that no approach curve of a reference tells.

    Notes
    -----
    To first order about the best fit. A property that was not stated has a prior that hardly counts: a modulus of 1 GPa
    within a factor of 20, an adhesion evenly up to tens of nanonewtons.
    """
    problem = _Problem(curve, probe, reference, amplitude, names, mean, covariance, neutral, centre_height)
    task = Problem(
        problem.residuals, problem.jacobian, problem.points, problem.at_depth, problem.at_zero, _STEP
    )
    # a few steps tell which valley is worth the rest
    trials = [search(task, start, _TRIAL) for start in _starts(problem)]
    p, _, converged = search(task, min(trials, key=lambda trial: trial.cost).p, _STEPS)
    J = problem.jacobian(p)
    inverse = np.linalg.pinv(J.T @ J, hermitian=True)
    values, material, zero, depth = problem.unpack(p)
    own = problem.root @ inverse[: problem.at_material, : problem.at_material] @ problem.root.T
    fitted = np.array([values[name] for name in problem.names])
    stretch = np.where(problem.positive, fitted / np.where(problem.positive, problem.mean, 1.0), 1.0)
    own = own * np.outer(stretch, stretch)
    at = slice(problem.at_material, problem.at_zero)
    spread = np.log(problem.material(p[at] + _STEP) / material) / _STEP * np.sqrt(np.diag(inverse)[at])
    signals, _, _ = problem.observed(values)
    model = problem.predict(values, material, depth, np.abs(signals.phasor[1]))
    data = problem.residuals(p)[: -problem.at_zero]
    predicted = {
        "A0": model.reading[:, 0].real,
        "CONS_1": model.force[:, 1].real,
        "A1": np.abs(signals.phasor[1]),
    }
    predicted |= {f"e{n}": model.reading[:, n] for n in problem.orders}
    return Fit(
        problem.names,
        fitted,
        own,
        {
            name: (float(m), float(s))
            for name, m, s in zip(problem.properties, np.log(material), spread, strict=True)
        },
        depth,
        float(data @ data),
        data.size - problem.points - len(problem.properties) - 1,
        predicted,
        zero,
        converged,
    )


def _starts(problem: _Problem) -> list[_Floats]:
    """Return starting points: materials over their priors, each with the indentations that give CONS_1."""
    values, _, _, _ = problem.unpack(np.zeros(problem.at_depth + problem.points))
    signals, force, _ = problem.observed(values)
    amplitude = np.abs(signals.phasor[1])
    starts = []
    axes = [
        (0.0,)
        if getattr(problem.reference, name, None) is not None
        else [scale.at(value) for value in STARTS[name]]
        for name, scale in zip(problem.properties, problem.scales, strict=True)
    ]
    for shifts in np.array(np.meshgrid(*axes, indexing="ij")).reshape(len(axes), -1).T:
        p = np.zeros(problem.at_depth + problem.points)
        p[problem.at_material : problem.at_zero] = shifts
        _, material, _, _ = problem.unpack(p)
        depth = _indentations(problem, values, material, amplitude, force.real)
        p[problem.at_depth :] = np.arcsinh(depth / _DEPTH)
        model = problem.predict(values, material, depth, amplitude)
        p[problem.at_zero] = float(np.median(problem.curve.height - model.height)) / _NANO
        p[: problem.at_material] = _linear(problem, model)
        starts.append(p)
    return starts


def _linear(problem: _Problem, model: Any) -> _Floats:
    """Return where to start: what is added to the harmonics, and their gains with their phases, for a given motion.

    In these the readings are linear, a gain with its latency being one complex number; along a wrong latency a search
    would lead nowhere.
    """
    theta = problem.mean.copy()
    read, noise = problem.curve.signals, problem.curve.noise
    first = read.phasor[1]
    for n in problem.orders:
        own = [*(f"distortion{n}_{j}" for j in range(TERMS)), f"crosstalk{n}"]
        names = [f"{name}_{part}" for name in own for part in ("re", "im")]
        g, psi = f"gain{n}", f"latency{n}"
        if not {*names, g, psi} <= set(problem.names):
            continue  # some are known, and not searched for
        at = [problem.names.index(name) for name in names]
        root = np.linalg.cholesky(problem.root[at] @ problem.root[at].T)
        added = np.column_stack([distortion_basis(first, n, problem.amplitude), np.ones(first.size)])
        B = np.stack([added, 1j * added], axis=-1).reshape(first.size, -1)
        motion = model.reading[:, n] * (first / np.abs(first)) ** n
        columns = np.column_stack([B @ root, motion, 1j * motion])
        sigma = np.broadcast_to(noise[f"A{n}"], first.shape)
        data = (read.phasor[n] - B @ problem.mean[at]) / sigma
        weighted = columns / sigma[:, None]
        design = np.concatenate([weighted.real, weighted.imag, np.eye(columns.shape[1])])
        target = np.concatenate([data.real, data.imag, np.zeros(len(at)), [1.0, 0.0]])
        found = np.linalg.lstsq(design, target, rcond=None)[0]
        theta[at] = problem.mean[at] + root @ found[: len(at)]
        gain = complex(*found[len(at) :])
        mean = problem.mean[problem.names.index(g)]
        growth = np.clip(np.log(max(abs(gain), 1e-3) / mean), -1.0, 1.0)
        theta[problem.names.index(g)] = mean * (1.0 + growth)
        theta[problem.names.index(psi)] = float(-np.angle(gain))
    return np.linalg.solve(problem.root, theta - problem.mean)


def _indentations(
    problem: _Problem, values: Mapping[str, float], material: _Floats, amplitude: _Floats, target: _Floats
) -> _Floats:
    """Return the indentations at which the first conservative harmonic is the measured one, by halving."""
    low, high = np.full(amplitude.shape, -1e-9), 1.6 * amplitude
    for _ in range(24):
        middle = 0.5 * (low + high)
        model = problem.predict(values, material, middle, amplitude)
        # deeper is more negative; a state that is not found counts as too deep
        shallow = (model.force[:, 1].real > target) & (model.status == FOUND)
        low, high = np.where(shallow, middle, low), np.where(shallow, high, middle)
    return 0.5 * (low + high)

"""What the materials of a scan would be if contact obeyed another law than the model's.

A wrong law hides: what the calibration left open moves until it fits. So the scan is fitted once more under each law
that the model may be mistaken for, with the same evidence and the same priors; where that fits about as well, the
difference of the moduli is an error of the model that no interval holds. Both fits are most probable values, with the
harmonics of the motion added as the model has them at its own, so that what both neglect cancels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.posterior import Prior
from overtone.kernels import kernel
from overtone.population.beforehand import add_priors, inside, log_prior
from overtone.population.evidence import inverse
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT, Scene
from overtone.population.joint import Joint, free_properties
from overtone.population.laws import Contacts, Law, Surroundings, alternatives, of_the_model
from overtone.population.materials import Question

_Floats = npt.NDArray[np.float64]

LIKELY = 5.0
"""ln of the ratio of posterior densities up to which a law counts as one that the data do not exclude."""
_STEPS, _HALVINGS = 60, 12
_NUDGE = 1e-4
_LONGEST, _LONGEST_LOG = 0.5, 1.0  # step of t, and of a logarithm
_LEAST = -12.0  # ln of an adhesion in units, or of a loss tangent
_AT_REST = 1e-6  # gain of ln of the density that ends a search


class Refit(NamedTuple):
    """Another law.

    Parameters
    ----------
    key, title : str
        Of the law.
    change : array (material,)
        Of ln of the modulus, that under the law less that under the model: the largest where the law was tried in
        several ways that the data do not exclude. A material to which it does not apply obeys the model in both, and
        still changes: it shares the calibration.
    gain : float
        ln of the posterior density at its best, less that of the model.
    """

    key: str
    title: str
    change: _Floats
    gain: float

    @property
    def excluded(self) -> bool:
        """Whether the data tell the law from the model, to the good of the model."""
        return not self.gain > -LIKELY

    @property
    def better(self) -> bool:
        """Whether they do to the good of the law."""
        return self.gain > LIKELY


def refits(joint: Joint, question: Question, exponent: float) -> tuple[Refit, ...]:
    """Return what other laws make of the materials of a joint posterior.

    Adhesion and the shape of the tip are tried for all materials that they apply to at once, a loss for each by itself
    as well: a relaxation time is one of a material.

    Parameters
    ----------
    joint : Joint
        The posterior under the model.
    question : Question
        Model, lever, priors.
    exponent : float
        Change of ln of the elastic unknown with ln R at a given force.

    Returns
    -------
    tuple of Refit
        Of every law that may be one of these materials; a law whose search fails has a gain of minus infinity.
    """
    task = _Task(joint, question, exponent)
    best = task.settle(None, task.start)
    model, moduli = task.density(None, best), task.ln_moduli(None, best)
    found = []
    for law in alternatives(question.columns, question.loss, question.sticky):
        applies = task.applies(law, best)
        ways = [applies] if applies.any() else []
        if law.of_the_material and applies.sum() > 1:
            ways += [applies & (np.arange(applies.size) == k) for k in np.flatnonzero(applies)]
        tried = []
        for way in ways:
            obeyed = Obeyed(law, way)
            there = task.settle(obeyed, best)
            gain = task.density(obeyed, there) - model
            if math.isfinite(gain):
                tried.append((gain, task.ln_moduli(obeyed, there) - moduli))
        if not ways:
            continue
        gain = max((one for one, _ in tried), default=-math.inf)
        likely = [change for one, change in tried if one > max(-LIKELY, gain - LIKELY)]
        changes = np.stack(likely or [change for one, change in tried if one == gain] or [moduli * math.nan])
        largest = np.abs(changes).argmax(axis=0)
        found.append(Refit(law.key, law.title, changes[largest, np.arange(moduli.size)], float(gain)))
    return tuple(found)


class Obeyed(NamedTuple):
    """A law and the materials that obey it, the model being the law of the others."""

    law: Law
    materials: npt.NDArray[np.bool_]


class _Task:
    """A joint posterior as a function of ln E and the unknowns (material, 1 + unknown)."""

    def __init__(self, joint: Joint, question: Question, exponent: float) -> None:
        self.scene = scene = joint.draws.scene
        self.joint, self.question, self.exponent = joint, question, exponent
        self.amplitude, self.unit = scene.amplitude, scene.unit
        self.orders, self.lossy, self.references = scene.orders, scene.lossy, scene.references
        self.precision, self.centre = joint.evidence.precision, joint.evidence.centre
        contact, scans = question.columns.contact, self.amplitude.shape[1]
        self.around = Surroundings(
            question.columns, (0.75 * contact.factor) ** 2, question.followed.omega, int(scene.orders.max())
        )
        self.free = np.concatenate([free_properties(question), np.ones(scans, bool)])
        draws = joint.draws
        every = np.concatenate([draws.ln_E[:, :, None], draws.unknowns], axis=2)
        off = draws.forces - self.centre
        chi2 = np.einsum("di,ij,dj->d", off, self.precision, off)
        heights = [-0.5 * c + self._log_prior(theta) for c, theta in zip(chi2, every, strict=True)]
        best = int(np.argmax(heights))
        self.start = every[best]
        # what the harmonics of the motion add at the best of the draws
        self.motion = draws.forces[best][: self.centre.size - self.references.size].reshape(
            len(self.start), -1
        )
        self.motion = self.motion - self.rows(None, self.start[None], bare=True)[0]

    def contacts(self, thetas: _Floats) -> Contacts:
        """Return the contacts (point * material * scan,) of unknowns (point, material, 1 + unknown)."""
        contact, scans = self.question.columns.contact, self.amplitude.shape[1]
        E_star = 1.0 / (contact.tip_compliance + contact.sample_factor * np.exp(-thetas[..., 0].ravel()))
        nothing = np.zeros(E_star.size)
        F = np.exp(thetas[..., 1 + ADHESION]).ravel() * self.unit if self.question.sticky else nothing
        tangent = np.exp(thetas[..., 1 + TANGENT]).ravel() if self.question.loss else nothing
        delta = 2.0 * self.amplitude / (1.0 + np.exp(-thetas[..., 1 + FIRST_DEPTH :]))
        E_star, F, tangent = (np.repeat(values, scans) for values in (E_star, F, tangent))
        return Contacts(
            E_star, F, tangent, np.broadcast_to(self.amplitude, delta.shape).ravel(), delta.ravel()
        )

    def applies(self, law: Law, theta: _Floats) -> npt.NDArray[np.bool_]:
        """Tell which materials may obey a law."""
        of_each = law.applies(self.around, self.contacts(theta[None]))
        return np.asarray(of_each.reshape(self.amplitude.shape).any(axis=1))

    def rows(self, obeyed: Obeyed | None, thetas: _Floats, *, bare: bool = False) -> _Floats:
        """Return the harmonics (point, material, scan * row) of unknowns (point, material, 1 + unknown)."""
        contacts = self.contacts(thetas)
        f = of_the_model(self.around, contacts)
        if obeyed is not None:
            which = np.tile(np.repeat(obeyed.materials, self.amplitude.shape[1]), len(thetas))
            f[which] = obeyed.law.harmonics(self.around, Contacts(*(part[which] for part in contacts)))
        f = f[:, self.orders]
        found = np.where(self.lossy, -f.imag, f.real).reshape(*thetas.shape[:2], -1) / self.unit
        return found if bare else found + self.motion

    def data(self, obeyed: Obeyed | None, theta: _Floats) -> _Floats:
        """Return all data (datum,) of unknowns (material, 1 + unknown)."""
        return np.concatenate([self.rows(obeyed, theta[None]).ravel(), theta[self.references, 0]])

    def slopes(self, obeyed: Obeyed | None, theta: _Floats) -> tuple[_Floats, _Floats]:
        """Return the data and how they go with every unknown (datum, material * (1 + unknown))."""
        materials, width = theta.shape
        # the harmonics of a material go with its own unknowns alone
        nudged = theta + _NUDGE * np.eye(width)[:, None, :]
        f = self.rows(obeyed, np.concatenate([theta[None], nudged]))
        by_each = (f[1:] - f[0]) / _NUDGE
        size = f.shape[2]
        J = np.zeros((materials * size + self.references.size, materials * width))
        for k in range(materials):
            J[k * size : (k + 1) * size, k * width : (k + 1) * width] = by_each[:, k].T
        for j, k in enumerate(self.references):
            J[materials * size + j, k * width] = 1.0
        return np.concatenate([f[0].ravel(), theta[self.references, 0]]), J

    def density(self, obeyed: Obeyed | None, theta: _Floats) -> float:
        """Return ln of the posterior density but for a constant; minus infinity beyond bounds."""
        prior = self._log_prior(theta)
        if not math.isfinite(prior):
            return -math.inf
        off = self.data(obeyed, theta) - self.centre
        value = prior - 0.5 * float(off @ self.precision @ off)
        return value if math.isfinite(value) else -math.inf

    def ln_moduli(self, obeyed: Obeyed | None, theta: _Floats) -> _Floats:
        """Return ln of the moduli (material,), with the tip radius that goes with them."""
        evidence = self.joint.evidence
        along = evidence.changes.T @ inverse(evidence.statistical)
        z = np.linalg.solve(
            evidence.z_precision + along @ evidence.changes,
            evidence.z_pull + along @ (evidence.mean - self.data(obeyed, theta)),
        )
        return np.asarray(theta[:, 0] + self.exponent * float(z @ evidence.radius))

    def settle(self, obeyed: Obeyed | None, start: _Floats) -> _Floats:
        """Return the unknowns of largest density, by Newton's method from a start."""
        theta = start.copy()
        free = np.flatnonzero(np.tile(self.free, len(start)))
        longest = np.full(start.shape, _LONGEST_LOG)
        longest[:, 1 + FIRST_DEPTH :] = _LONGEST
        height = self.density(obeyed, theta)
        for _ in range(_STEPS):
            f, J = self.slopes(obeyed, theta)
            J = J[:, free]
            if not (np.isfinite(J).all() and np.isfinite(f).all()):
                break
            _, g, P = self._priors(theta)
            pull = J.T @ self.precision @ (self.centre - f) + g.ravel()[free]
            step = np.linalg.solve(J.T @ self.precision @ J + np.diag(P.ravel()[free]), pull)
            if 0.5 * float(pull @ step) < _AT_REST:
                break
            step *= min(1.0, float(np.min(longest.ravel()[free] / np.maximum(np.abs(step), 1e-300))))
            gained = 0.0
            for _ in range(_HALVINGS):
                there = theta.copy()
                there.flat[free] += step
                gained = self.density(obeyed, there) - height
                if gained > 0.0:
                    theta, height = there, height + gained
                    break
                step *= 0.5
            if not gained > _AT_REST:
                break
        return theta

    def _log_prior(self, theta: _Floats) -> float:
        small = np.full(theta.shape[1] - 1, False)
        small[ADHESION], small[TANGENT] = self.question.sticky, self.question.loss
        if (theta[:, 1:][:, small] <= _LEAST).any():
            return -math.inf
        return self._priors(theta)[0]

    def _priors(self, theta: _Floats) -> tuple[float, _Floats, _Floats]:
        """Return ln of the priors, its slope and what they add to the diagonal of the metric, as theta is ordered."""
        question, (materials, width) = self.question, theta.shape
        x, v = np.ascontiguousarray(theta[:, 0]), np.ascontiguousarray(theta[:, 1:])
        g, P = np.zeros(theta.size), np.zeros(theta.size)
        value = _weigh(self.scene, question.prior, question.sticky, question.loss, x, v, g, P)
        # those of ln E stand behind all others
        others = materials * (width - 1)
        in_order = [np.column_stack([part[others:], part[:others].reshape(v.shape)]) for part in (g, P)]
        return value, in_order[0], in_order[1]


@kernel
def _weigh(
    scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats, g: _Floats, P: _Floats
) -> float:
    """Fill slope and metric of the priors as `add_priors` orders them; return their ln, or minus infinity."""
    add_priors(scene, prior, sticky, loss, x, v, g, P)
    if not inside(scene, prior, sticky, loss, x, v):
        return -math.inf
    return log_prior(scene, prior, sticky, loss, x, v)

"""From draws of materials to mixtures: what a pixel of a phase is told by it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from overtone.instrument.signals import Positions
from overtone.inversion.linear import stiffness
from overtone.inversion.pixels import Setting
from overtone.population.deviation import Centre, of_the_motion
from overtone.population.evidence import Tiles, reads_alike, sources_of
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT, Scene
from overtone.population.held import PROPERTIES
from overtone.population.joint import Joint, free_properties, respond
from overtone.population.materials import Question
from overtone.population.pooled import Mixture

_Floats = npt.NDArray[np.float64]

MOST_DRAWS = 48
_LOOSE = 0.2  # of t, for pixels whose loss the model does not know
_STEP = 100e-9  # [m]


def quantities_of(question: Question) -> tuple[str, ...]:
    """Return the properties that a mixture speaks of, the elastic one first."""
    names = ["modulus", "indentation"]
    names += ["adhesion"] if question.sticky else []
    return (*names, *(("loss_tangent", "viscosity") if question.loss else ()))


def tilts(settings: Sequence[Setting], tiles: Tiles, members: npt.NDArray[np.intp]) -> _Floats:
    """Return by how much more each shared error adds per metre of height, x and y: (3, datum, source) [N/m]."""
    parts = []
    for i, setting in enumerate(settings):
        rows = setting.rows.orders.size
        if setting.shared is None:
            parts.append(np.zeros((3, rows, 0)))
            continue
        centre = tiles.place.mean(axis=0)
        places = np.concatenate([centre[None], centre + _STEP * np.eye(3)])
        added, _ = sources_of(settings, i, reads_alike(setting.shared, members, Positions(*places.T)))
        parts.append((added[1:] - added[0]) / _STEP)
    return np.concatenate(parts, axis=1)


def mixture_of(
    settings: Sequence[Setting],
    question: Question,
    joint: Joint,
    k: int,
    tilt: _Floats,
    noise: _Floats,
    exponent: float,
    seed: int,
) -> tuple[Mixture, Centre, _Floats]:
    """Return what turns the harmonics of the pixels of a phase into their properties.

    Parameters
    ----------
    settings, question, joint
        As `overtone.population.joint.infer` has them.
    k : int
        Which phase.
    tilt : array (3, datum, source)
        From `tilts`.
    noise : array (datum, datum)
        Covariance of the noise of a pixel [N^2].
    exponent : float
        Change of ln of the elastic unknown with ln R at a given force.
    seed : int
        For the spread within the phase.

    Returns
    -------
    Mixture
        Quantities as `quantities_of` orders them, logarithms all.
    Centre
        The draw in the middle, about which pixels are solved for.
    mahalanobis : array (datum, datum)
        Precision of a pixel about its phase at the median draw [unit^-2].
    """
    draws, unit = joint.draws, joint.evidence.unit
    free = free_properties(question)
    scans, data = len(settings), noise.shape[0]
    amplitude = np.stack([t.amplitude for t in joint.tiles])
    generator = np.random.default_rng(seed)
    chosen = np.linspace(0, len(draws.ln_E) - 1, min(MOST_DRAWS, len(draws.ln_E))).astype(int)
    names = quantities_of(question)
    shared = joint.tiles[k].changes.shape[2]
    f = np.empty((chosen.size, data))
    slope = np.empty((chosen.size, 3, data))
    gain = np.empty((chosen.size, PROPERTIES + scans, data))
    lines = np.zeros((chosen.size, len(names), PROPERTIES + scans))
    base, spread = np.empty((chosen.size, len(names))), np.empty((chosen.size, len(names)))
    N = noise / unit**2
    depth, drawn = np.empty((chosen.size, scans, PROPERTIES)), np.empty((chosen.size, PROPERTIES))
    s0 = joint.spreads[k]
    inverses = np.empty((chosen.size, data, data))
    changes = joint.evidence.changes[k * data : (k + 1) * data, :shared]
    contact = question.columns.contact
    for i, d in enumerate(chosen):
        x, v, z = float(draws.ln_E[d, k]), draws.unknowns[d, k], draws.z[d]
        response = respond(
            settings, question, unit, amplitude, k, joint.tiles[k], x, v, free, np.zeros(PROPERTIES)
        )
        s = s0.value * np.exp(s0.root @ generator.standard_normal(PROPERTIES))
        variances = np.concatenate(
            [np.where(free, s, 0.0) ** 2, np.full(scans, 0.0 if question.loss else _LOOSE**2)]
        )
        J = np.concatenate([response.J, response.along], axis=1)
        V = (J * variances) @ J.T + N
        inverses[i] = np.linalg.inv(V)
        G = (J * variances).T @ inverses[i]
        P = np.diag(variances) - G @ (J * variances)
        f[i] = response.f + changes @ z[:shared]
        slope[i] = np.einsum("jds,s->jd", tilt, z[:shared]) / unit
        of_radius = exponent * float(joint.evidence.radius[:shared] @ z[:shared])
        t = v[FIRST_DEPTH]
        Delta = 1.0 / (1.0 + np.exp(-t))
        S, share = stiffness(contact, float(np.exp(x)))
        along = lines[i]
        for q, name in enumerate(names):
            if name == "modulus":
                along[q, 0] = 1.0
                base[i, q] = x + of_radius
            elif name == "indentation":
                along[q, :PROPERTIES] = (1.0 - Delta) * response.depth[0]
                along[q, PROPERTIES] = 1.0 - Delta
                base[i, q] = np.log(2.0 * amplitude[k, 0] * Delta)
            elif name == "adhesion":
                along[q, 1] = 1.0
                base[i, q] = v[ADHESION] + np.log(unit)
            elif name == "loss_tangent":
                along[q, 2] = 1.0
                base[i, q] = v[TANGENT]
            else:
                along[q, 0], along[q, 2] = share, 1.0
                base[i, q] = np.log(S / question.columns.loss) + v[TANGENT] + of_radius
        gain[i] = G
        depth[i], drawn[i] = response.depth, np.where(free, s, 0.0)
        spread[i] = np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", along, P, along), 1e-16))
    i = _middle(np.column_stack([draws.ln_E[chosen, k], draws.unknowns[chosen, k], drawn]))
    x, v = float(draws.ln_E[chosen[i], k]), draws.unknowns[chosen[i], k]
    scene = draws.scene
    motion, by = np.zeros(data), np.zeros((data, 4))
    of_the_motion(scene, without_motion(scene), k, x, v, motion, by)
    shift = changes @ draws.z[chosen[i], :shared]
    loose = math.inf if question.loss else _LOOSE
    centre = Centre(
        x, v, motion, by, shift, slope[i], np.asarray(np.linalg.inv(N)), drawn[i], depth[i], loose
    )
    return Mixture(f, slope, gain, lines, base, spread, i), centre, np.median(inverses, axis=0)


def _middle(all_of: _Floats) -> int:
    """Return which of some draws (draw, number) is nearest to the median of all."""
    off = (all_of - np.median(all_of, axis=0)) / np.maximum(all_of.std(axis=0), 1e-12)
    return int(np.argmin((off**2).sum(axis=1)))


def without_motion(scene: Scene) -> Scene:
    """Return a scene on bare cosines."""
    none = scene.followed._replace(tip=scene.followed.tip[:0])
    return scene._replace(followed=none)

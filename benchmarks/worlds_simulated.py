"""Simulated worlds: a sample drawn from stated priors, scanned by a microscope with errors drawn from its calibration.

A world is what an operator has (scans, probe, noise) and what only the simulator knows (truth, errors):

    scan       the readings, with noise, as they are after a correction with the neutral values of the instrument; the
               attribute ``calibration`` states the covariance that its true values were drawn from
    reading    what `undo` with the true values turns into the true signals
    state      at the amplitude of each pixel (set-point and error of the feedback), of the true lever, which is the
               stated one with the drawn factors of stiffness, quality factor, drive and radius
    sample     domains of two materials in a matrix with interphase, texture and gradients, or one of the other kinds

Kinds:

    three         PS-like matrix, LDPE-like domains on 30 %, a third material on 5 % of the area
    homogeneous   one of the three, without a gradient
    gradient      no phases: ln E and ln F change evenly over the scan, each in its own direction, the loss tangent is
                  the same everywhere; nothing scatters
    jkr           as three, but attraction and elastic force are those of JKR; ``adhesion`` is its pull-off force
    sls           as three, but a standard linear solid in place of the Kelvin-Voigt contact; ``modulus`` and
                  ``loss_tangent`` are its storage modulus and loss tangent at the drive frequency
    blunted-cone  as three, but the paraboloid goes over into a cone of 20 degrees where the contact radius is 0.94 R
                  and the indentation 0.88 R

The first three are exactly what ``dmt-viscous`` with the full motion takes for granted. One seed is one sample, one set
of standard normals for the errors of the instrument and one for the noise, whatever force, calibration and noise, so
that worlds can be compared in pairs; only a material that could not be held under JKR is another one there. All motions
are full ones; for the last two kinds see `worlds_forces`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import gaussian_filter

import overtone as ot
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import Sample
from overtone.demo import demo_probe
from overtone.dynamics.balance import FOUND
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.noise import add_noise
from overtone.instrument.phantom import sample_map
from overtone.instrument.shared import redo
from overtone.instrument.signals import positions, signals_of, with_signals
from overtone.instrument.unknowns import NEUTRAL, probe_with
from overtone.quantities import named_array
from overtone.readings import Reading, with_reading
from worlds_forces import N_MAX, Array, blunted_cone, held, jkr_viscous, standard_linear_solid

Random = np.random.Generator

KINDS = ("three", "homogeneous", "gradient", "jkr", "sls", "blunted-cone")
POISSON_RATIO = 0.35
SIZE = 3e-6
"""Width of a scan [m]."""
OBSERVABLES = ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3")
FEEDBACK_ERROR = 0.003
"""Of A1, from pixel to pixel."""
NOISE = {"A1": 1e-12, "phi1": math.radians(0.1), "A2": 1e-12, "A3": 1e-12}
RELIEF = 1.5e-9


@dataclass(frozen=True)
class Prior:
    """Where the properties of a material are drawn from, and how its domains lie.

    Parameters
    ----------
    modulus, adhesion, loss_tangent : float
        Medians between worlds [Pa, N, 1].
    height : float
        Of its surface [m].
    coverage : float
        Share of the area; 0 for the matrix.
    radii : tuple of float
        Least and largest radius of its domains, of the width of the scan.
    """

    modulus: float
    adhesion: float
    loss_tangent: float
    height: float
    coverage: float = 0.0
    radii: tuple[float, float] = (0.0, 0.0)


PRIORS = {
    "PS": Prior(1.93e9, 1.9e-9, 0.05, 0.0),
    "LDPE": Prior(94e6, 16e-9, 0.15, -12e-9, 0.30, (0.05, 0.11)),
    "third": Prior(0.5e9, 6e-9, 0.10, 5e-9, 0.05, (0.035, 0.06)),
}
BETWEEN_WORLDS = {"modulus": 0.5, "adhesion": 0.3, "loss_tangent": 0.4}
"""Standard deviations of ln of the median of a material."""
SPREAD = (0.10, 0.20)
"""Of ln of each property within a material, uniform between."""
GRADIENT = (0.05, 0.10)
"""Change of ln E of a material over the scan."""
INTERPHASE = (1.0, 3.0)
"""Width [pixel]."""
SETPOINT, MARGIN = 0.42, 1.5
WEAK = probe_with(
    demo_probe(), {**NEUTRAL, "stiffness": 0.93, "quality_factor": 1.02, "free_amplitude": 0.99}
)
"""A material is drawn again until this lever, weaker than most, can feed the loss of a pixel that is `MARGIN` spreads
softer, stickier and lossier than the median: a scan that loses the surface all over is none. It cuts the upper end of
LDPE: what is left has medians of 1.05, 0.91 and 0.88 times those of its prior (modulus, adhesion, loss tangent)."""

TIGHT = {
    "A0_offset": 3e-12,
    "A0_slope_z": 1e-4,
    "A0_slope_x": 2e-6,
    "A0_slope_y": 2e-6,
    "phi1_offset": math.radians(0.1),
    "gain0": 0.005,
    "gain2": 0.005,
    "gain3": 0.01,
    "latency2": math.radians(0.3),
    "latency3": math.radians(0.3),
    "stiffness": 0.05,
    "quality_factor": 0.005,
    "free_amplitude": 0.003,
    "radius": 0.10,
}
LOOSE = {
    "A0_offset": 30e-12,
    "A0_slope_z": 5e-4,
    "A0_slope_x": 1e-5,
    "A0_slope_y": 1e-5,
    "phi1_offset": math.radians(0.5),
    "gain0": 0.02,
    "gain2": 0.02,
    "gain3": 0.04,
    "latency2": math.radians(1.0),
    "latency3": math.radians(1.0),
    "stiffness": 0.05,
    "quality_factor": 0.02,
    "free_amplitude": 0.01,
    "radius": 0.10,
}
CALIBRATIONS = {"tight": TIGHT, "loose": LOOSE}
"""Standard deviations of the unknowns of `overtone.instrument.unknowns`, independent [m, rad, 1]."""


@dataclass(frozen=True)
class Material:
    """What is true of a material of a world, over its own pixels (none of an interphase).

    Parameters
    ----------
    name : str
        As in `PRIORS`.
    modulus, adhesion, loss_tangent : float
        Medians over its pixels [Pa, N, 1].
    spread : mapping of str to float
        Standard deviation of ln of each over its pixels, with the gradient.
    drawn : mapping of str to float
        The medians that the world drew for it, before texture and gradient.
    poisson_ratio : float
        Known to the operator.
    pixels : int
        How many it has.
    """

    name: str
    modulus: float
    adhesion: float
    loss_tangent: float
    spread: Mapping[str, float]
    drawn: Mapping[str, float]
    poisson_ratio: float
    pixels: int


@dataclass(frozen=True)
class World:
    """A scan, and what is true behind it.

    Parameters
    ----------
    scans : tuple of Dataset
        Corrected observables (y, x) with ``height``, one a set-point.
    probe : Probe
        As the operator believes it to be.
    noise : mapping
        Standard deviations as `overtone.map_properties` takes them.
    truth : Dataset
        ``modulus``, ``adhesion``, ``viscosity``, ``loss_tangent``, ``material`` (-1 in an interphase and in a gradient)
        over (y, x), and ``indentation``, with a first dimension ``setpoint`` where there are several.
    materials : tuple of Material
        In the order of ``material``; none in a gradient.
    errors : mapping
        True value of every unknown of the instrument.
    calibration : Calibration
        As the scans carry it: neutral values and the covariance that ``errors`` were drawn from.
    kind, seed : str, int
        As asked for.
    """

    scans: tuple[xr.Dataset, ...]
    probe: ot.Probe
    noise: Mapping[str, float]
    truth: xr.Dataset
    materials: tuple[Material, ...]
    errors: Mapping[str, float]
    calibration: Calibration
    kind: str
    seed: int

    @property
    def scan(self) -> xr.Dataset:
        """The scan at the first set-point."""
        return self.scans[0]

    @property
    def true_probe(self) -> ot.Probe:
        """The lever as it really is."""
        return probe_with(self.probe, self.errors)


def world(
    seed: int,
    *,
    kind: str = "three",
    noise_A0: float = 5e-12,
    calibration: str | Mapping[str, float] = "tight",
    shape: tuple[int, int] = (96, 96),
    setpoints: Sequence[float] = (0.42,),
) -> World:
    """Return a simulated world.

    Parameters
    ----------
    seed : int
        Of everything.
    kind : str
        One of `KINDS`.
    noise_A0 : float
        Standard deviation of A0 [m]; the others are `NOISE`.
    calibration : str or mapping
        Key of `CALIBRATIONS`, or standard deviations of any unknowns.
    shape : tuple of int
        Pixels (y, x), 40 or more each way.
    setpoints : sequence of float
        A1 over the free amplitude that the operator believes in; the same pixels and instrument for all of them.

    Notes
    -----
    Slopes of A0 count from the middle of each scan, as `overtone.instrument.signals.positions` has it: with several
    set-points the offset is that at the mean height of each.
    """
    if kind not in KINDS or min(shape) < 40:
        raise ValueError(f"no world of kind {kind!r} and shape {shape}")
    for_sample, for_errors, for_scans = np.random.default_rng(seed).spawn(3)
    ground, materials = _sample(kind, shape, for_sample)
    probe, stated = demo_probe(), CALIBRATIONS[calibration] if isinstance(calibration, str) else calibration
    normals = dict(zip(NEUTRAL, for_errors.standard_normal(len(NEUTRAL)), strict=True))
    errors = {name: value + stated.get(name, 0.0) * normals[name] for name, value in NEUTRAL.items()}
    covariance = np.diag(np.square(list(stated.values())))
    left = Calibration(probe, probe.drive.free_amplitude, dict(NEUTRAL), tuple(stated), covariance)
    noise = {**NOISE, "A0": noise_A0}
    scans, indentations = [], []
    for setpoint, random in zip(setpoints, for_scans.spawn(len(setpoints)), strict=True):
        off = 1.0 + FEEDBACK_ERROR * random.standard_normal(shape)
        amplitude = setpoint * probe.drive.free_amplitude * off
        states = _states(kind, probe_with(probe, errors), ground, amplitude)
        clean = ground[["height"]].assign({name: states[name] for name in OBSERVABLES})
        base = ground["height"].values + states["Z"].values
        clean["height"] = named_array("height", base - np.nanmax(base), ("y", "x"), ground.coords)
        where = positions(clean)._asdict()
        read = with_signals(clean, redo(signals_of(clean), errors, left.amplitude, **where))
        scan = add_noise(read, noise, seed=int(random.integers(2**31)))
        scan = with_reading(scan, Reading(probe, corrected=True))
        scans.append(scan.assign_attrs(calibration=format_calibration(left)))
        indentations.append(states["indentation"])
    deepest = xr.concat(indentations, dim="setpoint") if len(setpoints) > 1 else indentations[0]
    truth = ground.drop_vars("height").assign(indentation=deepest)
    return World(tuple(scans), probe, noise, truth, materials, errors, left, kind, seed)


# --- samples ----------------------------------------------------------------------------------------------------


def _between(random: Random, ends: tuple[float, float]) -> float:
    return float(random.uniform(*ends))


def _drawn(prior: Prior, kind: str, random: Random) -> tuple[dict[str, float], dict[str, float]]:
    """Return medians and spreads of a material in one world, which the feedback can hold."""
    while True:
        medians = {
            n: getattr(prior, n) * math.exp(sigma * random.standard_normal())
            for n, sigma in BETWEEN_WORLDS.items()
        }
        spreads = {name: _between(random, SPREAD) for name in medians}
        worst = {name: median * math.exp(MARGIN * spreads[name]) for name, median in medians.items()}
        worst["modulus"] = medians["modulus"] / math.exp(MARGIN * spreads["modulus"])
        solid = _solid(**{name: np.array([value]) for name, value in worst.items()})
        solids = [solid, Sample(jkr_viscous(), solid.values)] if kind == "jkr" else [solid]
        states = [ot.hold_amplitude(WEAK, one, setpoint=SETPOINT) for one in solids]
        if all(int(state["state"].item()) == FOUND for state in states):
            return medians, spreads


def _solid(modulus: Array, adhesion: Array, loss_tangent: Array) -> Sample:
    """Return a Kelvin-Voigt contact under the tip of the lever."""
    tip, drive = demo_probe().tip, demo_probe().drive
    E = effective_modulus(modulus, POISSON_RATIO, tip.modulus, tip.poisson_ratio)
    viscosity = loss_tangent * 2.0 * E / (2.0 * math.pi * drive.frequency)
    return ot.sample(
        "dmt-viscous", modulus=modulus, adhesion=adhesion, viscosity=viscosity, poisson_ratio=POISSON_RATIO
    )


def _ramp(shape: tuple[int, int], random: Random) -> Array:
    """Return a plane in a random direction, from -1/2 to 1/2 between two corners or sides."""
    angle = _between(random, (0.0, 2.0 * math.pi))
    y, x = np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in shape), indexing="ij")
    plane = x * math.cos(angle) + y * math.sin(angle)
    return np.asarray(plane / np.ptp(plane))


def _texture(shape: tuple[int, int], length: float, random: Random) -> Array:
    """Return a field of unit variance, correlated over a length [pixel], 0 for none."""
    field = random.standard_normal(shape)
    if length == 0.0:
        return field
    smooth = gaussian_filter(field, length, mode="wrap")
    return np.asarray(smooth / smooth.std())


def _circles(prior: Prior, shape: tuple[int, int], random: Random, others: Array) -> Array | None:
    """Return how far each pixel is outside the domains of a material, or None where they find no room [pixel]."""
    rows, columns = np.indices(shape)
    outside = np.full(shape, np.inf)
    for _ in range(500):
        if (outside < 0.0).mean() >= prior.coverage:
            return outside
        radius = max(min(shape) * _between(random, prior.radii), 4.0)
        y, x = random.uniform((0.0, 0.0), shape)
        circle = np.hypot(rows - y, columns - x) - radius
        if others[circle < INTERPHASE[1] + 1.0].min(initial=np.inf) > 0.5 * INTERPHASE[1]:
            outside = np.minimum(outside, circle)
    return None


def _shares(shape: tuple[int, int], random: Random) -> Array:
    """Return the share of each material (material, y, x), which runs smoothly through an interphase."""
    width = _between(random, INTERPHASE)
    while True:
        soft = _circles(PRIORS["LDPE"], shape, random, np.full(shape, np.inf))
        third = None if soft is None else _circles(PRIORS["third"], shape, random, soft)
        if soft is not None and third is not None:
            break
    inside = np.clip(0.5 - np.stack([soft, third]) / width, 0.0, 1.0)
    inside = inside**2 * (3.0 - 2.0 * inside)
    return np.concatenate([1.0 - inside.sum(axis=0, keepdims=True), inside])


def _sample(kind: str, shape: tuple[int, int], random: Random) -> tuple[xr.Dataset, tuple[Material, ...]]:
    """Return a map of properties with height and ``material``, and the materials."""
    # streams of their own, so that one part can change without the others
    for_medians, for_layout, for_texture, for_relief = random.spawn(4)
    if kind == "gradient":
        logs, height, material = _gradient_logs(shape, for_medians), np.zeros(shape), np.full(shape, -1)
        names, drawn = [], []
    else:
        names, streams = list(PRIORS), for_medians.spawn(len(PRIORS))
        drawn = [_drawn(prior, kind, own) for prior, own in zip(PRIORS.values(), streams, strict=True)]
        shares = _shares(shape, for_layout)
        if kind == "homogeneous":
            one = int(for_medians.integers(len(names)))
            names, drawn, shares = names[one : one + 1], drawn[one : one + 1], np.ones((1, *shape))
        logs = {name: np.zeros(shape) for name in BETWEEN_WORLDS}
        for share, (medians, spreads) in zip(shares, drawn, strict=True):
            length = float(for_texture.choice([0.0, 1.0, 2.0]))
            slope = 0.0 if kind == "homogeneous" else _between(for_texture, GRADIENT)
            ramp = slope * _ramp(shape, for_texture)
            for name, median in medians.items():
                field = spreads[name] * _texture(shape, length, for_texture)
                logs[name] += share * (math.log(median) + field + (ramp if name == "modulus" else 0.0))
        height = np.tensordot([PRIORS[name].height for name in names], shares, axes=1)
        material = np.where(shares.max(axis=0) == 1.0, shares.argmax(axis=0), -1)
    values = {name: np.exp(log) for name, log in logs.items()}
    y, x = np.meshgrid(*(np.arange(count) / min(shape) for count in shape), indexing="ij")
    turns = for_relief.uniform(0.0, 2.0 * math.pi, 2)
    height = height + RELIEF * np.sin(2 * np.pi * x + turns[0]) * np.cos(3 * np.pi * y + turns[1])
    stated = {name: _solid(**values).values[name] for name in ("modulus", "adhesion", "viscosity")}
    ground = sample_map(size=SIZE * shape[1] / min(shape), height=height, **stated)
    ground["loss_tangent"] = named_array("loss_tangent", values["loss_tangent"], ("y", "x"), ground.coords)
    flags = {"flag_values": list(range(-1, len(names))), "flag_meanings": " ".join(["none", *names])}
    ground["material"] = xr.DataArray(material.astype(np.int8), dims=("y", "x"), attrs=flags)
    found = [
        _material(n, d[0], logs, material == k) for k, (n, d) in enumerate(zip(names, drawn, strict=True))
    ]
    return ground, tuple(found)


def _material(
    name: str, drawn: Mapping[str, float], logs: Mapping[str, Array], own: npt.NDArray[np.bool_]
) -> Material:
    """Return what is true of a material over its own pixels."""
    medians = {key: float(np.exp(np.median(log[own]))) for key, log in logs.items()}
    spread = {key: float(log[own].std()) for key, log in logs.items()}
    return Material(
        name, **medians, spread=spread, drawn=drawn, poisson_ratio=POISSON_RATIO, pixels=int(own.sum())
    )


def _gradient_logs(shape: tuple[int, int], random: Random) -> dict[str, Array]:
    """Return ln of the properties of a sample without phases."""
    middle = math.log(_between(random, (0.3, 1.0))) + math.log(1e9)
    modulus = math.log(5.0) + _between(random, (0.0, 1.0)) * math.log(30.0 / 5.0)
    adhesion = _between(random, (0.0, math.log(3.0)))
    return {
        "modulus": middle + modulus * _ramp(shape, random),
        "adhesion": math.log(6e-9) + 0.3 * random.standard_normal() + adhesion * _ramp(shape, random),
        "loss_tangent": np.full(shape, math.log(0.1) + 0.4 * random.standard_normal()),
    }


# --- states -----------------------------------------------------------------------------------------------------


def _states(kind: str, probe: ot.Probe, ground: xr.Dataset, amplitude: Array) -> xr.Dataset:
    """Return observables, ``Z`` and ``indentation`` (y, x) at the amplitude of each pixel, NaN without a state."""
    solid = _solid(*(ground[name].values for name in BETWEEN_WORLDS))
    if kind == "jkr":
        solid = Sample(jkr_viscous(), solid.values)
    share = named_array("A1", amplitude / probe.drive.free_amplitude, ("y", "x"), ground.coords)
    states = ot.hold_amplitude(probe, solid, setpoint=share, n_max=N_MAX)
    if kind in ("sls", "blunted-cone"):
        force = standard_linear_solid if kind == "sls" else blunted_cone
        return held(probe, solid, ground["loss_tangent"].values, amplitude, states, force)
    return states

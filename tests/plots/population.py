"""Results of method "population" made by hand: domains in a matrix, with borders that belong to no phase."""

from __future__ import annotations

import json
import math

import numpy as np
import xarray as xr

from overtone import provenance
from overtone.demo import demo_probe
from overtone.inversion.result import STATUS_FLAGS
from overtone.probe import format_probe
from overtone.quantities import named_array, quantity
from overtone.readings import Reading, with_reading

SIZE = 48
PIXEL = 40e-9
NAMES = ("PS", "LDPE", "filler")
PROPERTIES = ("modulus", "adhesion", "indentation", "viscosity", "loss_tangent")
TRUTH = {
    "modulus": (1.93e9, 94e6, 7e9),
    "adhesion": (8e-9, 16e-9, 4e-9),
    "indentation": (2.4e-9, 17e-9, 1.1e-9),
    "viscosity": (60.0, 12.0, 90.0),
    "loss_tangent": (0.05, 0.2, 0.02),
}
SIGNALS = {
    "A0": (120e-12, 39e-12, 150e-12),
    "A1": (40e-9, 40e-9, 40e-9),
    "phi1": (1.15, 1.42, 1.08),
    "A2": (72e-12, 26e-12, 90e-12),
    "phi2": (5.3, 5.9, 5.2),
    "A3": (28e-12, 11e-12, 35e-12),
    "phi3": (2.0, 2.4, 1.9),
}
NOISE = {"A0": 5e-12, "A1": 1e-11, "phi1": 2e-3, "A2": 2e-12, "phi2": 0.05, "A3": 2e-12, "phi3": 0.1}
PRIORS = (
    "modulus log-range 1e+06 3e+11; indentation log-range 1e-11 8e-08; adhesion normal 0 1.88e-08; "
    "loss_tangent range 0 2"
)
ROWS = ("CONS_0", "CONS_1", "CONS_2", "CONS_3", "DISS_1", "DISS_2")


def coords(size: int = SIZE) -> dict[str, tuple[str, np.ndarray]]:
    return {"y": ("y", np.arange(size)[::-1] * PIXEL), "x": ("x", np.arange(size) * PIXEL)}


def labels(phases: int, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Which material a pixel is of, and which phase it was put to: -1 at borders, and everywhere without phases."""
    y, x = np.mgrid[:size, :size] * (48 / size)
    material = np.zeros((size, size), int)
    border = np.zeros((size, size), bool)
    for kind, disks in ((1, ((10, 12, 8), (33, 34, 10), (12, 38, 5), (38, 9, 6))), (2, ((25, 15, 5),))):
        if kind < max(phases, 1):
            for b, a, r in disks:
                away = np.hypot(y - b, x - a) - r
                material[away < 0] = kind
                border |= np.abs(away) < 0.8
    phase = np.where(border, -1, material) if phases > 1 else material - (phases == 0)
    return material, phase


def observables(phases: int = 2, seed: int = 1, size: int = SIZE) -> xr.Dataset:
    rng = np.random.default_rng(seed)
    material, phase = labels(phases, size)
    arrays = {}
    for name, values in SIGNALS.items():
        mean = np.asarray(values)[material]
        if phases > 1:  # pixels between phases lie between their signals
            mean = np.where(phase < 0, 0.5 * (values[0] + values[1]), mean)
        arrays[name] = named_array(
            name, mean + NOISE[name] * rng.normal(size=mean.shape), ("y", "x"), coords(size)
        )
    height = 12e-9 * (material == 1) * np.sqrt(np.clip(rng.uniform(0.8, 1.0, material.shape), 0, 1))
    y, x = np.mgrid[:size, :size] / size
    height = height + 6e-9 * np.sin(7 * x + 3 * y) + 20e-9 * x
    arrays["height"] = named_array("height", height, ("y", "x"), coords(size))
    found = with_reading(xr.Dataset(arrays), Reading(demo_probe(), corrected=True))
    found = provenance.add_finding(found, "Simulated data, made by hand.")
    return provenance.record(found, "open_scan", path="session/blend.ibw")


def before(scan: xr.Dataset) -> xr.Dataset:
    """The same scan with an offset that drifts, crosstalk, and a phase that is off."""
    rows = np.linspace(-1.0, 1.0, scan.sizes["y"])[:, None]
    raw = scan.copy()
    raw["A0"] = scan["A0"] + 1.5e-9 + 30e-12 * rows
    raw["phi1"] = scan["phi1"] + 0.05
    a2 = scan["A2"] * np.exp(-1j * scan["phi2"]) + 60e-12 * np.exp(-1j)
    raw["A2"], raw["phi2"] = abs(a2), (-xr.apply_ufunc(np.angle, a2)) % (2 * math.pi)
    raw["A3"] = 0.9 * scan["A3"]
    for name in scan.data_vars:
        raw[name].attrs = scan[name].attrs
    return raw


def energies(scan: xr.Dataset) -> xr.Dataset:
    from overtone.inversion.properties import map_energy

    return map_energy(scan, demo_probe())


def truth(phases: int = 2, size: int = SIZE) -> xr.Dataset:
    material, _ = labels(phases, size)
    known = {
        name: named_array(name, np.asarray(TRUTH[name])[material], ("y", "x"), coords(size)) for name in TRUTH
    }
    return xr.Dataset(known)


def result(
    scan: xr.Dataset, phases: int = 2, seed: int = 2, shift: float = 0.0, gaps: bool = True
) -> xr.Dataset:
    """A result with a sd of ln of 0.1 pooled, 0.8 alone, and 0.15 shared by the whole scan."""
    rng = np.random.default_rng(seed)
    size = scan.sizes["y"]
    material, phase = labels(phases, size)
    pooled = phase >= 0
    error = rng.normal(size=material.shape)
    arrays: dict[str, xr.DataArray] = {}

    def put(name: str, values: np.ndarray, like: str) -> None:
        record = quantity(like)
        arrays[name] = xr.DataArray(
            values, dims=("y", "x"), coords=coords(size), attrs={"units": record.unit if record else "1"}
        )

    status = np.where(pooled, 0, 1).astype(np.int8)
    if gaps:
        status[2:6, 30:36] = 9
        status[40:43, 20:24] = 6
    gone = np.isin(status, (6, 9))
    for name, weight in zip(PROPERTIES, (1.0, 0.4, -0.6, 0.5, 0.3), strict=True):
        true = np.asarray(TRUTH[name])[material] * math.exp(weight * shift)
        wide = np.where(pooled, 0.18, 0.82) * abs(weight)
        median = np.where(gone, np.nan, true * np.exp(0.6 * wide * error))
        alone = np.where(gone, np.nan, true * np.exp(weight * 0.5 * error))
        put(name, np.where(status == 0, median, np.nan), name)
        put(f"{name}_unscreened", median, name)
        for end, sign in (("lower", -1.645), ("upper", 1.645)):
            put(f"{name}_{end}", median * np.exp(sign * wide), name)
            put(f"{name}_unpooled_{end}", alone * np.exp(sign * 0.82 * abs(weight)), name)
        put(f"{name}_unpooled", alone, name)
    known = np.where(gone, np.nan, 1.0)
    put("uncertainty", np.where(pooled, 0.18, 0.82) * known, "1")
    put("uncertainty_statistical", np.where(pooled, 0.1, 0.81) * known, "1")
    put("uncertainty_systematic", 0.15 * known, "1")
    put("misfit", rng.chisquare(2, material.shape) * known, "1")
    put("contact_probability", np.where(status == 9, 0.02, 1.0), "1")
    put("shrinkage", np.where(pooled, np.where(material == 1, 0.7, 0.96), 0.0), "1")
    put("phase_probability", np.where(pooled, rng.uniform(0.9, 1.0, material.shape), 0.4), "1")
    put("status", status, "1")
    arrays["status"].attrs |= STATUS_FLAGS
    put("phase", phase.astype(np.int8), "1")
    names = NAMES[:phases]
    arrays["phase"].attrs |= {
        "flag_values": list(range(-1, phases)),
        "flag_meanings": " ".join(("none", *names)),
    }
    arrays |= _materials(phase, phases, shift)
    attributes = {
        **scan.attrs,
        "model": "dmt-viscous",
        "method": "population",
        "priors": PRIORS,
        "verdict": "relative",
        "verdict_reason": "shared errors move ln E of PS by 0.31, of its ratio to the reference by 0.12.",
        "phase_note": f"{phases} phases minimise the description length of the observables.",
    }
    found = xr.Dataset(arrays, coords={"material": list(names), "row": list(ROWS)}, attrs=attributes)
    return provenance.record(
        found,
        "map_properties",
        probe=format_probe(demo_probe()),
        model="dmt-viscous",
        method="population",
        harmonics=(0, 1, 2, 3),
        dissipative_harmonics=(1, 2),
        motion="full",
        noise=NOISE,
        noise_stated=["A0", "A2"],
        poisson_ratio=0.37,
        intermolecular_distance=0.2e-9,
        priors=PRIORS,
        phases=None,
        reference="PS",
    )


def _materials(phase: np.ndarray, phases: int, shift: float) -> dict[str, xr.DataArray]:
    """Numbers of each phase, and what a predictive check of it found: the last row of the first is off."""
    rng = np.random.default_rng(7)

    def each(values, units: str = "1", dims: tuple[str, ...] = ("material",)) -> xr.DataArray:
        return xr.DataArray(np.asarray(values), dims=dims, attrs={"units": units})

    index = np.arange(phases)
    arrays = {
        "material_pixels": each(np.array([(phase == k).sum() for k in index], int)),
        "material_domains": each(np.array([1, 4, 1], int)[:phases]),
        "material_resolved": each(np.ones(phases, np.int8)),
    }
    statistical, systematic = np.array([0.05, 0.02, 0.2])[:phases], np.array([0.31, 0.12, 0.5])[:phases]
    for name, weight in zip(PROPERTIES, (1.0, 0.4, -0.6, 0.5, 0.3), strict=True):
        record = quantity(name)
        unit = record.unit if record else "1"
        median = np.array(TRUTH[name])[:phases] * math.exp(weight * shift)
        half = np.exp(1.645 * abs(weight) * np.hypot(statistical, systematic))
        arrays |= {
            f"material_{name}": each(median, unit),
            f"material_{name}_lower": each(median / half, unit),
            f"material_{name}_upper": each(median * half, unit),
            f"material_{name}_spread": each(np.full(phases, 0.08 * abs(weight))),
            f"material_{name}_statistical": each(abs(weight) * statistical),
            f"material_{name}_systematic": each(abs(weight) * systematic),
        }
    ratio = np.array(TRUTH["modulus"])[:phases] / TRUTH["modulus"][0]
    arrays |= {
        "material_modulus_ratio": each(ratio),
        "material_modulus_ratio_lower": each(ratio * np.array([1.0, 0.8, 0.6])[:phases]),
        "material_modulus_ratio_upper": each(ratio * np.array([1.0, 1.25, 1.7])[:phases]),
        "material_misfit": each(np.array([3.1, 9.8, 2.0])[:phases]),
        "material_misfit_probability": each(np.array([0.37, 0.02, 0.6])[:phases]),
        "material_reference": each((index == 0).astype(np.int8)),
    }
    centre = np.array([1.97e-9, -4.1e-9, 3.6e-9, -2.9e-9, 1.2e-11, 4e-11]) * np.array(
        [[1.0], [0.33], [1.2]][:phases]
    ).reshape(phases, 1)
    sd = np.abs(centre) * 0.03 + 2e-12
    off = rng.normal(size=centre.shape) * 0.7
    if phases:
        off[0, -1] = 3.1
    dims = ("material", "row")
    arrays |= {
        "check_observed": each(centre + off * sd, "N", dims),
        "check_lower": each(centre - 1.645 * sd, "N", dims),
        "check_upper": each(centre + 1.645 * sd, "N", dims),
    }
    return arrays


def calibrated(scan: xr.Dataset) -> xr.Dataset:
    """The scan with a calibration that leaves 1.2 pm of A0 and 0.1 degrees of phi1 open."""
    from overtone.instrument.calibration import Calibration, ReferenceMaterial, format_calibration
    from overtone.instrument.unknowns import NEUTRAL

    names = ("A0_offset", "phi1_offset", "gain0", "gain2", "stiffness", "free_amplitude", "radius")
    errors = np.array([1.2e-12, math.radians(0.1), 0.004, 0.007, 0.05, 0.003, 0.1])
    record = Calibration(
        probe=demo_probe(),
        amplitude=94e-9,
        values={**NEUTRAL, "A0_offset": 1.5e-9, "gain2": 0.93},
        names=names,
        covariance=np.diag(errors**2),
        noise={"A0": 3e-12, "A2": 1e-12},
        reference=ReferenceMaterial("PS", "dmt", 0.35, {"modulus": (2e9, 0.1)}, ("modulus",)),
        source="curve.ibw",
    )
    attributes = {"calibration": format_calibration(record)}
    return provenance.record(scan.assign_attrs(attributes), "correct", calibration="curve.ibw")


def history_of(dataset: xr.Dataset) -> list[dict[str, object]]:
    return list(json.loads(dataset.attrs["history"]))

"""The demonstration: a virtual session at a microscope, calibrated, corrected, mapped and held against its truth."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationWarning
from overtone.instrument.approach_fit import Reference
from overtone.instrument.calibrate import calibrate
from overtone.instrument.calibration import save_calibration
from overtone.instrument.correct import calibration_of, correct
from overtone.instrument.curve import simulate_approach, simulate_far_field
from overtone.instrument.gates import gates
from overtone.instrument.instrument import Instrument, NearSurface
from overtone.instrument.noise import ORDINARY_NOISE, add_noise, noise_from_pair
from overtone.instrument.phantom import POLYOLEFIN, POLYSTYRENE, Material, blend
from overtone.instrument.photodiode import SplitDiode
from overtone.instrument.scan import scan_with_truth
from overtone.inversion.properties import DETERMINED, map_energy, map_properties
from overtone.inversion.validity import with_validity
from overtone.io.netcdf import save
from overtone.probe import Probe
from overtone.quantities import LIFT, named_array
from overtone.readings import Reading, probe_of, with_reading
from overtone.report.content import Calibrated, Report
from overtone.report.materials import materials_table
from overtone.report.numbers import percent
from overtone.report.page import write_report
from overtone.report.results import alone, is_pooled
from overtone.report.summary import energy_table, truth_materials_table, truth_properties_table, truth_table
from overtone.units import format_quantity

_POISSON_RATIO = 0.35
_SETPOINT = 0.42

RESULTS = (("population", "population", (0, 1, 2, 3)), ("least squares", "least-squares", (0, 1, 2)))
"""What is shown: a label, the method and the harmonics it uses. The first holds the posterior of each pixel as well."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Demo:
    """What the demonstration made."""

    report: Report
    files: tuple[Path, ...]


def demo_probe() -> Probe:
    """Return the lever of the method's paper: 16.4 N/m, 161.8 kHz, Q 287, driven to 94 nm at resonance."""
    return Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287.0,
        radius=10e-9,
        drive_frequency=161.8e3,
        free_amplitude=94e-9,
    )


def virtual_scan(
    *, shape: tuple[int, int] = (128, 128), seed: int = 1, progress: Callable[[int, int], None] | None = None
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return a noisy scan of a PS-LDPE blend, and the truth behind it.

    The data come from the exact DMT force with its van der Waals tail, on the motion with its higher
    harmonics, and never from the formulas that are inverted later.

    Parameters
    ----------
    shape : tuple of int
        Pixels (y, x).
    seed : int
        Seed of the sample and of the noise.
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Returns
    -------
    tuple of Dataset
        Observables with their reading, and truth (``modulus``, ``adhesion``, ``indentation``, ``material``).
    """
    probe = demo_probe()
    phantom = blend(shape=shape, seed=seed)
    material = sample(
        "dmt", modulus=phantom["modulus"], poisson_ratio=_POISSON_RATIO, adhesion=phantom["adhesion"]
    )
    states = hold_amplitude(probe, material, setpoint=_SETPOINT, progress=progress)
    states = states.assign_coords(phantom.coords)
    names = ["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]
    observables = add_noise(states[names], seed=seed)
    # The feedback follows the surface at the height that holds the amplitude.
    height = phantom["height"] + states["Z"] - float(states["Z"].max())
    dims = ("y", "x")
    observables["height"] = named_array("height", height, dims, phantom.coords)
    observables = with_reading(observables, Reading(probe, corrected=True))
    found = float((states["state"] == FOUND).mean())
    observables = provenance.add_finding(
        observables,
        "Simulated data: exact DMT force with van der Waals tail on a motion with ten harmonics, without loss; "
        f"a steady repulsive state was found at {100 * found:.1f} % of pixels.",
        "Noise: "
        + ", ".join(f"{name} {_noise_text(name)}" for name in ORDINARY_NOISE)
        + ", independent from "
        "pixel to pixel. No drift, no distortion, no error shared by the scan: a real microscope does worse.",
    )
    truth = phantom.drop_vars("height").assign(indentation=states["indentation"])
    return observables, truth


def _noise_text(name: str) -> str:
    return format_quantity(ORDINARY_NOISE[name], "rad" if name.startswith("phi") else "m")


def demo_instrument() -> Instrument:
    """Return a microscope as real ones are: a spot beside the middle of its diode, drift, crosstalk, a film of air."""
    return Instrument(
        mean_offset=1.5e-9,
        mean_slope_z=3e-3,
        mean_slope_x=2e-4,
        mean_slope_y=-1e-4,
        mean_drift=0.2e-12,
        flicker=2e-12,
        diode=SplitDiode(900e-9, offset=30e-9),
        crosstalk={2: 60e-12 * np.exp(-1j), 3: 25e-12 * np.exp(0.5j)},
        gains={0: 1.04, 2: 0.93, 3: 0.9},
        latency={2: 0.25, 3: 0.4},
        phase_offset=0.05,
        near_surface=NearSurface(damping=0.02, softening=2e-5, decay=5e-6),
        frequency_drift=0.01,
        drive_drift=1e-5,
        feedback_error=0.003,
    )


@dataclass(frozen=True)
class Session:
    """What an operator of the demo's microscope brings home, and the truth behind it.

    Parameters
    ----------
    ladder, curve : Dataset
        Far-field readings over frequency, and an approach curve on the reference.
    scan, retrace, lift : Dataset
        Trace, retrace and lift pass of the scan.
    truth : Dataset
        States and properties.
    """

    ladder: xr.Dataset
    curve: xr.Dataset
    scan: xr.Dataset
    retrace: xr.Dataset
    lift: xr.Dataset
    truth: xr.Dataset


def record_session(
    *, shape: tuple[int, int] = (128, 128), seed: int = 1, progress: Callable[[int, int], None] | None = None
) -> Session:
    """Record calibration data and a scan of a PS-LDPE blend with `demo_instrument`.

    Parameters
    ----------
    shape : tuple of int
        Pixels (y, x).
    seed : int
        Seed of sample and noise.
    progress : callable, optional
        Called with (pixels done, pixels in all) of the scan.
    """
    probe, instrument = demo_probe(), demo_instrument()
    ladder = simulate_far_field(probe, instrument, height=500e-9, seed=seed)
    reference = sample(
        "dmt", modulus=POLYSTYRENE.modulus, poisson_ratio=_POISSON_RATIO, adhesion=POLYSTYRENE.adhesion
    )
    curve = simulate_approach(
        probe,
        reference,
        instrument,
        z=np.linspace(300e-9, 12e-9, 200),
        height_noise=50e-12,
        time=2.0,
        seed=seed + 1,
    )
    both, truth = scan_with_truth(
        probe,
        blend(shape=shape, seed=seed),
        instrument,
        setpoint=_SETPOINT,
        poisson_ratio=_POISSON_RATIO,
        lift=200e-9,
        time=60.0,
        seed=seed + 2,
        progress=progress,
    )
    lifted = [str(name) for name in both.data_vars if str(name).startswith(LIFT)]
    trace, retrace = (both.drop_vars(lifted).sel(direction=way, drop=True) for way in ("trace", "retrace"))
    lift = both[lifted].sel(direction="trace", drop=True).rename({name: name[len(LIFT) :] for name in lifted})
    return Session(ladder, curve.sel(direction="approach", drop=True), trace, retrace, lift, truth)


def run_demo(folder: str | Path, *, progress: Progress | None = None) -> Demo:
    """Record a virtual session, calibrate, correct, map, and write results and report into a folder.

    Parameters
    ----------
    folder : str or Path
        Created where it does not exist; files of an earlier run are replaced.
    progress : callable, optional
        Called with (what is done, items done, items in all).

    Returns
    -------
    Demo
        The report, and the files written: ``curve.nc``, ``ladder.nc``, ``calibration.toml``, ``scan.nc``,
        ``results.nc``, ``report.html``.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    notify = progress or (lambda stage, done, count: None)
    notify("approach curve", 0, 1)
    session = record_session(progress=partial(notify, "simulating"))
    notify("calibrating", 0, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)  # its findings stand in the report
        calibration = calibrate(
            session.curve,
            demo_probe(),
            reference=Reference(_POISSON_RATIO, modulus=2e9, modulus_error=0.1, name=POLYSTYRENE.name),
            far_field=session.ladder,
        )
        observables = correct(session.scan, calibration, lift=session.lift)
        corrected_curve = correct(session.curve, calibration)
    notify("calibrating", 1, 1)
    noise = noise_from_pair(session.scan, session.retrace)
    left = calibration_of(observables) or calibration
    probe, truth = probe_of(observables), session.truth
    energies = map_energy(observables, probe, noise=noise)
    results: dict[str, xr.Dataset] = {}
    for label, method, orders in RESULTS:
        result = map_properties(
            observables,
            probe,
            model="dmt",
            poisson_ratio=_POISSON_RATIO,
            method=method,
            harmonics=orders,
            noise=noise,
            progress=partial(notify, label),
        )
        results[label] = with_validity(
            result, observables["A1"], probe, model="dmt", harmonics=orders, poisson_ratio=_POISSON_RATIO
        )
    materials = (POLYSTYRENE.name, POLYOLEFIN.name)
    supported = gates(
        left, setpoint=_SETPOINT, materials={m.name: _sample(m) for m in (POLYSTYRENE, POLYOLEFIN)}
    )
    pooled = results[RESULTS[0][0]]
    beside = truth_materials_table(results, truth, materials)
    report = Report(
        title="overtone demo: a PS-LDPE blend in tapping mode",
        subtitle="Simulated scan, 128 x 128 pixels, 8 x 8 um, with the lever of the method's paper and a microscope "
        "that drifts and distorts; calibrated on PS, corrected, mapped",
        observables=observables,
        energies=energies,
        properties=results,
        truth=truth,
        materials=materials,
        tables=(
            materials_table(pooled),
            *([] if beside is None else [beside]),
            truth_table(results, truth, materials),
            truth_properties_table(results, truth, materials),
            energy_table(energies),
        ),
        findings=(*provenance.findings(observables), *_verdicts(results, truth, materials)),
        before=session.scan,
        calibration=Calibrated(calibration, session.curve, corrected_curve, session.ladder, supported),
    )
    notify("writing", 0, 3)
    names = (
        "curve.nc",
        "ladder.nc",
        "calibration.toml",
        "scan.nc",
        "results.nc",
        "published.nc",
        "report.html",
    )
    files = tuple(folder / name for name in names)
    save(session.curve, files[0])
    save(session.ladder, files[1])
    save_calibration(calibration, files[2])
    lifted = session.lift.rename({name: f"{LIFT}{name}" for name in session.lift.data_vars})
    save(session.scan.merge(lifted).assign_attrs(session.scan.attrs), files[3])
    notify("writing", 1, 3)
    known = truth[[name for name in ("modulus", "adhesion", "indentation", "material") if name in truth]]
    known = known.rename({name: f"{name}_truth" for name in known.data_vars}).drop_attrs(deep=False)
    for result, path in zip(results.values(), files[4:6], strict=True):
        whole = result.merge(energies.drop_attrs(deep=False)).merge(known)
        save(whole.assign_attrs(result.attrs), path)
    notify("writing", 2, 3)
    write_report(report, files[6])
    notify("writing", 3, 3)
    return Demo(report, files)


def _sample(material: Material) -> Sample:
    return sample("dmt", modulus=material.modulus, poisson_ratio=_POISSON_RATIO, adhesion=material.adhesion)


def _verdicts(
    results: dict[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> tuple[str, ...]:
    """Say in words where a method can tell a modulus and where it cannot."""
    sentences = []
    for label, result in results.items():
        pixels = alone(result)["status"] if is_pooled(result) else None
        for i, material in enumerate(materials):
            mine = truth["material"].values == i
            share = float((result["status"].values[mine] == DETERMINED).mean())
            own, told = "", ""
            if pixels is not None:
                own = f"; {percent(float((pixels.values[mine] == DETERMINED).mean()))} by themselves"
                if material in result["material"].values[result["material_reference"].values == 1]:
                    told = " It is the reference, whose modulus was told."
            sentences.append(
                f"By {label} the modulus of {material} is {'' if share >= 0.5 else 'not '}determined "
                f"({percent(share)} of its pixels{own}).{told}"
            )
    return tuple(sentences)

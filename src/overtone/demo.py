"""The demonstration: a virtual scan of a PS-LDPE blend, mapped and held against its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import xarray as xr

from overtone import provenance
from overtone.contact.sample import sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.instrument.noise import ORDINARY_NOISE, add_noise
from overtone.instrument.phantom import POLYOLEFIN, POLYSTYRENE, blend
from overtone.inversion.properties import DETERMINED, HARMONIC_SETS, map_energy, map_properties
from overtone.io.netcdf import save
from overtone.probe import Probe
from overtone.quantities import named_array
from overtone.readings import Reading, with_reading
from overtone.report.content import Report
from overtone.report.page import write_report
from overtone.report.summary import energy_table, truth_properties_table, truth_table
from overtone.units import format_quantity

_POISSON_RATIO = 0.35
_SETPOINT = 0.42

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


def run_demo(folder: str | Path, *, progress: Progress | None = None) -> Demo:
    """Make a virtual scan, map it, and write results and report into a folder.

    Parameters
    ----------
    folder : str or Path
        Created where it does not exist; files of an earlier run are replaced.
    progress : callable, optional
        Called with (what is done, items done, items in all).

    Returns
    -------
    Demo
        The report, and the files written: ``scan.nc``, ``results.nc``, ``report.html``.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    notify = progress or (lambda stage, done, count: None)
    observables, truth = virtual_scan(progress=partial(notify, "simulating"))
    probe = demo_probe()
    energies = map_energy(observables, probe)
    results: dict[str, xr.Dataset] = {}
    for orders in HARMONIC_SETS:
        label = "harmonics " + " ".join(map(str, orders))
        results[label] = map_properties(
            observables,
            probe,
            model="dmt-linear",
            poisson_ratio=_POISSON_RATIO,
            harmonics=orders,
            progress=partial(notify, label),
        )
    materials = (POLYSTYRENE.name, POLYOLEFIN.name)
    report = Report(
        title="overtone demo: a PS-LDPE blend in tapping mode",
        subtitle="Simulated scan, 128 x 128 pixels, 8 x 8 um, with the lever of the method's paper",
        observables=observables,
        energies=energies,
        properties=results,
        truth=truth,
        materials=materials,
        tables=(
            truth_table(results, truth, materials),
            truth_properties_table(results, truth, materials),
            energy_table(energies),
        ),
        findings=(*provenance.findings(observables), *_verdicts(results, truth, materials)),
    )
    notify("writing", 0, 3)
    scan, maps, page = folder / "scan.nc", folder / "results.nc", folder / "report.html"
    save(observables, scan)
    notify("writing", 1, 3)
    stacked = xr.concat(
        [result.drop_attrs(deep=False) for result in results.values()],
        dim=xr.DataArray(list(results), dims="harmonics", name="harmonics"),
    )
    attributes = next(iter(results.values())).attrs
    save(
        stacked.merge(energies.drop_attrs(deep=False))
        .merge(truth.rename({name: f"{name}_truth" for name in truth.data_vars}))
        .assign_attrs(attributes),
        maps,
    )
    notify("writing", 2, 3)
    write_report(report, page)
    notify("writing", 3, 3)
    return Demo(report, (scan, maps, page))


def _verdicts(
    results: dict[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> tuple[str, ...]:
    """Say in words where least squares can tell a modulus and where it cannot."""
    sentences = []
    for label, result in results.items():
        for i, material in enumerate(materials):
            status = result["status"].values[truth["material"].values == i]
            share = float((status == DETERMINED).mean())
            verb = "determine" if share >= 0.5 else "do not determine"
            sentences.append(
                f"{label.capitalize()} {verb} the modulus of {material} ({100 * share:.0f} % of its pixels)."
            )
    return tuple(sentences)

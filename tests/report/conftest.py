import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from overtone import provenance
from overtone.quantities import named_array
from overtone.report.content import Report, Table

STATUS = {"flag_values": [0, 1], "flag_meanings": "determined not_determined_by_these_data"}
PROBE = '[cantilever]\nstiffness = "16.4 N/m"\n'


@pytest.fixture(scope="session")
def synthetic() -> SimpleNamespace:
    """Return what makes results with intervals and solutions."""
    return SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "plots" / "synthetic.py")))


@pytest.fixture(scope="session")
def report() -> Report:
    """A small report whose texts try to be more than text."""
    rng = np.random.default_rng(0)
    dims, shape = ("y", "x"), (4, 6)

    def field(name: str, mean: float) -> xr.DataArray:
        return named_array(name, mean * rng.normal(1.0, 0.01, shape), dims)

    observables = xr.Dataset({name: field(name, mean) for name, mean in (("A1", 4e-8), ("phi1", 0.4))})
    observables = observables.assign_attrs(probe=PROBE, sample="<b>PS</b>")
    observables = provenance.record(observables, "open_scan", path="<img src=x>.ibw", probe=PROBE)
    forces = rng.normal(1e-9, 1e-11, (2, *shape))
    energies = xr.Dataset(
        {
            "F_cons": named_array("F_cons", forces, ("harmonic", *dims), {"harmonic": [0, 1]}),
            "dissipation": field("dissipation", 1e-18),
            "virial": field("virial", -1e-16),
        },
        attrs=observables.attrs,
    )
    energies = provenance.record(energies, "map_energy", probe=PROBE)
    properties = xr.Dataset(
        {
            "modulus_unscreened": field("modulus_unscreened", 2e9),
            "residual": field("residual", 1e-9),
            "status": named_array("status", np.repeat([[0, 1, 1]], 4, 0).repeat(2, 1), dims, **STATUS),
        },
        attrs=observables.attrs | {"model": "dmt-linear"},
    )
    return Report(
        title="A <script>alert(1)</script> title",
        subtitle="[red]subtitle[/red] & more",
        observables=observables,
        energies=energies,
        properties={"harmonics 1, 2, 3": provenance.record(properties, "map_properties", model="dmt-linear")},
        tables=(
            Table("Modulus", ("material", "median [GPa]"), (("PS", "1.93"), ("LD<PE>", "0.094")), "A note."),
            Table("Empty", ("one", "two"), ()),
        ),
        findings=(
            "<script>alert(2)</script> was assumed.",
            "[bold]Not markup[/bold] \x1b[31mnor colour\x1b[0m.",
        ),
    )

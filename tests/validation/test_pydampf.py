"""Approach curves of another program, which steps through time and samples the force as it goes.

Its gap counts from a0: the van der Waals force is -H R/(6 d^2) down to d = a0 and the indentation is a0 - d, with
and without adhesion. Ours therefore is smaller by a0, and so is Z.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.steady import steady_states
from overtone.harmonics import energy, to_force_harmonics
from overtone.probe import Probe

Case = dict[str, Any]
Rows = dict[str, np.ndarray]

CONSERVATIVE_OR_VISCOUS = [
    "A_paper_fig4_DMT_1GPa_20nN",
    "B_PS_like_2GPa_2nN",
    "C_LDPE_like_94MPa_16nN",
    "D_DMT_1GPa_20nN_eta50",
    "E_Hertz_1GPa",
    "G_lowQ_k1_Q3_10MPa_0nN",
    "H_soft_10MPa_5nN",
]
HYSTERETIC = "F_DMT_1GPa_20nN_vdwhyst0.1"


def case_of(folder: Path, name: str) -> Case:
    cases: list[Case] = json.loads((folder / "cases.json").read_text())
    return next(case for case in cases if case["name"] == name)


def rows_of(folder: Path, name: str) -> Rows:
    """Return the columns of a curve in SI units and radians."""
    path = folder / f"out_{name}.csv"
    names = path.read_text().splitlines()[0].lstrip("# ").split(",")
    units = {"nm": 1e-9, "nN": 1e-9, "aJ": 1e-18, "deg": math.pi / 180.0}
    columns = {}
    for label, values in zip(names, np.loadtxt(path, delimiter=",").T, strict=True):
        quantity, _, unit = label.rpartition("_")
        columns[quantity if unit in units else label] = values * units.get(unit, 1.0)
    return columns


def probe_of(case: Case) -> Probe:
    return Probe.simple(
        stiffness=case["k"],
        frequency=case["f0_Hz"],
        quality_factor=case["Q"],
        radius=case["R"],
        drive_frequency=case["f0_Hz"],
        free_amplitude=case["A1far"],
    )


def sample_of(case: Case) -> Sample:
    if case["Fad"] == 0.0:
        return sample("hertz", modulus=case["E_sample"], poisson_ratio=0.3)
    model = "dmt-viscous" if case["eta_Pa_s"] else "dmt"
    return sample(
        model,
        modulus=case["E_sample"],
        poisson_ratio=0.3,
        adhesion=case["Fad"],
        intermolecular_distance=case["a0"],
        viscosity=case["eta_Pa_s"] or None,
    )


def forces_of(rows: Rows) -> np.ndarray:
    """Return CONS_n - i DISS_n (n, row) [N], as the program integrated them."""
    return np.stack([rows["F0"] + 0j, *(rows[f"F{n}c"] - 1j * rows[f"F{n}s"] for n in (1, 2, 3))])


def difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the difference in units of |F_1|, over the rows in which the tip feels the sample (n, row)."""
    felt = abs(theirs[1]) > 1e-13
    assert abs(ours[:, ~felt]).max(initial=0.0) < 1e-15
    return np.asarray(abs(ours - theirs)[:, felt] / abs(theirs[1, felt]))


def nearest(states: xr.Dataset, amplitude: np.ndarray) -> xr.Dataset:
    """Return the state nearest in amplitude at every height."""
    off = abs(states["A1"] - xr.DataArray(amplitude, dims="z"))
    return states.isel(branch=off.fillna(np.inf).argmin("branch"))


@pytest.mark.parametrize("name", CONSERVATIVE_OR_VISCOUS)
def test_every_row_of_a_curve(pydampf: Path, name: str) -> None:
    """All 238 rows agree; the worst are those in which attraction and repulsion leave little of F_1."""
    case, rows = case_of(pydampf, name), rows_of(pydampf, name)
    states = steady_states(probe_of(case), sample_of(case), z=rows["zc"] - case["a0"], n_max=20)
    state = nearest(states, rows["A1"])
    assert (state["state"] == FOUND).all()
    assert state["stable"].all()
    ours = (state["F_cons"] - 1j * state["F_diss"]).transpose("harmonic", "z").values
    theirs = forces_of(rows)
    off = difference(ours, theirs)
    assert off.max() < 8e-4
    assert np.median(off) < 4e-5
    np.testing.assert_allclose(state["A1"], rows["A1"], rtol=2e-5)
    np.testing.assert_allclose(state["phi1"], rows["phi1"], atol=math.radians(0.005))
    np.testing.assert_allclose(state["indentation"], case["a0"] - rows["dmin"], atol=2e-12)


def observables_of(rows: Rows) -> xr.Dataset:
    names = ["A0", "A1", "A2", "A3", "phi1", "phi2", "phi3"]
    units = {"A": "m", "p": "rad"}
    return xr.Dataset({name: ("row", rows[name], {"units": units[name[0]]}) for name in names})


@pytest.mark.parametrize("name", [*CONSERVATIVE_OR_VISCOUS, HYSTERETIC])
def test_eq_6_on_its_observables_is_its_own_force(pydampf: Path, name: str) -> None:
    rows = rows_of(pydampf, name)
    force = to_force_harmonics(observables_of(rows), probe_of(case_of(pydampf, name)))
    read = (force["F_cons"] - 1j * force["F_diss"]).transpose("harmonic", "row").values
    theirs = forces_of(rows)
    off = difference(read, theirs)
    assert off.max() < 2e-3
    assert np.median(off) < 8e-5


def test_viscous_loss_is_read_from_the_observables(pydampf: Path) -> None:
    name = "D_DMT_1GPa_20nN_eta50"
    rows = rows_of(pydampf, name)
    probe = probe_of(case_of(pydampf, name))
    lost = energy(to_force_harmonics(observables_of(rows), probe), probe)["dissipation"]
    contact = rows["dmin"] < 0.0
    np.testing.assert_allclose(lost.values[contact], rows["Ediss"][contact], rtol=2e-3)


def test_hysteretic_adhesion_loses_what_its_areas_say(pydampf: Path) -> None:
    """An attraction that is 10 % stronger on the way out loses 0.2 F_ad (a0 + delta) a cycle."""
    case, rows = case_of(pydampf, HYSTERETIC), rows_of(pydampf, HYSTERETIC)
    probe = probe_of(case)
    lost = energy(to_force_harmonics(observables_of(rows), probe), probe)["dissipation"].values
    contact = rows["dmin"] < case["a0"]
    area = np.where(contact, 2.0 * case["a0"] - rows["dmin"], case["a0"] ** 2 / rows["dmin"])
    # a turn inside of a step of the way costs a part of it, most where the turn is in the steep part
    np.testing.assert_allclose(
        2.0 * case["eps_vdw_hyst"] * case["Fad"] * area[contact], lost[contact], rtol=3e-3
    )
    assert contact.sum() == 30


def test_a_curve_whose_parameters_are_read_from_its_own_numbers(pydampf: Path) -> None:
    """Stiffness from F0/A0, drive force from F1 and phi1, the law from peak force and closest gap; then every row."""
    rows = rows_of(pydampf, "X_dforce_example_Hertz")
    touched = rows["Fmax"] > 0.0
    stiffness = float(np.median(rows["F0"][touched] / rows["A0"][touched]))
    drive = float(np.median(-rows["F1c"][touched] / np.cos(rows["phi1"][touched])))
    free = float(rows["A1"][0])
    slope, start = np.polyfit(rows["dmin"][touched], rows["Fmax"][touched] ** (2.0 / 3.0), 1)
    a0 = -start / slope
    assert stiffness == pytest.approx(0.9, rel=1e-6, abs=0)
    assert stiffness * free / drive == pytest.approx(200.0, rel=1e-5, abs=0)
    assert a0 == pytest.approx(0.169e-9, rel=1e-6, abs=0)
    probe = Probe.simple(
        stiffness=stiffness,
        frequency=1e5,
        quality_factor=stiffness * free / drive,
        drive_frequency=1e5,
        free_amplitude=free,
    )
    contact = sample("power", prefactor=(-slope) ** 1.5, exponent=1.5)
    states = steady_states(probe, contact, z=rows["zc"] - a0, n_max=20)
    state = nearest(states, rows["A1"])
    ours = (state["F_cons"] - 1j * state["F_diss"]).transpose("harmonic", "z").values
    assert difference(ours, forces_of(rows)).max() < 1e-4

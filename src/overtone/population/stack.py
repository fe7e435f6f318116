"""Several scans of one area as one dataset: further set-points of the same materials, under one calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import InversionError, ObservablesError
from overtone.probe import format_probe
from overtone.quantities import harmonic_orders, validate_observables
from overtone.readings import Reading, reading_of, with_reading

SCAN = "scan"
_SAME_PLACE = 1e-3  # of a pixel


def stack_scans(scans: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return scans of one area, stacked along ``scan``, as method ``population`` takes them together.

    Parameters
    ----------
    scans : sequence of Dataset
        Observables (y, x) of the same pixels, with the same harmonics and probe, uncorrected or corrected with one
        calibration. Set-points may differ.

    Returns
    -------
    Dataset
        What all of them hold, over (scan, y, x), with the attributes of the first and the findings of all.

    Raises
    ------
    ObservablesError
        If there is no scan, or one of them is no map or not valid.
    InversionError
        If pixels, coordinates, harmonics, probes or calibrations differ, or two scans are one.

    Notes
    -----
    What the calibration leaves uncertain is taken to be the same in all scans. Scans that were anchored each by itself
    have errors, and a calibration, of their own. A zero of A0 that differs between them, by drift or because virtual
    deflection follows the height, shows as a model that does not fit.
    """
    scans = list(scans)
    if not scans:
        raise ObservablesError("there is nothing to stack", expected="one scan or more", got="none")
    for i, scan in enumerate(scans, start=1):
        _check_one(scan, i)
    dims = tuple(map(str, scans[0]["A1"].dims))
    for i, scan in enumerate(scans[1:], start=2):
        _check_alike(scans[0], scan, i)
    names = [name for name in scans[0].data_vars if all(name in scan for scan in scans)]
    kept = [name for name in names if all(set(scan[name].dims) == set(dims) for scan in scans)]
    first = scans[0][kept]
    parts = [
        # coordinates are the same but for their last digits
        scan[kept].transpose(*dims).assign_coords({d: first[d] for d in dims if d in first.coords})
        for scan in scans
    ]
    stacked = xr.concat(
        parts, dim=SCAN, coords="minimal", compat="override", join="override", combine_attrs="override"
    ).assign_attrs(scans[0].attrs)
    readings = [reading for scan in scans if (reading := reading_of(scan)) is not None]
    if readings:
        stacked = with_reading(stacked, _together(readings))
    sentences = dict.fromkeys(sentence for scan in scans[1:] for sentence in provenance.findings(scan))
    known = provenance.findings(stacked)
    stacked = provenance.add_finding(stacked, *(s for s in sentences if s not in known))
    lost = sorted({str(name) for scan in scans for name in scan.data_vars} - set(map(str, kept)))
    if lost:
        stacked = provenance.add_finding(
            stacked, f"Not all scans have {', '.join(lost)} over their pixels: left out."
        )
    return provenance.record(
        stacked, "stack_scans", sources=[str(scan.attrs.get("source", "not named")) for scan in scans]
    )


def _check_one(scan: xr.Dataset, number: int) -> None:
    if not isinstance(scan, xr.Dataset):
        raise ObservablesError(
            f"scan {number} is no dataset", expected="observables over (y, x)", got=type(scan).__name__
        )
    validate_observables(scan)
    if set(scan["A1"].dims) != {"y", "x"}:
        raise ObservablesError(
            f"scan {number} is no map",
            expected="dimensions (y, x)",
            got=str(tuple(map(str, scan["A1"].dims))),
            hint='scan.sel(direction="trace", drop=True), or one set-point of a stack',
        )


def _check_alike(first: xr.Dataset, scan: xr.Dataset, number: int) -> None:
    """Refuse a scan that is not of the pixels, the lever and the calibration of the first."""
    pixels, others = ({d: dataset["A1"].sizes[d] for d in ("y", "x")} for dataset in (first, scan))
    if pixels != others:
        raise InversionError(
            f"scan {number} has other pixels than the first",
            expected=str(pixels),
            got=str(others),
            hint="scans of one area, with the same number of lines and points",
        )
    for dim in ("y", "x"):
        _check_places(first, scan, dim, number)
    orders, other_orders = harmonic_orders(first), harmonic_orders(scan)
    if orders != other_orders:
        raise InversionError(
            f"scan {number} has other harmonics than the first",
            expected=_listed(orders),
            got=_listed(other_orders),
            hint="drop those that not all scans have",
        )
    readings = [reading_of(dataset) for dataset in (first, scan)]
    probes = ["none" if r is None else format_probe(r.probe) for r in readings]
    texts = [dataset.attrs.get("calibration") for dataset in (first, scan)]
    if texts[0] != texts[1]:
        one_only = None in texts
        raise InversionError(
            f"scan {number} has another calibration than the first",
            expected="one calibration for all, so that what it leaves uncertain is the same in all",
            got="one corrected scan and one that is not" if one_only else "two that differ",
            hint="overtone.correct for each, with the same calibration and reference=None (--reference-area none): "
            "anchored, each scan has a calibration of its own",
        )
    if probes[0] != probes[1]:
        raise InversionError(
            f"scan {number} has another probe than the first",
            expected="the same lever, drive and tip",
            got=_difference(*probes),
            hint="scans of one session at one drive",
        )
    if all(
        np.array_equal(first[name].values, _like(scan[name], first), equal_nan=True)
        for name in ("A1", "phi1")
    ):
        raise InversionError(
            f"scan {number} has the very readings of the first",
            expected="another scan of the area, with noise of its own",
            got="the same A1 and phi1 at every pixel",
            hint="the other file",
        )


def _like(array: xr.DataArray, first: xr.Dataset) -> npt.NDArray[np.float64]:
    return np.asarray(array.transpose(*first["A1"].dims).values)


def _check_places(first: xr.Dataset, scan: xr.Dataset, dim: str, number: int) -> None:
    known = [dim in dataset.coords for dataset in (first, scan)]
    if not any(known):
        return
    if not all(known):
        raise InversionError(
            f"scan {number} and the first do not both say where their pixels are",
            expected=f"the coordinate {dim} in both or in none",
        )
    here, there = (np.asarray(dataset[dim].values, dtype=float) for dataset in (first, scan))
    step = abs(here[-1] - here[0]) / max(here.size - 1, 1) or 1.0
    off = float(np.abs(there - here).max())
    if not off <= _SAME_PLACE * step:
        raise InversionError(
            f"scan {number} lies elsewhere than the first",
            expected=f"{dim} from {here[0]:.6g} to {here[-1]:.6g} m",
            got=f"{there[0]:.6g} to {there[-1]:.6g} m",
            hint="scans of the same area, their drift taken out",
        )


def _together(readings: Sequence[Reading]) -> Reading:
    """Return the reading of a stack: what is doubted of one scan is doubted of all."""
    doubts: dict[int, dict[str, None]] = {}
    for reading in readings:
        for n, text in reading.doubts.items():
            doubts.setdefault(n, {}).update(dict.fromkeys(text.splitlines()))
    return replace(
        readings[0],
        phase_established=all(reading.phase_established for reading in readings),
        corrected=all(reading.corrected for reading in readings),
        doubts={n: "\n".join(lines) for n, lines in doubts.items()},
    )


def _difference(one: str, other: str) -> str:
    """Return the first line by which two texts differ, in the other one."""
    lines = one.splitlines()
    for i, line in enumerate(other.splitlines()):
        if i >= len(lines) or line != lines[i]:
            return line.strip()
    return "a shorter description"


def _listed(orders: Sequence[int]) -> str:
    return ", ".join(map(str, orders))

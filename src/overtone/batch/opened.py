"""The scans of one map: opened, corrected where there is a calibration, stacked where several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overtone.batch.settings import Settings
from overtone.errors import OvertoneError

if TYPE_CHECKING:
    import xarray as xr


def opened(files: Sequence[Path], settings: Settings) -> tuple[Any, dict[str, Any]]:
    """Return the scan of a file, or of several as one stack, and what a report says of its correction.

    Parameters
    ----------
    files : sequence of Path
        Scans of one area.
    settings : Settings
        How they are to be read and corrected.

    Raises
    ------
    OvertoneError
        If a file cannot be read, or the calibration does not fit.
    """
    if settings.calibration is None:
        return _stacked([open_one(file, settings) for file in files]), {}
    from overtone import provenance
    from overtone.errors import CalibrationError
    from overtone.instrument.calibration import load_calibration
    from overtone.instrument.correct import calibration_of, correct
    from overtone.instrument.gates import gates
    from overtone.report.content import Calibrated

    record = load_calibration(settings.calibration)
    raw, clean = [], []
    for file in files:
        before = open_one(file, settings, probe=record.probe, keep_offset=True)
        nap = open_one(file, settings, probe=record.probe, lift=True) if settings.lift else None
        for i, part in enumerate(parts := _parts(before)):
            below = None if nap is None else _parts(nap)[i if len(parts) > 1 else 0]
            raw.append(part)
            clean.append(correct(part, record, reference=settings.reference_area, lift=below))
    after = _stacked(clean)
    left = calibration_of(after)
    supported: tuple[Any, ...] = ()
    if left is not None and left.reference is not None:
        setpoint = float(clean[0]["A1"].median()) / left.probe.drive.free_amplitude
        try:
            supported = gates(left, setpoint=setpoint)
        except CalibrationError as error:
            after = provenance.add_finding(after, f"What the calibration supports cannot be told: {error}")
    return after, {"before": raw[0], "calibration": Calibrated(record, gates=supported)}


def open_one(
    path: Path, settings: Settings, *, probe: Any = None, lift: bool = False, keep_offset: bool = False
) -> Any:
    """Open a scan as the settings say and return its observables, the tip radius set.

    ``probe`` stands in where the settings name none; ``lift`` and ``keep_offset`` are those of `overtone.open_scan`.
    """
    from overtone.io.observables import open_scan

    arguments = reading_arguments(settings) | {"lift": lift, "keep_offset": keep_offset}
    arguments["probe"] = settings.probe or probe
    return with_radius(open_scan(path, **arguments), settings.radius)


def reading_arguments(settings: Settings) -> dict[str, Any]:
    """Return what settings say of reading a file, as `overtone.open_scan` takes it."""
    names = ("probe", "channels", "scales", "far_phase", "phase_sign", "direction", "corrected", "frame")
    return {name: getattr(settings, name) for name in names}


def with_radius(observables: xr.Dataset, radius: float | None) -> xr.Dataset:
    """Return observables whose probe has a tip of this radius [m]; as they are where it is None."""
    from overtone.readings import reading_of, with_reading

    reading = reading_of(observables)
    if radius is None or reading is None:
        return observables
    tip = replace(reading.probe.tip, radius=radius)
    return with_reading(observables, replace(reading, probe=replace(reading.probe, tip=tip)))


def first_of(dataset: Any) -> Any:
    """Return the first scan of a stack, or what is none as it is."""
    from overtone.population.population import SCAN_DIMS

    return dataset.isel({dim: 0 for dim in SCAN_DIMS if dim in dataset.dims}, drop=True)


def both_ways(file: Path, settings: Settings, probe: Any) -> tuple[Any, Any]:
    """Return the direction that is mapped and the other one, as stored.

    Raises
    ------
    OvertoneError
        If the settings do not say which is mapped, or the file has only one.
    """
    other = {"trace": "retrace", "retrace": "trace"}.get(settings.direction or "")
    if other is None:
        raise OvertoneError(
            "it is not said which of trace and retrace is mapped",
            hint="--direction trace, or --noise scatter",
        )
    here, there = (
        open_one(file, replace(settings, direction=way, radius=None), probe=probe, keep_offset=True)
        for way in (settings.direction, other)
    )
    return here, there


def _stacked(scans: Sequence[Any]) -> Any:
    if len(scans) == 1:
        return scans[0]
    from overtone.population.stack import stack_scans

    return stack_scans([part for scan in scans for part in _parts(scan)])


def _parts(scan: Any) -> list[Any]:
    """Return the scans that a file holds, one as it is."""
    from overtone.population.population import SCAN_DIMS

    parts = [scan]
    for dim in (dim for dim in SCAN_DIMS if dim in scan["A1"].dims):
        parts = [part.isel({dim: i}, drop=True) for part in parts for i in range(part.sizes[dim])]
    return parts

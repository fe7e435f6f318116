"""The scans that ``overtone map`` is given: opened, corrected where there is a calibration, stacked where several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from overtone.cli.options import ScanOptions, open_with, parse_rectangle
from overtone.errors import OvertoneError


def opened(
    files: Sequence[Path],
    scan: ScanOptions,
    calibration: Path | None,
    reference_area: str | None,
    lift: bool,
) -> tuple[Any, dict[str, Any]]:
    """Return the scan of a file, or of several as one stack, and what a report says of its correction.

    Parameters
    ----------
    files : sequence of Path
        Scans of one area.
    scan : ScanOptions
        How they are to be read.
    calibration : Path, optional
        What they are corrected with.
    reference_area : str, optional
        Where the reference of the calibration is.
    lift : bool
        Whether the lift pass of the files takes part.
    """
    if calibration is None:
        for option, given in (("--reference-area", reference_area), ("--lift", lift)):
            if given:
                raise OvertoneError(
                    f"{option} corrects a scan",
                    expected="a calibration",
                    hint="--calibration calibration.toml",
                )
        return _stacked([open_with(file, scan) for file in files]), {}
    from overtone import provenance
    from overtone.errors import CalibrationError
    from overtone.instrument.calibration import load_calibration
    from overtone.instrument.correct import calibration_of, correct
    from overtone.instrument.gates import gates
    from overtone.report.content import Calibrated

    record = load_calibration(calibration)
    raw, clean = [], []
    for file in files:
        before = open_with(file, scan, probe=record.probe, keep_offset=True)
        nap = open_with(file, scan, probe=record.probe, lift=True) if lift else None
        for i, part in enumerate(parts := _parts(before)):
            below = None if nap is None else _parts(nap)[i if len(parts) > 1 else 0]
            raw.append(part)
            clean.append(correct(part, record, reference=_area(reference_area), lift=below))
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


def first_of(dataset: Any) -> Any:
    """Return the first scan of a stack, or what is none as it is."""
    from overtone.population.population import SCAN_DIMS

    return dataset.isel({dim: 0 for dim in SCAN_DIMS if dim in dataset.dims}, drop=True)


def both_ways(file: Path, scan: ScanOptions, probe: Any) -> tuple[Any, Any]:
    """Return the direction that is mapped and the other one, as stored."""
    from dataclasses import replace

    other = {"trace": "retrace", "retrace": "trace"}.get(scan.direction or "")
    if other is None:
        raise OvertoneError(
            "it is not said which of trace and retrace is mapped",
            hint="--direction trace, or --noise scatter",
        )
    here, there = (
        open_with(file, replace(scan, direction=way), probe=probe, keep_offset=True)
        for way in (scan.direction, other)
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


def _area(text: str | None) -> Any:
    """Return the reference area of a text: auto, None, or a rectangle [m]."""
    if text is None or text == "auto":
        return "auto"
    if text == "none":
        return None
    return parse_rectangle(text, "--reference-area", '"auto", "none" or ')

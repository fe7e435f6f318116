"""What a result of overtone holds: properties, what they can be trusted for, findings, and how it was made."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.inspection.records import IF, NO, YES, Inspection, PropertyRow, Verdict
from overtone.inspection.tables import format_title
from overtone.inspection.verdicts import ABSOLUTE, CONTRAST, ENERGIES, REGIME, RELATIVE, shares_text
from overtone.quantities import quantity
from overtone.report.shares import flag_shares
from overtone.units import display_unit, format_quantity

_SHOWN = ("property", "energy")
_VARIANTS = ("_unscreened", "_lower", "_upper", "_unpooled", "_solutions")
# What of a history tells a reader how a result was made.
_TOLD = (
    "path",
    "probe",
    "direction",
    "frame",
    "far_phase",
    "calibration",
    "reference",
    "model",
    "method",
    "harmonics",
    "motion",
    "poisson_ratio",
    "phases",
    "setpoint",
    "seed",
)
_LONGEST = 60
# As overtone.instrument.gates says them, which brings the contact models with it.
_VERDICTS = ("contrast", "relative", "absolute")


def is_result(dataset: xr.Dataset) -> bool:
    """Tell whether a dataset holds what overtone concluded, and not only what was measured or simulated.

    A simulated curve knows its indentation and its energies as well.
    """
    kinds = {
        record.kind
        for name in dataset.data_vars
        if name != "indentation" and (record := quantity(str(name))) is not None
    }
    return (
        "property" in kinds or "regime" in dataset or ("A1" not in dataset and bool(kinds - {"observable"}))
    )


def inspect_result(path: Path, dataset: xr.Dataset) -> Inspection:
    """Say what a result holds, and what it can be trusted for."""
    rows = tuple(_property_rows(dataset))
    shown = {row.name for row in rows}
    others = [
        str(name)
        for name in dataset.data_vars
        if name not in shown and not str(name).endswith(_VARIANTS) and name not in ("regime", "status")
    ]
    remarks = [*_materials(dataset), *provenance.findings(dataset)]
    note = str(dataset.attrs.get("method_note", ""))
    remarks += [f"Method {dataset.attrs.get('method')}: {note}."] if note else []
    remarks += [f"It holds as well: {', '.join(others)}."] if others else []
    steps = provenance.history(dataset)
    last = str(steps[-1].get("operation", "")) if steps else ""
    return Inspection(
        path=path,
        kind="result",
        format=format_title("zarr" if path.is_dir() else "netcdf"),
        headline=f"a result of overtone{f' ({last})' if last else ''}: {_size(dataset)}",
        verdicts=tuple(_verdicts(dataset)),
        remarks=tuple(remarks),
        properties=rows,
        made_by=tuple(_step(entry) for entry in steps),
    )


# --- what is in it --------------------------------------------------------------------------------


def _property_rows(dataset: xr.Dataset) -> Iterator[PropertyRow]:
    for name, array in dataset.data_vars.items():
        record = quantity(str(name))
        if record is None or record.kind not in _SHOWN or str(name).endswith(_VARIANTS):
            continue
        if array.dtype.kind != "f" or not array.size or name == "regime":
            continue
        values = np.asarray(array.values)
        good = values[np.isfinite(values)]
        low, median, high = np.percentile(good, (5, 50, 95)) if good.size else (math.nan,) * 3
        yield PropertyRow(
            str(name),
            record.meaning,
            record.unit,
            float(median),
            float(low),
            float(high),
            _median(dataset, f"{name}_lower", np.isfinite(values)),
            _median(dataset, f"{name}_upper", np.isfinite(values)),
            good.size / values.size,
        )


def _median(dataset: xr.Dataset, name: str, where: npt.NDArray[np.bool_]) -> float:
    if name not in dataset or dataset[name].shape != where.shape:
        return math.nan
    values = dataset[name].values[where]
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else math.nan


def _size(dataset: xr.Dataset) -> str:
    sizes = dict(dataset.sizes)
    if "y" in sizes and "x" in sizes:
        spans = [float(np.ptp(dataset[dim].values)) for dim in ("x", "y") if dim in dataset.coords]
        text = f"{sizes['x']} x {sizes['y']} pixels"
        if len(spans) == 2 and max(spans) > 0.0:
            display = display_unit(max(spans), "m")
            text += ", " + " x ".join(f"{span * display.factor:.3g}" for span in spans) + f" {display.label}"
        return text
    return (
        ", ".join(f"{size} {'points' if dim == 'point' else dim}" for dim, size in sizes.items())
        or "one value"
    )


def _materials(dataset: xr.Dataset) -> Iterator[str]:
    """Yield a sentence for each material of a scan whose pixels were taken together."""
    if "material" not in dataset.coords:
        return
    for k, name in enumerate(map(str, dataset["material"].values)):
        words = []
        for key in ("material_modulus", "material_adhesion"):
            if key in dataset:
                middle, low, high = (
                    float(dataset[f"{key}{end}"].values[k]) if f"{key}{end}" in dataset else math.nan
                    for end in ("", "_lower", "_upper")
                )
                unit = str(dataset[key].attrs.get("units", "1"))
                ends = f"{format_quantity(low, unit)} .. {format_quantity(high, unit)}"
                words.append(
                    f"{key.removeprefix('material_')} {format_quantity(middle, unit)} (90 %: {ends})"
                )
        pixels = (
            f", {int(dataset['material_pixels'].values[k])} pixels" if "material_pixels" in dataset else ""
        )
        yield f"Material {name.replace('_', ' ')}: {', '.join(words) or 'no numbers'}{pixels}."


def _step(entry: dict[str, Any]) -> str:
    """Return one entry of a history in a line; what is long, such as a probe, is left to the report."""
    given = entry.get("arguments")
    arguments = given if isinstance(given, dict) else {}
    words = []
    for name in _TOLD:
        value = arguments.get(name)
        if value is None or isinstance(value, dict) or value in ("", []):
            continue
        text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        if name == "path":
            text = Path(text).name
        elif name == "far_phase" and isinstance(value, float):
            text = format_quantity(value, "rad", 4)
        if "\n" not in text and len(text) <= _LONGEST:
            words.append(f"{name.replace('_', ' ')} {text}")
    version = f" (overtone {entry['overtone']})" if entry.get("overtone") else ""
    return f"{entry.get('operation', 'something')}{version}" + (f": {'; '.join(words)}" if words else "")


# --- what it can be trusted for -------------------------------------------------------------------


def _verdicts(dataset: xr.Dataset) -> Iterator[Verdict]:
    """Yield what a map can be trusted for; a plan or a simulation is no map of anything."""
    if ("regime" not in dataset and "status" not in dataset) or "setpoint" in dataset.dims:
        return
    if "dissipation" in dataset:
        yield Verdict(ENERGIES, YES, (), "They are mapped.")
    else:
        yield Verdict(ENERGIES, NO, (), "They are not in this file.")
    if "regime" in dataset:
        shares = flag_shares(dataset["regime"])
        answer = NO if shares.get("undetermined") == 1.0 else YES
        yield Verdict(REGIME, answer, (), shares_text(dataset["regime"]))
    else:
        yield Verdict(REGIME, NO, (), "It is not in this file.")
    yield from _of_modulus(dataset)


def _of_modulus(dataset: xr.Dataset) -> Iterator[Verdict]:
    questions = (CONTRAST, RELATIVE, ABSOLUTE)
    cannot = str(dataset.attrs.get("cannot_conclude", ""))
    if "modulus" not in dataset or cannot:
        reason = cannot or "No modulus is in this file."
        yield from (Verdict(question, NO, (), reason) for question in questions)
        return
    determined = shares_text(dataset["status"]) if "status" in dataset else ""
    stated = str(dataset.attrs.get("verdict", ""))
    reason = str(dataset.attrs.get("verdict_reason", ""))
    yield Verdict(CONTRAST, YES, (), determined)
    if stated in _VERDICTS:
        yield Verdict(RELATIVE, NO if stated == _VERDICTS[0] else YES, (), reason)
        yield Verdict(ABSOLUTE, YES if stated == _VERDICTS[2] else NO, (), reason)
        return
    if "calibration" in dataset.attrs:
        yield from (
            Verdict(question, IF, ("what overtone.gates says of its calibration",), "")
            for question in questions[1:]
        )
        return
    if dataset.attrs.get("corrected") == "True":
        said = (
            "It was said that the scan had been corrected; no error of that correction is in the intervals."
        )
        yield from (
            Verdict(question, IF, ("a correction that is right",), said) for question in questions[1:]
        )
        return
    said = "The scan has no calibration: what all pixels share is in no interval."
    yield from (Verdict(question, NO, (), said) for question in questions[1:])

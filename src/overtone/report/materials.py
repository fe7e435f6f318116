"""The materials of a scan in numbers: how many pixels, what property, how well known, against the reference."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from overtone.population.refit import LIKELY
from overtone.quantities import quantity
from overtone.report.content import Table
from overtone.report.numbers import spread_text
from overtone.report.results import PROPERTIES
from overtone.report.shares import format_share
from overtone.units import display_unit, format_quantity

_COLUMNS = (
    "material",
    "pixels (domains)",
    "property",
    "median",
    "90 % interval",
    "within",
    "noise",
    "scan",
)
_CHECK = 0.01  # chance of a misfit as large, below which it is said
UNRESOLVED = "merged, not resolved"


def materials_table(result: xr.Dataset) -> Table:
    """Return the medians of the materials with what is known of them, a row a material and property.

    Parameters
    ----------
    result : Dataset
        Result of `overtone.map_properties` by ``population``.

    Notes
    -----
    The interval is that of the median of the material. What the whole scan shares does not average out over pixels,
    so it stands beside what does.
    """
    rows: list[tuple[str, ...]] = []
    names = materials_properties(result)
    for k, material in enumerate(map(str, result["material"].values)):
        found = [
            cells for name in names for cells in (_numbers(result, k, name), _ratio(result, k, name)) if cells
        ]
        first = (_name(result, k, material), _counts(result, k))
        for cells in found or [("-",) * (len(_COLUMNS) - 2)]:
            rows.append((*first, *cells))
            first = ("", "")
    return Table("Materials", _COLUMNS, tuple(rows), note=_note(result))


def materials_properties(result: xr.Dataset) -> tuple[str, ...]:
    """Return the properties that a result has of its materials, the leading one first."""
    found = tuple(name for name in PROPERTIES if f"material_{name}" in result)
    leading = [name for name in ("modulus", "stiffness") if name in found][:1]
    return (*leading, *(name for name in found if name not in leading))


def verdict_text(result: xr.Dataset) -> str:
    """Return what the result supports with the reason, as sentences; nothing where it does not say."""
    verdict = str(result.attrs.get("verdict", ""))
    if not verdict:
        return ""
    meaning = {
        "absolute": "moduli in pascal",
        "relative": "ratios to the reference, no moduli in pascal",
        "contrast": "what is stiffer than what, no moduli and no ratios",
    }.get(verdict, "")
    reason = str(result.attrs.get("verdict_reason", "")).strip()
    said = f"Verdict: {verdict}" + (f" ({meaning})" if meaning else "") + "."
    return f"{said} {sentence(reason)}" if reason else said


def sentence(text: str) -> str:
    """Return a text as a sentence: a capital letter first, unless it is a symbol, and a full stop last."""
    text = text.strip()
    if not text:
        return ""
    first = text[0].upper() + text[1:] if len(text) > 1 and (text[1].islower() or text[1] == " ") else text
    return first if first.endswith((".", "!", "?")) else f"{first}."


def _name(result: xr.Dataset, k: int, material: str) -> str:
    remarks = []
    if _flag(result, "material_reference", k) == 1:
        remarks.append("reference")
    if _flag(result, "material_resolved", k) == 0:
        remarks.append(UNRESOLVED)
    text = material.replace("_", " ")
    return f"{text} ({'; '.join(remarks)})" if remarks else text


def _flag(result: xr.Dataset, name: str, k: int) -> int | None:
    return int(result[name].values[k]) if name in result else None


def _counts(result: xr.Dataset, k: int) -> str:
    pixels, domains = (_flag(result, f"material_{what}", k) for what in ("pixels", "domains"))
    return ("-" if pixels is None else str(pixels)) + ("" if domains is None else f" ({domains})")


def _number(result: xr.Dataset, name: str, k: int) -> float:
    return float(result[name].values[k]) if name in result else math.nan


def _numbers(result: xr.Dataset, k: int, name: str) -> tuple[str, ...]:
    stem = f"material_{name}"
    record = quantity(name)
    unit = str(result[stem].attrs.get("units", record.unit if record else "1"))
    parts = (_number(result, f"{stem}_{part}", k) for part in ("spread", "statistical", "systematic"))
    return (
        name.replace("_", " "),
        format_quantity(_number(result, stem, k), unit),
        interval(_number(result, f"{stem}_lower", k), _number(result, f"{stem}_upper", k), unit),
        *(spread_text(part) for part in parts),
    )


def interval(lower: float, upper: float, unit: str) -> str:
    """Write both ends of an interval with one unit, a dash where one is not known."""
    if not (math.isfinite(lower) and math.isfinite(upper)):
        return "-"
    display = display_unit(max(abs(lower), abs(upper)), unit)
    return f"{lower * display.factor:.3g} .. {upper * display.factor:.3g} {display.label}".strip()


def _ratio(result: xr.Dataset, k: int, name: str) -> tuple[str, ...]:
    """Return the row of the ratio to the reference, nothing for the reference itself and without one."""
    middle = _number(result, f"material_{name}_ratio", k)
    if not math.isfinite(middle) or _flag(result, "material_reference", k) == 1:
        return ()
    lower, upper = (_number(result, f"material_{name}_ratio_{end}", k) for end in ("lower", "upper"))
    return (f"{name.replace('_', ' ')} ratio", f"{middle:.3g}", interval(lower, upper, "1"), "-", "-", "-")


def _note(result: xr.Dataset) -> str:
    phase = np.asarray(result["phase"].values)
    said = []
    if not result.sizes["material"]:
        said.append("No phases: nothing is pooled, every pixel stands for itself.")
    elif phase.size:
        said.append(f"{format_share(float((phase < 0).mean()))} of pixels belong to no phase.")
    said.append(sentence(str(result.attrs.get("phase_note", ""))))
    if result.sizes["material"]:
        said.append(
            "Median of the material with its 90 % interval; a ratio is to the reference. Standard deviations of the "
            "logarithm: within, how pixels of the material differ; of the median, from noise and scatter (noise), and "
            "from what the whole scan shares (scan)."
        )
    for k, material in enumerate(map(str, result["material"].values)):
        chance = _number(result, "material_misfit_probability", k)
        if chance < _CHECK:
            said.append(
                f"The model does not fit {material.replace('_', ' ')}: a misfit as large has a chance of "
                f"{100.0 * chance:.2g} %."
            )
    said += law_sentences(result)
    if result.sizes["material"] and "calibration" not in result.attrs:
        said.append(
            "The scan was not corrected with a calibration: what its pixels share is in no interval, and the verdict "
            "holds but for that."
        )
    said.append(verdict_text(result))
    return " ".join(part for part in said if part)


def law_sentences(result: xr.Dataset) -> list[str]:
    """Return what another law of contact would change, where that counts beside the interval or fits better."""
    if "law_change" not in result or not result.sizes["material"]:
        return []
    said = []
    gains, titles = result["law_gain"].values, [str(title) for title in result["law_title"].values]
    for j, title in enumerate(titles):
        best = float(np.max(gains[:, j], where=np.isfinite(gains[:, j]), initial=-math.inf))
        if best > LIKELY:
            said.append(
                f"The data prefer {title} to the model, with odds of 10^{best / math.log(10.0):.0f} to 1."
            )
    for k, material in enumerate(map(str, result["material"].values)):
        law = _number(result, "material_modulus_law", k)
        ends = [_number(result, f"material_modulus_{end}", k) for end in ("lower", "upper")]
        if not math.isfinite(law) or abs(law) <= 0.5 * math.log(ends[1] / ends[0]):
            continue
        change = np.where(gains[k] > -LIKELY, np.abs(result["law_change"].values[k]), -1.0)
        said.append(
            f"Under {titles[int(change.argmax())]}, which fits as well, {material.replace('_', ' ')} would have "
            f"{math.exp(law):.2g} times its modulus: an error of the model that is in no interval."
        )
    return said

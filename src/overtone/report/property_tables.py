"""What was found of each property, by the method that found it."""

from __future__ import annotations

import numpy as np
import xarray as xr

from overtone.quantities import quantity
from overtone.report.content import Table
from overtone.report.numbers import (
    flat,
    interval_text,
    median_of,
    percent,
    range_of,
    spread_text,
    typical,
    unit_of,
)
from overtone.report.results import (
    EXACT,
    POSTERIOR,
    PROPERTIES,
    alone,
    estimate_of,
    interval_of,
    is_pooled,
    method_of,
    properties_in,
    undetermined,
)
from overtone.report.shares import flag_shares, format_share

FEW = 0.1  # share of determined pixels below which they are the outliers of the noise


def property_table(label: str, result: xr.Dataset) -> Table:
    """Return the properties of a scan where they are determined, and what is known or unknown of them.

    Parameters
    ----------
    label : str
        What the result was inverted from, such as "harmonics 1, 2, 3".
    result : Dataset
        Result of `overtone.map_properties`.

    Notes
    -----
    Of ``posterior`` results the interval of a typical pixel stands beside the scatter of the pixels, and both parts
    of its standard deviation. No error of a mean over pixels is given: what the whole scan shares does not average out.
    """
    method = method_of(result)
    if method == POSTERIOR:
        return _posterior_table(label, result)
    if method == EXACT:
        return _exact_table(label, result)
    return _estimates_table(label, result)


def _estimates_table(label: str, result: xr.Dataset) -> Table:
    quoted = _is_quoted(result)
    rows = []
    for name in ("modulus", "adhesion", "indentation"):
        if name not in result:
            continue
        record = quantity(name)
        unit = record.unit if record else "1"
        kept = result[name].values.ravel() if quoted else np.empty(0)
        every = result[f"{name}_unscreened" if f"{name}_unscreened" in result else name].values.ravel()
        rows.append((name, median_of(kept, unit), range_of(kept, unit, 5, 95), range_of(every, unit, 5, 95)))
    return Table(
        f"Properties ({label})",
        (
            "property",
            "median, determined",
            "5 .. 95 %, determined",
            "5 .. 95 %, every pixel (not to be quoted)",
        ),
        tuple(rows),
        note=_joined(_count(result), _held(result), _reason(result)),
    )


def _posterior_table(label: str, result: xr.Dataset) -> Table:
    sure, quoted = ~undetermined(result).values.ravel(), _is_quoted(result)
    names = properties_in(result)
    rows = []
    for name in names:
        estimate, interval = estimate_of(result, name), interval_of(result, name)
        assert estimate is not None
        unit = unit_of(estimate)
        kept = flat(estimate, result)[sure] if quoted else np.empty(0)
        wide = "-"
        if interval is not None and quoted:
            lower, upper = (flat(end, result)[sure] for end in interval)
            wide = interval_text(lower, upper, unit)
        parts = (_deviation(result, part, sure & quoted) for part in ("statistical", "systematic"))
        rows.append(
            (
                PROPERTIES[name],
                median_of(kept, unit),
                range_of(kept, unit, 5, 95),
                wide,
                *(parts if name == names[0] else ("-", "-")),
            )
        )
    return Table(
        f"Properties ({label})",
        (
            "property",
            "median, determined",
            "5 .. 95 %, determined",
            "90 % interval of one pixel, end to end",
            "sd of ln E, noise",
            "sd of ln E, whole scan",
        ),
        tuple(rows),
        note=_joined(
            _count(result),
            _allowed(result, names),
            _held(result),
            "5 .. 95 % is how pixels differ; how well one is known is its interval. The part of the whole scan is the "
            "same for all pixels and does not average out, so no error of a mean is given.",
            _by_itself(result, names),
            _models(result),
            _reason(result),
        ),
    )


def _exact_table(label: str, result: xr.Dataset) -> Table:
    sure, quoted = ~undetermined(result).values.ravel(), _is_quoted(result)
    names = properties_in(result)
    rows = []
    for name in names:
        estimate = estimate_of(result, name)
        assert estimate is not None
        every, unit = flat(estimate, result), unit_of(estimate)
        kept = every[sure] if quoted else np.empty(0)
        deviation = "-"
        if name == names[0] and "uncertainty" in result and quoted:
            deviation = spread_text(typical(flat(result["uncertainty"], result)[sure]))
        rows.append(
            (
                PROPERTIES[name],
                median_of(kept, unit),
                range_of(kept, unit, 5, 95),
                range_of(every, unit, 5, 95),
                deviation,
            )
        )
    return Table(
        f"Properties ({label})",
        (
            "property",
            "median, determined",
            "5 .. 95 %, determined",
            "5 .. 95 %, every pixel (not to be quoted)",
            "sd of ln E, one pixel",
        ),
        tuple(rows),
        note=_joined(_count(result), _solutions(result), _reason(result)),
    )


def _is_quoted(result: xr.Dataset) -> bool:
    return float((~undetermined(result)).mean()) >= FEW


def _count(result: xr.Dataset) -> str:
    sure = ~undetermined(result)
    share = float(sure.mean())
    if 0.0 < share < FEW:
        return (
            f"{int(sure.sum())} pixels pass as determined, so few that their noise selected them: not quoted."
        )
    return f"{percent(share)} of pixels are determined."


def _held(result: xr.Dataset) -> str:
    shared = result.get("uncertainty_systematic")
    if "calibration" in result.attrs or (shared is not None and bool((shared > 0.0).any())):
        return "Intervals hold noise and what the calibration leaves uncertain for the whole scan."
    return "Intervals hold noise only."


def _reason(result: xr.Dataset) -> str:
    return str(result.attrs.get("cannot_conclude", ""))


def _deviation(result: xr.Dataset, part: str, chosen: np.ndarray) -> str:
    name = f"uncertainty_{part}"
    return spread_text(typical(flat(result[name], result)[chosen])) if name in result else "-"


def _allowed(result: xr.Dataset, names: tuple[str, ...]) -> str:
    """Say what the data of a typical pixel leave open, where the pixels are not quoted."""
    interval = interval_of(result, names[0]) if names and not _is_quoted(result) else None
    if interval is None:
        return ""
    lower, upper = (median_of(flat(end, result), unit_of(end)) for end in interval)
    return f"At 90 %, the data of a typical pixel allow a {PROPERTIES[names[0]]} from {lower} to {upper}."


def _by_itself(result: xr.Dataset, names: tuple[str, ...]) -> str:
    """Say how much of a pooled interval comes from the phase of a pixel."""
    if not is_pooled(result) or not names or f"{names[0]}_unpooled_lower" not in result:
        return ""
    own, unit = alone(result), unit_of(result[f"{names[0]}_unpooled"])
    inside = flat(result["phase"], result) >= 0
    if not inside.any():
        return ""
    said = []
    for dataset in (own, result):
        interval = interval_of(dataset, names[0])
        if interval is None:
            return ""
        lower, upper = (flat(end, result)[inside] for end in interval)
        said.append(interval_text(lower, upper, unit))
    return (
        f"Of pixels of a phase, a typical {PROPERTIES[names[0]]} by itself has an interval of {said[0]}, "
        f"pooled with its phase of {said[1]}; by itself {percent(float((~undetermined(own)).mean()))} of all pixels "
        "would be determined."
    )


def _models(result: xr.Dataset) -> str:
    if "model" not in result:
        return ""
    shares = {name: share for name, share in flag_shares(result["model"]).items() if share > 0.0}
    return (
        "Model chosen: " + ", ".join(f"{name} {format_share(share)}" for name, share in shares.items()) + "."
    )


def _solutions(result: xr.Dataset) -> str:
    if "solutions" not in result:
        return ""
    count = np.asarray(result["solutions"].values, dtype=float)
    total = max(count.size, 1)
    words = {"one solution": count == 1, "several": count > 1, "none": count == 0}
    shares = ", ".join(
        f"{word} {format_share(int(np.count_nonzero(mask)) / total)}" for word, mask in words.items()
    )
    return f"Physical solutions of the force harmonics, share of pixels: {shares}."


def _joined(*sentences: str) -> str:
    return " ".join(sentence for sentence in sentences if sentence)

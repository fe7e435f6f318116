"""What one simulated world says of method ``population``: rows of numbers, one a material and inversion.

Each row is a flat mapping with the columns `COLUMNS`; what does not apply is left out. Rows of a world are

    every true material      with ``material`` its name, once without and once with a reference
    the interphase           ``material`` = interphase: pixels only
    a scan without phases    ``material`` = all: how many phases were found
    three set-points         a row a phase, ``material`` the one that most of it is: two fitted, the third predicted
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

import overtone as ot
from overtone.instrument.material import Reference
from overtone.inversion.result import DETERMINED, POOR_FIT
from worlds_limit import PROPERTIES, STATED, limits
from worlds_setpoints import READINGS, SETPOINTS, predictions
from worlds_simulated import POISSON_RATIO, World, world

Row = dict[str, Any]
Mask = npt.NDArray[np.bool_]

MODEL = "dmt-viscous"
SHAPE, SMALL = (64, 64), (48, 48)
"""Pixels of a scan of three materials, and of every other one."""
NOISES = (5, 20, 50)
"""Standard deviations of A0 [pm]."""
CALIBRATIONS = ("tight", "loose")
NULLS = ("homogeneous", "gradient")
WRONG = ("jkr", "sls", "blunted-cone")
SEVERAL = "setpoints"
"""Worlds of three materials at three set-points."""
KINDS = ("three", *NULLS, *WRONG, SEVERAL)
REFERENCE, REFERENCE_ERROR = "PS", 0.10
PIXELS, INTERPHASE_PIXELS, COMPARED_PIXELS = 25, 10, 200
FITTED = (0, 1, 2)
"""Harmonics of least squares."""
CHECKED = ("CONS_0", "CONS_1", "CONS_2", "CONS_3", "DISS_1", "DISS_2")

COLUMNS = (
    *("version", "kind", "seed", "noise", "calibration", "reference", "material", "error"),
    *("seconds", "cpu", "phases", "resolved_phases", "verdict", "verdict_misfit"),
    *("own_pixels", "found", "purity", "recall", "merged", "determined", "poor_fit", "misfit_probability"),
    *("Delta", "law", "law_gain", "ratio_true", "ratio_lower", "ratio_upper"),
    *(
        f"{name}_{what}"
        for name in PROPERTIES
        for what in ("true", "lower", "median", "upper", "spread_true", "spread", "limit")
    ),
    *(
        f"pixel_{name}_{what}"
        for name in PROPERTIES
        for what in ("count", "held", "held_alone", "width", "width_alone", "pooled", "pooled_held")
    ),
    *("compared", "answers", "error_fit", "error_pixel", "error_alone", "error_material"),
    *(f"check_{name}" for name in CHECKED),
    *(f"predicted_{name}" for name in READINGS),
)


def conditions(kind: str, seed: int) -> tuple[int, str]:
    """Return noise of A0 [pm] and calibration of a world: every combination in turn, or the best for a wrong model."""
    if kind in WRONG:
        return NOISES[0], CALIBRATIONS[0]
    return NOISES[seed % len(NOISES)], CALIBRATIONS[seed // len(NOISES) % len(CALIBRATIONS)]


def scores(kind: str, seed: int) -> list[Row]:
    """Return the rows of a world."""
    noise, calibration = conditions(kind, seed)
    if kind == SEVERAL:
        return of_setpoints(seed, noise, calibration)
    shape = SHAPE if kind == "three" else SMALL
    made = world(seed, kind=kind, noise_A0=1e-12 * noise, calibration=calibration, shape=shape)
    head: Row = {"kind": kind, "seed": seed, "noise": noise, "calibration": calibration}
    rows: list[Row] = []
    known = limits(made, REFERENCE, REFERENCE_ERROR) if kind == "three" else {}
    for with_reference in (False,) if kind in NULLS else (False, True):
        mine = head | {"reference": int(with_reference)}
        try:
            result, seconds, cpu = inverted(made, with_reference=with_reference)
        except Exception as error:  # one scan must not end a run; the page counts these
            rows.append(mine | {"material": "all", "error": told(error)})
            continue
        mine |= {"seconds": seconds, "cpu": cpu} | of_scan(result)
        if kind == "gradient":
            rows.append(mine | {"material": "all"})
            continue
        for index, material in enumerate(made.materials):
            row = mine | {"material": material.name} | of_material(made, result, index)
            if (material.name, with_reference) in known:
                row |= {f"{n}_limit": sd for n, sd in known[material.name, with_reference].items()}
            if kind == "three" and not with_reference:
                row |= against_least_squares(made, result, index)
            rows.append(row)
        if kind == "three":
            rows.append(mine | {"material": "interphase"} | of_pixels(made, result, -1, INTERPHASE_PIXELS))
    return rows


def told(error: Exception) -> str:
    """Return an error and where it came from in a line."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}: {error}"
    return " ".join(text.split())[:200]


def inverted(made: World, *, with_reference: bool) -> tuple[xr.Dataset, float, float]:
    """Return the answer of the method, how long it took, and how long on all cores together [s]."""
    known = known_of(made, with_reference=with_reference)
    start, cpu = time.perf_counter(), time.process_time()
    result = ot.map_properties(
        made.scan,
        made.probe,
        model=MODEL,
        poisson_ratio=POISSON_RATIO,
        method="population",
        noise=made.noise,
        priors=STATED,
        **known,
    )
    return result, time.perf_counter() - start, time.process_time() - cpu


def stated_reference(made: World) -> Reference:
    """Return what is stated of the reference: the true median, off by as much as its error says."""
    index = [m.name for m in made.materials].index(REFERENCE)
    off = REFERENCE_ERROR * np.random.default_rng([made.seed, 1]).standard_normal()
    value = made.materials[index].modulus * math.exp(off)
    return Reference(POISSON_RATIO, modulus=value, modulus_error=REFERENCE_ERROR, name=REFERENCE)


def marked_pixels(made: World) -> xr.DataArray:
    """Return a mask (y, x) of half of the pixels of the reference: those on one side of a column."""
    index = [m.name for m in made.materials].index(REFERENCE)
    own = made.truth["material"].values == index
    columns = np.nonzero(own)[1]
    left = np.arange(own.shape[1]) < np.median(columns)
    return made.truth["material"].copy(data=(own & left).astype(np.int8)).drop_attrs()


# --- scores -----------------------------------------------------------------------------------------------------


def of_scan(result: xr.Dataset) -> Row:
    """Return what is said of the scan as a whole."""
    reason = str(result.attrs.get("verdict_reason", ""))
    return {
        "phases": result.sizes.get("material", 0),
        "resolved_phases": int((result["material_resolved"] == 1).sum())
        if "material_resolved" in result
        else 0,
        "verdict": result.attrs.get("verdict", ""),
        "verdict_misfit": int("does not fit" in reason),
    }


def found_phase(made: World, result: xr.Dataset, index: int) -> tuple[int, float, float]:
    """Return the phase that holds most of a material, what share of it is that material, and what share it holds."""
    own, label = made.truth["material"].values == index, result["phase"].values
    counts = np.bincount(label[own & (label >= 0)], minlength=1)
    if not counts.sum():
        return -1, math.nan, 0.0
    k = int(np.argmax(counts))
    return k, float(counts[k] / (label == k).sum()), float(counts[k] / own.sum())


def of_material(made: World, result: xr.Dataset, index: int) -> Row:
    """Return what is found of a material."""
    truth = made.materials[index]
    k, purity, recall = found_phase(made, result, index)
    own = made.truth["material"].values == index
    row: Row = {"own_pixels": int(own.sum()), "purity": purity, "recall": recall, "found": int(purity > 0.5)}
    row |= {f"{n}_true": getattr(truth, n) for n in PROPERTIES}
    row |= {f"{n}_spread_true": truth.spread[n] for n in PROPERTIES}
    row |= of_pixels(made, result, index, PIXELS)
    row["Delta"] = float(np.median(depth_of(made)[own]))
    if not row["found"]:
        return row
    phase = result.isel(material=k)
    pixels = result["phase"].values == k
    status = result["status"].values[pixels]
    row |= {
        "merged": int(phase["material_resolved"] == 0),
        "determined": float((status == DETERMINED).mean()),
        "poor_fit": float((status == POOR_FIT).mean()),
        "misfit_probability": float(phase["material_misfit_probability"]),
    }
    for name in PROPERTIES:
        row |= {
            f"{name}_{end}": float(phase[f"material_{name}_{end}"]) for end in ("lower", "upper", "spread")
        }
        row[f"{name}_median"] = float(phase[f"material_{name}"])
    if "material_modulus_ratio" in phase and np.isfinite(phase["material_modulus_ratio"]):
        reference = next(m for m in made.materials if m.name == REFERENCE)
        row["ratio_true"] = truth.modulus / reference.modulus
        row |= {f"ratio_{end}": float(phase[f"material_modulus_ratio_{end}"]) for end in ("lower", "upper")}
    for name in CHECKED:
        if name in phase["row"].values:
            one = phase.sel(row=name)
            if np.isfinite(one["check_observed"]):
                inside = one["check_lower"] <= one["check_observed"] <= one["check_upper"]
                row[f"check_{name}"] = int(inside)
    row["law"] = float(phase["material_modulus_law"])
    if "law_gain" in phase:
        row["law_gain"] = float(phase["law_gain"].max())
    return row


def of_setpoints(seed: int, noise: int, calibration: str) -> list[Row]:
    """Return a row a phase of a world of three set-points: whether the third is as the first two say."""
    made = world(seed, noise_A0=1e-12 * noise, calibration=calibration, shape=SMALL, setpoints=SETPOINTS)
    rows: list[Row] = []
    for with_reference in (False, True):
        head: Row = {"kind": SEVERAL, "seed": seed, "noise": noise, "calibration": calibration}
        head["reference"] = int(with_reference)
        try:
            result, found = predictions(made, known_of(made, with_reference=with_reference))
        except Exception as error:  # one scan must not end a run; the page counts these
            rows.append(head | {"material": "all", "error": told(error)})
            continue
        own, label = made.truth["material"].values, result["phase"].values
        for phase in found:
            counts = np.bincount(own[(label == phase["index"]) & (own >= 0)], minlength=len(made.materials))
            index = int(np.argmax(counts))
            row = head | {"material": made.materials[index].name}
            row["purity"] = float(counts[index] / counts.sum())  # an interphase apart
            rows.append(row | {f"predicted_{name}": phase[name] for name in READINGS if name in phase})
    return rows


def known_of(made: World, *, with_reference: bool) -> dict[str, Any]:
    """Return what is told of the reference."""
    if not with_reference:
        return {}
    return {"reference": stated_reference(made), "reference_pixels": marked_pixels(made)}


def depth_of(made: World) -> npt.NDArray[np.float64]:
    """Return indentation over 2 A1 at every pixel."""
    return np.asarray(made.truth["indentation"].values / (2.0 * made.scan["A1"].values))


def some_pixels(made: World, index: int, count: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return rows and columns of pixels of a material drawn by chance, or of the interphase (-1)."""
    y, x = np.nonzero(made.truth["material"].values == index)
    some = np.random.default_rng([made.seed, 2, index + 1, count]).permutation(y.size)[:count]
    return y[some], x[some]


def of_pixels(made: World, result: xr.Dataset, index: int, count: int) -> Row:
    """Return how often intervals of single pixels hold what is true there, and how wide they are."""
    at = some_pixels(made, index, count)
    row: Row = {}
    pooled = (result["phase"].values[at] >= 0) & (result["shrinkage"].values[at] > 0.0)
    for name in PROPERTIES:
        truth = made.truth[name].values[at]

        def ends(kind: str, name: str = name) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
            low, high = (result[f"{name}{kind}_{end}"].values[at] for end in ("lower", "upper"))
            return low, high

        (low, high), (alone_low, alone_high) = ends(""), ends("_unpooled")
        both = np.isfinite(low) & np.isfinite(high) & np.isfinite(alone_low) & np.isfinite(alone_high)
        held = both & (low <= truth) & (truth <= high)
        # ratios for the modulus; adhesion and loss may be next to nothing
        if name == "modulus":
            width, alone = np.log(high / low), np.log(alone_high / alone_low)
        else:
            width, alone = (high - low) / truth, (alone_high - alone_low) / truth
        row |= {
            f"pixel_{name}_count": int(both.sum()),
            f"pixel_{name}_held": int(held.sum()),
            f"pixel_{name}_held_alone": int((both & (alone_low <= truth) & (truth <= alone_high)).sum()),
            f"pixel_{name}_pooled": int((both & pooled).sum()),
            f"pixel_{name}_pooled_held": int((held & pooled).sum()),
        }
        if both.any():
            row[f"pixel_{name}_width"] = float(np.median(width[both]))
            row[f"pixel_{name}_width_alone"] = float(np.median(alone[both]))
    return row


def against_least_squares(made: World, result: xr.Dataset, index: int) -> Row:
    """Return errors of ln E of the published estimator and of this method at the same pixels."""
    at = some_pixels(made, index, COMPARED_PIXELS)
    where = {dim: xr.DataArray(i, dims="pixel") for dim, i in zip(("y", "x"), at, strict=True)}
    pixels = made.scan.isel(where)
    pixels.attrs.pop("calibration", None)  # the estimator takes none
    fit = ot.map_properties(
        pixels,
        made.probe,
        model="dmt",
        poisson_ratio=POISSON_RATIO,
        method="least-squares",
        harmonics=FITTED,
        noise=made.noise,
    )
    truth = np.log(made.truth["modulus"].values[at])

    def median_error(values: npt.NDArray[np.float64]) -> float:
        off = np.abs(np.log(values) - truth)
        return float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else math.nan

    estimate = fit["modulus_unscreened"].values
    row: Row = {
        "compared": at[0].size,
        "answers": int(np.isfinite(estimate).sum()),
        "error_fit": median_error(estimate),
        "error_pixel": median_error(result["modulus_unscreened"].values[at]),
        "error_alone": median_error(result["modulus_unpooled"].values[at]),
    }
    k, purity, _ = found_phase(made, result, index)
    if purity > 0.5:
        off = float(result["material_modulus"][k]) / made.materials[index].modulus
        row["error_material"] = abs(math.log(off)) if off > 0.0 else math.nan
    return row


def written(rows: list[Row], version: str) -> Iterator[Mapping[str, str]]:
    """Return rows as text, numbers to five digits."""
    for row in rows:
        extra = set(row) - set(COLUMNS)
        if extra:
            raise KeyError(f"columns {sorted(extra)} are not among those of the table")
        texts = {"version": version}
        for name, value in row.items():
            plain = f"{value:.5g}" if isinstance(value, float) else str(value)
            texts[name] = "" if plain == "nan" else plain
        yield texts

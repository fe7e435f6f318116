"""Results as the inversion gives them, made by hand: 48 x 48 pixels, two phases, intervals that are right."""

from __future__ import annotations

import numpy as np
import xarray as xr

MEANINGS = (
    "determined",
    "not_determined_by_these_data",
    "answer_depends_on_start",
    "model_does_not_fit",
    "at_bound",
    "not_converged",
    "missing_data",
    "several_solutions",
    "no_physical_solution",
    "no_contact",
)
STATUS = {"flag_values": list(range(len(MEANINGS))), "flag_meanings": " ".join(MEANINGS)}
SIZE = 48
SOFT = {"modulus": 95e6, "adhesion": 16e-9, "indentation": 17e-9, "loss_tangent": 0.2}
STIFF = {"modulus": 1.9e9, "adhesion": 2e-9, "indentation": 2.4e-9, "loss_tangent": 0.05}
UNITS = {"modulus": "Pa", "adhesion": "N", "indentation": "m", "loss_tangent": "1"}
# how strongly an error of ln E moves the others
SLOPES = {"modulus": 1.0, "adhesion": 0.4, "indentation": -0.6, "loss_tangent": 0.3}


def array(values, units: str = "1", **attributes) -> xr.DataArray:
    values = np.asarray(values)
    ny, nx = values.shape[-2:]
    coords = {"y": np.arange(ny)[::-1] * 40e-9, "x": np.arange(nx) * 40e-9}
    dims = ("y", "x") if values.ndim == 2 else ("solution", "y", "x")
    return xr.DataArray(values, dims=dims, coords=coords, attrs={"units": units, **attributes})


def material() -> np.ndarray:
    """1 within round soft domains, 0 in the stiff matrix."""
    y, x = np.mgrid[:SIZE, :SIZE]
    centres = ((10, 12, 8), (33, 34, 10), (12, 38, 5), (38, 9, 6))
    return np.any([(y - b) ** 2 + (x - a) ** 2 < r**2 for b, a, r in centres], axis=0).astype(np.int8)


def truth() -> xr.Dataset:
    soft = material() == 1
    known = {name: array(np.where(soft, SOFT[name], STIFF[name]), UNITS[name]) for name in UNITS}
    return xr.Dataset(known | {"material": array(material())})


def status_codes() -> np.ndarray:
    """Most of the map determined; the lower left open, and a few of everything else."""
    codes = np.zeros((SIZE, SIZE), np.int8)
    codes[30:, :22] = 1
    codes[30:34, :6] = 4
    codes[40:44, 16:22] = 3
    codes[0:5, 22:28] = 9
    codes[44:46, 30:36] = 7
    codes[46:, 40:] = 6
    return codes


def posterior(
    noise: float = 0.12,
    shared: float = 0.1,
    codes: np.ndarray | None = None,
    seed: int = 3,
    several_models: bool = True,
    validity: bool = True,
) -> xr.Dataset:
    """A posterior with a sd of ln E of ``noise`` a pixel and ``shared`` for all; open ones have twelve times that."""
    rng = np.random.default_rng(seed)
    codes = status_codes() if codes is None else codes
    known = truth()
    sure = codes == 0
    wide = np.where(sure, 1.0, 12.0)
    total = np.hypot(noise * wide, shared)
    error = rng.normal(size=codes.shape) * noise * wide + shared * rng.normal()
    gone = (codes == 6) | (codes == 9)
    arrays: dict[str, xr.DataArray] = {}
    for name, slope in SLOPES.items():
        median = known[name].values * np.exp(slope * error)
        median[gone] = np.nan
        half = np.exp(1.645 * abs(slope) * total)
        arrays[name] = array(np.where(sure, median, np.nan), UNITS[name])
        arrays[f"{name}_unscreened"] = array(median, UNITS[name])
        arrays[f"{name}_lower"] = array(median / half, UNITS[name])
        arrays[f"{name}_upper"] = array(median * half, UNITS[name])
    known_only = np.where(gone, np.nan, 1.0)
    arrays["uncertainty"] = array(total * known_only)
    arrays["uncertainty_statistical"] = array(noise * wide * known_only)
    arrays["uncertainty_systematic"] = array(shared * known_only)
    arrays["misfit"] = array(rng.chisquare(2, codes.shape) * np.where(codes == 3, 30.0, 1.0) * known_only)
    arrays["log_evidence"] = array(-rng.chisquare(3, codes.shape) * known_only)
    arrays["contact_probability"] = array(np.where(codes == 9, 0.02, np.where(sure, 1.0, 0.9)))
    arrays["status"] = array(codes, **STATUS)
    if several_models:
        chosen = np.where(material() == 1, 1, rng.integers(0, 2, codes.shape) * 2).astype(np.int8)
        chosen[gone] = -1
        flags = {"flag_values": [0, 1, 2], "flag_meanings": "dmt jkr maugis"}
        arrays["model"] = array(chosen, **flags)
        arrays["model_probability"] = array(np.where(material() == 1, 0.95, 0.55) * known_only)
    if validity:
        arrays |= validity_of(known, arrays["modulus_unscreened"].values)
    return xr.Dataset(arrays, attrs={"method": "posterior"})


def validity_of(known: xr.Dataset, modulus: np.ndarray) -> dict[str, xr.DataArray]:
    soft = known["material"].values == 1
    here = modulus / known["modulus"].values
    return {
        "peak_force": array(np.where(soft, 9e-9, 20e-9) * here, "N"),
        "contact_radius": array(np.where(soft, 13e-9, 4.9e-9) * here, "m"),
        "mean_pressure": array(np.where(soft, 0.05, 0.23) * modulus, "Pa"),
        "relative_indentation": array(np.where(soft, 1.7, 0.24) * here),
        "tabor": array(np.where(soft, 20.0, 0.64) * here),
        "contact_time": array(np.where(soft, 0.31, 0.11) * here),
        "modulus_jkr": array(modulus * 1.4, "Pa"),
        "adhesion_jkr": array(known["adhesion"].values * 1.2, "N"),
        "model_difference": array(np.where(soft, 0.5, 0.02) * here),
    }


def exact(seed: int = 5) -> xr.Dataset:
    """Solutions of an exact inversion: one, two, or none."""
    rng = np.random.default_rng(seed)
    known, codes = truth(), status_codes()
    codes[30:, :10] = 7
    codes[30:36, 10:22] = 8
    count = np.ones(codes.shape, np.int8)
    count[codes == 7], count[np.isin(codes, (8, 9, 6))] = 2, 0
    error = rng.normal(size=codes.shape) * 0.12
    arrays: dict[str, xr.DataArray] = {}
    for name, slope in list(SLOPES.items())[:3]:
        value = known[name].values * np.exp(slope * error)
        value[count == 0] = np.nan
        other = np.where(count == 2, value * np.exp(2.5 * slope), np.nan)
        arrays[name] = array(np.where(codes == 0, value, np.nan), UNITS[name])
        arrays[f"{name}_unscreened"] = array(value, UNITS[name])
        arrays[f"{name}_solutions"] = array(np.stack([other, value]), UNITS[name])
    arrays["solutions"] = array(count)
    arrays["residual"] = array(np.where(count > 0, 1e-9, 0.05) * rng.uniform(0.5, 2.0, codes.shape))
    arrays["uncertainty"] = array(np.where(count > 0, 0.12, np.nan))
    arrays["status"] = array(codes, **STATUS)
    return xr.Dataset(arrays, attrs={"method": "exact"})

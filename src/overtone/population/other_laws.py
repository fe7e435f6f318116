"""What other laws of contact would make of the materials of a scan, as part of their table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.population.materials import Question
from overtone.population.refit import LIKELY, refits

if TYPE_CHECKING:
    from overtone.population.table import Material

_Floats = npt.NDArray[np.float64]


class Laws(NamedTuple):
    """What other laws of contact would make of the materials."""

    error: _Floats
    """(material,): change of ln of the modulus under the law that changes it most, of those not excluded."""
    better: str
    """Laws that fit better than the model, in words."""
    arrays: dict[str, xr.DataArray]


def laws_of(materials: Sequence[Material], question: Question, exponent: float, names: Sequence[str]) -> Laws:
    """Return what other laws would make of materials; arguments as those of `materials_of`."""
    joints = {id(m.joint): m.joint for m in materials if m.joint is not None}
    found = {key: refits(joint, question, exponent) for key, joint in joints.items()}
    titles = {refit.key: refit.title for tried in found.values() for refit in tried}
    keys = list(titles)
    change, gain = (np.full((len(materials), len(keys)), math.nan) for _ in range(2))
    error = np.full(len(materials), math.nan)
    for i, material in enumerate(materials):
        if material.joint is None:
            continue
        for refit in found[id(material.joint)]:
            change[i, keys.index(refit.key)] = refit.change[material.place]
            gain[i, keys.index(refit.key)] = refit.gain
        likely = np.where(gain[i] > -LIKELY, np.abs(change[i]), -1.0)
        if likely.size and likely.max() >= 0.0:
            error[i] = change[i, int(likely.argmax())]
    best = np.nanmax(np.where(np.isnan(gain), -math.inf, gain), axis=0, initial=-math.inf)
    better = [f"{titles[key]} (ln of odds {best[j]:.1f})" for j, key in enumerate(keys) if best[j] > LIKELY]
    coords = {"material": list(names), "law": keys}
    arrays = {
        name: xr.DataArray(
            values, dims=("material", "law"), coords=coords, attrs={"units": "1", "long_name": meaning}
        )
        for name, values, meaning in (
            ("law_change", change, "change of ln of the modulus of the phase under another law of contact"),
            ("law_gain", gain, "ln of the posterior density under another law, less that under the model"),
        )
    }
    arrays["law_title"] = xr.DataArray(
        np.array(list(titles.values()), dtype=str),
        dims="law",
        coords={"law": keys},
        attrs={"long_name": "law of contact in words"},
    )
    return Laws(error, " and ".join(better), arrays if keys else {})

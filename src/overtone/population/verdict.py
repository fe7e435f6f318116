"""What a scan can be trusted for: absolute values, ratios to a reference, or contrast alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from overtone.instrument.gates import ABSOLUTE, CONTRAST, GATE, RELATIVE

if TYPE_CHECKING:
    from overtone.population.table import Material

_Floats = npt.NDArray[np.float64]

NINETY = 2.0 * 1.6448536269514722
"""Standard deviations of a normal distribution that its 90 % interval spans."""
_UNLIKELY = 1e-3


def verdict_of(
    materials: Sequence[Material],
    columns: Mapping[str, _Floats],
    names: Sequence[str],
    anchored: bool,
    better: str,
) -> tuple[str, str]:
    """Return absolute, relative or contrast, and why, in a sentence.

    ``better`` names laws of contact that fit better than the model.
    """
    seen = [i for i, m in enumerate(materials) if m.joint is not None and m.resolved]
    if not seen:
        return CONTRAST, "no phase was resolved and inverted: maps show each pixel by itself"
    restless = [names[i] for i in seen if not materials[i].settled]
    if restless:
        return (
            CONTRAST,
            f"the draws of {', '.join(restless)} have not settled: no interval of theirs can be trusted",
        )
    misfits = [names[i] for i in seen if materials[i].misfit_probability < _UNLIKELY]
    if misfits:
        return CONTRAST, f"the model does not fit {', '.join(misfits)}"
    if better:
        return CONTRAST, f"{better} fits better than the model"
    others = [i for i in seen if not materials[i].reference]
    law = {i: abs(float(np.nan_to_num(columns["material_modulus_law"][i]))) for i in others}
    if any(materials[i].reference for i in seen):
        if not others:
            return CONTRAST, "nothing but the reference was resolved and inverted"
        ratios = {i: math.hypot(_width(columns, "material_modulus_ratio", i), law[i]) for i in others}
        far = max(ratios, key=lambda i: ratios[i])
        how = "anchored to" if anchored else "inferred together with"
        size = f"{ratios[far]:.2g} in ln E{_of_which(law[far], ratios[far])}"
        if ratios[far] <= GATE:
            return RELATIVE, f"{how} a reference: ratios of moduli are known to {size} or better"
        return CONTRAST, f"{how} a reference, and still the ratio of {names[far]} is open to {size}"
    total = {i: math.hypot(_width(columns, "material_modulus", i), law[i]) for i in others}
    worst = max(total, key=lambda i: total[i])
    size = f"{names[worst]} has ln E +- {total[worst]:.2g}{_of_which(law[worst], total[worst])}"
    if total[worst] <= GATE:
        return ABSOLUTE, f"calibration, noise and law of contact leave {size} or less"
    return CONTRAST, f"{size} and no reference is in the scan"


def _of_which(law: float, total: float) -> str:
    """Return a remark where the law of contact is the greater part of an error."""
    return f" ({law:.2g} of it because another law of contact fits as well)" if law > 0.7 * total else ""


def _width(columns: Mapping[str, _Floats], name: str, i: int) -> float:
    """Return the standard deviation that a 90 % interval of a logarithm speaks of."""
    return float(np.log(columns[f"{name}_upper"][i] / columns[f"{name}_lower"][i])) / NINETY

"""A material under a tip: a contact model with the parameters that are the sample's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact.models import ContactModel, contact_model
from overtone.contact.parameters import check_shapes, resolve

OF_THE_PROBE = ("radius", "tip_modulus", "tip_poisson_ratio", "frequency")


@dataclass(frozen=True)
class Sample:
    """A material: a contact model with the parameters that are the sample's own, in SI units.

    Parameters
    ----------
    model : ContactModel
        The force law.
    values : mapping of str to array, all of one shape
        Its parameters, without those of the probe (tip radius, modulus and Poisson's ratio, frequency).
    """

    model: ContactModel
    values: Mapping[str, npt.NDArray[np.float64]]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the arrays."""
        return next(iter(self.values.values())).shape


def sample(model: str, **parameters: Any) -> Sample:
    """Describe a material, or a map of them, by a contact model and its parameters.

    Parameters
    ----------
    model : str
        Key of a contact model.
    **parameters
        Parameters of the model in SI units that belong to the sample; arrays broadcast against each other.

    Raises
    ------
    ContactModelError
        If a parameter is missing, unknown or out of range, or if shapes do not fit.

    Examples
    --------
    >>> float(sample("dmt", modulus=2e9, poisson_ratio=0.35, adhesion=8e-9).values["modulus"])
    2000000000.0
    """
    record = contact_model(model)
    own = tuple(q for q in record.parameters if q.name not in OF_THE_PROBE)
    values = resolve(model, own, parameters)
    check_shapes(values)
    arrays = np.broadcast_arrays(*values.values())
    return Sample(record, dict(zip(values, arrays, strict=True)))

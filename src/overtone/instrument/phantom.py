"""Sample maps with known properties: what a virtual scan scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.models import contact_model, models
from overtone.contact.parameters import Parameter
from overtone.contact.sample import OF_THE_PROBE, Sample, sample
from overtone.errors import OvertoneError
from overtone.quantities import named_array, quantity

_Floats = npt.NDArray[np.float64]

_DIMS = ("y", "x")
_RELIEF = 1.5e-9


@dataclass(frozen=True)
class Material:
    """A material of a phantom.

    Parameters
    ----------
    name : str
        What it is called in tables.
    modulus, adhesion : float
        Medians of the elastic modulus [Pa] and the force of adhesion [N].
    height : float
        Height of its surface [m].
    spread : float
        Standard deviation of the logarithm of modulus, adhesion and viscosity from place to place.
    viscosity : float, optional
        Median of the viscosity of the contact [Pa s]; none unless given.
    """

    name: str
    modulus: float
    adhesion: float
    height: float = 0.0
    spread: float = 0.1
    viscosity: float | None = None


POLYSTYRENE = Material("PS", modulus=1.93e9, adhesion=1.91e-9)
POLYOLEFIN = Material("LDPE", modulus=93.78e6, adhesion=16.24e-9, height=-12e-9)


def blend(
    matrix: Material = POLYSTYRENE,
    domains: Material = POLYOLEFIN,
    *,
    shape: tuple[int, int] = (128, 128),
    size: float = 8e-6,
    coverage: float = 0.35,
    relief: float = _RELIEF,
    tilt: float = 0.0,
    poisson_ratio: float | None = None,
    seed: int,
) -> xr.Dataset:
    """Return a polymer blend: round domains of one material in a matrix of another.

    Parameters
    ----------
    matrix, domains : Material
        PS and LDPE with the values of the method's paper unless given.
    shape : tuple of int
        Pixels (y, x).
    size : float
        Width of the scan [m]; pixels are square.
    coverage : float
        Share of the area that domains should cover, between 0 and 0.8.
    relief : float
        Amplitude of waves in the surface [m], next to the steps between the materials.
    tilt : float
        Slope of the whole surface along the fast axis.
    poisson_ratio : float, optional
        Of both materials, to be kept with the map.
    seed : int
        Seed of the generator.

    Returns
    -------
    Dataset
        ``modulus`` [Pa], ``adhesion`` [N], ``height`` [m] and ``material`` (0 matrix, 1 domains) over (y, x);
        ``viscosity`` [Pa s] where a material has one, ``poisson_ratio`` where it is given.
    """
    rows, columns = shape
    if rows < 1 or columns < 1 or not 0.0 <= coverage <= 0.8:
        raise OvertoneError(
            "this phantom cannot be made",
            expected="at least one pixel and a coverage between 0 and 0.8",
            got=f"shape {shape}, coverage {coverage}",
        )
    generator = np.random.default_rng(seed)
    pixel = size / columns
    x, y = np.arange(columns) * pixel, np.arange(rows)[::-1] * pixel
    soft = np.zeros(shape, bool)
    while soft.mean() < coverage:
        centre = generator.uniform((0.0, 0.0), (size, rows * pixel))
        radius = size * generator.uniform(0.04, 0.11)
        soft |= (x[None, :] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 < radius**2

    def draw(name: str) -> _Floats:
        median = np.where(soft, getattr(domains, name) or 0.0, getattr(matrix, name) or 0.0)
        spread = np.where(soft, domains.spread, matrix.spread)
        return np.asarray(median * np.exp(spread * generator.standard_normal(shape)))

    properties: dict[str, Any] = {"modulus": draw("modulus"), "adhesion": draw("adhesion")}
    if matrix.viscosity is not None or domains.viscosity is not None:
        properties["viscosity"] = draw("viscosity")
    if poisson_ratio is not None:
        properties["poisson_ratio"] = poisson_ratio
    steps = np.where(soft, domains.height, matrix.height)
    height = steps + _surface(x, y, size, relief, tilt)
    flags = {"flag_values": [0, 1], "flag_meanings": f"{matrix.name} {domains.name}"}
    material = xr.DataArray(soft.astype(np.int8), dims=_DIMS, attrs=flags)
    return sample_map(size=size, height=height, **properties).assign(material=material)


def gradient(
    *,
    modulus: tuple[float, float] = (0.1e9, 3e9),
    adhesion: tuple[float, float] = (5e-9, 15e-9),
    viscosity: float | None = None,
    poisson_ratio: float | None = None,
    shape: tuple[int, int] = (128, 128),
    size: float = 8e-6,
    relief: float = _RELIEF,
    tilt: float = 0.0,
) -> xr.Dataset:
    """Return a surface without phases: modulus rises evenly along the fast axis, adhesion along the slow one.

    Parameters
    ----------
    modulus : tuple of float
        Left and right [Pa]; its logarithm is linear between them.
    adhesion : tuple of float
        At the bottom and the top [N], likewise.
    viscosity, poisson_ratio : float, optional
        The same everywhere [Pa s, 1], to be kept with the map.
    shape, size, relief, tilt
        As in `blend`.

    Returns
    -------
    Dataset
        As `blend` returns it, without ``material``.
    """
    rows, columns = shape
    ends = (*modulus, *adhesion)
    if rows < 1 or columns < 1 or not all(0.0 < end < math.inf for end in ends):
        raise OvertoneError(
            "this phantom cannot be made",
            expected="at least one pixel and positive ends of the gradients",
            got=f"shape {shape}, modulus {modulus}, adhesion {adhesion}",
        )
    pixel = size / columns
    x, y = np.arange(columns) * pixel, np.arange(rows)[::-1] * pixel
    properties: dict[str, Any] = {
        "modulus": np.broadcast_to(np.geomspace(*modulus, columns), shape),
        "adhesion": np.broadcast_to(np.geomspace(*adhesion, rows)[::-1, None], shape),
        "viscosity": viscosity,
        "poisson_ratio": poisson_ratio,
    }
    given = {name: value for name, value in properties.items() if value is not None}
    return sample_map(size=size, height=_surface(x, y, size, relief, tilt), **given)


def _surface(x: npt.NDArray[Any], y: npt.NDArray[Any], size: float, relief: float, tilt: float) -> _Floats:
    """Return gentle waves on a tilted plane [m]."""
    waves = np.sin(2 * np.pi * x[None, :] / size + 1.0) * np.cos(3 * np.pi * y[:, None] / size)
    return np.asarray(relief * waves + tilt * x[None, :])


def sample_map(*, size: float, height: Any = 0.0, **parameters: Any) -> xr.Dataset:
    """Return arrays of properties as a map with places.

    Parameters
    ----------
    size : float
        Width of the map [m]; pixels are square.
    height : float or array (y, x)
        Surface [m]; row 0 is on top.
    **parameters
        Parameters of a contact model that belong to the sample, SI units: numbers or arrays (y, x).

    Returns
    -------
    Dataset
        ``height`` and every parameter over (y, x), in metres along ``y`` and ``x``.

    Raises
    ------
    OvertoneError
        If a name is no parameter of a sample, shapes do not fit, or the size is not positive.

    Examples
    --------
    >>> polymer = sample_map(size=1e-6, modulus=np.full((4, 8), 2e9), adhesion=5e-9, poisson_ratio=0.35)
    >>> dict(polymer.sizes), polymer.adhesion.attrs["units"]
    ({'y': 4, 'x': 8}, 'N')
    """
    known = _parameters()
    strangers = [name for name in parameters if name not in known]
    if strangers:
        raise OvertoneError(
            f"{' and '.join(strangers)} belong to no sample", expected=", ".join(sorted(known))
        )
    try:
        arrays = np.broadcast_arrays(height, *(np.asarray(value, float) for value in parameters.values()))
    except ValueError as error:
        raise OvertoneError(
            "arrays of a sample map do not fit", expected="one shape (y, x)", got=str(error)
        ) from error
    if arrays[0].ndim != 2 or arrays[0].size == 0 or not 0.0 < size < math.inf:
        raise OvertoneError(
            "this is no sample map",
            expected="arrays (y, x) and a width [m]",
            got=f"shape {arrays[0].shape}, size {size!r}",
        )
    rows, columns = arrays[0].shape
    pixel = size / columns
    places = {"y": np.arange(rows)[::-1] * pixel, "x": np.arange(columns) * pixel}
    names = {"y": "slow axis", "x": "fast axis"}
    coords = {
        dim: xr.DataArray(values, dims=dim, attrs={"units": "m", "long_name": names[dim]})
        for dim, values in places.items()
    }

    def array(name: str, values: _Floats) -> xr.DataArray:
        if quantity(name) is not None:
            return named_array(name, values.astype(float), _DIMS, coords)
        attributes = {"units": known[name].unit, "long_name": known[name].meaning}
        return xr.DataArray(values.copy(), dims=_DIMS, coords=coords, attrs=attributes)

    named = dict(zip(("height", *parameters), arrays, strict=True))
    return xr.Dataset({name: array(name, named[name]) for name in (*parameters, "height")})


def _parameters() -> dict[str, Parameter]:
    """Return every parameter that samples of any model have."""
    return {q.name: q for model in models() for q in model.parameters if q.name not in OF_THE_PROBE}


def map_of(material: Sample, size: float | None) -> xr.Dataset:
    """Return the map of a sample of arrays (y, x), flat.

    Raises
    ------
    OvertoneError
        If it has no two dimensions, or the size is missing.
    """
    if len(material.shape) != 2 or size is None:
        raise OvertoneError(
            "a sample to be scanned lacks places",
            expected="arrays (y, x) and size= [m], the width of the scan",
            got=f"arrays of shape {material.shape}, size {size!r}",
            hint="overtone.instrument.phantom.sample_map, which also takes a surface",
        )
    return sample_map(size=size, **material.values)


def material_of(surface: xr.Dataset, model: str | None, poisson_ratio: float | None) -> Sample:
    """Return the material of a map, a point of it for each pixel.

    Parameters
    ----------
    surface : Dataset
        Parameters of the sample over (y, x).
    model : str, optional
        Contact model; ``dmt-viscous`` where the map has a viscosity and ``dmt`` where not, unless given.
    poisson_ratio : float, optional
        Where the map has none.

    Raises
    ------
    OvertoneError
        If Poisson's ratio is given twice, or the map holds a parameter that the model does not have.
    ContactModelError
        If a parameter is missing or out of range.
    """
    key = model or ("dmt-viscous" if "viscosity" in surface else "dmt")
    own = {q.name for q in contact_model(key).parameters} - set(OF_THE_PROBE)
    given = {name for name in _parameters() if name in surface}
    excess = sorted(given - own)
    if excess:
        raise OvertoneError(
            f"model {key!r} has no {' and '.join(excess)}, which the map holds",
            hint="another model=, or a map without it",
        )
    values: dict[str, Any] = {name: surface[name].transpose(*_DIMS).values for name in sorted(given)}
    if poisson_ratio is not None:
        if "poisson_ratio" in given:
            raise OvertoneError("the map has a Poisson's ratio of its own", hint="leave poisson_ratio out")
        values["poisson_ratio"] = poisson_ratio
    return sample(key, **values)

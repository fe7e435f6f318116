"""Sample maps with known properties: what a virtual scan scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import OvertoneError
from overtone.quantities import named_array


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
        Standard deviation of the logarithm of modulus and of adhesion from place to place.
    """

    name: str
    modulus: float
    adhesion: float
    height: float = 0.0
    spread: float = 0.1


POLYSTYRENE = Material("PS", modulus=1.93e9, adhesion=1.91e-9)
POLYOLEFIN = Material("LDPE", modulus=93.78e6, adhesion=16.24e-9, height=-12e-9)


def blend(
    matrix: Material = POLYSTYRENE,
    domains: Material = POLYOLEFIN,
    *,
    shape: tuple[int, int] = (128, 128),
    size: float = 8e-6,
    coverage: float = 0.35,
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
    seed : int
        Seed of the generator.

    Returns
    -------
    Dataset
        ``modulus`` [Pa], ``adhesion`` [N], ``height`` [m] and ``material`` (0 matrix, 1 domains) over (y, x).
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

    def draw(name: str) -> npt.NDArray[np.float64]:
        median = np.where(soft, getattr(domains, name), getattr(matrix, name))
        spread = np.where(soft, domains.spread, matrix.spread)
        return np.asarray(median * np.exp(spread * generator.standard_normal(shape)))

    coords = {
        "y": xr.DataArray(y, dims="y", attrs={"units": "m", "long_name": "slow axis"}),
        "x": xr.DataArray(x, dims="x", attrs={"units": "m", "long_name": "fast axis"}),
    }
    dims = ("y", "x")
    waviness = 1.5e-9 * np.sin(2 * np.pi * x[None, :] / size + 1.0) * np.cos(3 * np.pi * y[:, None] / size)
    height = np.where(soft, domains.height, matrix.height) + waviness
    return xr.Dataset(
        {
            "modulus": named_array("modulus", draw("modulus"), dims, coords),
            "adhesion": named_array("adhesion", draw("adhesion"), dims, coords),
            "height": named_array("height", height, dims, coords),
            "material": xr.DataArray(
                soft.astype(np.int8),
                dims=dims,
                coords=coords,
                attrs={"flag_values": [0, 1], "flag_meanings": f"{matrix.name} {domains.name}"},
            ),
        }
    )

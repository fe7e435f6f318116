"""What method ``population`` is told of the sample: phases and the reference in the scan, fitted to its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from overtone.errors import OvertoneError
from overtone.units import format_quantity

FILES = "a netCDF file, a table with columns x and y, or a .gsf"
"""What labels and masks are read from, in words."""
_LABELS = ("labels", "label", "phase", "phases")
_MASK = ("mask", "reference", *_LABELS)


class Sample(NamedTuple):
    """What is known of the sample, before any scan is opened."""

    phases: int | Path | None = None
    reference: Any = None
    region: tuple[float, float, float, float] | Path | None = None
    seed: int = 0


def check_scan(observables: Any, orders: Sequence[int]) -> None:
    """Refuse a scan in which no phases can be looked for, before a long inversion.

    Raises
    ------
    OvertoneError
        If it is no map, or no pixel has all harmonics.
    """
    import numpy as np

    dims = tuple(map(str, observables["A1"].dims))
    if dims not in (("y", "x"), ("x", "y")):
        raise OvertoneError(
            "phases are found in maps",
            expected="a scan over y and x",
            got=f"data over {', '.join(dims) or 'no dimension'}",
            hint="--method posterior, which takes points and curves",
        )
    names = ["A1", "phi1", *(f"A{n}" for n in orders), *(f"phi{n}" for n in orders if n > 0)]
    known = {name: np.isfinite(observables[name].values) for name in dict.fromkeys(names)}
    if not np.logical_and.reduce(list(known.values())).any():
        worst = min(known, key=lambda name: int(known[name].sum()))
        others = [str(n) for n in orders if n != int(worst.lstrip("Aphi"))]
        raise OvertoneError(
            "no pixel has all harmonics",
            expected=f"pixels with {', '.join(known)}",
            got=f"{worst} in {int(known[worst].sum())} of {known[worst].size} pixels",
            hint=f"--harmonics {','.join(others)}" if others and worst not in ("A1", "phi1") else None,
        )


def arguments_of(told: Sample, observables: Any, poisson_ratio: float | None) -> tuple[dict[str, Any], str]:
    """Return what `overtone.map_properties` is told of the sample, and what a reader has to know of it.

    Parameters
    ----------
    told : Sample
        What is known before.
    observables : Dataset
        The scan, or the first of a stack.
    poisson_ratio : float, optional
        That all phases are mapped with.

    Raises
    ------
    OvertoneError
        If labels or mask do not fit the scan, or the reference lies outside of it.
    """
    arguments: dict[str, Any] = {"seed": told.seed, "phases": told.phases}
    remark = ""
    if isinstance(told.phases, Path):
        labels = read_plane(told.phases, observables, _LABELS)
        arguments["phases"] = labels.fillna(-1.0)
    if told.reference is not None:
        region = told.region
        if isinstance(region, Path):
            region = read_plane(region, observables, _MASK)
        _check_region(region, observables)
        arguments["reference_pixels"] = region
        arguments["reference"] = told.reference
        remark = _at_the_ratio(told.reference, poisson_ratio)
    return arguments, remark


def _at_the_ratio(reference: Any, poisson_ratio: float | None) -> str:
    """Say which modulus a reference of another Poisson's ratio stands for in the maps: E/(1 - nu^2) counts."""
    if poisson_ratio is None or reference.poisson_ratio == poisson_ratio:
        return ""
    modulus = reference.modulus * (1.0 - poisson_ratio**2) / (1.0 - reference.poisson_ratio**2)
    return (
        f"All phases are mapped with Poisson's ratio {poisson_ratio:g}: {reference.name}, "
        f"{format_quantity(reference.modulus, 'Pa')} at {reference.poisson_ratio:g}, stands as "
        f"{format_quantity(modulus, 'Pa')}."
    )


def _check_region(region: Any, observables: Any) -> None:
    """Refuse a rectangle that holds no pixel; what else is wrong `overtone.map_properties` would say after minutes."""
    from overtone.instrument.reference import reference_pixels

    if isinstance(region, tuple) and {"x", "y"} <= set(observables.coords):
        (x0, x1), (y0, y1) = sorted(region[0::2]), sorted(region[1::2])
        x, y = observables["x"].values, observables["y"].values
        if not (((x >= x0) & (x <= x1)).any() and ((y >= y0) & (y <= y1)).any()):
            span = [
                f"{name} {format_quantity(float(v.min()), 'm')} .. {format_quantity(float(v.max()), 'm')}"
                for name, v in (("x", x), ("y", y))
            ]
            raise OvertoneError(
                "the region of the reference lies outside of the scan",
                expected=", ".join(span),
                got=f"x {format_quantity(x0, 'm')} .. {format_quantity(x1, 'm')}, "
                f"y {format_quantity(y0, 'm')} .. {format_quantity(y1, 'm')}",
                hint="y of the row on top is the largest; overtone inspect shows the scan",
            )
    reference_pixels(observables, region)


def read_plane(path: Path, observables: Any, names: Sequence[str]) -> Any:
    """Return labels or a mask of the pixels of a scan from a file, NaN where it has none.

    Parameters
    ----------
    path : Path
        netCDF with a variable over (y, x), a table with columns x and y, or a map of another format.
    observables : Dataset
        The scan.
    names : sequence of str
        What the variable may be called, the likeliest first; the only one of a file may have any name.

    Raises
    ------
    OvertoneError
        If the file holds none, several, or one of other pixels.
    """
    import numpy as np
    import xarray as xr

    planes = _planes(path)
    chosen = next((name for name in names if name in planes), None)
    if chosen is None:
        if len(planes) != 1:
            raise OvertoneError(
                f"{path.name} does not say which variable is meant",
                expected=f"one over y and x, or one called {names[0]}",
                got=", ".join(planes) or "none over y and x",
                hint=FILES,
            )
        chosen = next(iter(planes))
    like, plane = observables["A1"], planes[chosen]
    wanted, got = ({d: array.sizes[d] for d in ("y", "x")} for array in (like, plane))
    if wanted != got:
        raise OvertoneError(
            f"{chosen} of {path.name} does not fit the scan",
            expected=f"{wanted['y']} lines of {wanted['x']} pixels",
            got=f"{got['y']} lines of {got['x']}",
            hint="labels of the same pixels",
        )
    values = np.asarray(plane.transpose("y", "x").values, dtype=float)
    for axis, dim in enumerate(("y", "x")):
        if dim in plane.coords and dim in like.coords:
            here, there = (np.asarray(array[dim].values, dtype=float) for array in (like, plane))
            close = 0.5 * abs(here[-1] - here[0]) / max(here.size - 1, 1)
            if np.abs(there[::-1] - here).max() <= close < np.abs(there - here).max():
                values = np.flip(values, axis)
            elif not np.abs(there - here).max() <= close:
                raise OvertoneError(
                    f"{chosen} of {path.name} lies elsewhere than the scan",
                    expected=f"{dim} from {here[0]:.6g} to {here[-1]:.6g} m",
                    got=f"{there[0]:.6g} to {there[-1]:.6g} m",
                    hint="labels of the same pixels, or without coordinates",
                )
    coords = {d: like[d] for d in ("y", "x") if d in like.coords}
    return xr.DataArray(values, dims=("y", "x"), coords=coords, name=chosen)


def _planes(path: Path) -> dict[str, Any]:
    """Return every array over (y, x) of a file by name."""
    import xarray as xr

    if path.suffix.lower() == ".nc":
        from overtone.io.netcdf import load

        return {
            str(name): array
            for name, array in load(path).data_vars.items()
            if set(array.dims) == {"y", "x"} and array.dtype.kind in "fiub"
        }
    from overtone.io.registry import read_channels

    recording = read_channels(path)
    if set(recording.dims) != {"y", "x"}:
        return {}
    coords = {dim: recording.coords[dim] for dim in recording.dims if dim in recording.coords}
    return {
        channel.name: xr.DataArray(channel.values, dims=recording.dims, coords=coords)
        for channel in recording.channels
    }


def no_calibration(observables: Any) -> str:
    """Return what pooling cannot know of a scan without a calibration, nothing where it has one."""
    if "calibration" in observables.attrs:
        return ""
    return (
        "The scan was not corrected with a calibration: what all pixels share, such as the zero of A0, the phase and "
        "the gains, is in no interval. Intervals of pixels and materials hold noise only, and no number of pixels "
        "averages the rest out."
    )

"""Datasets out to files, in the format that the ending of the name says, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from overtone.errors import FileFormatError, ObservablesError
from overtone.io import csv_write, gwy_write, igor_write, netcdf, png_write, zarr_store
from overtone.io.layers import RAW
from overtone.io.recording import Recording

# Attributes with a meaning here, which those of a foreign file must not take.
_KEPT_BY_US = ("findings", "history", "direction")


@dataclass(frozen=True)
class Writer:
    """A format that datasets are written in.

    Parameters
    ----------
    suffix : str
        Ending of the name, with its dot.
    title : str
        Name for people, with what the format is for.
    write : callable
        Takes the dataset and the path; an existing file is replaced once the new one is complete.
    """

    suffix: str
    title: str
    write: Callable[[xr.Dataset, Path], None]


def _write_igor(dataset: xr.Dataset, path: Path) -> None:
    if not {"A1", "phi1"} & set(dataset.data_vars):
        raise ObservablesError(
            "an Igor wave in Asylum's layout holds observables alone",
            expected="A1 and phi1",
            got=", ".join(map(str, list(dataset.data_vars)[:12])) or "no variables",
            hint="a name that ends in .gwy or .csv for maps, in .nc or .zarr for anything",
        )
    igor_write.write(dataset, path)


WRITERS: tuple[Writer, ...] = (
    Writer(".nc", "netCDF, which holds anything", netcdf.save),
    Writer(".zarr", "Zarr, which holds anything in blocks", zarr_store.save),
    Writer(".gwy", "maps for Gwyddion", gwy_write.write),
    Writer(".ibw", "observables as an Igor wave in Asylum's layout", _write_igor),
    Writer(".csv", "a table of maps or curves with units", csv_write.write),
    Writer(".png", "a picture of maps or curves", png_write.write),
)


def writer_of(path: Path) -> Writer:
    """Return what writes a file of this name.

    Raises
    ------
    FileFormatError
        If nothing does; the message lists the formats.
    """
    for writer in WRITERS:
        if path.suffix.lower() == writer.suffix:
            return writer
    raise FileFormatError(
        f"cannot save as {path.name!r}",
        expected="a name that ends in " + ", ".join(f"{w.suffix} ({w.title})" for w in WRITERS),
        got=repr(path.suffix) if path.suffix else "no ending",
    )


def save(dataset: xr.Dataset, path: str | Path) -> None:
    """Write a dataset to a file, whole or not at all, in the format that the ending of its name says.

    ========= ====================================================================================
    ``.nc``   netCDF: everything, compressed, with a digest that notices damage
    ``.zarr`` Zarr, a folder: everything, in blocks that can be read one by one
    ``.gwy``  Gwyddion: every map with its unit and size; history and findings in the metadata
    ``.ibw``  Igor, as Asylum's microscopes write it: observables only, 32-bit numbers
    ``.csv``  a table: one row a pixel or point, one column a variable, units in the header
    ``.png``  one picture of all maps or curves, with units and colour bars
    ========= ====================================================================================

    Parameters
    ----------
    dataset : Dataset
        Observables, force harmonics, properties or anything else xarray holds.
    path : str or Path
        An existing file is replaced once the new one is complete.

    Raises
    ------
    FileFormatError
        If the ending is none of these, the folder does not exist or the file cannot be written.
    ObservablesError
        If the argument is no dataset, or holds nothing that the format can.

    Warns
    -----
    ChannelWarning
        If the format has no place for some of the variables; they are named.
    """
    target = Path(path)
    writer = writer_of(target)
    netcdf.check_dataset(dataset)
    writer.write(dataset, target)


def load(path: str | Path) -> xr.Dataset:
    """Return the dataset of a netCDF file or a Zarr store as it was saved, in memory.

    Parameters
    ----------
    path : str or Path
        A file or folder that :func:`save` wrote.

    Raises
    ------
    FileFormatError
        If it is missing, damaged or neither of the two.
    """
    source = Path(path)
    return zarr_store.load(source) if source.is_dir() else netcdf.load(source)


def channels_dataset(recording: Recording) -> xr.Dataset:
    """Return the channels of a recording as a dataset, as the file holds them: nothing combined or corrected.

    A variable is named by its channel with the line direction behind it (``HeightRetrace``); where that is not
    unique a number follows. Values are in SI units; the header of the file, what it states and what was noticed are
    attributes.

    Parameters
    ----------
    recording : Recording
        From `overtone.io.registry.read_channels`.
    """
    from overtone import provenance
    from overtone.io.observables import coordinates_of

    variables = {}
    for layer, channel in enumerate(recording.channels):
        plain = name = channel.name.replace("/", "_") + (channel.direction or "").capitalize()
        again = 2
        while name in variables or name in recording.dims:
            name, again = f"{plain} {again}", again + 1
        attributes: dict[str, object] = {"channel": channel.name, gwy_write.LAYER: layer}
        if channel.unit is not None:
            attributes["units"] = channel.unit
        if channel.flattened is not None:
            attributes["flattened"] = str(channel.flattened)
        variables[name] = xr.Variable(recording.dims, channel.values, attributes)
    dataset = xr.Dataset(variables, coordinates_of(recording))
    attributes = {key: text for key, text in recording.metadata.items() if key not in _KEPT_BY_US}
    attributes |= {
        "source": recording.path.name,
        "vendor": recording.vendor,
        RAW: f"{recording.format}, as in the file",
    }
    dataset = dataset.assign_attrs(attributes)
    dataset = provenance.add_finding(dataset, *(f"{note}." for note in recording.notes))
    return provenance.record(dataset, "read_channels", path=str(recording.path))

"""What a result says it was made from, so that a batch knows which are done, and which have to be made again."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from overtone._version import __version__
from overtone.batch.inputs import Stamp
from overtone.errors import FileFormatError
from overtone.io import netcdf

ATTRIBUTE = "made_from"


@dataclass(frozen=True)
class Record:
    """What a result was made from, and what is in it in a word.

    Parameters
    ----------
    files : mapping of str to Stamp
        The files, by their path as seen from the folder of the result.
    settings : mapping of str to str
        Settings that are not the default, as text.
    version : str
        Of overtone.
    report : str
        Digest of the report that was written with it, empty without.
    summary : mapping
        ``pixels``, ``determined`` (their share) and ``modulus`` (its median [Pa]), where there are such.
    """

    files: Mapping[str, Stamp]
    settings: Mapping[str, str]
    version: str = __version__
    report: str = ""
    summary: Mapping[str, Any] | None = None

    def text(self) -> str:
        """Return it as an attribute holds it."""
        return json.dumps(asdict(self), sort_keys=True)


def path_from(folder: Path, file: Path) -> str:
    """Return the path of a file as seen from a folder, which stays when both move; the whole path elsewhere."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return file.resolve().as_posix()


def parse_record(text: object) -> Record | None:
    """Return the record that an attribute holds, None where it holds none."""
    try:
        values = json.loads(str(text))
        files = {str(name): Stamp(**stamp) for name, stamp in values.pop("files").items()}
        return Record(files, **values)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def record_in(path: Path) -> Record | None:
    """Return what a result says it was made from, None where it does not say or cannot be read.

    Parameters
    ----------
    path : Path
        netCDF file or Zarr folder; only its attributes are read.
    """
    # whatever a damaged file makes a reader stumble over: it has no record then
    try:
        if path.suffix.lower() == ".zarr":
            return parse_record(json.loads((path / "zarr.json").read_text())["attributes"].get(ATTRIBUTE))
        import h5py

        with h5py.File(path, "r") as file:
            return parse_record(file.attrs.get(ATTRIBUTE))
    except Exception:
        return None


def is_whole(path: Path) -> bool:
    """Tell whether a netCDF file ends with its digest and has this digest; a Zarr folder is whole or not there."""
    if path.suffix.lower() == ".zarr":
        return (path / "zarr.json").is_file()
    try:
        netcdf.check_seal(path)
        return netcdf.is_sealed(path)
    except (OSError, FileFormatError):
        return False


def summary_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the number of pixels of a map, the share whose modulus is determined, and its median [Pa]."""
    summary: dict[str, Any] = {"pixels": int(dataset["A1"].size)}
    if "status" in dataset:
        summary["determined"] = float((dataset["status"] == 0).mean())
    if "modulus" in dataset:
        values = dataset["modulus"].values
        known = values[np.isfinite(values)]
        summary["modulus"] = float(np.median(known)) if known.size else None
    return summary


def why_again(path: Path, file: Path, settings: Mapping[str, str], report: Path | None) -> str:
    """Return why the result of a file has to be made again, empty where it stands as it is.

    Parameters
    ----------
    path : Path
        Of the result, which exists.
    file : Path
        What it is to be made from.
    settings : mapping of str to str
        What it is to be made with.
    report : Path, optional
        Report that has to be there as well.
    """
    record = record_in(path)
    if record is None or not is_whole(path):
        return "the result was damaged"
    if record.version != __version__:
        return f"overtone was {record.version}, is {__version__}"
    if other := [n for n in {**record.settings, **settings} if record.settings.get(n) != settings.get(n)]:
        return f"other settings: {', '.join(other)}"
    if len(record.files) != 1 or not next(iter(record.files.values())).is_that_of(file):
        return "the input has changed"
    if report is not None and not (record.report and report.is_file()):
        return "its report is missing"
    if report is not None and Stamp.of(report).digest != record.report:
        return "its report is of another run"
    return ""


def belongs_to(path: Path, file: Path) -> bool:
    """Tell whether a result may be replaced by that of a file: its own, or one that cannot be read."""
    record = record_in(path)
    if record is None:
        return not _is_readable(path)
    if path_from(path.parent, file) in record.files:
        return True
    try:  # moved since
        return len(record.files) == 1 and next(iter(record.files.values())).is_that_of(file)
    except OSError:
        return False


def _is_readable(path: Path) -> bool:
    """Tell whether something that holds no record is of another origin, rather than a damaged result."""
    if path.is_dir() or (path.stat().st_size and not path.read_bytes().startswith(netcdf.HDF5)):
        return True
    try:
        netcdf.load(path)
    except FileFormatError:
        return False
    return True

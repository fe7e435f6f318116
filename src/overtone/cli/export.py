"""``overtone export``."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.options import ScanOptions, open_with
from overtone.errors import ChannelError, FileFormatError, OvertoneError


def export(
    file: Path,
    output: Path,
    /,
    *,
    variables: Annotated[str | None, Parameter(name="--variables")] = None,
    observables: Annotated[bool, Parameter(name="--observables", negative=())] = False,
    scan: ScanOptions = ScanOptions(),  # noqa: B008 - a frozen record
) -> None:
    """Write a result or a scan in another format: .gwy, .csv, .png, .ibw, .nc or .zarr.

    A result is written as it is. Of a microscope's file it is the channels as they are, in SI units, with nothing
    combined or corrected; with --observables, or any option that says how the file is to be read, it is the
    observables that "overtone map" would use (A1, phi1, ...). An .ibw always holds observables.

    Parameters
    ----------
    file : Path
        A result (.nc, .zarr) or any file that overtone reads.
    output : Path
        Its ending says the format; an existing file is replaced once the new one is complete.
    variables : str
        Which ones, separated by commas, for example A1,phi1; all of them unless given.
    observables : bool
        The observables of a scan instead of its channels.
    scan : ScanOptions
        How the file is to be read.
    """
    import warnings

    from overtone.errors import OvertoneWarning
    from overtone.io.export import save, writer_of

    writer = writer_of(output)
    _check_paths(file, output)
    given = [option.name for option in fields(scan) if getattr(scan, option.name) != option.default]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OvertoneWarning)
        dataset = _opened(file, scan, observables=observables, given=given, igor=writer.suffix == ".ibw")
    if variables is not None:
        dataset = _chosen(dataset, variables)
    with warnings.catch_warnings(record=True) as lost:
        warnings.simplefilter("always", OvertoneWarning)
        save(dataset, output)
    console = Console()
    for text in dict.fromkeys(str(warning.message) for warning in (*caught, *lost)):
        console.print(f"- {text}", markup=False, highlight=False, soft_wrap=True)
    names = ", ".join(map(str, dataset.data_vars))
    console.print(f"wrote {output}: {names}", markup=False, highlight=False, soft_wrap=True)


def _opened(file: Path, scan: ScanOptions, *, observables: bool, given: list[str], igor: bool) -> Any:
    """Return a result as it was saved, else the observables or the channels of a scan."""
    from overtone.io.export import channels_dataset, load
    from overtone.io.registry import read_channels

    if not (observables or given):
        result = _result(file, load)
        if result is not None:
            return result
    if observables or given or igor:
        return open_with(file, scan)
    return channels_dataset(read_channels(file))


def _result(file: Path, load: Any) -> Any:
    """Return the dataset of a netCDF file or a Zarr store, None where the file is of another kind."""
    from overtone.io.registry import FORMATS

    if not file.exists():
        return None
    head = b""
    if file.is_file():
        with file.open("rb") as stream:
            head = stream.read(4096)
    known = next((form.key for form in FORMATS if form.sniff(file, head)), None)
    return load(file) if known in ("netcdf", "zarr") else None


def _chosen(dataset: Any, variables: str) -> Any:
    names = [name.strip() for name in variables.split(",") if name.strip()]
    unknown = [name for name in names if name not in dataset.data_vars]
    if unknown or not names:
        raise ChannelError(
            f"there is no variable {unknown[0]!r}" if unknown else "--variables names none",
            expected=", ".join(map(str, dataset.data_vars)),
            got=repr(variables),
        )
    return dataset[names]


def _check_paths(file: Path, output: Path) -> None:
    """Refuse an output that could not be written, or would replace its own source."""
    if not output.parent.is_dir():
        raise FileFormatError(f"the folder {output.parent} does not exist", hint="create it first")
    if output.resolve() == file.resolve():
        raise OvertoneError(f"{output} is the file itself", expected="another name for the copy")

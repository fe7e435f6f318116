"""Which reader opens which file: by what is in it, whatever its name says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from overtone.errors import FileFormatError, OvertoneError
from overtone.io import (
    gsf,
    gwy,
    gwyddion_bridge,
    igor,
    igor_experiment,
    jpk,
    jpk_h5,
    nanoscope,
    nanosurf,
    neasnom,
    netcdf,
    nsid,
    park,
    table,
    zarr_store,
)
from overtone.io.recording import Recording

_HEAD = 4096


@dataclass(frozen=True)
class Format:
    """A file format: how to tell it and how to read it.

    Parameters
    ----------
    key : str
        Short name, as in :attr:`Recording.format`.
    title : str
        Name for people.
    suffixes : tuple of str
        Usual endings of file names, for messages only.
    sniff : callable
        Takes the path and the first bytes (none of a folder); tells whether the file is of this format.
    read : callable
        Takes the path and returns the recording.
    """

    key: str
    title: str
    suffixes: tuple[str, ...]
    sniff: Callable[[Path, bytes], bool]
    read: Callable[[Path], Recording]


# In the order in which they are tried: a field of a neaSNOM set is also a lone .gsf, and nearly
# anything that is text might be a table.
FORMATS: tuple[Format, ...] = (
    Format(
        "igor_experiment",
        "packed Igor experiment (.pxp)",
        (".pxp",),
        igor_experiment.sniff,
        igor_experiment.read,
    ),
    Format("igor", "Igor binary wave (.ibw)", (".ibw",), igor.sniff, igor.read),
    Format("neasnom", "neaSNOM folder", (".html", ".gsf"), neasnom.sniff, neasnom.read),
    Format("nanosurf", "Nanosurf (.nid)", (".nid",), nanosurf.sniff, nanosurf.read),
    Format(
        "nanoscope", "Bruker NanoScope (.spm, .000)", (".spm", ".000", ".di"), nanoscope.sniff, nanoscope.read
    ),
    Format("gsf", "Gwyddion Simple Field (.gsf)", (".gsf",), gsf.sniff, gsf.read),
    Format("jpk", "JPK image (.jpk)", (".jpk", ".jpk-qi-image"), jpk.sniff, jpk.read),
    Format("jpk_h5", "JPK image or video (.h5-jpk)", (".h5-jpk",), jpk_h5.sniff, jpk_h5.read),
    Format("park", "Park image (.tiff) or folder of one scan", (".tiff", ".tif"), park.sniff, park.read),
    Format("gwy", "Gwyddion (.gwy)", (".gwy",), gwy.sniff, gwy.read),
    Format("nsid", "NSID or USID of pycroscopy (.h5)", (".h5", ".hf5"), nsid.sniff, nsid.read),
    Format("zarr", "Zarr store (.zarr)", (".zarr",), zarr_store.sniff, zarr_store.read),
    Format("netcdf", "netCDF (.nc)", (".nc",), netcdf.sniff, netcdf.read),
    Format(
        "gwyddion",
        "what Gwyddion reads of Nanonis, NT-MDT, WSxM, Agilent, ...",
        (".sxm", ".mdt", ".top", ".mi", ".sm4"),
        gwyddion_bridge.sniff,
        gwyddion_bridge.read,
    ),
    Format("table", "table of text with units (.csv)", (".csv", ".tsv"), table.sniff, table.read),
)

# Files that people have and overtone does not read yet, by their first bytes.
_OTHERS = (
    (b"II*\0", "a TIFF picture: colours, without the numbers that JPK and Park add to theirs"),
    (b"MM\0*", "a TIFF picture: colours, without the numbers that JPK and Park add to theirs"),
    (b"PK\x03\x04", "a ZIP archive or spreadsheet"),
)


def read_channels(path: str | Path) -> Recording:
    """Read every channel of a microscope's file, with units, coordinates and what the header says.

    The format is found by the content of the file, not by its name.

    Parameters
    ----------
    path : str or Path
        A file, the folder of a neaSNOM measurement or of a Park scan, or a Zarr store; ``experiment.pxp::Image0`` is
        one wave of an Igor experiment that holds several.

    Returns
    -------
    Recording
        Channels in SI units and radians, as the file holds them: nothing is combined or corrected.

    Raises
    ------
    FileFormatError
        If the path is missing, the format is not known, or the file is damaged.
    """
    source, wave = igor_experiment.split(Path(path))
    try:
        head = _head(source)
        chosen = next((known for known in FORMATS if known.sniff(source, head)), None)
        if chosen is None:
            raise _unrecognised(source, head)
        if wave is not None:
            return _one_wave(source, chosen, wave)
        return chosen.read(source)
    except OvertoneError:
        raise
    except ImportError as error:
        raise OvertoneError(
            f"{source.name} needs a library that is not installed",
            got=str(error),
            hint="pip install overtone again",
        ) from error
    except OSError as error:
        raise FileFormatError(
            f"cannot read {str(source)!r}", got=f"{type(error).__name__} ({error.strerror or error})"
        ) from error
    except Exception as error:  # whatever a damaged file makes a reader stumble over
        raise FileFormatError(
            f"{source.name} is damaged or unusual beyond reading",
            expected="a whole file of a known format",
            got=f"{type(error).__name__} ({str(error)[:200]})",
            hint="copy or export the file again",
        ) from error


def _one_wave(source: Path, chosen: Format, wave: str) -> Recording:
    if chosen.key != "igor_experiment":
        raise FileFormatError(
            f"{source.name} has no parts to choose from",
            expected=f"the name of an Igor experiment before {igor_experiment.SEPARATOR}{wave}",
            got=chosen.title,
            hint=repr(source.name),
        )
    return igor_experiment.read(source, wave)


def _head(path: Path) -> bytes:
    if path.is_dir():
        return b""
    if not path.exists():
        near = next((parent for parent in path.parents if parent.is_dir()), None)
        raise FileFormatError(
            f"there is no file {str(path)!r}",
            expected="a file or a neaSNOM folder",
            got="nothing",
            hint="check the name" if near == path.parent else f"check the folder; {str(near)!r} exists",
        )
    if not path.is_file():
        raise FileFormatError(
            f"{str(path)!r} is no ordinary file", expected="a file", got="a device or a pipe"
        )
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if not head:
        raise FileFormatError(
            f"{path.name} is empty",
            expected="a file with content",
            got="0 bytes",
            hint="copy or export it again",
        )
    return head


def _unrecognised(path: Path, head: bytes) -> FileFormatError:
    readable = ", ".join(known.title for known in FORMATS)
    if path.is_dir():
        return FileFormatError(
            f"{str(path)!r} is a folder",
            expected="one file, a neaSNOM folder of .gsf files with their .html page, or a Zarr store",
            got="none of these",
            hint="a file in it",
        )
    other = next((name for magic, name in _OTHERS if head.startswith(magic)), None)
    if other is not None:
        hint = "export the channels as one table (CSV) with units in its header, or as netCDF"
        got = other
    else:
        got = repr(head[:24].decode("latin-1"))
        promised = [known.title for known in FORMATS if path.suffix.lower() in known.suffixes]
        hint = "look into the file with a text editor, or export it again"
        if promised:
            hint = (
                f"its name promises {' or '.join(promised)}, its content is something else; export it again"
            )
    return FileFormatError(f"the format of {path.name} is not known", expected=readable, got=got, hint=hint)

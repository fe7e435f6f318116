"""Make the tables of the page on files: what overtone reads from real files, and what others read from the same.

Run by hand, ``python docs/files.py FOLDER``, with a folder of the files that the page names; some seconds. With
``--damage`` the files are damaged as well, some thousand times, and read again; two minutes on two cores.

Three kinds of readers stand beside overtone's own: the vendors' and Gwyddion's programs as they are; libraries that
hand out raw numbers, with the arithmetic done here; and plain NumPy, with places and factors that a person took
from the header. None of them shares code with overtone.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import math
import re
import sys
import textwrap
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.io.recording import Channel, Recording
from overtone.io.registry import FORMATS, read_channels

Array = npt.NDArray[Any]
Images = Sequence[Array]
"""Values in SI units and radians of every channel, in the order of overtone's, row 0 on top."""

FOLDER = Path(__file__).parent
PAGE = FOLDER / "files.md"
DEGREE = math.pi / 180.0
INSIDE = "row 1/3, column 1/4"
CORNERS = ("top left", "top right", "bottom left", "bottom right", INSIDE)
ALONG = ("first", "at 1/4", "at 1/2", "at 3/4", "last")
UNITS = {
    "m": ((1e-6, "um"), (1e-9, "nm"), (1e-12, "pm")),
    "V": ((1.0, "V"), (1e-3, "mV"), (1e-6, "uV")),
    "A": ((1e-9, "nA"), (1e-12, "pA"), (1e-15, "fA"), (1e-18, "aA")),
    "Hz": ((1e3, "kHz"), (1.0, "Hz")),
}
CUTS, FLIPS, RENAMES = 20, 40, 4


# --- readers that are not overtone's ----------------------------------------------------------------


class Others(NamedTuple):
    """What another reader makes of a file."""

    images: Images
    size: tuple[float, float] | None = None
    """Width and height of the image [m], where it says so."""
    remark: str = ""


def gwyddion(path: Path) -> Others:
    """Read a file with Gwyddion; its degrees become radians, its units are kept otherwise."""
    import gwyddionpy

    channels = list(gwyddionpy.load(path).channels.values())
    first = channels[0]
    images = [np.asarray(c.data) * (DEGREE if c.si_unit_z == "deg" else 1.0) for c in channels]
    return Others(images, (first.xreal, first.yreal) if first.si_unit_xy == "m" else None)


def gwyddion_of_millivolts(*volts: int) -> Callable[[Path], Others]:
    """Return Gwyddion for a file in which it calls the millivolts of these channels volts."""

    def read(path: Path) -> Others:
        theirs = gwyddion(path)
        images = [image * (1e-3 if i in volts else 1.0) for i, image in enumerate(theirs.images)]
        return Others(images, theirs.size, "its V taken as mV")

    return read


def nsfopen(path: Path) -> Others:
    """Read a .nid with the vendor's library, which hands out lines from the bottom and phases in degrees."""
    from NSFopen.read import read

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        images = read(str(path), verbose=False).data["Image"]
    return Others([values[::-1] * (DEGREE if key[-1] == "Phase" else 1.0) for key, values in images.items()])


def wave(start: int, order: str = "<", phases: Sequence[int] = ()) -> Callable[[Path], Others]:
    """Return a reader of an Igor wave of 32-bit floats that begin at a byte, phases in degrees."""

    def read(path: Path) -> Others:
        content = path.read_bytes()
        # Igor's technical note 3: four dimensions at byte 132; the one wave that is older has one, of five points.
        dims = [n for n in np.frombuffer(content, f"{order}i4", 4, 132) if n] if start == 384 else [5]
        stored = np.frombuffer(content, f"{order}f4", math.prod(dims), start).astype(float)
        stored = stored.reshape(dims, order="F")
        if stored.ndim == 1:
            layers = [stored]
        elif stored.ndim == 2:
            layers = list(stored.T)
        else:
            layers = [stored[:, :, k].T[::-1] for k in range(stored.shape[2])]
        return Others([layer * (DEGREE if k in phases else 1.0) for k, layer in enumerate(layers)])

    return read


def raw(
    *parts: tuple[int, float], rows: int, columns: int, kind: str = "<i2", turned: bool = False
) -> Callable[[Path], Others]:
    """Return a reader of images that begin at these bytes, times these factors; lines from the bottom."""

    def read(path: Path) -> Others:
        content = path.read_bytes()
        images = []
        for start, factor in parts:
            stored = np.frombuffer(content, kind, rows * columns, start).reshape(rows, columns)
            images.append((stored[::-1, ::-1] if turned else stored[::-1]).astype(float) * factor)
        return Others(images)

    return read


def nanonis(path: Path) -> Others:
    """Read a Nanonis scan: forward and backward of nine channels; backward lines begin at their right end."""
    content = path.read_bytes()
    start = content.index(b"\x1a\x04") + 2
    stored = np.frombuffer(content, ">f4", offset=start).reshape(9, 2, 128, 128).astype(float)
    pairs = [((DEGREE if k == 3 else 1.0) * both) for k, both in enumerate(stored)]
    return Others([image for both in pairs for image in (both[0][::-1], both[1][::-1, ::-1])])


def jpk_tags(path: Path) -> Others:
    """Read a .jpk: the integers of each page, times multiplier plus offset of the slot that is its default."""
    import tifffile

    images = []
    with tifffile.TiffFile(path) as file:
        for page in file.pages[1:]:
            tags = {tag.code: tag.value for tag in page.tags}
            slots = [32912 + 48 * i for i in range(tags[32896])]
            base = next(at for at in slots if tags[at] == tags[32897])
            values = page.asarray()[::-1] * tags[base + 20] + tags[base + 21]
            images.append(values * (DEGREE if tags[base + 18] == "deg" else 1.0))
    return Others(images)


def jpk_hdf5(path: Path) -> Others:
    """Read a .h5-jpk: integers over pixels and frames, times the one step that sums up each chain of calibrations."""
    import h5py

    images = []
    with h5py.File(path) as file:
        scan = file["Measurement_000"]
        assert (np.diff(scan["Position_Values"][:, 1].reshape(128, 128)[:, 0]) > 0.0).all()  # from the bottom
        for group in (scan[f"Channel_{index:03d}"] for index in range(9)):
            (data,) = (group[key][()] for key in group if key != "thumbnail")
            factor, offset = (group.attrs[f"net-encoder.scaling.{key}"] for key in ("multiplier", "offset"))
            values = (data * factor + offset).T.reshape(4, 128, 128)[:, ::-1]
            images.append(values * (DEGREE if group.attrs["channel.name"] == b"phase" else 1.0))
    return Others(images)


def park_tags(path: Path) -> Others:
    """Read a Park image: 32-bit floats in tag 50434, times the gain at byte 220 of tag 50435, in micrometres."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        tags = {tag.code: tag.value for tag in file.pages[0].tags}
    gain = np.frombuffer(tags[50435], "<f8", 1, 220)[0]
    assert np.frombuffer(tags[50435], "<u2", 2, 244).tobytes().decode("utf-16-le") == "um"
    return Others([np.frombuffer(tags[50434], "<f4").reshape(256, 256)[::-1].astype(float) * gain * 1e-6])


def park_picture(path: Path) -> list[float]:
    """Return how well the picture that Park's software rendered agrees with the values, upside down and mirrored."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        picture = file.pages[0].colormap.astype(float).sum(0)[file.pages[0].asarray()].ravel()
    values = park_tags(path).images[0]
    return [float(np.corrcoef(picture, v.ravel())[0, 1]) for v in (values, values[::-1], values[:, ::-1])]


def gwyfile_library(path: Path) -> Others:
    """Read a .gwy with the library gwyfile."""
    import gwyfile

    fields = gwyfile.util.get_datafields(gwyfile.load(str(path)))
    images = [field.data * (DEGREE if field.si_unit_z.unitstr == "deg" else 1.0) for field in fields.values()]
    first = next(iter(fields.values()))
    return Others(images, (first.xreal, first.yreal))


def old_gwy(path: Path) -> Others:
    """Read the one field of a file of Gwyddion 1 by hand: a size, then doubles from the top."""
    content = path.read_bytes()
    start = content.index(b"data\0D") + 6
    return Others([np.frombuffer(content, "<f8", 300 * 300, start + 4).reshape(300, 300)])


def gsf_library(path: Path) -> Others:
    """Read a .gsf with the library gsffile."""
    import gsffile

    values, header = gsffile.read_gsf(str(path))
    return Others([np.asarray(values, dtype=float)], (header["XReal"], header["YReal"]))


def neasnom_fields(of_one: Callable[[Path], Others]) -> Callable[[Path], Others]:
    """Return a reader of all fields of a folder, phases in radians and M1A in nanometres."""

    def read(path: Path) -> Others:
        images, size = [], None
        for field in sorted(path.glob("*.gsf")):
            values, size, _ = of_one(field)
            images.append(values[0] * (1e-9 if field.stem.endswith("M1A") else 1.0))
        return Others(images, size)

    return read


def nsid_hdf5(path: Path) -> Others:
    """Read an NSID file: values[x, y] with y from the bottom."""
    import h5py

    images = []
    with h5py.File(path) as file:
        for k in range(4):
            data = file[f"Measurement_000/Channel_{k}/Channel_{k}/Channel_{k}"]
            unit = DEGREE if k == 3 else 1.0
            images.append(data[()].astype(float).T[::-1] * unit)
    return Others(images)


def igor_packed(path: Path) -> Others:
    """Read a wave of an Igor experiment with igor2."""
    from igor2 import packed

    experiment = packed.load(str(path).partition("::")[0])[1]
    return Others([experiment["root"][b"radiusData"].wave["wave"]["wData"].astype(float)])


# --- the files --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class File:
    """A real file, and who else reads it."""

    name: str
    readers: Mapping[str, Callable[[Path], Others]]
    remark: str = ""


@dataclass(frozen=True)
class Vendor:
    """Files of one kind."""

    title: str
    top: str
    """How it was checked which row is the top."""
    files: tuple[File, ...]


def _asylum(name: str, *phases: int, remark: str = "") -> File:
    return File(name, {"by hand": wave(384, phases=phases), "Gwyddion": gwyddion}, remark)


def _curve(name: str, *phases: int) -> File:
    return File(name, {"by hand": wave(384, phases=phases)}, "curve; every column has the unit of its kind")


def _bruker(name: str, read: Callable[[Path], Others], *millivolts: int) -> File:
    theirs = gwyddion_of_millivolts(*millivolts) if millivolts else gwyddion
    return File(f"bruker/{name}", {"by hand": read, "Gwyddion": theirs})


def _nid(name: str, remark: str = "") -> File:
    return File(f"nanosurf/{name}", {"NSFopen": nsfopen, "Gwyddion": gwyddion}, remark)


WORD, LONG = 2.0**16, 2.0**32
ANGLE = 359.9945 * DEGREE / WORD
VENDORS = (
    Vendor(
        "Asylum Research (.ibw, .pxp)",
        "Igor counts rows from the bottom; Gwyddion puts the same row on top. The size is that of all pixels: Asylum's "
        "scan size reaches from the first to the last centre and is one pixel less.",
        (
            _asylum("ibw/AR_20211011.ibw", 2),
            _asylum("ibw/tono_whiskers.ibw", 2),
            _asylum("ibw/AutexysEFM_0000.ibw", 3, 4, remark="Nap channels are those of the lift pass"),
            _asylum("ibw/DTMicroscope_scan_0001_DART.ibw", 3, 4),
            _asylum("ibw/IgorIBWReader_ImageStack_BTFO_DSO.ibw", 3),
            _asylum(
                "ibw/10x10-one_channel_without_name.ibw",
                remark="made by Igor alone: no name, no unit, no size",
            ),
            _curve("ibw_curves/LRCol0_MS_LG7d0001.ibw", 3),
            _curve("ibw_curves/ForceMetric_X60_3_x4_0100.ibw"),
            _curve("ibw_curves/afmformats_SiN_FD_plot.ibw"),
            File("ibw_byteorder/mac-version2.ibw", {"by hand": wave(126, ">")}, "big-endian, version 2"),
            File("ibw_byteorder/mac-version5.ibw", {"by hand": wave(384, ">")}, "big-endian, version 5"),
            File("ibw_byteorder/win-version5.ibw", {"by hand": wave(384)}, "little-endian, version 5"),
            File(
                "igor_experiment/polar-graphs-demo.pxp::radiusData", {"igor2": igor_packed}, "no image in it"
            ),
        ),
    ),
    Vendor(
        "Bruker NanoScope (.spm, .000, .di)",
        "The first line of a file is the lowest, of frames that were scanned upwards (ST_di-3, ST_di-5) and downwards "
        "(the others) alike; Gwyddion puts the same row on top.",
        (
            _bruker(
                "hystorian_test_nanonis.000",
                raw(
                    (40960, 46.27417 * 21.65764e-9 / WORD),
                    (565248, 24.57563 * 79.05961e-9 / WORD),
                    (1089536, 3999.939e-3 / WORD),
                    (1613824, ANGLE),
                    (2138112, 3999.939e-3 / WORD),
                    rows=512,
                    columns=512,
                ),
                2,
                4,
            ),
            _bruker(
                "ST_di-3.di",
                raw(
                    (40960, 24.57563 * 790.3658e-9 / WORD),
                    (172032, 2999.954e-3 / WORD),
                    (303104, ANGLE),
                    (434176, 329.9950 * 34.55678e-9 / WORD),
                    rows=256,
                    columns=256,
                ),
                1,
            ),
            _bruker(
                "ST_di-4.di",
                raw(
                    (40960, 1.5 * 363.9249e-9 / WORD),
                    (565248, 1999.969e-3 * 62e-9 / WORD),
                    (1089536, ANGLE),
                    rows=512,
                    columns=512,
                ),
            ),
            _bruker(
                "ST_di-5.di",
                raw(
                    (80960, 24.576 * 842.6266e-9 / LONG),
                    (1129536, 24.576 / LONG),
                    kind="<i4",
                    rows=512,
                    columns=512,
                ),
            ),
            _bruker(
                "nanoAFMr_kpg20080408.007",
                raw(
                    (40960, 2.416955 * 8.661471e-9 / WORD),
                    (172032, 66.26404 * DEGREE / WORD),
                    rows=256,
                    columns=256,
                ),
            ),
            File("bruker/ST_di_corrupted.di", {}, "cut off by whoever published it, and refused"),
        ),
    ),
    Vendor(
        "Nanosurf (.nid)",
        "The first line of a file is the lowest; Gwyddion puts the same row on top, NSFopen hands lines out as stored.",
        (
            _nid("NSFopen_MoS2.nid", "pixels are not square"),
            _nid("NSFopen_grid1.nid"),
            _nid(
                "NSFopen_circles_holes.nid",
                "12 pixels in which the electronics stopped are NaN in all channels",
            ),
            _nid("NanoSurf_20160301.nid", "16 bits"),
        ),
    ),
    Vendor(
        "JPK (.jpk, .h5-jpk)",
        "The first line of a file is the lowest: Gwyddion puts the same row on top of the .jpk; the .h5-jpk has a list "
        "of positions, whose y grows. Of the video the first of four frames is shown, and all were compared.",
        (
            File("jpk/TopoStats_file.jpk", {"tifffile": jpk_tags, "Gwyddion": gwyddion}),
            File("jpk/AFMReader_sample_0.h5-jpk", {"h5py": jpk_hdf5}),
        ),
    ),
    Vendor(
        "Park (.tiff)",
        "The first line is the lowest: the picture that Park's software rendered into the first file agrees with the "
        "values this way up (r = 0.93), not upside down or mirrored (r < 0.1); Gwyddion puts the same row on top.",
        (
            File(
                "park/Park_20210916_034.tiff",
                {"tifffile": park_tags, "Gwyddion": gwyddion},
            ),
            File(
                "park/nanoAFMr_ForceCurve_009.tiff", {"tifffile": park_tags}, "the image of a file of spectra"
            ),
        ),
    ),
    Vendor(
        "Gwyddion (.gwy, .gsf)",
        "Fields are stored from the top.",
        (
            File("gwyddion/PTO_110_Virgin0001.gwy", {"gwyfile": gwyfile_library, "Gwyddion": gwyddion}),
            File(
                "gwyddion/GwiddionReader_chip.gwy",
                {"by hand": old_gwy},
                "of Gwyddion 1; the same image as the .gsf",
            ),
            File("gwyddion/GwiddionReader_chip.gsf", {"gsffile": gsf_library, "Gwyddion": gwyddion}),
        ),
    ),
    Vendor(
        "neaSNOM (folder of .gsf and .html)",
        "Fields are stored from the top, as in every .gsf. Only Z and M have a unit in the file; M1A is in nanometres "
        "because its mean is the tapping amplitude of the page of settings.",
        (
            File(
                "neasnom/SnO2_NW4_hyp",
                {"gsffile": neasnom_fields(gsf_library), "Gwyddion": neasnom_fields(gwyddion)},
            ),
        ),
    ),
    Vendor(
        "NSID of pycroscopy (.h5)",
        "Made from an .ibw, with rows from the bottom as there. No other reader says which row is the top.",
        (File("nsid_h5/DTMicroscope_PMN28Pt0000.h5", {"h5py": nsid_hdf5}),),
    ),
    Vendor(
        "Nanonis, NT-MDT, Agilent, WSxM (through Gwyddion)",
        "Which row is the top is Gwyddion's word, and for Nanonis the header's (`SCAN_DIR: up`: the first line is the "
        "lowest). Numbers and units, which come from Gwyddion as well, are held against the bytes of the files.",
        (
            File("nanonis/A151216.123306-02602.sxm", {"by hand": nanonis}),
            File(
                "ntmdt/GaAs_map.mdt",
                {"by hand": raw((45421, 1e-9), (614405, 1e-9), kind="<f8", rows=256, columns=256)},
                "the file says nA; overtone keeps no unit that only Gwyddion states",
            ),
            File(
                "agilent/ST_mi-1.mi",
                {
                    "by hand": raw(
                        (5073, 2.9025e-6 / 2.0**31),
                        (267217, 10.0 / 2.0**31),
                        (529361, 10.0 / 2.0**31),
                        (791505, 10.0 / 2.0**31),
                        kind="<i4",
                        rows=256,
                        columns=256,
                    )
                },
            ),
            File(
                "wsxm/ST_top-1.top",
                {"by hand": raw((2245, 18.8851e-9 / (6900 - 5927)), rows=256, columns=256, turned=True)},
            ),
        ),
    ),
)


class Stated(NamedTuple):
    """A number that the header of a file states of a channel's mean, or that a person noted of the file."""

    name: str
    what: str
    value: float
    """SI, worked out by hand from what stands in the header."""
    within: float
    """Relative: how well a feedback held it, or how the header rounds."""


MEANS = (
    Stated("ibw/AR_20211011.ibw", "Amplitude", 0.74347 * 41.497e-9, 0.002),
    Stated("ibw/AutexysEFM_0000.ibw", "Amplitude", 0.3 * 109e-9, 0.002),
    Stated("ibw/tono_whiskers.ibw", "Amplitude", 1.2 * 109e-9, 0.02),
    Stated("ibw/IgorIBWReader_ImageStack_BTFO_DSO.ibw", "Deflection", 1.0 * 37.919e-9, 0.01),
    Stated("bruker/hystorian_test_nanonis.000", "AmplitudeActual", 550.0e-3, 0.001),
    Stated("nanosurf/NSFopen_MoS2.nid", "Amplitude", 0.5 * 250e-3, 0.002),
    Stated("nanosurf/NSFopen_grid1.nid", "Amplitude", 0.65 * 500.063e-3, 0.002),
    Stated("nanosurf/NSFopen_circles_holes.nid", "Amplitude", 0.61 * 580e-3, 0.01),
    Stated("nanosurf/NanoSurf_20160301.nid", "Amplitude", 0.5 * 100.253e-3, 0.01),
    Stated("jpk/TopoStats_file.jpk", "Lock-In Amplitude", 1.7387439435 * 14.877639e-9, 0.005),
    Stated(
        "jpk/AFMReader_sample_0.h5-jpk", "Lock-In Amplitude", 0.76423888 * 1.9720535 * 2.7937011e-9, 0.002
    ),
    Stated("neasnom/SnO2_NW4_hyp", "M1A", 87.076e-9, 0.002),
    Stated("nanonis/A151216.123306-02602.sxm", "Amplitude", 100e-12, 0.001),
)
FACTS = (
    Stated("ibw/AR_20211011.ibw", "stiffness", 27.952, 1e-6),
    Stated("ibw/AR_20211011.ibw", "drive_frequency", 256976.8, 1e-6),
    Stated("ibw/AR_20211011.ibw", "free_phase", 70.714 * DEGREE, 1e-4),
    Stated("ibw/AR_20211011.ibw", "free_amplitude", 33.27e-9, 1e-3),
    Stated("ibw/tono_whiskers.ibw", "free_phase", 5.2 * DEGREE, 0.01),
    Stated("ibw_curves/LRCol0_MS_LG7d0001.ibw", "stiffness", 25.36, 1e-6),
    Stated("ibw_curves/LRCol0_MS_LG7d0001.ibw", "drive_frequency", 125.46e3, 1e-6),
    Stated("bruker/hystorian_test_nanonis.000", "drive_frequency", 271731.4, 1e-6),
    Stated("bruker/hystorian_test_nanonis.000", "drive_phase", -54.5 * DEGREE, 1e-3),
    Stated("bruker/hystorian_test_nanonis.000", "drive_amplitude", 613.7e-3, 1e-4),
    Stated("bruker/ST_di-4.di", "amplitude_sensitivity", 62e-9, 1e-6),
    Stated("bruker/ST_di-4.di", "setpoint_volts", 246.9e-3, 1e-4),
    Stated("nanosurf/NSFopen_MoS2.nid", "stiffness", 48.0, 1e-6),
    Stated("nanosurf/NSFopen_MoS2.nid", "drive_frequency", 172.823e3, 1e-6),
    Stated("nanosurf/NSFopen_MoS2.nid", "deflection_sensitivity", 139.3e-9, 1e-6),
    Stated("nanosurf/NSFopen_grid1.nid", "drive_frequency", 170.147e3, 1e-6),
    Stated("neasnom/SnO2_NW4_hyp", "drive_frequency", 237595.0, 1e-6),
)


# --- what they say ----------------------------------------------------------------------------------


class Row(NamedTuple):
    """One channel of one file, as text for the page."""

    file: str
    label: str
    unit: str
    pixels: tuple[str, ...]
    agrees: str
    digits: int | None
    """Those in which the worst pixel of the worst other reader agrees, None where no other reader was asked."""


def labelled(channel: Channel) -> str:
    """Return name, direction and what was done to a channel."""
    said = {True: "flattened", False: "not flattened", None: ""}[channel.flattened]
    return ", ".join(
        part for part in (channel.name, channel.direction, "lift" if channel.nap else "", said) if part
    )


def pixels_of(values: Array) -> list[float]:
    """Return the five named pixels of a map, of the first frame of a video, or five points of a curve."""
    if values.ndim == 1:
        return [float(values[round(k * (values.size - 1) / 4)]) for k in range(5)]
    frame = values if values.ndim == 2 else values[0]
    rows, columns = frame.shape
    places = ((0, 0), (0, -1), (-1, 0), (-1, -1), (rows // 3, columns // 4))
    return [float(frame[place]) for place in places]


def shown(pixels: Sequence[float], unit: str | None) -> tuple[str, tuple[str, ...]]:
    """Return the unit that suits five values, and the values with seven digits."""
    largest = max((abs(v) for v in pixels if math.isfinite(v)), default=0.0)
    choices = UNITS.get(unit or "", ((1.0, unit or "none"),))
    factor, name = next((choice for choice in choices if largest >= choice[0]), choices[-1])
    return name, tuple(f"{v / factor:.7g}" for v in pixels)


def digits(ours: Array, theirs: Array) -> int:
    """Return how many digits of the largest value agree in the pixel that agrees least; 16 where all bits do."""
    if ours.shape != theirs.shape:
        return 0
    there = np.isfinite(ours) & np.isfinite(theirs)
    # An invalid pixel may be a number for others, never the other way round.
    if np.any(np.isfinite(ours) & ~np.isfinite(theirs)) or there.mean() < 0.999:
        return 0
    off = float(np.abs(ours - theirs)[there].max() / (np.abs(theirs[there]).max() or 1.0))
    return 16 if off == 0.0 else max(0, min(16, math.floor(-math.log10(off))))


def rows_of(root: Path, file: File, *, asked: bool = True) -> list[Row]:
    """Return what overtone reads from a file and, if the others are asked, how well they agree."""
    recording = read_channels(root / file.name)
    others = {name: read(root / file.name) for name, read in file.readers.items()} if asked else {}
    size = size_of(recording)
    for name, theirs in others.items():
        if theirs.size is not None and (
            size is None or not np.allclose(size, theirs.size, rtol=1e-6, atol=0.0)
        ):
            raise ValueError(f"{name} finds {file.name} {theirs.size} m large, not {size}")
    rows = []
    for k, channel in enumerate(recording.channels):
        agree = {}
        for name, theirs in others.items():
            if len(theirs.images) != len(recording.channels):
                raise ValueError(f"{name} has {len(theirs.images)} channels of {file.name}")
            agree[name] = digits(channel.values, theirs.images[k])
        words = [f"{name} {n}" if n < 16 else f"{name} all" for name, n in agree.items()]
        unit, pixels = shown(pixels_of(channel.values), channel.unit)
        rows.append(
            Row(
                file.name,
                labelled(channel),
                unit,
                pixels,
                ", ".join(words),
                min(agree.values(), default=None),
            )
        )
    return rows


def size_of(recording: Recording) -> tuple[float, float] | None:
    """Return width and height [m] of an image, counting whole pixels, None where it has no coordinates."""
    if not {"x", "y"} <= recording.coords.keys():
        return None
    x, y = recording.coords["x"], recording.coords["y"]
    width, height = ((values[-1] - values[0]) * values.size / (values.size - 1) for values in (x, -y))
    return float(width), float(height)


def headed(root: Path, file: File) -> str:
    """Return the sentence above the table of a file: format, pixels, size and where it comes from."""
    recording = read_channels(root / file.name)
    shape = recording.channels[0].values.shape
    words = [f"read as `{recording.format}`"]
    if recording.dims == ("point",):
        words.append(f"{shape[0]} points")
    else:
        words.append(
            f"{shape[-1]} x {shape[-2]} pixels" + (f", {shape[0]} frames" if len(shape) == 3 else "")
        )
        size = size_of(recording)
        if size is None:
            words.append("no size")
        else:
            unit, values = shown(size, "m")
            words.append(f"{values[0]} x {values[1]} {unit}")
    remark = f" {file.remark[0].upper()}{file.remark[1:]}." if file.remark else ""
    return f"{', '.join(words)}.{remark}"


def origins(root: Path) -> dict[str, str]:
    """Return where each file was published: repository, commit and path, from the notes in the folder."""
    found = {}
    text = (root / "PROVENANCE.md").read_text(encoding="utf-8")
    for part in re.split(r"^## ", text, flags=re.M)[1:]:
        name = part.splitlines()[0].split(" (")[0].strip().rstrip("/")
        source = re.search(r"^- source: (.+?) @ (\w+).*?`([^`]+)`", part, re.M)
        assert source is not None, name
        place = re.sub(r" \(.*| at commit.*", "", source[3])
        if place.endswith("/"):
            place += Path(name).name
        found[name] = f"{source[1].split(' (')[0]}, `{place}`"
    return found


def prose(text: str) -> str:
    """Return a paragraph in lines of the usual length."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def table(rows: Sequence[Row], *, curve: bool) -> list[str]:
    """Return the lines of a table of channels."""
    head = ("channel", "unit", *(ALONG if curve else CORNERS), "digits that agree")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    lines += [f"| {' | '.join((row.label, row.unit, *row.pixels, row.agrees))} |" for row in rows]
    return lines


def values_section(root: Path) -> str:
    """Return what the page says of every real file."""
    where = origins(root)
    every = [file for vendor in VENDORS for file in vendor.files]
    known = {file.name: rows_of(root, file) for file in every if file.readers}
    counted = [row for rows in known.values() for row in rows]
    least = min(row.digits for row in counted if row.digits is not None)
    lines = [
        prose(
            f"{len(every)} files of {len(VENDORS)} families, {len(counted)} channels. In every channel every pixel was "
            f"held against the readers named beside it: at least {least} digits of the largest value agree. The sizes "
            "are those of Gwyddion, gwyfile and gsffile, where they state one, too. Shown are the four corners and a "
            "pixel inside."
        ),
        "",
        prose(
            "*By hand* is plain NumPy with places and factors from the header; *tifffile* and *h5py* give raw integers "
            "and tags, the rest is arithmetic from the tags; *all* means to the last bit."
        ),
        "",
    ]
    for vendor in VENDORS:
        lines += [f"### {vendor.title}", "", prose(f"*Row 0.* {vendor.top}"), ""]
        for file in vendor.files:
            base = file.name.partition("::")[0]
            lines += [f"**{Path(file.name).name}** ({where[base]}):"]
            if file.readers:
                lines += [headed(root, file), ""]
                curve = read_channels(root / file.name).dims == ("point",)
                lines += [*table(known[file.name], curve=curve), ""]
            else:
                lines += [f"{file.remark}.", ""]
    return "\n".join(lines + stated_lines(root) + ["", *wrong_lines(root)])


def stated_lines(root: Path) -> list[str]:
    """Return the table of means that feedbacks held, against what the header says of them."""
    lines = [
        "### Absolute values, against the settings in the same file",
        "",
        "A feedback holds the amplitude at its set-point, so that a wrong unit or scale would show as a factor:",
        "",
        "| file | channel | mean | set-point by the header |",
        "|---|---|---|---|",
    ]
    for one in MEANS:
        mean = mean_of(root, one)
        unit, (read, said) = shown((mean, one.value), unit_of(root, one))
        lines.append(
            f"| {Path(one.name).name} | {one.what} | {float(read):.4g} {unit} | {float(said):.4g} {unit} |"
        )
    return lines


def mean_of(root: Path, one: Stated) -> float:
    """Return the mean of the first channel of a name over pixels that are valid."""
    channel = next(c for c in read_channels(root / one.name).channels if c.name == one.what)
    return float(np.nanmean(channel.values))


def unit_of(root: Path, one: Stated) -> str | None:
    """Return the unit of that channel."""
    return next(c.unit for c in read_channels(root / one.name).channels if c.name == one.what)


def wrong_lines(root: Path) -> list[str]:
    """Return where other readers are wrong or silent, as they are now."""
    lines = [
        "### Where the other reader is wrong",
        "",
        "| reader | file | what it says | why that is not so |",
        "|---|---|---|---|",
    ]
    lines += [f"| {' | '.join(cells)} |" for cells in wrong(root)]
    return lines


def wrong(root: Path) -> Iterable[tuple[str, str, str, str]]:
    """Yield reader, file, what it says and why it is wrong; each was seen just now."""
    import gwyddionpy
    from igor2 import binarywave
    from NSFopen.read import read as read_nid

    for name, label in (
        ("hystorian_test_nanonis.000", "AmplitudeActual"),
        ("hystorian_test_nanonis.000", "AmplitudeError"),
        ("ST_di-3.di", "AmplitudeError"),
    ):
        path = root / "bruker" / name
        (theirs,) = (c for c in gwyddionpy.load(path).channels.values() if c.name == label)
        ours = next(c for c in read_channels(path).channels if c.name == label)
        factor = float(np.abs(theirs.data).max() / np.abs(ours.values).max())
        assert theirs.si_unit_z == "V"
        assert math.isclose(factor, 1000.0, rel_tol=1e-9)
        why = "its Z scale is in mV"
        if label == "AmplitudeActual":
            why += (
                f", and the mean, {theirs.data.mean():.1f}, is the set-point of 550.0 mV (`TMSetAmplitude`)"
            )
        yield "Gwyddion", name, f"{label} in V, {factor:.0f} times too large", why
    yield (
        "Gwyddion",
        "all of Asylum",
        "the right size, one pixel more than `FastScanSize`",
        "no fault: it counts pixels, Asylum the way between their centres",
    )
    names = ", ".join(_refused_by_gwyddion(root))
    yield "Gwyddion", names, "nothing: it does not read them, or finds no image", "no fault: most hold none"
    path = root / "nanosurf" / "NanoSurf_20160301.nid"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = read_nid(str(path), verbose=False).param["Tip"]["Sensitivity"]["Value"]
        volts = read_nid(str(root / "nanosurf/NSFopen_circles_holes.nid"), verbose=False).data["Image"]
    right = read_channels(path).facts["deflection_sensitivity"].value
    assert math.isclose(said, 4.0 * right, rel_tol=1e-9)
    yield (
        "NSFopen",
        path.name,
        f"a sensitivity of {said * 1e9:.0f} nm/V",
        f"it divides by the full scale of the amplitude, 2.5 V; that of the deflection is 10 V: {right * 1e9:.0f} nm/V",
    )
    lowest = float(volts["Forward"]["Amplitude"].min())
    yield (
        "NSFopen, Gwyddion",
        "NSFopen_circles_holes.nid",
        f"{lowest:.3f} V and 6.77 um in single pixels",
        "no amplitude is below zero: the electronics stopped there, and overtone makes them NaN",
    )
    labels = binarywave.load(str(root / "ibw/DTMicroscope_scan_0001_DART.ibw"))["wave"]["labels"][2]
    assert b"Phase2Retraceace" in labels
    yield (
        "igor2",
        "DTMicroscope_scan_0001_DART.ibw",
        "`Phase2Retraceace`",
        "what stood behind the end of a label",
    )
    import gwyfile

    path = root / "gwyddion" / "GwiddionReader_chip.gwy"
    try:
        gwyfile.load(str(path))
    except AssertionError:
        yield (
            "gwyfile, gwyddionpy",
            path.name,
            "a bare AssertionError",
            "it begins GWYO, as those of Gwyddion 1 do",
        )


def _refused_by_gwyddion(root: Path) -> Iterable[str]:
    import gwyddionpy

    for vendor in VENDORS:
        for file in vendor.files:
            place = root / file.name.partition("::")[0]
            if (
                "Gwyddion" in file.readers
                or not file.readers
                or place.suffix == ".gwy"
                or "through" in vendor.title
            ):
                continue
            with contextlib.suppress(gwyddionpy.GwyddionPyError):
                assert not gwyddionpy.load(place).channels
            yield place.name


# --- damage -----------------------------------------------------------------------------------------


def harness() -> ModuleType:
    """Return the module that damages files, which belongs to the tests."""
    path = FOLDER.parent / "tests" / "io" / "damage.py"
    spec = importlib.util.spec_from_file_location("damage", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


OWN = ("own.nc", "own.zarr", "own.csv", "own.gwy")
"""Files that overtone itself writes, one of each format that it reads as well."""


def write_own(folder: Path) -> None:
    """Write a small map in every format that overtone writes and reads."""
    import overtone as ot

    random = np.random.default_rng(2)
    units = {"height": "m", "A1": "m", "phi1": "rad", "A2": "m"}
    variables = {name: (("y", "x"), random.random((20, 30)), {"units": unit}) for name, unit in units.items()}
    coords = {"y": ("y", np.arange(20.0)[::-1] * 1e-9, {"units": "m"}), "x": ("x", np.arange(30.0) * 1e-9)}
    dataset = xr.Dataset(variables, coords)
    dataset["x"].attrs["units"] = "m"
    for name in OWN:
        ot.save(dataset, folder / name)


def wanted_mutants(damage: ModuleType, root: Path, names: Sequence[str]) -> list[Any]:
    """Return every mutant of these files that the page counts."""
    counts = {"cuts": CUTS, "flips": FLIPS, "renames": RENAMES}
    return [mutant for name in names for mutant in damage.mutants(root, name, **counts)]


def real_names() -> list[str]:
    """Return the names of all real files, or of the waves in them."""
    return [file.name for vendor in VENDORS for file in vendor.files]


def damage_section(outcomes: Sequence[Any], root: Path) -> str:
    """Return what the page says of damaged files."""
    titles = {known.key: known.title for known in FORMATS}
    kinds = {name: f"{Path(name).suffix}, written by overtone" for name in OWN}
    for vendor in VENDORS:
        for file in vendor.files:
            kinds[file.name] = titles[read_channels(root / file.name).format] if file.readers else ""
    kinds["bruker/ST_di_corrupted.di"] = titles["nanoscope"]
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    slowest: dict[str, float] = defaultdict(float)
    bad, damage = sum(one.verdict == "bad" for one in outcomes), harness()
    outcomes = [one for one in outcomes if one.mutant.kind != damage.WHOLE]
    for one in outcomes:
        kind = kinds[one.mutant.source]
        counts[kind][one.verdict] += 1
        counts[kind][one.mutant.kind] += 1
        slowest[kind] = max(slowest[kind], one.seconds)
    lines = [
        prose(
            f"{len(outcomes)} damaged files, each seeded. Each file above was cut at {CUTS} places, emptied, given "
            f"{RENAMES} other endings and changed in {FLIPS} ways: single bytes and bits, numbers in texts, four-byte "
            "numbers at the ends of their range, holes, a byte lost; two of five in its header, one beside a text, one "
            "at its end, one anywhere. Of a folder each file in it was. Every reading is to end in an error of "
            "overtone's own or in a recording whose shapes, units and coordinates agree, within "
            f"{damage.SECONDS:g} s and {damage.TIMES} times the size of the file plus {damage.SLACK >> 20} MB, and "
            f"without running anything from the file: **{bad} did not**. Whole files open under any ending."
        ),
        "",
        prose(
            "Refused: with a message. Unchanged: all values, coordinates and facts are those of the whole file, as the "
            "damage met what overtone does not use. Changed: a byte of a pixel, a label or a number of the header is "
            "another one that may be. Only what is compressed or has a checksum tells: .h5-jpk, Zarr and overtone's "
            "own netCDF."
        ),
        "",
        "| format | damaged files | refused [%] | unchanged [%] | changed [%] | slowest [s] |",
        "|---|---|---|---|---|---|",
    ]
    for kind in sorted(counts):
        count = counts[kind]
        total = sum(count[verdict] for verdict in ("refused", "same", "changed", "bad"))
        shares = " | ".join(f"{100 * count[v] / total:.0f}" for v in ("refused", "same", "changed"))
        lines.append(f"| {kind} | {total} | {shares} | {slowest[kind]:.1f} |")
    return "\n".join(lines)


# --- the page ---------------------------------------------------------------------------------------


def section(text: str, name: str) -> str:
    """Return what stands between the marks of a part of the page."""
    return _marked(text, name)[1]


def _marked(text: str, name: str) -> tuple[str, str, str]:
    begin, end = f"<!-- {name}: written by docs/files.py -->\n", f"<!-- end of {name} -->\n"
    before, _, rest = text.partition(begin)
    inside, found, after = rest.partition(end)
    assert found, name
    return before + begin, inside, end + after


def write_section(name: str, content: str) -> None:
    """Put a part into the page where it has been before."""
    before, _, after = _marked(PAGE.read_text(encoding="utf-8"), name)
    PAGE.write_text(f"{before}\n{content}\n\n{after}", encoding="utf-8")


def main() -> None:
    """Write the parts of the page."""
    options = argparse.ArgumentParser(description="Write the tables of docs/files.md.")
    options.add_argument("folder", type=Path, help="where the real files lie")
    options.add_argument("--damage", action="store_true", help="damage the files as well")
    given = options.parse_args()
    write_section("values", values_section(given.folder))
    if not given.damage:
        return
    damage = harness()
    outcomes = damage.run(given.folder, wanted_mutants(damage, given.folder, real_names()))
    with TemporaryDirectory() as folder:
        write_own(Path(folder))
        outcomes += damage.run(Path(folder), wanted_mutants(damage, Path(folder), OWN))
    for one in outcomes:
        if one.verdict == "bad":
            print(tuple(one.mutant), one.why)  # noqa: T201
    write_section("damage", damage_section(outcomes, given.folder))


if __name__ == "__main__":
    main()

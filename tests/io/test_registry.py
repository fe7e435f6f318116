import os

import numpy as np
import pytest

from overtone.errors import FileFormatError
from overtone.io.registry import FORMATS, read_channels


def test_keys_are_unique():
    assert len({known.key for known in FORMATS}) == len(FORMATS)


@pytest.mark.parametrize("name", ["scan.csv", "scan", "scan.nc"])
def test_content_decides_not_the_name(tmp_path, igor_wave, name):
    path = tmp_path / name
    path.write_bytes(igor_wave(np.ones((2, 3))))
    assert read_channels(str(path)).format == "igor"


def test_table_under_another_name(tmp_path):
    path = tmp_path / "curve.ibw"
    path.write_text("z [nm], A1 [nm]\n1, 2\n")
    assert read_channels(path).format == "table"


def test_text_under_the_name_of_a_wave(tmp_path):
    path = tmp_path / "scan.ibw"
    path.write_text("This is no wave.\nIt is a letter.\n")
    with pytest.raises(FileFormatError, match=r"Igor binary wave.*'This is no wave.*its name promises Igor"):
        read_channels(path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FileFormatError, match=r"there is no file.*check the name"):
        read_channels(tmp_path / "missing.ibw")
    with pytest.raises(FileFormatError, match="check the folder"):
        read_channels(tmp_path / "nowhere" / "missing.ibw")


def test_folder_that_is_no_set(tmp_path):
    with pytest.raises(FileFormatError, match=r"is a folder.*neaSNOM"):
        read_channels(tmp_path)


def test_empty_file(tmp_path):
    (tmp_path / "empty.ibw").touch()
    with pytest.raises(FileFormatError, match="empty"):
        read_channels(tmp_path / "empty.ibw")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipe_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.ibw")
    with pytest.raises(FileFormatError, match="no ordinary file"):
        read_channels(tmp_path / "pipe.ibw")


def test_web_page_that_is_no_header(tmp_path):
    (tmp_path / "page.html").write_text("<html>hello, world</html>")
    with pytest.raises(FileFormatError, match=r"format of page.html"):
        read_channels(tmp_path / "page.html")


# --- real files -----------------------------------------------------------------------------------

REAL = {
    "ibw/AR_20211011.ibw": ("igor", "asylum"),
    "ibw/10x10-one_channel_without_name.ibw": ("igor", "igor"),
    "ibw_curves/LRCol0_MS_LG7d0001.ibw": ("igor", "asylum"),
    "ibw_byteorder/mac-version2.ibw": ("igor", "igor"),
    "ibw_byteorder/mac-version5.ibw": ("igor", "igor"),
    "igor_experiment/polar-graphs-demo.pxp::radiusData": ("igor_experiment", "igor"),
    "bruker/hystorian_test_nanonis.000": ("nanoscope", "bruker"),
    "bruker/ST_di-5.di": ("nanoscope", "bruker"),
    "bruker/nanoAFMr_kpg20080408.007": ("nanoscope", "bruker"),
    "nanosurf/NSFopen_grid1.nid": ("nanosurf", "nanosurf"),
    "nanosurf/NanoSurf_20160301.nid": ("nanosurf", "nanosurf"),
    "jpk/TopoStats_file.jpk": ("jpk", "jpk"),
    "jpk/AFMReader_sample_0.h5-jpk": ("jpk_h5", "jpk"),
    "park/Park_20210916_034.tiff": ("park", "park"),
    "park/nanoAFMr_ForceCurve_009.tiff": ("park", "park"),
    "gwyddion/GwiddionReader_chip.gsf": ("gsf", "gwyddion"),
    "gwyddion/GwiddionReader_chip.gwy": ("gwy", "gwyddion"),
    "gwyddion/PTO_110_Virgin0001.gwy": ("gwy", "asylum"),
    "nsid_h5/DTMicroscope_PMN28Pt0000.h5": ("nsid", "asylum"),
    "nanonis/A151216.123306-02602.sxm": ("gwyddion", "nanonis"),
    "ntmdt/GaAs_map.mdt": ("gwyddion", "ntmdt"),
    "agilent/ST_mi-1.mi": ("gwyddion", "agilent"),
    "wsxm/ST_top-1.top": ("gwyddion", "wsxm"),
    "neasnom/SnO2_NW4_hyp": ("neasnom", "neasnom"),
}
# Every ending that some format goes by, those of sets and stores among them, in capitals too, and none.
SUFFIXES = sorted(
    {suffix for known in FORMATS for suffix in known.suffixes} | {".txt", ".007", ".TIFF", ".H5", ""}
)


def needs_gwyddion(name):
    if REAL[name][0] == "gwyddion":
        for library in ("gwyddionpy", "gwyddionpy_converter", "gwyfile"):
            pytest.importorskip(library)


@pytest.mark.parametrize("name", REAL)
def test_every_real_file_has_its_reader(afm_data, name):
    needs_gwyddion(name)
    recording = read_channels(afm_data / name)
    assert (recording.format, recording.vendor) == REAL[name]
    # Only one format claims the content, but for a .gsf, which may be part of a set, and what is text.
    path = afm_data / name.partition("::")[0]
    head = path.read_bytes()[:4096] if path.is_file() else b""
    claims = [known.key for known in FORMATS if known.sniff(path, head)]
    assert claims[0] == REAL[name][0]
    assert set(claims[1:]) <= {"table", "netcdf"}, claims


@pytest.mark.parametrize("name", [name for name in REAL if not name.startswith("neasnom")])
def test_real_files_under_every_other_name(afm_data, tmp_path, name):
    """Which reader takes it follows from the content; some of the readers are then asked for all of it."""
    base, mark, wave = name.partition("::")
    content = (afm_data / base).read_bytes()
    for suffix in SUFFIXES:
        path = tmp_path / f"scan{suffix}"
        path.write_bytes(content)
        claim = next(known.key for known in FORMATS if known.sniff(path, content[:4096]))
        assert claim == REAL[name][0], suffix
        path.unlink()
    needs_gwyddion(name)
    whole = read_channels(f"{afm_data / base}{mark}{wave}")
    for suffix in (".h5-jpk", ".jpk", ".ibw", ".csv", ""):
        path = tmp_path / f"scan{suffix}"
        path.write_bytes(content)
        again = read_channels(f"{path}{mark}{wave}")
        assert again.facts == whole.facts
        for one, other in zip(again.channels, whole.channels, strict=True):
            assert (one.name, one.unit, one.direction) == (other.name, other.unit, other.direction)
            np.testing.assert_array_equal(one.values, other.values)


# --- formats that are known but not read ------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"II*\0\x08\0\0\0\0\0\0\0\0\0", "a TIFF picture: colours"),
        (b"MM\0*\0\0\0\x08\0\0\0\0\0\0", "a TIFF picture: colours"),
        (b"PK\x03\x04" + bytes(60), "a ZIP archive or spreadsheet"),
    ],
)
def test_formats_that_are_known_but_not_read(tmp_path, content, what):
    (tmp_path / "scan.dat").write_bytes(content)
    with pytest.raises(
        FileFormatError, match=rf"scan\.dat is not known: .*got {what}.*Try: export the channels"
    ):
        read_channels(tmp_path / "scan.dat")


def test_a_photograph_is_no_scan(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "photo.tif", np.zeros((4, 5, 3), np.uint8))
    with pytest.raises(FileFormatError, match="TIFF picture"):
        read_channels(tmp_path / "photo.tif")


@pytest.mark.parametrize(
    "suffix", [suffix for known in FORMATS for suffix in known.suffixes if suffix != ".html"]
)
def test_every_format_is_promised_by_its_endings(tmp_path, suffix):
    path = tmp_path / f"scan{suffix}"
    path.write_bytes(bytes(range(255, -1, -1)) * 20)
    titles = [known.title for known in FORMATS if suffix in known.suffixes]
    with pytest.raises(FileFormatError) as refused:
        read_channels(path)
    assert all(title in str(refused.value).rpartition("Try:")[2] for title in titles)

"""Files cut short or with wrong bytes: an overtone error or a recording, never anything else.

`damage.py` beside this file makes the mutants and reads them in processes of their own; the page docs/files.md counts
what became of all of them, and here every other one is read again.
"""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from overtone.errors import OvertoneError
from overtone.io import hdf5_guard
from overtone.io.netcdf import load, save
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

ROOT = Path(__file__).parents[2]
BRIDGED = ("nanonis/", "ntmdt/", "agilent/", "wsxm/")


def _module(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def damage() -> ModuleType:
    if not sys.platform.startswith("linux"):
        pytest.skip("memory is measured as Linux tells it")
    return _module("damage", Path(__file__).with_name("damage.py"))


@pytest.fixture(scope="module")
def page() -> ModuleType:
    return _module("files_page", ROOT / "docs" / "files.py")


# --- the systematic run -----------------------------------------------------------------------------


def told(outcomes):
    return "\n".join(f"{tuple(one.mutant)}: {one.why}" for one in outcomes if one.verdict == "bad")


def test_damaged_real_files(afm_data, damage, page):
    names = page.real_names()
    if any(importlib.util.find_spec(library) is None for library in ("gwyddionpy_converter", "gwyfile")):
        names = [name for name in names if not name.startswith(BRIDGED)]
    every = page.wanted_mutants(damage, afm_data, names)
    mutants = [one for one in every if one.kind != damage.WHOLE][::2]
    mutants += [one for one in every if one.kind == damage.WHOLE]
    assert len(mutants) >= 1500
    outcomes = damage.run(afm_data, mutants)
    assert [one.mutant for one in outcomes] == mutants
    assert not told(outcomes)
    assert {one.verdict for one in outcomes} == {"refused", "same", "changed"}
    for one in outcomes:
        if one.mutant.kind == "empty":
            assert one.verdict == "refused"
        if one.mutant.kind == damage.WHOLE:  # nothing of the damage stays behind
            assert (one.verdict == "refused") == ("corrupted" in one.mutant.source)
    # Data that were cut off are never made up: what is left is all there or refused, but for texts without an end.
    opened = {
        one.mutant.file[-5:] for one in outcomes if (one.mutant.kind, one.verdict) == ("cut", "changed")
    }
    assert opened <= {".html"}


def test_damaged_files_that_overtone_wrote(tmp_path, damage, page):
    pytest.importorskip("zarr")
    page.write_own(tmp_path)
    outcomes = damage.run(tmp_path, page.wanted_mutants(damage, tmp_path, page.OWN))
    assert len(outcomes) > 300
    assert not told(outcomes)
    changed = [one.mutant.source for one in outcomes if one.verdict == "changed"]
    assert "own.nc" not in changed  # it has a checksum
    for one in outcomes:
        if one.mutant.kind == damage.WHOLE:
            assert one.verdict == "same", one
        if one.mutant.kind == "cut":
            assert one.verdict in ("refused", "same"), one


def test_mutants_come_out_again(damage):
    content = b"\\*File list\r\n\\Data offset: 8192\r\n" + bytes(range(256)) * 40
    for kind in ("cut", "flip", "empty", "rename"):
        some = [damage.Mutant("a.spm", "", kind, number, 20) for number in range(20)]
        first, again = ([damage.damaged(content, mutant) for mutant in some] for _ in range(2))
        assert first == again
        if kind == "cut":
            assert all(content.startswith(one) and len(one) < len(content) for one in first)
            assert len({len(one) for one in first}) == 20
        if kind == "flip":
            assert sum(one != content for one in first) >= 18
            assert {len(one) - len(content) for one in first} >= {0, -1}
    assert damage.damaged(content, damage.Mutant("a.spm", "", "empty", 0, 1)) == b""


# What a reader might do wrong, and what the harness has to say of it.
WRONG = {
    "eval('1 + 1')": "ran ['exec of <string>']",
    "exec('a = 1')": "ran ['exec of <string>']",
    "pickle.loads(pickle.dumps([1]))": "ran ['pickle.loads']",
    "os.system('true')": "ran ['os.system']",
    "subprocess.run(['true'])": "subprocess ['true']",
    "open('/var/overtone-was-here', 'w')": "ran ['writing of /var",
    "{}['missing']": "KeyError",
    "np.ones(60_000_000)": "MemoryError",
    "recording(np.ones((2, 3)), np.ones((2, 2)))": "shapes",
    "recording(np.ones((2, 3)), unit='parsec/V')": "unit 'parsec/V'",
    "recording(np.ones((2, 3)), x=np.array([0.0, np.nan, 1.0]))": "coordinate x",
    "recording(np.ones((2, 3)), x=np.arange(2.0))": "coordinate x",
    "recording(np.ones((2, 3)), stiffness=math.inf)": "fact stiffness",
    "recording()": "no channels",
    "None": "instead of a recording",
}


def test_the_harness_sees_what_readers_might_do_wrong(damage, tmp_path):
    # The code of each has a name of a file, as that of a reader has.
    script = f"""
__file__ = {str(Path(__file__))!r}
import importlib.util, math, os, pickle, subprocess, sys, pathlib, types
import numpy as np
spec = importlib.util.spec_from_file_location("damage", {damage.__file__!r})
damage = importlib.util.module_from_spec(spec)
sys.modules["damage"] = damage
spec.loader.exec_module(damage)
from overtone.io import registry
from overtone.io.recording import Channel, Fact, Recording
damage.SLACK, damage.TIMES = 200_000_000, 0

def recording(*values, unit="m", x=None, stiffness=1.0):
    channels = tuple(Channel("A", v, unit) for v in values)
    coords = {{}} if x is None else {{"x": x}}
    facts = {{"stiffness": Fact(stiffness, "N/m", "k")}}
    return Recording(pathlib.Path("a"), "igor", "igor", ("y", "x"), coords, channels, facts)

worker = damage._Worker(pathlib.Path("."))
for source in [*{list(WRONG)!r}, "recording(np.ones((2, 3)) * np.ones(20_000_000)[0])"]:
    code = compile(source, __file__, "eval")
    registry.read_channels = lambda path, run=types.FunctionType(code, globals()): run()
    verdict, why, seconds, memory = worker.read("a", 100)
    print(verdict, "|", why.replace("\\n", " "), "|", memory)
"""
    answer = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=120
    )
    assert answer.returncode == 0, answer.stderr
    lines = answer.stdout.splitlines()
    assert len(lines) == len(WRONG) + 1
    for line, (source, expected) in zip(lines, WRONG.items(), strict=False):
        assert line.startswith("bad |"), (source, line)
        assert expected in line, (source, line)
    assert lines[-1].startswith("opened |")
    assert 150e6 < float(lines[-1].split("|")[-1]) < 170e6
    assert not Path("/var/overtone-was-here").exists()


def test_a_reader_that_does_not_end_is_killed_and_told(damage, tmp_path, igor_wave, monkeypatch):
    (tmp_path / "a.ibw").write_bytes(igor_wave(np.ones((3, 2))))
    mutant = damage.Mutant("a.ibw", "", "flip", 0, 1)
    process = damage._Process(tmp_path)
    try:
        monkeypatch.setattr(damage, "PATIENCE", 0.0)
        assert (process.ask(mutant).verdict, process.ask(mutant).why) == ("bad", "does not end")
        monkeypatch.setattr(damage, "PATIENCE", 60.0)
        assert process.ask(mutant).verdict in ("same", "changed")
        process.process.kill()
        process.process.wait()
        assert process.ask(mutant).why == "ended the process"
    finally:
        process.close()


# --- every place of small files ---------------------------------------------------------------------


def survives(path):
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        recording = str(error)
    if isinstance(recording, str):
        assert len(recording) < 1500
        return False
    assert isinstance(recording, Recording)
    shapes = {channel.values.shape for channel in recording.channels}
    assert len(shapes) == 1
    assert len(shapes.pop()) == len(recording.dims)
    return True


@pytest.mark.parametrize("order", ["<", ">"])
def test_every_number_in_the_header_of_a_wave(tmp_path, igor_wave, order):
    note = "SpringConstant: 1\rDriveFrequency: 1e5\rThermalQ: 20\rThermalFrequency: 75000\rFlattenOrder 0: 1"
    labels = [(), (), ("HeightTrace", "PhaseTrace")]
    content = igor_wave(np.ones((4, 3, 2)), order=order, note=note, labels=labels)
    path = tmp_path / "flipped.ibw"
    for at in range(0, 384, 2):
        for value in (b"\xff\xff", b"\x7f\xff", b"\0\0"):
            path.write_bytes(content[:at] + value + content[at + 2 :])
            survives(path)
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        assert not survives(path)


def test_checksum_of_netcdf(tmp_path):
    path = tmp_path / "whole.nc"
    values = np.random.default_rng(2).random((20, 30))
    variables = {name: (("y", "x"), values, {"units": "m"}) for name in ("A0", "A1", "A2")}
    save(xr.Dataset(variables, {"y": np.arange(20.0), "x": np.arange(30.0)}, {"history": "[]"}), path)
    content = path.read_bytes()
    random = np.random.default_rng(7)
    for _ in range(50):
        changed = bytearray(content)
        changed[random.integers(8, len(content) - 60)] ^= 1 << random.integers(0, 8)
        path.write_bytes(bytes(changed))
        with pytest.raises(OvertoneError, match="damaged"):
            load(path)
    path.write_bytes(content[:4000])
    with pytest.raises(OvertoneError, match="as its header says, got 4000"):
        load(path)


def test_netcdf_that_another_program_changed_opens(tmp_path):
    import h5py

    path = tmp_path / "a.nc"
    save(xr.Dataset({"A1": ("point", [1.0, 2.0], {"units": "m"})}), path)
    with h5py.File(path, "a") as file:
        file.attrs["remark"] = "checked"
        file["A1"][0] = 3.0
    assert load(path).attrs["remark"] == "checked"
    assert load(path)["A1"].values.tolist() == [3.0, 2.0]


def test_netcdf_of_others_that_hdf5_never_returns_from(tmp_path, monkeypatch):
    path = tmp_path / "foreign.nc"
    labels = ("y", [f"row {k}" for k in range(20)])
    dataset = xr.Dataset({"A1": (("y", "x"), np.ones((20, 30)), {"units": "m"})}, {"label": labels})
    dataset.to_netcdf(path, engine="h5netcdf")
    assert survives(path)
    content = path.read_bytes()
    # A text where those of any length lie, without its length of eight bytes.
    text = content.index(b"row 10\0", content.index(b"GCOL"))
    path.write_bytes(content[: text - 8] + bytes(20) + content[text + 12 :])
    monkeypatch.setattr(hdf5_guard, "_SECONDS", 0.5)
    for read in (read_channels, load):
        with pytest.raises(OvertoneError, match=r"foreign\.nc is damaged.*no answer from the library"):
            read(path)


def test_jpk_with_texts_of_any_length_is_tried_in_another_process(afm_data, tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    tried = []
    monkeypatch.setattr(hdf5_guard, "check", lambda path, function: tried.append(function))
    path = tmp_path / "scan.h5-jpk"
    path.write_bytes((afm_data / "jpk/AFMReader_sample_0.h5-jpk").read_bytes())
    read_channels(path)
    assert tried == []
    with h5py.File(path, "a") as file:
        file.attrs["remark"] = "changed by somebody"
    read_channels(path)
    assert tried == ["overtone.io.jpk_h5:_unguarded"]


def test_every_length_of_a_table(tmp_path):
    rows = "".join(f"{i % 5},{i // 5},{i / 7:.6f},{i}\n" for i in range(25))
    content = ("# made: here\nx [nm],y [nm],A1 [nm],phi1 [deg]\n" + rows).encode()
    path = tmp_path / "table.csv"
    for length in range(0, len(content), 5):
        path.write_bytes(content[:length])
        survives(path)
    for at in range(len(content)):
        path.write_bytes(content[:at] + b"\xff" + content[at + 1 :])
        survives(path)


MAGIC = st.sampled_from(
    [
        b"\x05\x00",
        b"\x00\x05",
        b"\x02\x00",
        b"\x00\x03",
        b"\x01\x00",
        b"\x0b\x00\x00\x00\x34\x00\x00\x00",
        b"Gwyddion Simple Field 1.0\nXRes=2\nYRes=2\n",
        b"GWYPGwyContainer\x00",
        b"GWYOGwyContainer\x00",
        b"\\*File list\r\n\\Data length: 40\r\n\\*Ciao image list\r\n",
        b"[DataSet]\r\nVersion=2\r\nGroupCount=1\r\nGr0-Name=Scan forward\r\n#!",
        b"II*\0\x08\0\0\0",
        b"MM\0*\0\0\0\x08",
        b"PK\x03\x04",
        b"\x89HDF\r\n\x1a\n",
        b"CDF\x01",
        b"<html>Tip Frequency",
        b"a [nm],b [nm]\n1,2\n",
        b"\xff\xfe",
        b"",
    ]
)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    magic=MAGIC,
    rest=st.binary(max_size=600),
    suffix=st.sampled_from([".ibw", ".gsf", ".csv", ".html", ".nc", ".spm", ".nid", ".jpk", ".gwy", ""]),
)
def test_anything_behind_a_familiar_beginning(magic, rest, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"any{suffix}"
        path.write_bytes(magic + rest)
        survives(path)

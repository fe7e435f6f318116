import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from overtone.errors import OvertoneError
from overtone.io.registry import read_channels


def _cell(text: str) -> bytes:
    # As Igor leaves them: whatever was in memory stands behind the zero.
    return (text.encode("latin-1") + b"\0" + b"junk" * 8)[:32]


def _wave(
    values: np.ndarray,
    *,
    note: str = "",
    labels: Sequence[Sequence[str]] = (),
    steps: Sequence[float] = (1e-9, 1e-9, 1.0, 1.0),
    unit: str = "",
    axis_units: Sequence[str] = ("m", "m", "", ""),
    order: str = "<",
    kind: int = 4,
) -> bytes:
    """An Igor binary wave of version 5, after Igor's technical note 3."""
    dims = [*values.shape, *[0] * (4 - values.ndim)]
    item = {2: "f4", 4: "f8", 0x10: "i2", 0: "S1", 5: "c16"}[kind]
    data = values.astype(order + item if item[0] != "S" else item).tobytes(order="F")
    text = note.encode("latin-1")
    cells = [
        b"".join(map(_cell, ["", *names])) if names else b"" for names in [*labels, *[()] * (4 - len(labels))]
    ]
    sizes = [320 + len(data), 0, len(text), 0, *[0] * 4, *map(len, cells), 0, 0, 0]
    header = struct.pack(order + "hh15i", 5, 0, *sizes)
    wave = struct.pack(
        order + "iIIihh6sh32siI4i4d4d",
        0,
        0,
        0,
        values.size,
        kind,
        0,
        b"",
        1,
        b"w",
        0,
        0,
        *dims,
        *steps,
        0,
        0,
        0,
        0,
    )
    wave += unit.encode().ljust(4, b"\0") + b"".join(name.encode().ljust(4, b"\0") for name in axis_units)
    return header + wave.ljust(320, b"\0") + data + text + b"".join(cells)


@pytest.fixture(scope="session")
def igor_wave() -> Callable[..., bytes]:
    return _wave


def _field(values: np.ndarray, **header: object) -> bytes:
    """A Gwyddion Simple Field."""
    entries = {"XRes": values.shape[1], "YRes": values.shape[0], **header}
    text = "Gwyddion Simple Field 1.0\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
    start = text.encode()
    return start + b"\0" * (4 - len(start) % 4) + values.astype("<f4").tobytes()


@pytest.fixture(scope="session")
def gwyddion_field() -> Callable[..., bytes]:
    return _field


NANOSCOPE_SCANNER = {"@Sens. Zsens": "V 20.00000 nm/V"}
NANOSCOPE_SCAN = {
    "Scan Size": "1000 nm",
    "@MicroscopeList": 'S [TMMode] "Tapping"',
    "@Sens. AmplSens": "V 50.00000 nm/V",
    "@Sens. Amplitude": "V 1.000000 ",
    "@Sens. Amplitude Error": "V 1.000000 ",
    "@Sens. Phase": "V 1.000000 ",
    "@2:TMSetAmplitude": "V [Sens. AmplSens] (0.06 mV/LSB) 400.0000 mV",
    "@3:TMSetAmplitude": "V [Sens. AmplSens] (0.06 mV/LSB) 0 mV",
    "@2:CantFrequency": "V (0.0000116415 kHz/LSB) 300.0000 kHz",
    "@2:CantDrive": "V (0.3051758 mV/LSB) 120.0000 mV",
    "@2:CantPhase": "V (0.005493164 \xba/LSB) 45.00000 \xba",
}
NANOSCOPE_SCALES = {
    "Height": "[Sens. Zsens] (0.001525879 V/LSB) 100.0000 V",
    "AmplitudeActual": "[Sens. Amplitude] (0.06103516 mV/LSB) 4000.000 mV",
    "AmplitudeError": "[Sens. Amplitude Error] (0.03051758 mV/LSB) 2000.000 mV",
    "Phase": "[Sens. Phase] (0.005493164 \xba/LSB) 360.0000 \xba",
}


def _nanoscope(
    *images: tuple[str, np.ndarray],
    own: Sequence[dict[str, str | None]] = (),
    scan: dict[str, str | None] | None = None,
    scanner: dict[str, str | None] | None = None,
    first: str = "File list",
    sections: Sequence[str] = (),
    start: int = 8192,
) -> bytes:
    """A NanoScope file of images (name, counts in the order of the file); a dictionary replaces lines of a list."""

    def entry(entries: dict[str, str | None]) -> list[str]:
        return [f"{key}: {text}" for key, text in entries.items() if text is not None]

    lines = [f"*{first}", "Version: 0x09010201", f"Data length: {start}"]
    lines += ["*Scanner list", *entry(NANOSCOPE_SCANNER | (scanner or {}))]
    lines += ["*Ciao scan list", *entry(NANOSCOPE_SCAN | (scan or {}))]
    data = b""
    for index, (name, counts) in enumerate(images):
        raw = counts.astype(counts.dtype.newbyteorder("<")).tobytes()
        entries: dict[str, str | None] = {
            "Data offset": str(start + len(data)),
            "Data length": str(len(raw)),
            "Bytes/pixel": str(counts.dtype.itemsize),
            "Samps/line": str(counts.shape[1]),
            "Number of lines": str(counts.shape[0]),
            "Aspect Ratio": "1:1",
            "Scan Size": "1 1 ~m",
            "Scan Line": "Main",
            "Line Direction": "Retrace",
            "Realtime Planefit": "None",
            "Offline Planefit": "None",
            "@2:Image Data": f'S [{name}] "{name} label"',
            "@2:Z scale": f"V {NANOSCOPE_SCALES.get(name, NANOSCOPE_SCALES['Height'])}",
        } | (own[index] if index < len(own) else {})
        lines += ["*Ciao image list", *entry(entries)]
        data += raw
    lines += [*sections, "*File list end"]
    text = "".join(f"\\{line}\r\n" for line in lines).encode("latin-1") + b"\x1a"
    assert len(text) <= start
    return text.ljust(start, b"\0") + data


@pytest.fixture(scope="session")
def nanoscope_file() -> Callable[..., bytes]:
    return _nanoscope


def _survives(path: Path, content: bytes) -> bool:
    """Whether bytes are read, soon and of one shape; else they are refused in so many words."""
    path.write_bytes(content)
    began = time.perf_counter()
    try:
        recording, message = read_channels(path), ""
    except OvertoneError as error:
        recording, message = None, str(error)
    assert time.perf_counter() - began < 5.0
    if recording is None:
        assert len(message) < 1000
        return False
    assert len({c.values.shape for c in recording.channels}) == 1
    return True


@pytest.fixture(scope="session")
def survives() -> Callable[[Path, bytes], bool]:
    return _survives

import struct
from collections.abc import Callable, Sequence

import numpy as np
import pytest


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

from pathlib import Path

import numpy as np

from overtone.io.recording import Channel, Recording
from overtone.io.selection import Request, choose


def test_a_second_pass_is_found_under_plain_names_as_well() -> None:
    """Nanosurf calls the channels of its second scan as those of the first, Asylum and Bruker prefix them."""
    plain = [
        Channel(name, np.full((2, 2), value), unit, "trace", nap=nap)
        for nap, value in ((False, 1.0), (True, 2.0))
        for name, unit in (("Amplitude", "m"), ("Phase", "rad"))
    ]
    for vendor, channels in (
        ("nanosurf", plain),
        (
            "asylum",
            [Channel(f"Nap{c.name}" if c.nap else c.name, c.values, c.unit, nap=c.nap) for c in plain],
        ),
    ):
        scan = Recording(Path("a"), "x", vendor, ("y", "x"), {}, tuple(channels))
        for lift, value in ((False, 1.0), (True, 2.0)):
            chosen = choose(scan, Request(lift=lift))
            assert set(chosen) == {"A1", "phi1"}
            assert {float(c.values[0, 0]) for c in chosen.values()} == {value}
            assert all(c.nap == lift for c in chosen.values())

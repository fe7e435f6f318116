"""What each vendor calls its modes, and what channels give away."""

from pathlib import Path

import numpy as np
import pytest

from overtone.io.imaging_mode import imaging_mode
from overtone.io.recording import Channel, Recording


def recording(metadata: dict[str, str], *channels: Channel) -> Recording:
    return Recording(Path("a"), "x", "x", ("y", "x"), {}, channels, metadata=metadata)


def channel(name: str, unit: str, *values: float) -> Channel:
    return Channel(name, np.array([values or (1.0, 2.0)]), unit)


@pytest.mark.parametrize(
    ("key", "text", "title", "tapping"),
    [
        ("ImagingMode", "AC Mode", "AC Mode", True),
        ("ImagingMode", "PFM Mode", "PFM Mode", False),
        ("ImagingMode", "Contact", "Contact", False),
        ("@MicroscopeList", 'S [TMMode] "Tapping"', "Tapping", True),
        ("@MicroscopeList", 'S [ContactMode] "Contact"', "Contact", False),
        ("@MicroscopeList", 'S [SoftHarmoniXAutoPilot] "ScanAsyst"', "ScanAsyst", False),
        ("@MicroscopeList", 'S [HarmoniX] "PeakForce Tapping"', "PeakForce Tapping", False),
        ("Op. mode", "Phase Contrast", "Phase Contrast", True),
        ("Op. mode", "Static Force", "Static Force", False),
        ("headMode", "NCM", "NCM", True),
        ("headMode", "Contact", "Contact", False),
        ("feedback-mode.name", "ac", "ac", True),
        ("feedback-mode.name", "contact", "contact", False),
        ("feedback mode (tag 32816)", "ac-ultra-speed-direct-drive", "ac-ultra-speed-direct-drive", True),
        ("mode", "Contact AFM", "Contact AFM", False),
        ("mode", "AC AFM", "AC AFM", True),
    ],
)
def test_what_files_say(key: str, text: str, title: str, tapping: bool) -> None:
    mode = imaging_mode(recording({key: text}))
    assert mode is not None
    assert (mode.title, mode.tapping, mode.key) == (title, tapping, key)
    assert mode.sentence() == f"the file says {title} ({key})"


@pytest.mark.parametrize(
    "metadata",
    [{}, {"Op. mode": "something new"}, {"mode": "fast"}, {"headMode": "?"}, {"@MicroscopeList": "broken"}],
)
def test_what_nobody_knows_says_nothing(metadata: dict[str, str]) -> None:
    assert imaging_mode(recording(metadata)) is None


def test_channels_count_more_than_words() -> None:
    peak_force = imaging_mode(
        recording({"@MicroscopeList": 'S [TMMode] "Tapping"'}, channel("PeakForceError", "V"))
    )
    assert peak_force is not None
    assert not peak_force.tapping
    modulated = imaging_mode(recording({}, channel("Frequency_Shift", "Hz"), channel("Excitation", "V")))
    assert modulated is not None
    assert modulated.sentence().startswith("it has the channels of frequency modulation")


def test_a_drive_that_moves_is_no_tapping_at_one_frequency() -> None:
    note = {"ImagingMode": "AC Mode"}
    moved = imaging_mode(recording(note, channel("Frequency", "Hz", 300e3, 301e3)))
    assert moved is not None
    assert not moved.tapping
    still = imaging_mode(recording(note, channel("Frequency", "Hz", 300e3, 300e3)))
    assert still is not None
    assert still.tapping

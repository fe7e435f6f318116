"""The mode in which a file says it was recorded: overtone reads tapping, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from overtone.io.recording import Recording

_QUOTED = re.compile(r'S \[(\w*)\] "([^"]*)"')
_BRUKER_TAPPING = "TMMode"
# What the vendors' software calls the modes in which the tip taps at a fixed drive, and those in which it does not.
# A mode that is in neither list says nothing.
_NANOSURF = {
    "dynamic force": True,
    "phase contrast": True,
    "static force": False,
    "spreading resistance": False,
    "lateral force": False,
    "force modulation": False,
}
_PARK = {"ncm": True, "tapping": True, "contact": False, "c-afm": False, "lfm": False, "fmm": False}
_STEADY = 1e-4  # share of itself by which a drive frequency may vary that nobody varied


@dataclass(frozen=True)
class Mode:
    """The mode of a recording.

    Parameters
    ----------
    title : str
        What the file calls it.
    tapping : bool
        Whether the tip taps, at a drive of one frequency and one size.
    key : str
        Where the file says so, or the channels that show it.
    stated : bool
        Whether the file states it in words.
    """

    title: str
    tapping: bool
    key: str
    stated: bool = True

    def sentence(self) -> str:
        """Return where the mode is known from, as a clause."""
        if self.stated:
            return f"the file says {self.title} ({self.key})"
        return f"it has the channels of {self.title} ({self.key})"


def imaging_mode(recording: Recording) -> Mode | None:
    """Return the mode that a file states or its channels show, None where neither tells.

    Parameters
    ----------
    recording : Recording
        What a reader returned.

    Examples
    --------
    >>> from pathlib import Path
    >>> scan = Recording(Path("a.ibw"), "igor", "asylum", ("y", "x"), {}, (), metadata={"ImagingMode": "PFM Mode"})
    >>> imaging_mode(scan).tapping
    False
    """
    stated = _stated({key.lower(): (key, text) for key, text in recording.metadata.items()})
    return _shown(recording, stated) or stated


def _stated(entries: Mapping[str, tuple[str, str]]) -> Mode | None:
    key, text = entries.get("imagingmode", ("", ""))
    if text:
        return Mode(text, text == "AC Mode", key)
    key, text = entries.get("@microscopelist", ("", ""))
    quoted = _QUOTED.search(text)
    if quoted:
        # "PeakForce Tapping" taps as well, but far below the resonance: there are no harmonics of a drive in it.
        return Mode(quoted[2], quoted[1] == _BRUKER_TAPPING or quoted[2] == "Tapping", key)
    for known, name in ((_NANOSURF, "op. mode"), (_PARK, "headmode")):
        key, text = entries.get(name, ("", ""))
        if text.lower() in known:
            return Mode(text, known[text.lower()], key)
    for name in ("feedback-mode.name", "feedback mode (tag 32816)"):  # JPK
        key, text = entries.get(name, ("", ""))
        if text:
            return Mode(text, text.lower().startswith("ac"), key)
    key, text = entries.get("mode", ("", ""))  # Agilent
    if text.endswith("AFM"):
        return Mode(text, text.startswith("AC"), key)
    return None


def _shown(recording: Recording, stated: Mode | None) -> Mode | None:
    """Return what channels give away that the tapping mode does not have."""
    names = {channel.name for channel in recording.channels}
    if "PeakForceError" in names:
        return Mode("PeakForce tapping", False, "PeakForceError", stated=False)
    if {"Frequency_Shift", "Excitation"} <= names:
        return Mode(
            "frequency modulation, which holds the amplitude",
            False,
            "Frequency_Shift and Excitation",
            stated=False,
        )
    if stated is not None and not stated.tapping:
        return None
    for channel in recording.channels:
        if channel.name == "Frequency" and channel.unit == "Hz":
            values = channel.values[np.isfinite(channel.values)]
            if values.size and float(np.ptp(values)) > _STEADY * abs(float(values.mean())):
                return Mode("a drive whose frequency was changed", False, "Frequency", stated=False)
    return None

"""How each vendor names its channels and what its phase means."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from overtone.io.recording import Channel, Recording
from overtone.quantities import LIFT

"""Begins the names of overtone's own variables of a lift pass."""
_NAP = "Nap"
_SAME_FREQUENCY = 1e-6
_FIRST_LOCK_IN = ("height", "A0", "A1", "phi1")


@dataclass(frozen=True)
class Vendor:
    """Naming and phase convention of a vendor's files.

    Parameters
    ----------
    key, title : str
        Key as in `Recording.vendor`, and in words.
    aliases : mapping of str to tuple of str
        Observable to channel names, the preferred one first.
    phase_known : bool
        Whether the stored phase is a lag whose zero the vendor's software sets (90 degrees at the tuned
        resonance). Where False the reading far from the surface has to be given.
    phase_note : str
        The convention in words.
    optical_lever : bool
        Whether the deflection is read by an optical lever, which sees slope.
    """

    key: str
    title: str
    aliases: Mapping[str, tuple[str, ...]]
    phase_known: bool
    phase_note: str
    optical_lever: bool = False


_HARMONIC = re.compile(r"(A|phi)\d+|height")
_NEASNOM = {"height": ("Z",)} | {
    name: (channel,)
    for n in range(6)
    for name, channel in ((f"A{n}", f"M{n}A"), (f"phi{n}", f"M{n}P"))
    if name != "phi0"
}
_VENDORS = (
    Vendor(
        "asylum",
        "Asylum Research",
        {
            "height": ("ZSensor", "Height", "ZSnsr"),
            "A0": ("Deflection", "Defl"),
            "A1": ("Amplitude", "Amplitude1", "Amp"),
            "phi1": ("Phase", "Phase1"),
            "A2": ("Amplitude2", "Amp2"),
            "phi2": ("Phase2", "Phas2"),
        }
        # Asylum has two lock-ins; what overtone writes as .ibw goes on in the same manner.
        | {
            name: (f"{long}{n}", f"{short}{n}")
            for n in range(3, 10)
            for name, long, short in ((f"A{n}", "Amplitude", "Amp"), (f"phi{n}", "Phase", "Phas"))
        },
        phase_known=True,
        phase_note="Asylum stores a phase lag, 90 deg at the resonance of the last tune",
        optical_lever=True,
    ),
    Vendor(
        "nanosurf",
        "Nanosurf",
        {
            "height": ("Z-Axis Sensor", "Z-Axis", "Topography"),
            "A0": ("Deflection",),
            "A1": ("Amplitude",),
            "phi1": ("Phase",),
        },
        phase_known=False,
        phase_note="Nanosurf counts phases from a reference phase that the tuning or the operator sets",
        optical_lever=True,
    ),
    Vendor(
        "bruker",
        "Bruker NanoScope",
        {
            "height": ("ZSensor", "Height"),
            "A0": ("TMDeflection", "Deflection"),
            "A1": ("AmplitudeActual", "Amplitude", "Amplitude1", "AmplitudeError"),
            "phi1": ("Phase",),
        },
        phase_known=False,
        phase_note="Bruker's phase counts from a zero (CantPhase) that the operator or a tune sets, near 0 deg for a "
        "free lever at resonance; the file does not say whether it still holds, nor whether the phase is a lag",
        optical_lever=True,
    ),
    Vendor(
        "jpk",
        "JPK (Bruker NanoWizard)",
        {
            "height": ("Height (measured)", "Height"),
            "A0": ("Vertical Deflection",),
            "A1": ("Lock-In Amplitude",),
            "phi1": ("Lock-In Phase",),
        },
        phase_known=False,
        phase_note="JPK's phase counts from a shift of the lock-in that the operator or a tune sets",
        optical_lever=True,
    ),
    Vendor(
        "park",
        "Park Systems",
        {
            # Lock-In2, Lock-In3 and so on are left out: no file says what they listen to.
            "height": ("Z Detector", "Z Height", "Topography"),
            "A1": ("NCM Amplitude",),
            "phi1": ("NCM Phase",),
        },
        phase_known=False,
        phase_note="the zero and the sign of Park's phases are not in the file",
        optical_lever=True,
    ),
    Vendor(
        "agilent",
        "Agilent or Keysight",
        {"height": ("Topography",), "A0": ("Deflection",), "A1": ("Amplitude",), "phi1": ("Phase",)},
        phase_known=False,
        phase_note="the zero of PicoView's phases is set by hand",
        optical_lever=True,
    ),
    Vendor(
        "nanonis",
        "SPECS Nanonis",
        {"height": ("Z",), "A1": ("Amplitude",), "phi1": ("Phase",)},
        phase_known=False,
        phase_note="Nanonis counts phases from the reference phase of its PLL or lock-in, set by hand",
    ),
    Vendor(
        "wsxm",
        "Nanotec WSxM",
        {"height": ("Topography",), "A0": ("Normal force",), "A1": ("Amplitude",), "phi1": ("Phase",)},
        phase_known=False,
        phase_note="the zero of Nanotec's phases is set by hand",
        optical_lever=True,
    ),
    Vendor(
        "neasnom",
        "neaspec neaSNOM",
        _NEASNOM,
        phase_known=False,
        phase_note="the zero and the sign of neaSNOM phases are arbitrary",
        optical_lever=True,
    ),
    Vendor(
        "overtone",
        "overtone",
        {},
        phase_known=True,
        phase_note="phases are lags referred to the free lever, as overtone writes them",
    ),
)
_UNKNOWN = Vendor(
    "unknown",
    "unknown",
    {},
    phase_known=False,
    phase_note="the convention of this file's phases is not known",
)
_BY_KEY = {vendor.key: vendor for vendor in _VENDORS}


def vendor_of(recording: Recording) -> Vendor:
    """Return the preset of a recording; one without any aliases where the vendor is not known."""
    return _BY_KEY.get(recording.vendor, _UNKNOWN)


def candidates(recording: Recording, observable: str, *, lift: bool = False) -> tuple[str, ...]:
    """Return the channel names that may hold an observable, the preferred one first.

    Every vendor's file may also name a channel by the observable itself. Lock-ins beyond the first count as
    higher harmonics only where the second one listens at exactly twice the drive: in dual-tone modes it does not.
    With ``lift`` they are the names that the same channels have in a Nap or Lift pass: some vendors prefix them,
    some do not.
    """
    names = vendor_of(recording).aliases.get(observable, ())
    if recording.vendor == "asylum" and observable not in _FIRST_LOCK_IN:
        drive, second = (recording.facts.get(k) for k in ("drive_frequency", "second_lockin_frequency"))
        if drive is None or second is None or abs(second.value / drive.value - 2.0) > _SAME_FREQUENCY:
            names = ()
    if lift:
        return (LIFT + observable, *(f"{_NAP}{name}" for name in names), *names)
    return (observable, *names) if _HARMONIC.fullmatch(observable) else names


def main_channels(recording: Recording) -> tuple[Channel, ...]:
    """Return the channels of the main pass: Nap and Lift passes calibrate, they never mix with it."""
    return tuple(channel for channel in recording.channels if not channel.nap)


def lift_channels(recording: Recording) -> tuple[Channel, ...]:
    """Return the channels of the Nap or Lift pass, none where the file has no such pass."""
    return tuple(channel for channel in recording.channels if channel.nap)

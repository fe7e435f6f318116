"""What Asylum's software writes about a scan: its note of settings and its channel labels.

The note stands behind the data of an .ibw, in the metadata of a .gwy and among the attributes of NSID files. A key
may come twice: once with the value at the start of the scan, and again with the value and the line at which somebody
changed it, or from another panel. The first one counts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

from overtone.io.recording import Fact, Resonance

_KEYS = ("springconstant", "thermalq", "imagingmode", "invols")
_LONGEST_NUMBER = 100

# What Asylum's software writes where nobody has calibrated.
_DEFAULT_STIFFNESS = 1.0
_DEFAULT_INVOLS = 1e-7
_DEFAULT_AMP_INVOLS = 1.09e-7
_DEFAULT_AMP2_INVOLS = 2e-8
_DEFAULT_THERMAL_Q = 20.0
_DEFAULT_THERMAL_FREQUENCY = 75000.0
# Found as the tune of levers that were never tuned, and as the second tune of several instruments.
_DEFAULT_TUNE_Q = 158.91

_LENGTHS = ("height", "zsensor", "zsnsr", "deflection", "defl", "amplitude", "amp", "raw", "lvdt")
_ANGLES = ("phase", "phas")
_FREQUENCIES = ("frequency", "freq")
_DIRECTION = re.compile(r"(.+?)(Retrace|Trace)(.*)")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:@.*)?")


# --- the note -------------------------------------------------------------------------------------


def lines_of(note: str) -> list[tuple[str, str]]:
    """Return every line of a note as key and value, also where a key comes twice."""
    pairs = (line.partition(":") for line in re.split(r"[\r\n]+", note))
    return [(key.strip(), value.strip()) for key, colon, value in pairs if colon and key.strip()]


def entries_of(note: str) -> dict[str, str]:
    """Return the settings of a note by key, each with its first value."""
    entries: dict[str, str] = {}
    taken: set[str] = set()
    for key, value in lines_of(note):
        if key.lower() not in taken:
            taken.add(key.lower())
            entries[key] = value
    return entries


def changed_during_the_scan(entries: Iterable[tuple[str, str]]) -> list[str]:
    """Return a sentence for each setting that governs a measurement and was changed while it ran."""
    watched = {"drivefrequency", "driveamplitude", "amplitudesetpointvolts", "phaseoffset", "springconstant"}
    return [
        f"{key} was changed during the scan, to {value}"
        for key, value in entries
        if key.lower() in watched and "@Line" in value
    ]


class Settings:
    """Asylum's settings by key; the case of a key varies between versions of the software."""

    def __init__(self, metadata: Mapping[str, str]) -> None:
        self._entries = {key.lower(): (key, value) for key, value in metadata.items()}

    def text(self, key: str) -> str | None:
        """Return the value of a key as text, None where the file has none."""
        return self._entries.get(key.lower(), ("", None))[1]

    def spelling(self, key: str) -> str:
        """Return the key as this file writes it."""
        return self._entries.get(key.lower(), (key, ""))[0]

    def number(self, key: str) -> float | None:
        """Return the value of a key as a number, None where there is none or it is NaN."""
        text = self.text(key) or ""
        match = _NUMBER.fullmatch(text) if len(text) <= _LONGEST_NUMBER else None
        value = float(match.group(1)) if match else math.nan
        return value if math.isfinite(value) else None

    def measured(self, key: str) -> float | None:
        """Return a number that a measurement left; zero stands for "never measured"."""
        return self.number(key) or None


def is_asylum(settings: Settings) -> bool:
    """Tell whether settings are those of Asylum's software."""
    return any(settings.text(key) is not None for key in _KEYS)


# --- what it says ---------------------------------------------------------------------------------


def facts_of(settings: Settings, channels: set[str]) -> dict[str, Fact]:
    """Return what the settings state about the instrument.

    Parameters
    ----------
    settings : Settings
        Of the note.
    channels : set of str
        Names of the channels, without line direction: some settings say what one of them is worth.
    """
    facts: dict[str, Fact] = {}

    def add(name: str, value: float | None, unit: str, key: str, default: bool = False) -> None:
        if value is not None:
            facts[name] = Fact(value, unit, key, default)

    stiffness = settings.measured("SpringConstant")
    add("stiffness", stiffness, "N/m", settings.spelling("SpringConstant"), stiffness == _DEFAULT_STIFFNESS)
    add("drive_frequency", settings.measured("DriveFrequency"), "Hz", settings.spelling("DriveFrequency"))
    add(
        "second_lockin_frequency",
        settings.measured("DriveFrequency1"),
        "Hz",
        settings.spelling("DriveFrequency1"),
    )

    sensitivity = settings.measured("AmpInvOLS")
    uncalibrated = sensitivity is not None and math.isclose(sensitivity, _DEFAULT_AMP_INVOLS, rel_tol=1e-4)
    sensitivity_key = settings.spelling("AmpInvOLS")
    add("amplitude_sensitivity", sensitivity, "m/V", sensitivity_key, uncalibrated)
    for channel, key, default in (
        ("Deflection", "InvOLS", _DEFAULT_INVOLS),
        ("Defl", "InvOLS", _DEFAULT_INVOLS),
        ("Amplitude2", "Amp2InvOLS", _DEFAULT_AMP2_INVOLS),
    ):
        if channel in channels:
            scale = settings.measured(key)
            is_default = scale is not None and math.isclose(scale, default, rel_tol=1e-4)
            add(f"scale:{channel}", scale, "m/V", settings.spelling(key), is_default)

    if any(is_nap(channel) for channel in channels):
        for name, key, unit in (
            ("lift_height", "NapHeight", "m"),
            ("drive_amplitude", "DriveAmplitude", "V"),
            ("lift_drive_amplitude", "NapDriveAmplitude", "V"),
            ("lift_drive_frequency", "NapDriveFrequency", "Hz"),
        ):
            add(name, settings.measured(key), unit, settings.spelling(key))

    amplitudes = {"free_amplitude": "FreeAirAmplitude", "tune_amplitude": "TunePeakResult"}
    # The amplitude set-point governs the scan only where the amplitude is the feedback.
    if settings.text("ImagingMode") in (None, "AC Mode"):
        amplitudes["setpoint_amplitude"] = "AmplitudeSetpointVolts"
    for name, key in amplitudes.items():
        volts = settings.measured(key)
        if volts is not None and sensitivity is not None:
            add(name, volts * sensitivity, "m", f"{settings.spelling(key)} x {sensitivity_key}", uncalibrated)
    phase = settings.measured("FreeAirPhase")
    add(
        "free_phase", None if phase is None else math.radians(phase), "rad", settings.spelling("FreeAirPhase")
    )
    return facts


def resonances_of(settings: Settings, notes: list[str]) -> tuple[Resonance, ...]:
    """Return the resonances of thermal fit and tune; ``notes`` takes a sentence where one is rounded."""
    resonances: list[Resonance] = []
    for source, frequency_key, quality_key, default_frequency, default_quality in (
        ("thermal", "ThermalFrequency", "ThermalQ", _DEFAULT_THERMAL_FREQUENCY, _DEFAULT_THERMAL_Q),
        ("tune", "TuneFreqResult", "TuneQResult", None, _DEFAULT_TUNE_Q),
    ):
        frequency, quality = settings.measured(frequency_key), settings.measured(quality_key)
        if frequency is None or quality is None:
            continue
        default = frequency == default_frequency or quality == default_quality
        # The note rounds to five digits; the resonance of the lever may stand there in full.
        full = settings.measured("ResFreq1")
        if full is not None and full != frequency and float(f"{full:.5g}") == frequency:
            notes.append(
                f"{settings.spelling(frequency_key)} {frequency:g} Hz is rounded; "
                f"{settings.spelling('ResFreq1')} gives it in full, {full:.2f} Hz"
            )
            frequency, frequency_key = full, "ResFreq1"
        # A thermal fit and a tune that agree to the last digit are one measurement written down twice.
        if not any((r.frequency, r.quality_factor) == (frequency, quality) for r in resonances):
            keys = (settings.spelling(frequency_key), settings.spelling(quality_key))
            resonances.append(Resonance(source, frequency, quality, keys, default))
    return tuple(resonances)


# --- channels -------------------------------------------------------------------------------------


def split_label(label: str) -> tuple[str, str | None]:
    """Return name and direction of a label such as ``HeightRetrace``.

    Examples
    --------
    >>> split_label("HeightRetrace"), split_label("UserIn0")
    (('Height', 'retrace'), ('UserIn0', None))
    """
    match = _DIRECTION.fullmatch(label)
    if match is None:
        return label, None
    # What follows the direction marks a processed copy and keeps it apart from the original.
    return match.group(1) + match.group(3), match.group(2).lower()


def is_nap(name: str) -> bool:
    """Tell whether a channel belongs to a Nap pass."""
    return name.startswith("Nap")


def unit_of_kind(name: str) -> tuple[float, str] | None:
    """Return factor and SI unit of a channel from its name, which is all that an .ibw gives; None if unknown."""
    kind = re.sub(r"(?:Mod)?\d*$", "", name.removeprefix("Nap")).lower()
    if kind in _LENGTHS:
        return 1.0, "m"
    if kind in _ANGLES:
        return math.pi / 180.0, "rad"
    if kind in _FREQUENCIES:
        return 1.0, "Hz"
    return None


def is_flattened(index: int, settings: Settings) -> bool | None:
    """Return whether the layer of this index was flattened or plane-fitted when it was stored, None if unsaid."""
    orders = [settings.number(f"{key} {index}") for key in ("FlattenOrder", "PlanefitOrder")]
    stated = [order for order in orders if order is not None]
    return any(order >= 0 for order in stated) if stated else None

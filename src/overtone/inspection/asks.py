"""What to ask the operator for, and what to do at the microscope next time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from overtone.inspection.channels import nameable_channels, spare_channels
from overtone.inspection.look import Look
from overtone.inspection.needs import LOST, MISSING, THERE, Need
from overtone.inspection.records import Ask, listed
from overtone.inspection.verdicts import modulus_harmonics
from overtone.io.recording import Recording
from overtone.io.resonance import usable_resonances
from overtone.io.vendors import vendor_of
from overtone.units import format_quantity

_PROBE = {
    "stiffness": "its stiffness k",
    "resonance": "its resonance f0 and Q",
    "drive": "the drive frequency",
    "free": "the free amplitude",
}
_RECORD = {
    "A0": "the mean deflection, raw (A0)",
    "A2": "a second lock-in at exactly twice the drive (A2 and phi2)",
    "A3": "a third one at three times the drive (A3 and phi3)",
}


def asks_of(look: Look, needs: Mapping[str, Need]) -> list[Ask]:
    """Return what to ask for and what to do, the most important first, each once."""
    if needs["mode"].state == LOST:
        return [
            Ask(
                f"Record amplitude and phase in tapping (AC) mode{_channels(look, ('A1', 'phi1'))}.",
                later=True,
            ),
            *_next_time(look, needs),
        ]
    asks = [] if needs["mode"].state == THERE else [Ask("Was the curve recorded in tapping mode?")]
    lost = [
        key
        for key in ("A1", "phi1", "direction", "metres", "zero")
        if key in needs and needs[key].state == LOST
    ]
    if lost:
        return [*asks, *_of_lost(look, lost), *_next_time(look, needs)]
    asks += _choices(look)
    asks += _of_probe(needs)
    asks += _of_scale(look, needs["metres"])
    if needs["zero"].state != THERE:
        asks.append(_of_zero(look, needs["zero"]))
    if look.curve:
        if needs["A0"].state == LOST:
            asks.append(Ask("Record the deflection in the curve: its far end is the zero of A0.", later=True))
        return asks
    return [*asks, *_of_modulus(look, needs)]


def probe_file(look: Look, needs: Mapping[str, Need]) -> str:
    """Return a probe file to complete, with what the file knows and a question mark for the rest.

    Empty where the probe is known, or where nothing could be done with it.
    """
    lost = any(
        need.state == LOST
        for key, need in needs.items()
        if key in ("mode", "A1", "phi1", "direction", "metres", "zero")
    )
    if lost or all(needs[key].state == THERE for key in _PROBE):
        return ""

    def known(name: str, unit: str, why: str) -> str:
        """Return the value of a line, and behind it where it comes from."""
        fact = look.recording.facts.get(name)
        if fact is None or fact.factory_default:
            return f'"? {unit}"  # {why}'
        return f'"{format_quantity(fact.value, fact.unit, 9)}"  # {fact.key}'

    frequency, quality = '"? kHz"  # resonance far from the surface', '"?"  # of that resonance'
    pairs = usable_resonances(look.recording)
    if needs["resonance"].state == THERE and (look.reading is not None or len(pairs) == 1):
        lever = look.reading.probe.cantilever.modes[0] if look.reading is not None else pairs[0]
        frequency, quality = f'"{format_quantity(lever.frequency, "Hz", 9)}"', f"{lever.quality_factor:.5g}"
    free = _free(look) or known(
        "free_amplitude", "nm", f"A1 far from the surface{_free_hint(look.recording)}"
    )
    lines = (
        "[cantilever]",
        f"stiffness = {known('stiffness', 'N/m', 'from a thermal spectrum')}",
        f"frequency = {frequency}",
        f"quality_factor = {quality}",
        "",
        "[drive]",
        f"frequency = {known('drive_frequency', 'kHz', 'as set at the microscope')}",
        f"free_amplitude = {free}",
    )
    return "\n".join(lines) + "\n"


# --- what is lost ---------------------------------------------------------------------------------


def _of_lost(look: Look, lost: list[str]) -> list[Ask]:
    """Return what may still save a file without amplitude or phase, and what to record in its place."""
    asks = []
    words = {"A1": "amplitude", "phi1": "phase"}
    for key, units in (("A1", ("m", "V", None)), ("phi1", ("rad", None))):
        names = nameable_channels(look, units) if key in lost and key not in look.chosen else []
        if names:
            question = f"Is {' or '.join(names[:3])} the {words[key]} of the first harmonic?"
            asks.append(Ask(question, f'--channel {key}="{names[0]}"'))
    if look.recording.vendor == "park" and look.recording.path.is_file():
        asks.append(
            Ask(
                "The other channels of this scan: Park keeps each in a file; put them into one folder and inspect that."
            )
        )
    flattened = [look.chosen[key].name for key in words if key in look.chosen and look.chosen[key].flattened]
    if flattened:
        asks.append(
            Ask(f"Is there a raw file, with {listed(flattened)} as recorded, not flattened or plane-fitted?")
        )
    if "direction" in lost:
        asks.append(Ask("Record amplitude and phase in the same line direction.", later=True))
    elif any(key in lost for key in words):
        record = listed([f"the {word}" for key, word in words.items() if key in lost])
        asks.append(
            Ask(
                f"Record {record} of the first harmonic{_channels(look, [k for k in words if k in lost])}, raw.",
                later=True,
            )
        )
    return asks


def _channels(look: Look, keys: Sequence[str]) -> str:
    """Return the names of observables in the vendor's software."""
    aliases = vendor_of(look.recording).aliases
    names = [aliases[key][0] for key in keys if aliases.get(key)]
    return f" (channel{'s' if len(names) > 1 else ''} {listed(names)})" if names else ""


def _next_time(look: Look, needs: Mapping[str, Need]) -> list[Ask]:
    """Return what else belongs to a scan that has to be recorded again."""
    fact = look.recording.facts.get("stiffness")
    lever = ["k"] if fact is None or fact.factory_default else []
    lever += [] if needs["resonance"].state == THERE else ["f0", "Q"]
    spectrum = f"Take a thermal spectrum for {listed(lever)}, and note" if lever else "Note"
    return [
        Ask(f"{spectrum} amplitude and phase far from the surface.", later=True),
        _harmonics_ask(("A0", "A2")),
    ]


def _harmonics_ask(keys: tuple[str, ...]) -> Ask:
    what = listed([_RECORD[key] for key in keys])
    return Ask(
        f"Record, for a modulus, {what}, and an approach curve on a reference of known modulus; overtone protocol says "
        "how.",
        later=True,
    )


# --- what can be given ----------------------------------------------------------------------------


def _choices(look: Look) -> list[Ask]:
    asks = [Ask(f"Which of the {look.frames} frames?", "--frame 1")] if look.frames else []
    if len(look.directions) > 1:
        asks.append(
            Ask(f"Which line direction, {' or '.join(look.directions)}?", f"--direction {look.directions[0]}")
        )
    elif look.directions:
        way = look.directions[0]
        asks.append(
            Ask(
                f"The channels are of both line directions; only {way} has amplitude and phase.",
                f"--direction {way}",
            )
        )
    return asks


def _of_probe(needs: Mapping[str, Need]) -> list[Ask]:
    words = [word for key, word in _PROBE.items() if needs[key].state != THERE]
    if not words:
        return []
    return [Ask(f"The lever: {listed(words)}, as measured that day.", "--probe probe.toml")]


def _of_scale(look: Look, need: Need) -> list[Ask]:
    channel = look.chosen["A1"]
    if need.state == THERE:
        return []
    if channel.unit == "m":
        sentence = "Calibrate the sensitivity of the amplitude before the scan: here it was a nominal one."
        return [Ask(sentence, later=True)]
    if channel.unit is None:
        return [Ask(f"What is one count of {channel.name}?", f'--scale {channel.name}="? nm"')]
    return [Ask("The sensitivity of the amplitude, in nm per volt.", f'--scale {channel.name}="? nm/V"')]


def _of_zero(look: Look, need: Need) -> Ask:
    channel, free = look.chosen["phi1"], look.recording.facts.get("free_phase")
    if channel.unit is None and channel.name not in look.request.scales:
        sentence = f"The unit of {channel.name}, and what it reads far from the surface."
        return Ask(sentence, f'--scale {channel.name}="1 deg" --far-phase "? deg"')
    perhaps = ""
    if free is not None and need.state == MISSING:
        perhaps = f" ({format_quantity(free.value, 'rad', 4)}, {free.key}?)"
    sign = (
        ""
        if look.request.phase_sign == -1 or vendor_of(look.recording).phase_known
        else (" Does it grow with the drive frequency? If it falls: --phase-sign -1.")
    )
    return Ask(
        f"What did {channel.name} read far from the surface at this drive{perhaps}?{sign}",
        '--far-phase "? deg"',
    )


def _of_modulus(look: Look, needs: Mapping[str, Need]) -> list[Ask]:
    keys = modulus_harmonics(needs)
    lost = tuple(key for key in keys if needs[key].state == LOST)
    asks = _of_spare(look, needs, keys)
    if lost:
        return [*asks, _harmonics_ask(lost)]
    asks += _of_harmonics(look, needs, keys)
    if needs["modes"].state != THERE:
        sentence = (
            "For a modulus: the modes of the lever with their slopes, as the presets of overtone have them."
        )
        asks.append(Ask(sentence, "--probe probe.toml"))
    if needs["calibration"].state != THERE:
        sentence = (
            "Record, for a modulus, an approach curve on a reference of known modulus, best within the same scan; "
            "overtone calibrate takes it."
        )
        asks.append(Ask(sentence, later=True))
    elif needs["reference"].state != THERE:
        asks.append(
            Ask("For a relative modulus: a reference material of known modulus in the same scan.", later=True)
        )
    if needs["radius"].state != THERE:
        asks.append(Ask("For a modulus in pascal: the tip radius.", '--radius "? nm"'))
    if needs["poisson"].state != THERE:
        asks.append(Ask("For a modulus in pascal: Poisson's ratio of the sample; overtone map takes it."))
    return asks


def _of_harmonics(look: Look, needs: Mapping[str, Need], keys: tuple[str, ...]) -> list[Ask]:
    """Return what gives harmonics their units."""
    names = [
        look.chosen[part].name
        for key in keys
        if needs[key].state == MISSING
        for part in (key, f"phi{key[1:]}")
        if part in look.chosen and look.chosen[part].unit in (None, "V") and part != "phi0"
    ]
    names = [name for name in names if name not in look.request.scales]
    if not names:
        return []
    volts = any(c.name in names and c.unit == "V" for c in look.chosen.values())
    unit, word = ("? nm/V", "volt") if volts else ("? nm", "count")
    options = " ".join(f'--scale {name}="{unit}"' for name in names)
    return [Ask(f"For a modulus: what is one {word} of {listed(names)}?", options)]


def _of_spare(look: Look, needs: Mapping[str, Need], keys: tuple[str, ...]) -> list[Ask]:
    """Return whether inputs of the user's own hold another lock-in."""
    spare = spare_channels(look)
    wanted = [key for key in keys if needs[key].state == MISSING and key not in look.chosen]
    if not spare or not wanted:
        return []
    sentence = f"For a modulus: what do {listed(spare)} hold? If it is {listed(wanted)}, name it."
    return [Ask(sentence, f"--channel {wanted[0]}={spare[0]}")]


def _free(look: Look) -> str:
    """Return the line of a free amplitude that is as uncalibrated as A1, empty where it is not.

    Only their ratio counts for the phase of the force, so both have to come from one sensitivity.
    """
    fact = look.recording.facts.get("free_amplitude")
    if fact is None or not fact.factory_default:
        return ""
    volts = look.recording.facts.get("free_amplitude_volts")
    if look.chosen["A1"].unit == "V" and volts is not None:
        return f'"? nm"  # {format_quantity(volts.value, "V", 5)} ({volts.key}) times the sensitivity of A1'
    return f'"{format_quantity(fact.value, "m", 9)}"  # {fact.key}, by a nominal sensitivity like A1'


def _free_hint(recording: Recording) -> str:
    setpoint, fraction = (recording.facts.get(name) for name in ("setpoint_amplitude", "setpoint_fraction"))
    if setpoint is None or fraction is None or setpoint.factory_default or not 0.0 < fraction.value <= 1.0:
        return ""
    return f"; the set-point makes it {format_quantity(setpoint.value / fraction.value, 'm', 4)}"

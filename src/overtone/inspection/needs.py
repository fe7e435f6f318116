"""What energies and moduli need, and how a file stands with each of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from overtone.errors import PhaseReferenceWarning
from overtone.harmonics import far_phase
from overtone.inspection.channels import mean_deflection, nameable_channels, spare_channels, unused
from overtone.inspection.look import Look
from overtone.inspection.tables import quantity_text
from overtone.io.resonance import NOMINAL, PLAUSIBLE_PHASE, free_phase_error, usable_resonances, why_not
from overtone.io.vendors import vendor_of
from overtone.probe import SLOPE, Probe
from overtone.units import format_quantity

THERE, DOUBTFUL, MISSING, LOST = "there", "doubtful", "missing", "lost"
"""In the file or given; there, but not to be believed; can be given; can never be given for this file."""
TOO_LARGE = "A1 averages"
"""How the warning of an amplitude larger than the free one begins."""
TAPPING, ABSENT = "tapping (AC) mode", "not recorded"
_REFERENCE = "[reference"  # in the text of a calibration that has one


@dataclass(frozen=True)
class Need:
    """One thing that an answer needs.

    Parameters
    ----------
    what : str
        In words.
    state : str
        `THERE`, `DOUBTFUL`, `MISSING` or `LOST`.
    remark : str
        What the file has in its place, and what is wrong with it.
    short : str
        In a list of what is lacking; ``what`` unless given.
    """

    what: str
    state: str
    remark: str = ""
    short: str = ""

    @property
    def name(self) -> str:
        """Name in a list."""
        return self.short or self.what


def needs_of(look: Look) -> dict[str, Need]:
    """Return everything that energies, regime and moduli need, by key, in the order of importance."""
    needs = {"mode": _mode(look), "A1": _recorded(look, "A1"), "phi1": _recorded(look, "phi1")}
    if look.opposed:
        remark = "amplitude and phase were recorded in opposite line directions only: they never belong to one pixel"
        needs["direction"] = Need("amplitude and phase of one line direction", LOST, remark)
    elif look.directions:
        needs["direction"] = Need(
            "one line direction",
            MISSING,
            "the file holds both" if len(look.directions) > 1 else "the channels are of both",
            "the choice of a line direction",
        )
    if look.frames:
        needs["frame"] = Need("one frame", MISSING, f"the file holds {look.frames}", "the choice of a frame")
    needs |= _probe(look)
    if needs["A1"].state != LOST:
        needs["metres"] = _metres(look)
    if needs["phi1"].state != LOST:
        needs["zero"] = _zero(look)
    for name in ("A0", "A2", "A3"):
        needs[name] = _harmonic(look, name)
    needs["modes"] = _modes(look)
    needs["calibration"] = _calibration(look)
    anchored = _REFERENCE in look.recording.metadata.get("calibration", "")
    what = "reference material of known modulus in the scan"
    needs["reference"] = Need(what, THERE if anchored else MISSING, "", f"a {what}")
    radius = None if look.reading is None else look.reading.probe.tip.radius
    radius = look.request.probe.tip.radius if look.request.probe is not None else radius
    needs["radius"] = Need("tip radius", MISSING if radius is None else THERE, "", "the tip radius")
    needs["poisson"] = Need("Poisson's ratio of the sample", MISSING)
    return needs


# --- one need after the other ---------------------------------------------------------------------


def _mode(look: Look) -> Need:
    what, mode = TAPPING, look.mode
    if mode is None or mode.tapping:
        return Need(what, THERE)
    remark = mode.sentence()
    if look.curve and {"A1", "phi1"} <= look.chosen.keys() and _free_resonance(look):
        # Asylum's curves carry the mode of the images around them.
        remark += ", but the lever was driven at its free resonance, as in tapping"
        return Need(what, DOUBTFUL, remark, "your word that the curve was recorded in tapping mode")
    return Need(what, LOST, remark)


def _free_resonance(look: Look) -> bool:
    """Tell whether the drive lies within the width of a resonance that was measured without a sample."""
    drive = look.recording.facts.get("drive_frequency")
    return drive is not None and any(
        pair.source == "thermal"
        and not pair.factory_default
        and abs(drive.value - pair.frequency) <= pair.frequency / pair.quality_factor
        for pair in look.recording.resonances
    )


def _recorded(look: Look, name: str) -> Need:
    what = {"A1": "amplitude of the first harmonic (A1)", "phi1": "phase of the first harmonic (phi1)"}[name]
    channel = look.chosen.get(name)
    if channel is None:
        units = ("m", "V", None) if name == "A1" else ("rad", None)
        known = "" if not nameable_channels(look, units) else " under a name that overtone knows"
        return Need(what, LOST, f"{ABSENT}{known}")
    if channel.flattened:
        remark = f"{channel.name} was flattened or plane-fitted: its absolute value is lost"
        return Need(what, LOST, remark)
    if not np.isfinite(channel.values).any():
        return Need(what, LOST, f"{channel.name} has no valid pixel")
    return Need(what, THERE)


def _probe(look: Look) -> dict[str, Need]:
    names = {
        "stiffness": ("stiffness k of the lever", "k"),
        "resonance": ("resonance f0 and quality factor Q", "f0 and Q"),
        "drive": ("drive frequency", "the drive frequency"),
        "free": ("free amplitude (A1 far from the surface)", "the free amplitude"),
    }
    given = look.request.probe is not None or (look.opened is None and look.reading is not None)
    stored = "probe" in look.recording.metadata and look.recording.vendor == "overtone"
    if given or stored:
        return {key: Need(what, THERE, "", short) for key, (what, short) in names.items()}
    facts = look.recording.facts
    needs = {}
    for key, fact_name in (
        ("stiffness", "stiffness"),
        ("resonance", ""),
        ("drive", "drive_frequency"),
        ("free", "free_amplitude"),
    ):
        what, short = names[key]
        if key == "resonance":
            needs[key] = _resonance(look, what, short)
            continue
        fact = facts.get(fact_name)
        if fact is None:
            there = look.opened is not None  # the far end of a curve gave it
            needs[key] = Need(what, THERE if there else MISSING, "", short)
        elif fact.factory_default and key == "stiffness":
            value = quantity_text(fact.value, fact.unit)
            remark = f"{value} ({fact.key}) is a factory default, not a measurement"
            needs[key] = Need(what, DOUBTFUL, remark, "a measured k")
        else:  # a free amplitude by a default sensitivity is as uncalibrated as A1, which `metres` says
            needs[key] = Need(what, THERE, "", short)
    return needs


def _resonance(look: Look, what: str, short: str) -> Need:
    usable = usable_resonances(look.recording)
    if not usable:
        return Need(what, MISSING, "; ".join(map(why_not, look.recording.resonances)), short)
    first = usable[0]
    if first.source == NOMINAL:
        remark = (
            f"{format_quantity(first.frequency, 'Hz', 6)}, Q {first.quality_factor:.4g} ({', '.join(first.keys)}) "
            "stands where the catalogue's values stand; nothing says that it was measured"
        )
        return Need(what, DOUBTFUL, remark, "f0 and Q confirmed")
    if first.factory_default:
        return Need(what, DOUBTFUL, f"{', '.join(first.keys)} are factory defaults", "a measured f0 and Q")
    return Need(what, THERE, "", short)


def _metres(look: Look) -> Need:
    what, channel, facts = "A1 in metres", look.chosen["A1"], look.recording.facts
    if _is_too_large(look):
        remark = "it averages more than the free amplitude: one of the two is not calibrated like the other"
        return Need(what, DOUBTFUL, remark, "a calibrated sensitivity")
    if channel.name in look.request.scales:
        return Need(what, THERE)
    if channel.unit == "m":
        fact = facts.get("amplitude_sensitivity")
        if fact is not None and fact.factory_default:
            return Need(what, DOUBTFUL, _default(fact.value, fact.key), "a calibrated sensitivity")
        return Need(what, THERE)
    scale = facts.get(f"scale:{channel.name}")
    if channel.unit == "V" and scale is not None:
        if scale.factory_default:
            return Need(what, DOUBTFUL, _default(scale.value, scale.key), "a calibrated sensitivity")
        return Need(what, THERE)
    if channel.unit == "V":
        return Need(
            what,
            MISSING,
            f"{channel.name} is in volts, without a sensitivity",
            "the sensitivity of the amplitude",
        )
    if channel.unit is None:
        return Need(what, MISSING, f"{channel.name} has no unit", "the unit of the amplitude")
    return Need(what, LOST, f"{channel.name} is in {channel.unit}: it is no amplitude")


def _is_too_large(look: Look) -> bool:
    """Tell whether A1 averages more than its free value, which no lever that taps does."""
    return any(text.startswith(TOO_LARGE) for _, text in look.said)


def _default(value: float, key: str) -> str:
    return (
        f"the sensitivity, {quantity_text(value, 'm/V')} ({key}), is a factory default: lengths are nominal"
    )


def _zero(look: Look) -> Need:
    what, short = "phase far from the surface", "the phase far from the surface"
    channel, reading = look.chosen["phi1"], look.reading
    if channel.unit is None and channel.name not in look.request.scales:
        return Need(
            "unit and zero of the phase", MISSING, f"{channel.name} has no unit", "unit and zero of the phase"
        )
    if channel.unit not in (None, "rad"):
        return Need(what, LOST, f"{channel.name} is in {channel.unit}: it is no phase")
    producing = [
        text for kind, text in look.said if kind is PhaseReferenceWarning and text.startswith("most pixels")
    ]
    if look.opened is not None and producing and not _is_too_large(look):
        return Need(
            what,
            DOUBTFUL,
            "most pixels would give energy to the tip: sign or zero of the phase, or the calibration, is wrong",
            short,
        )
    if look.request.far_phase is not None:
        return Need(what, THERE)
    vendor = vendor_of(look.recording)
    if look.recording.vendor == "overtone":
        if look.request.corrected or (reading is not None and reading.phase_established):
            return Need(what, THERE)
        return Need(what, MISSING, "nothing says that the phases are referred to the free lever", short)
    free = look.recording.facts.get("free_phase")
    if not vendor.phase_known:
        hint = f"; {quantity_text(free.value, 'rad')} ({free.key}) may be it" if free else ""
        return Need(what, MISSING, vendor.phase_note + hint, short)
    probe = _probe_of(look)
    error = free_phase_error(look.recording, probe) if probe is not None else None
    if free is not None and probe is not None and error is not None and abs(error) > PLAUSIBLE_PHASE:
        remark = (
            f"{math.degrees(free.value):.1f} deg in the file ({free.key}), where a lever with this resonance and drive "
            f"has {math.degrees(far_phase(probe)):.1f} deg"
        )
        return Need(what, DOUBTFUL, remark, short)
    return Need(what, THERE)


def _probe_of(look: Look) -> Probe | None:
    return look.request.probe if look.reading is None else look.reading.probe


def _harmonic(look: Look, name: str) -> Need:
    phase = "" if name == "A0" else f"phi{name[1:]}"
    what = {
        "A0": "mean deflection (A0)",
        "A2": "second harmonic (A2 and phi2)",
        "A3": "third harmonic (A3 and phi3)",
    }[name]
    reasons = unused(look)
    parts = [part for part in (name, phase) if part]
    absent = [part for part in parts if part not in look.chosen]
    if not absent:
        for part in parts:
            if part in reasons:
                remark = f"{look.chosen[part].name}: {reasons[part]}"
                if part == "A0" and reasons[part].startswith("an offset"):
                    mean = format_quantity(mean_deflection(look), "m")
                    remark += f" (its mean is {mean}, where tapping leaves picometres)"
                    return Need(what, DOUBTFUL, remark, "the zero of A0")
                return Need(what, MISSING, remark, f"the unit of {look.chosen[part].name}")
        flattened = [look.chosen[part].name for part in parts if look.chosen[part].flattened]
        if flattened:
            return Need(what, LOST, f"{flattened[0]} was flattened: its absolute value is lost")
        return Need(what, THERE)
    drive, second = (look.recording.facts.get(k) for k in ("drive_frequency", "second_lockin_frequency"))
    other = [c.name for c in look.recording.channels if c.name.endswith(("Amplitude2", "Amp2")) and not c.nap]
    if name == "A2" and other and drive is not None and second is not None:
        remark = (
            f"{other[0]} is none: the second lock-in listened at {format_quantity(second.value, 'Hz', 5)}"
        )
        return Need(what, LOST, f"{remark}, not at twice the drive")
    spare = spare_channels(look)
    if spare:
        return Need(
            what,
            MISSING,
            f"not there, unless {' or '.join(spare)} holds it",
            f"the name of the channel of {name}",
        )
    return Need(what, LOST, ABSENT)


def _modes(look: Look) -> Need:
    what, short = "modes of the lever and their slopes", "the modes of the lever"
    probe = _probe_of(look)
    if not vendor_of(look.recording).optical_lever:
        return Need(what, THERE)
    if probe is not None and probe.detector.kind == SLOPE and len(probe.cantilever.modes) > 1:
        return Need(what, THERE)
    return Need(what, MISSING, "an optical lever reads slopes, not displacements", short)


def _calibration(look: Look) -> Need:
    what = "approach curve on a reference material"
    corrected = look.request.corrected or (look.reading is not None and look.reading.corrected)
    if corrected:
        return Need(what, THERE)
    return Need(
        what,
        MISSING,
        "it gives the zero of A0, gains and distortion",
        "an approach curve on a reference material",
    )


def open_ends(needs: Mapping[str, Need], keys: tuple[str, ...]) -> Iterator[Need]:
    """Yield what stands open among some needs."""
    for key in keys:
        need = needs.get(key)
        if need is not None and need.state != THERE:
            yield need

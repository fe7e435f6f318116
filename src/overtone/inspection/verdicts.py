"""What a file can give, one question a verdict, with the reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import xarray as xr

from overtone.harmonics import regime
from overtone.inspection.look import Look
from overtone.inspection.needs import ABSENT, DOUBTFUL, LOST, MISSING, TAPPING, THERE, Need, open_ends
from overtone.inspection.records import IF, NO, YES, Missing, Verdict, as_sentence, listed
from overtone.instrument.noise import complete_noise
from overtone.report.shares import flag_shares, format_share

ENERGIES = "energy dissipated and force of the first harmonic"
REGIME = "regime (attractive or repulsive)"
CONTRAST, RELATIVE, ABSOLUTE = "modulus, contrast", "modulus, relative", "modulus, absolute"
CALIBRATES = "calibration of scans with this lever"

_READ = ("mode", "A1", "phi1", "direction", "frame")
_PROBE = ("stiffness", "resonance", "drive", "free")
_FIRST = (*_READ, *_PROBE, "metres", "zero")
# The regime is a sign: neither the stiffness nor the metre need be right, but each must have some value.
_SCALE_FREE = ("stiffness", "metres")
_EITHER = "mean deflection A0 with the second harmonic (A2, phi2), or the second with the third (A3, phi3)"
_ALL_OF_ENERGIES = Need("what the energies take", MISSING)
_ALL_OF_CONTRAST = Need("what contrast takes", MISSING)
_OF_THE_LEVER = "an optical lever"
_SCALES = {"stiffness": "the stiffness", "metres": "the sensitivity"}


def verdicts_of(look: Look, needs: Mapping[str, Need]) -> list[Verdict]:
    """Return a verdict for each thing that a file may give."""
    for_energies = list(open_ends(needs, _FIRST))
    verdicts = [_verdict(ENERGIES, look, for_energies, _of_energies(needs)), _regime(look, needs)]
    if look.curve:
        curve = list(open_ends(needs, (*_FIRST, "A0")))
        return [*verdicts, _verdict(CALIBRATES, look, curve, _of_curves(needs))]
    harmonics = modulus_harmonics(needs)
    contrast = list(open_ends(needs, (*harmonics, "modes", *_calibrated(look, harmonics))))
    lost = [need for need in (*for_energies, *contrast) if need.state == LOST]
    if lost:
        reason = as_sentence(_why_lost(lost))
        return [
            *verdicts,
            *(Verdict(question, NO, (), reason) for question in (CONTRAST, RELATIVE, ABSOLUTE)),
        ]
    contrast = [*([_ALL_OF_ENERGIES] if for_energies else []), *contrast]
    so_far = [_ALL_OF_CONTRAST] if contrast else []
    relative = [*so_far, *(n for n in open_ends(needs, ("calibration", "reference")) if n not in contrast)]
    absolute = [
        *so_far,
        *(n for n in open_ends(needs, ("calibration", "radius", "poisson")) if n not in contrast),
    ]
    return [
        *verdicts,
        _verdict(
            CONTRAST, look, contrast, "What is stiffer than what; radius and Poisson's ratio may be assumed."
        ),
        _verdict(RELATIVE, look, relative, "Ratios to the reference."),
        _verdict(
            ABSOLUTE,
            look,
            absolute,
            "In pascal, as far as the calibration carries; overtone map says how far.",
        ),
    ]


def missing_of(look: Look, needs: Mapping[str, Need]) -> list[Missing]:
    """Return what is missing, with the purpose that needs it; each thing once, at the first purpose."""
    if needs["mode"].state == LOST:
        return [Missing("anything", needs["mode"].what, needs["mode"].remark)]
    rows = [
        Missing("energies and forces of the first harmonic", need.what, need.remark)
        for need in open_ends(needs, _FIRST)
    ]
    if look.curve or LOST in (needs["A1"].state, needs["phi1"].state):
        return rows
    harmonics = modulus_harmonics(needs)
    if any(needs[key].state == LOST for key in harmonics):
        rows.append(Missing("any modulus", _EITHER, _why_neither(needs)))
        harmonics = ()
    for purpose, keys in (
        ("any modulus", (*harmonics, "modes")),
        ("a relative or absolute modulus", ("calibration",)),
        ("a relative modulus", ("reference",)),
        ("an absolute modulus", ("radius", "poisson")),
    ):
        rows += [Missing(purpose, need.what, need.remark) for need in open_ends(needs, keys)]
    return rows


def shares_text(flags: xr.DataArray, why_undetermined: str = "") -> str:
    """Return the shares of pixels by flag as a sentence.

    Examples
    --------
    >>> shares_text(xr.DataArray([0, 1, 1, 1], attrs={"flag_values": [0, 1], "flag_meanings": "no yes"}))
    'Of the points: no 25.0 %, yes 75.0 %.'
    """
    why = f" ({why_undetermined})" if why_undetermined else ""
    words = [
        f"{word} {format_share(share)}{why if word == 'undetermined' else ''}"
        for word, share in flag_shares(flags).items()
        if share
    ]
    noun = "pixels" if "y" in flags.dims else "points"
    return f"Of the {noun}: {', '.join(words)}." if words else ""


def modulus_harmonics(needs: Mapping[str, Need]) -> tuple[str, ...]:
    """Return the harmonics beside the first that a modulus is to be told from: those that lack least."""
    price = {THERE: 0, DOUBTFUL: 1, MISSING: 2, LOST: 10}
    choices = (("A0", "A2"), ("A2", "A3"))
    return min(choices, key=lambda keys: sum(price[needs[key].state] for key in keys))


def _why_neither(needs: Mapping[str, Need]) -> str:
    """Return what of the harmonics is not there, in a line."""
    remarks: dict[str, list[str]] = {}
    for key in ("A0", "A2", "A3"):
        if needs[key].state != THERE:
            remarks.setdefault(needs[key].remark, []).append(key)
    if list(remarks) == [ABSENT]:
        return f"{ABSENT}, none of them"
    return "; ".join(f"{listed(keys)} {remark}" for remark, keys in remarks.items())


# --- one verdict after the other ------------------------------------------------------------------


def _verdict(question: str, look: Look, open_needs: Sequence[Need], reason: str) -> Verdict:
    lost = [need for need in open_needs if need.state == LOST]
    if lost:
        return Verdict(question, NO, (), as_sentence(_why_lost(lost)))
    if not open_needs and look.opened is None:
        return Verdict(question, NO, (), as_sentence(look.refusal))
    if open_needs:
        return Verdict(question, IF, tuple(dict.fromkeys(need.name for need in open_needs)), reason)
    return Verdict(question, YES, (), reason)


def _why_lost(lost: Sequence[Need]) -> str:
    first = lost[0]
    if first.what == TAPPING:
        return f"{first.remark}; it takes tapping mode"
    if first.remark.startswith(ABSENT):
        return f"{first.remark}: {listed([need.what for need in lost if need.remark == first.remark])}"
    return first.remark or f"no {first.what}"


def _of_energies(needs: Mapping[str, Need]) -> str:
    states = {key: needs[key].state for key in (*_FIRST,) if key in needs}
    doubtful = [needs[key] for key in _SCALES if states.get(key) == DOUBTFUL]
    if MISSING not in states.values() and doubtful:
        what = listed([_SCALES[key] for key in _SCALES if states.get(key) == DOUBTFUL])
        verb = "is" if len(doubtful) == 1 else "are"
        return f"Until then neither joules nor newtons: {what} in the file {verb} nominal."
    if all(state == THERE for state in states.values()):
        return "Everything it takes is there."
    return ""


def _of_curves(needs: Mapping[str, Need]) -> str:
    second = "; on a known material the gains of A0 and A2 as well" if needs["A2"].state == THERE else ""
    return f"overtone calibrate takes the zero of A0 and of the phase from it{second}."


def _calibrated(look: Look, harmonics: Sequence[str]) -> tuple[str, ...]:
    """Return the calibration as a need of contrast where A0 counts, or where a detector explains A2 as well.

    The zero of A0 far from the surface is in no file.
    """
    doubts = look.reading.doubts.get(2, "").splitlines() if look.reading is not None else []
    distorted = any(not line.startswith(_OF_THE_LEVER) for line in doubts)
    return ("calibration",) if "A0" in harmonics or distorted else ()


def _regime(look: Look, needs: Mapping[str, Need]) -> Verdict:
    open_needs = [
        need
        for key in _FIRST
        for need in open_ends(needs, (key,))
        if not (key in _SCALE_FREE and need.state == DOUBTFUL)
    ]
    verdict = _verdict(REGIME, look, open_needs, "")
    if look.opened is None or look.directions or look.frames or verdict.answer != YES or look.reading is None:
        return verdict
    reading = look.reading
    if not reading.phase_established:
        return Verdict(REGIME, IF, (needs["zero"].short or "the phase far from the surface",), "")
    signs = regime(look.opened, reading.probe, reading.alternatives, noise=complete_noise(None, (1,))["phi1"])
    return Verdict(
        REGIME, YES, (), shares_text(signs, "the sign hangs on what the file leaves open or on noise")
    )

"""Channels of a file become observables: names, units, phase reference, and what is missing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import (
    ChannelError,
    ChannelWarning,
    DistortionWarning,
    PhaseReferenceWarning,
    ResonanceWarning,
    UncalibratedWarning,
)
from overtone.harmonics import far_phase, read_receptance, to_force_harmonics
from overtone.io.recording import Channel, Recording
from overtone.io.registry import read_channels
from overtone.io.resonance import PLAUSIBLE_PHASE, free_phase_error, rank_resonances
from overtone.io.vendors import Vendor, candidates, main_channels, vendor_of
from overtone.probe import SLOPE, Probe, format_probe
from overtone.quantities import harmonic_orders, named_array, quantity, validate_observables
from overtone.readings import Reading, parse_reading, with_reading
from overtone.units import format_quantity

# Where the phase of the second harmonic follows twice the first this closely and its amplitude varies this
# little, kappa a1^2 of a photodiode explains it as well as contact does.
_LOCKED_PHASE = 0.05
_FLAT_AMPLITUDE = 0.07
_LARGEST_A0 = 5e-9
_PRODUCED = 0.05  # share of the drive force that DISS_1 may fall below zero by a small error of the phase
_HIGHEST = 9
_OBSERVABLES = ("height", "A0", *(f"{letter}{n}" for n in range(1, _HIGHEST + 1) for letter in ("A", "phi")))


def open_scan(
    path: str | Path,
    *,
    probe: Probe | None = None,
    channels: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    far_phase: float | None = None,
    phase_sign: int = 1,
    direction: str | None = None,
    corrected: bool = False,
) -> xr.Dataset:
    """Open a scan, a curve or a table as observables.

    Parameters
    ----------
    path : str or Path
        File of any known format.
    probe : Probe, optional
        The probe. Without it, it is built from the file, whose resonances are tested against its own
        free-air amplitude and phase.
    channels : mapping of str to str, optional
        Observable to channel name, for example ``{"A2": "UserIn0"}``, before the vendor's own names.
    scales : mapping of str to float, optional
        Channel name to the SI value of one count, for channels without a unit.
    far_phase : float, optional
        Reading of the first-harmonic phase channel far from the surface [rad]. Without it the vendor's zero
        is taken where it is known; where it is not, this is required.
    phase_sign : int
        1 where the stored phases are lags, -1 where they are leads.
    direction : str, optional
        ``trace`` or ``retrace`` where the file holds both.
    corrected : bool
        True states that A0 was freed of its offset and the higher harmonics of detector distortion beforehand.

    Returns
    -------
    Dataset
        Observables in SI units. Its attributes hold the source, the detector, how the file was read (see
        `overtone.readings`), and findings and history (see `overtone.provenance`).

    Raises
    ------
    OvertoneError
        If the file cannot be read, A1 or phi1 is missing, a channel is ambiguous, the probe is not known,
        or the zero of the phase is not.
    """
    recording = read_channels(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = _observables(
            recording, probe, channels or {}, scales or {}, far_phase, phase_sign, direction, corrected
        )
    # A warning scrolls away; the dataset keeps what it said.
    for warning in caught:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    warned = [f"{w.category.__name__}: {w.message}" for w in caught]
    sentences = [*recording.notes, *dict.fromkeys(warned)]
    dataset = provenance.add_finding(dataset, *map(_sentence, sentences))
    return provenance.record(
        dataset,
        "open_scan",
        path=str(path),
        probe=format_probe(probe) if probe else "from the file",
        channels=dict(channels or {}),
        scales=dict(scales or {}),
        far_phase=far_phase,
        phase_sign=phase_sign,
        direction=direction,
        corrected=corrected,
    )


def _sentence(text: str) -> str:
    text = text.strip()
    first = text.split(maxsplit=1)[0] if text else ""
    if first.isalpha() and first.islower():
        text = text[0].upper() + text[1:]
    return text + ("" if text.endswith(".") else ".")


def _observables(
    recording: Recording,
    probe: Probe | None,
    wanted: Mapping[str, str],
    scales: Mapping[str, float],
    far_reading: float | None,
    phase_sign: int,
    direction: str | None,
    corrected: bool,
) -> xr.Dataset:
    _check_names(recording, wanted, scales, phase_sign)
    chosen = _choose(recording, wanted, direction)
    missing = [name for name in ("A1", "phi1") if name not in chosen]
    if missing:
        raise ChannelError(
            f"{recording.path.name} has no channel for {' and '.join(missing)}",
            expected="amplitude and phase of the first harmonic",
            got=_names(recording) or "no channels",
            hint=f"name it, --channel {missing[0]}=NAME",
        )
    reading = _reading(recording, probe, far_reading, corrected)
    turn = _turn(recording, vendor_of(recording), reading.probe, far_reading, phase_sign)
    coords = _coords(recording)
    arrays: dict[str, xr.DataArray] = {}
    for name, values in _in_si(chosen, scales).items():
        if name.startswith("phi"):
            values = phase_sign * values + int(name[3:]) * turn
        arrays[name] = named_array(name, values, recording.dims, coords, channel=chosen[name].name)
    _drop_unpaired(arrays)
    attributes = {
        "source": recording.path.name,
        "vendor": recording.vendor,
        "detector": recording.metadata.get("detector", reading.probe.detector.kind),
    }
    dataset = validate_observables(xr.Dataset(arrays, attrs=attributes))
    _check_probe(recording, dataset, reading.probe)
    established = (
        reading.phase_established and _is_tapping(recording) and _loses_energy(dataset, reading.probe)
    )
    doubts = _doubts(dataset, reading, vendor_of(recording))
    return with_reading(dataset, replace(reading, phase_established=established, doubts=doubts))


def missing_for_modulus(observables: xr.Dataset) -> str:
    """Return what a modulus needs and these observables lack, empty where nothing is missing."""
    orders = harmonic_orders(observables)
    if {0, 1, 2} <= set(orders) or {1, 2, 3} <= set(orders):
        return ""
    lacking = {0: "A0 (mean deflection)", 2: "A2 and phi2", 3: "A3 and phi3"}
    first = " and ".join(text for n, text in lacking.items() if n in (0, 2) and n not in orders)
    second = " and ".join(text for n, text in lacking.items() if n in (2, 3) and n not in orders)
    return f"for a modulus this file lacks {first}, or {second}"


# --- channels -------------------------------------------------------------------------------------


def _names(recording: Recording) -> str:
    return ", ".join(dict.fromkeys(channel.name for channel in recording.channels))


def _check_names(
    recording: Recording, wanted: Mapping[str, str], scales: Mapping[str, float], phase_sign: int
) -> None:
    if phase_sign not in (1, -1):
        raise ChannelError("unknown phase sign", expected="1 (lag) or -1 (lead)", got=str(phase_sign))
    for name in wanted:
        if name not in _OBSERVABLES:
            raise ChannelError(
                f"{name!r} is not an observable",
                expected="height, A0, A1, phi1, A2, phi2, ...",
                hint="observable first, then the channel: A2=UserIn0",
            )
    known = {channel.name for channel in recording.channels}
    unknown = [name for name in (*wanted.values(), *scales) if name not in known]
    if unknown:
        raise ChannelError(
            f"{recording.path.name} has no channel {unknown[0]!r}", expected=f"one of {_names(recording)}"
        )


def _choose(recording: Recording, wanted: Mapping[str, str], direction: str | None) -> dict[str, Channel]:
    """Pick a channel for each observable, all of one line direction."""
    pool = main_channels(recording)
    directions = {channel.direction for channel in pool if channel.direction}
    if direction is not None and direction not in directions:
        raise ChannelError(
            f"{recording.path.name} has no {direction}",
            expected=" or ".join(sorted(directions)) or "no direction",
        )
    chosen: dict[str, Channel] = {}
    for observable in _OBSERVABLES:
        names = (wanted[observable],) if observable in wanted else candidates(recording, observable)
        for name in names:
            found = [
                c for c in pool if c.name == name and (direction is None or c.direction in (direction, None))
            ]
            if len(found) > 1:
                raise ChannelError(
                    f"{recording.path.name} holds {name} {len(found)} times",
                    expected="one line direction",
                    got=", ".join(str(c.direction) for c in found),
                    hint=" or ".join(f"--direction {c.direction}" for c in found if c.direction),
                )
            if found:
                chosen[observable] = found[0]
                break
    mixed = {c.direction for name, c in chosen.items() if name != "height" and c.direction}
    if len(mixed) > 1:
        raise ChannelError(
            "trace and retrace do not mix",
            expected="observables of one line direction",
            got=", ".join(f"{name}: {c.name} {c.direction}" for name, c in chosen.items()),
            hint=" or ".join(f"--direction {direction}" for direction in sorted(mixed)),
        )
    flattened = [c.name for name, c in chosen.items() if name != "height" and c.flattened]
    if flattened:
        warnings.warn(
            f"{', '.join(flattened)} was flattened or plane-fitted: its absolute value is lost",
            ChannelWarning,
            stacklevel=2,
        )
    return chosen


def _in_si(chosen: Mapping[str, Channel], scales: Mapping[str, float]) -> dict[str, npt.NDArray[np.float64]]:
    """Return the channels in the SI units of their observables; name those that have no usable unit."""
    values: dict[str, npt.NDArray[np.float64]] = {}
    without: list[str] = []
    for name, channel in chosen.items():
        record = quantity(name)
        unit = record.unit if record else None
        if channel.name in scales and channel.unit is not None:
            raise ChannelError(
                f"{channel.name} has the unit {channel.unit} in the file",
                got=f"a scale of {scales[channel.name]:g} for it",
                hint="scales are for channels without a unit",
            )
        if channel.name in scales:
            values[name] = channel.values * scales[channel.name]
        elif channel.unit == unit:
            values[name] = channel.values
        else:
            stated = "no unit" if channel.unit is None else f"the unit {channel.unit} instead of {unit}"
            if name in ("A1", "phi1"):
                raise ChannelError(
                    f"{name} ({channel.name}) has {stated}",
                    expected=f"a channel in {unit}",
                    hint=f'a unit in the file, or --scale {channel.name}="1 {"nm" if unit == "m" else "deg"}" '
                    "where it has none",
                )
            zero = ", and a zero that is not known" if name == "A0" else ""
            without.append(f"{name} ({channel.name}: {stated}{zero})")
    if without:
        example = chosen[without[0].split()[0]].name
        warnings.warn(
            f"not used for want of a unit: {', '.join(without)}. Where you know what one count means, say so: "
            f'--scale {example}="1 nm"',
            ChannelWarning,
            stacklevel=2,
        )
    empty = [
        name for name, array in values.items() if not np.isfinite(array).any() and name not in ("A1", "phi1")
    ]
    if empty:
        warnings.warn(
            f"not used, because no pixel has a value: {', '.join(empty)}", ChannelWarning, stacklevel=2
        )
        values = {name: array for name, array in values.items() if name not in empty}
    mean = float(np.mean(values["A0"][np.isfinite(values["A0"])])) if "A0" in values else 0.0
    if abs(mean) > _LARGEST_A0:
        warnings.warn(
            f"A0 ({chosen['A0'].name}) averages {format_quantity(mean, 'm')}, where a mean deflection in tapping "
            "mode is picometres: an offset or a set-point is still in it, so it is not used",
            ChannelWarning,
            stacklevel=2,
        )
        del values["A0"]
    return values


def _drop_unpaired(arrays: dict[str, xr.DataArray]) -> None:
    """Leave out a harmonic that has an amplitude without a phase or a phase without an amplitude."""
    for n in range(2, _HIGHEST + 1):
        if (f"A{n}" in arrays) != (f"phi{n}" in arrays):
            arrays.pop(f"A{n}", None)
            arrays.pop(f"phi{n}", None)


def _coords(recording: Recording) -> dict[str, xr.DataArray]:
    names = {"x": "fast axis", "y": "slow axis", "z": "height of the base"}
    return {
        dim: xr.DataArray(values, dims=dim, attrs={"units": "m", "long_name": names.get(dim, dim)})
        for dim, values in recording.coords.items()
        if dim in recording.dims
    }


# --- probe and phase ------------------------------------------------------------------------------


def _reading(
    recording: Recording, probe: Probe | None, far_reading: float | None, corrected: bool
) -> Reading:
    """Return the probe to use, and what the file leaves open."""
    stored = parse_reading(recording.metadata)
    corrected = corrected or (stored is not None and stored.corrected)
    if stored is not None and probe is None:
        return replace(stored, corrected=corrected)
    if probe is not None:
        established, alternatives = far_reading is not None or stored is not None, []
        error = free_phase_error(recording, probe)
        if established:
            pass
        elif error is not None:
            established = abs(error) <= PLAUSIBLE_PHASE
            alternatives = [(probe, -error)]
            warnings.warn(
                f"phases are taken as stored; the free-air phase in the file is {math.degrees(error):+.1f} deg off the "
                "one this probe predicts, and a regime that the difference flips counts as undetermined",
                PhaseReferenceWarning,
                stacklevel=2,
            )
        elif recording.vendor == "overtone":
            established = corrected
            if not corrected:
                warnings.warn(
                    "phases are taken as lags referred to the free lever, but nothing in the file says that they are: "
                    "no regime is decided. Give the phase read far from the surface (--far-phase)",
                    PhaseReferenceWarning,
                    stacklevel=2,
                )
        else:
            established = vendor_of(recording).phase_known
        return Reading(probe, tuple(alternatives), established, corrected)
    best, *others = rank_resonances(recording, referenced=far_reading is not None)
    alternatives = [(test.probe, 0.0) for test in others]
    established = True
    if far_reading is not None:
        # Once the free lever is the reference, each probe refers the phase to its own prediction.
        alternatives = [(test.probe, test.far_phase - best.far_phase) for test in others]
    elif best.phase_error is not None:
        established = abs(best.phase_error) <= PLAUSIBLE_PHASE
        alternatives.append((best.probe, -best.phase_error))
        warnings.warn(
            f"phases are taken as stored; the free-air phase in the file is "
            f"{math.degrees(best.phase_error):+.1f} deg off the one its probe predicts, and a regime that this "
            "difference flips counts as undetermined",
            PhaseReferenceWarning,
            stacklevel=2,
        )
    return Reading(best.probe, tuple(alternatives), established, corrected)


def _turn(
    recording: Recording, vendor: Vendor, probe: Probe, far_reading: float | None, phase_sign: int
) -> float:
    """Return what to add to the first-harmonic phase so that far from the sample it is the probe's own."""
    if far_reading is not None:
        return far_phase(probe) - phase_sign * far_reading
    if not vendor.phase_known:
        raise ChannelError(
            f"the zero of the phase in {recording.path.name} is not known",
            expected="the reading of the phase channel far from the surface, as a reference",
            got=vendor.phase_note,
            hint='--far-phase "1.57 rad", and --phase-sign -1 if the stored phases are leads',
        )
    return 0.0


def _check_probe(recording: Recording, dataset: xr.Dataset, probe: Probe) -> None:
    """Warn where the probe and the file contradict each other."""
    drive = recording.facts.get("drive_frequency")
    if drive is not None and abs(drive.value / probe.drive.frequency - 1.0) > 1e-3:
        warnings.warn(
            f"the probe is driven at {format_quantity(probe.drive.frequency, 'Hz', 6)}, the file says "
            f"{format_quantity(drive.value, 'Hz', 6)} ({drive.key}): is this the probe of this scan?",
            ResonanceWarning,
            stacklevel=2,
        )
    mean = float(dataset["A1"].where(np.isfinite(dataset["A1"])).mean())
    free = probe.drive.free_amplitude
    if mean > 1.02 * free:
        warnings.warn(
            f"A1 averages {format_quantity(mean, 'm')}, more than the free amplitude of "
            f"{format_quantity(free, 'm')}: one of the two is not calibrated like the other",
            UncalibratedWarning,
            stacklevel=2,
        )


# --- what cannot be concluded ---------------------------------------------------------------------


def _doubts(dataset: xr.Dataset, reading: Reading, vendor: Vendor) -> dict[int, str]:
    """Return, by harmonic, why nothing can be concluded from it, one reason a line."""
    doubts: dict[int, str] = {}
    if not reading.corrected and "A0" in dataset:
        doubts[0] = (
            "A0 is as the file stores it: its zero far from the surface is not known, and 1 pm of it moves a "
            "modulus by tens of per cent. If it was corrected before, say so: --corrected"
        )
    distortion = "" if reading.corrected else _distortion(dataset)
    if distortion:
        doubts[2] = distortion
    probe = reading.probe
    if vendor.optical_lever and (probe.detector.kind != SLOPE or len(probe.cantilever.modes) == 1):
        lever = (
            "an optical lever reads slope: against a single-mode probe it shows A0 about 12 % high, A2 7 to 40 % low "
            "and A3 of either sign, which moves a modulus by factors. Give the modes of the lever in the probe file, "
            'with their slope ratios and kind = "slope" in [detector]'
        )
        for n in harmonic_orders(dataset):
            if n != 1:
                doubts[n] = f"{doubts[n]}\n{lever}" if n in doubts else lever
    for reason in dict.fromkeys(line for doubt in doubts.values() for line in doubt.splitlines()):
        warnings.warn(reason, DistortionWarning, stacklevel=2)
    return doubts


def _is_tapping(recording: Recording) -> bool:
    """Warn where the file says that it was not recorded in tapping mode."""
    mode = recording.metadata.get("ImagingMode", "AC Mode")
    if mode == "AC Mode":
        return True
    warnings.warn(
        f"the file says {mode}, not AC mode: if its amplitude is no tapping amplitude, nothing here holds; no regime "
        "is decided",
        ChannelWarning,
        stacklevel=2,
    )
    return False


def _loses_energy(dataset: xr.Dataset, probe: Probe) -> bool:
    """Warn where most pixels would produce energy: then sign, zero or calibration of the phase is wrong."""
    force = to_force_harmonics(dataset[["A1", "phi1"]], probe)["F_diss"].sel(harmonic=1)
    floor = (
        -_PRODUCED * probe.drive.free_amplitude / abs(complex(read_receptance(probe, probe.drive.frequency)))
    )
    if not float((force < floor).mean()) > 0.5:
        return True
    warnings.warn(
        "most pixels would give energy to the tip instead of taking it: the sign or the zero of the phase, or the "
        "calibration of the amplitude, is wrong; no regime is decided",
        PhaseReferenceWarning,
        stacklevel=2,
    )
    return False


def _distortion(dataset: xr.Dataset) -> str:
    """Return why the second harmonic cannot be put down to contact, empty where it can."""
    if "A2" not in dataset:
        return ""
    locked = np.exp(1j * (dataset["phi2"].values - 2.0 * dataset["phi1"].values))
    relative = dataset["A2"].values / dataset["A1"].values ** 2
    good = np.isfinite(locked) & np.isfinite(relative)
    if good.sum() < 3:
        return ""
    order = abs(locked[good].mean())
    phase_spread = math.sqrt(max(-2.0 * math.log(max(order, 1e-300)), 0.0))
    amplitude_spread = float(relative[good].std() / relative[good].mean())
    if phase_spread > _LOCKED_PHASE or amplitude_spread > _FLAT_AMPLITUDE:
        return ""
    return (
        f"phi2 - 2 phi1 is constant to {phase_spread:.3f} rad and A2/A1^2 to {100 * amplitude_spread:.1f} % over "
        "the scan: distortion in the detector (kappa a1^2) gives that as well as contact does. Without far-field "
        "data that tell the two apart no modulus can be concluded from A2. If it was corrected before, say so: "
        "--corrected"
    )

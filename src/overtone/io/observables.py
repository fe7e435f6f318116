"""Channels of a file become observables: names, units, phase reference, and what is missing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from overtone.errors import (
    ChannelError,
    ChannelWarning,
    DistortionWarning,
    PhaseReferenceWarning,
    ResonanceWarning,
    UncalibratedWarning,
)
from overtone.harmonics import far_phase, read_receptance, to_force_harmonics
from overtone.io.netcdf import REFERENCE
from overtone.io.opening import kept_warnings, with_history
from overtone.io.recording import Recording
from overtone.io.registry import read_channels
from overtone.io.resonance import PLAUSIBLE_PHASE, free_phase_error, rank_resonances
from overtone.io.selection import Request, check_request, choose, drop_unpaired, in_si, one_frame
from overtone.io.vendors import Vendor, vendor_of
from overtone.probe import SLOPE, Probe
from overtone.quantities import harmonic_orders, named_array, validate_observables
from overtone.readings import Reading, parse_reading, with_reading
from overtone.units import format_quantity

# Where the phase of the second harmonic follows twice the first this closely and its amplitude varies this
# little, kappa a1^2 of a photodiode explains it as well as contact does.
_LOCKED_PHASE = 0.05
_FLAT_AMPLITUDE = 0.07
_PRODUCED = 0.05  # share of the drive force that DISS_1 may fall below zero by a small error of the phase
_AXES = {
    "x": ("m", "fast axis"),
    "y": ("m", "slow axis"),
    "z": ("m", "height of the base"),
    "time": ("s", "time"),
}
# Where files name the imaging mode, and what they call tapping.
_MODE_KEYS = ("ImagingMode", "@MicroscopeList")
_TAPPING = ("AC Mode", "Tapping", 'S [TMMode] "Tapping"')
# Settings of a lift pass that differ from those of the main one by more than their digits in the file.
_SAME_SETTING = 1e-5


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
    lift: bool = False,
    keep_offset: bool = False,
    frame: int | None = None,
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
        Channel name to the SI value of one count, for channels without a unit, or of one volt, for lengths in volts.
    far_phase : float, optional
        Reading of the first-harmonic phase channel far from the surface [rad]. Without it the vendor's zero
        is taken where it is known; where it is not, this is required.
    phase_sign : int
        1 where the stored phases are lags, -1 where they are leads.
    direction : str, optional
        ``trace`` or ``retrace`` where the file holds both.
    corrected : bool
        True states that A0 was freed of its offset and the higher harmonics of detector distortion beforehand.
    lift : bool
        True opens the Nap or Lift pass, which never mixes with the main one: channels ``Nap...`` of Asylum,
        variables ``lift_A0``, ``lift_A1``, ... of a netCDF file. Its A0 is kept whatever its offset.
    keep_offset : bool
        True keeps A0 whatever its offset, for a scan that a calibration is to correct (`overtone.correct`).
    frame : int, optional
        Which frame of a video, from 1; needed where a file has several.

    Returns
    -------
    Dataset
        Observables in SI units. Its attributes hold the source, the detector, how the file was read (see
        `overtone.readings`), findings and history (see `overtone.provenance`), and where the file tells the
        ``direction`` of its lines; of a lift pass also ``pass`` and ``lift_height`` [m].

    Raises
    ------
    OvertoneError
        If the file cannot be read, A1 or phi1 is missing, a channel is ambiguous, the probe is not known,
        the zero of the phase is not, or there is no lift pass where one is wanted.

    Warns
    -----
    OvertoneWarning
        Whatever in the file is doubtful: its probe, its phase, a channel without unit, flattened or saturated.
    """
    request = Request(
        probe,
        channels or {},
        scales or {},
        far_phase,
        phase_sign,
        direction,
        corrected,
        lift,
        keep_offset=lift or keep_offset,
        frame=frame,
    )
    with kept_warnings() as said:
        recording = read_channels(path)
        dataset = observables_of(recording, request)
    return with_history(dataset, "open_scan", path, request, [*recording.notes, *said])


def observables_of(recording: Recording, request: Request) -> xr.Dataset:
    """Turn a recording into observables, with everything that speaks against them in warnings.

    Raises
    ------
    OvertoneError
        As `open_scan` does.
    """
    recording = one_frame(recording, request.frame)
    check_request(recording, request)
    chosen = choose(recording, request)
    reading = _reading(recording, request)
    vendor = vendor_of(recording)
    turn = _turn(recording, vendor, reading.probe, request)
    coords = coordinates_of(recording)
    arrays: dict[str, xr.DataArray] = {}
    for name, values in in_si(chosen, request, recording.facts).items():
        if name.startswith("phi"):
            values = request.phase_sign * values + int(name[3:]) * turn
        arrays[name] = named_array(name, values, recording.dims, coords, channel=chosen[name].name)
    drop_unpaired(arrays)
    attributes: dict[str, object] = {
        "source": recording.path.name,
        "vendor": recording.vendor,
        "detector": recording.metadata.get("detector", reading.probe.detector.kind),
    }
    if chosen["A1"].direction:
        attributes["direction"] = chosen["A1"].direction
    if request.lift:
        attributes["pass"] = "lift"
        if "lift_height" in recording.facts:
            attributes["lift_height"] = recording.facts["lift_height"].value
    attributes |= _of_its_correction(recording, request)
    if "calibration" in attributes:
        for channel in recording.channels:
            if channel.name == REFERENCE:
                flags = channel.values.astype(np.int8)
                arrays[REFERENCE] = named_array(REFERENCE, flags, recording.dims, coords)
    dataset = validate_observables(xr.Dataset(arrays, attrs=attributes))
    _check_probe(recording, dataset, reading.probe)
    known_drive = not request.lift or _shares_drive(recording)
    established = (
        reading.phase_established
        and known_drive
        and _is_tapping(recording)
        and _loses_energy(dataset, reading.probe)
    )
    doubts = _doubts(dataset, reading, vendor)
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


def coordinates_of(recording: Recording) -> dict[str, xr.DataArray]:
    """Return the coordinates of a recording with their units."""
    coords = {}
    for dim, values in recording.coords.items():
        if dim in recording.dims:
            unit, meaning = _AXES.get(dim, ("1", dim))
            coords[dim] = xr.DataArray(values, dims=dim, attrs={"units": unit, "long_name": meaning})
    return coords


# --- probe and phase ------------------------------------------------------------------------------


def _reading(recording: Recording, request: Request) -> Reading:
    """Return the probe to use, and what the file leaves open."""
    probe, far_reading = request.probe, request.far_phase
    stored = parse_reading(recording.metadata)
    corrected = request.corrected or (stored is not None and stored.corrected)
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


def _turn(recording: Recording, vendor: Vendor, probe: Probe, request: Request) -> float:
    """Return what to add to the first-harmonic phase so that far from the sample it is the probe's own."""
    if request.far_phase is not None:
        return far_phase(probe) - request.phase_sign * request.far_phase
    if not vendor.phase_known:
        free = recording.facts.get("free_phase")
        reading = f"{math.degrees(free.value):.4g} deg" if free else "1.57 rad"
        raise ChannelError(
            f"the zero of the phase in {recording.path.name} is not known",
            expected="the reading of the phase channel far from the surface, as a reference",
            got=vendor.phase_note,
            hint=f'--far-phase "{reading}"'
            + (f" if that is what {free.key} in the file means" if free else "")
            + ", and --phase-sign -1 if the stored phases are leads",
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


def _of_its_correction(recording: Recording, request: Request) -> dict[str, object]:
    """Return the calibration that a saved scan was corrected with: what that left open is an error of every pixel.

    Nothing where another probe is to be believed than the one that calibration belongs to.
    """
    stored = parse_reading(recording.metadata)
    if stored is None or not stored.corrected or request.probe not in (None, stored.probe):
        return {}
    return {key: recording.metadata[key] for key in ("calibration",) if key in recording.metadata}


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
    mode = next((recording.metadata[key] for key in _MODE_KEYS if key in recording.metadata), "AC Mode")
    if mode in _TAPPING:
        return True
    warnings.warn(
        f"the file says {mode}, not AC mode: if its amplitude is no tapping amplitude, nothing here holds; no regime "
        "is decided",
        ChannelWarning,
        stacklevel=2,
    )
    return False


def _shares_drive(recording: Recording) -> bool:
    """Warn where a lift pass has settings of its own for the drive, which the probe does not describe."""
    facts = recording.facts
    other = [
        f"{format_quantity(facts[lift].value, facts[lift].unit, 6)} ({facts[lift].key}) instead of "
        f"{format_quantity(facts[main].value, facts[main].unit, 6)}"
        for lift, main in (
            ("lift_drive_frequency", "drive_frequency"),
            ("lift_drive_amplitude", "drive_amplitude"),
        )
        if lift in facts
        and main in facts
        and not math.isclose(facts[lift].value, facts[main].value, rel_tol=_SAME_SETTING)
    ]
    if not other:
        return True
    warnings.warn(
        f"the file has a drive of its own for the lift pass, {' and '.join(other)}; whether it was in force is not "
        "known, so the probe of the main pass may not be the one here; no regime is decided",
        ResonanceWarning,
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

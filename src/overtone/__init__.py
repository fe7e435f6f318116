"""overtone: nanomechanics from an ordinary tapping-mode AFM scan, with an answer to "how sure?".

SI units and radians everywhere. Names are imported where they are first used, so that the command
line answers quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from overtone._version import __version__

if TYPE_CHECKING:
    from overtone.batch.files import map_files as map_files
    from overtone.beam import beam_modes as beam_modes
    from overtone.contact.evaluate import force as force
    from overtone.contact.evaluate import force_harmonics as force_harmonics
    from overtone.contact.models import models as models
    from overtone.contact.sample import Sample as Sample
    from overtone.contact.sample import sample as sample
    from overtone.contact.validity import tabor_parameter as tabor_parameter
    from overtone.dynamics.curve import approach_curve as approach_curve
    from overtone.dynamics.hold import hold_amplitude as hold_amplitude
    from overtone.dynamics.steady import steady_states as steady_states
    from overtone.harmonics import to_force_harmonics as to_force_harmonics
    from overtone.harmonics import to_observables as to_observables
    from overtone.inspection.scan import inspect_scan as inspect_scan
    from overtone.instrument.approach_fit import Reference as Reference
    from overtone.instrument.calibrate import calibrate as calibrate
    from overtone.instrument.calibration import Calibration as Calibration
    from overtone.instrument.calibration import load_calibration as load_calibration
    from overtone.instrument.calibration import save_calibration as save_calibration
    from overtone.instrument.correct import calibration_of as calibration_of
    from overtone.instrument.correct import correct as correct
    from overtone.instrument.curve import simulate_approach as simulate_approach
    from overtone.instrument.curve import simulate_far_field as simulate_far_field
    from overtone.instrument.demodulate import demodulate as demodulate
    from overtone.instrument.gates import gates as gates
    from overtone.instrument.instrument import Instrument as Instrument
    from overtone.instrument.noise import noise_from_pair as noise_from_pair
    from overtone.instrument.noise_sources import noise_from_bandwidth as noise_from_bandwidth
    from overtone.instrument.noise_sources import noise_from_scan as noise_from_scan
    from overtone.instrument.photodiode import SplitDiode as SplitDiode
    from overtone.instrument.scan import simulate_scan as simulate_scan
    from overtone.instrument.sensitivity import static_sensitivity as static_sensitivity
    from overtone.instrument.surface import lever_near_surface as lever_near_surface
    from overtone.instrument.surface import resonance_from_ladder as resonance_from_ladder
    from overtone.instrument.thermal import fit_thermal as fit_thermal
    from overtone.instrument.thermal import thermal_spectrum as thermal_spectrum
    from overtone.instrument.thermal_noise import thermal_noise_density as thermal_noise_density
    from overtone.instrument.tip import tip_radius as tip_radius
    from overtone.instrument.tip import tip_wear as tip_wear
    from overtone.instrument.toml import load_instrument as load_instrument
    from overtone.instrument.toml import save_instrument as save_instrument
    from overtone.inversion.priors import Prior as Prior
    from overtone.inversion.properties import map_energy as map_energy
    from overtone.inversion.properties import map_properties as map_properties
    from overtone.inversion.reconstruction import reconstruct_force as reconstruct_force
    from overtone.inversion.validity import contact_validity as contact_validity
    from overtone.io.curves import open_curve as open_curve
    from overtone.io.export import load as load
    from overtone.io.export import save as save
    from overtone.io.ladder import open_ladder as open_ladder
    from overtone.io.observables import open_scan as open_scan
    from overtone.io.quadratures import from_quadratures as from_quadratures
    from overtone.io.quadratures import read_quadratures as read_quadratures
    from overtone.io.registry import read_channels as read_channels
    from overtone.io.spectrum import read_spectrum as read_spectrum
    from overtone.io.traces import read_trace as read_trace
    from overtone.planning.experiment import plan_experiment as plan_experiment
    from overtone.population.stack import stack_scans as stack_scans
    from overtone.presets import preset as preset
    from overtone.probe import Probe as Probe
    from overtone.probe import load_probe as load_probe
    from overtone.probe import save_probe as save_probe
    from overtone.readings import probe_of as probe_of
    from overtone.report.paper import write_paper as write_paper

# Public name to the module it lives in.
_HOME = {
    "Calibration": "instrument.calibration",
    "Instrument": "instrument.instrument",
    "Prior": "inversion.priors",
    "Probe": "probe",
    "Reference": "instrument.approach_fit",
    "Sample": "contact.sample",
    "SplitDiode": "instrument.photodiode",
    "approach_curve": "dynamics.curve",
    "beam_modes": "beam",
    "calibrate": "instrument.calibrate",
    "calibration_of": "instrument.correct",
    "contact_validity": "inversion.validity",
    "correct": "instrument.correct",
    "demodulate": "instrument.demodulate",
    "fit_thermal": "instrument.thermal",
    "force": "contact.evaluate",
    "force_harmonics": "contact.evaluate",
    "from_quadratures": "io.quadratures",
    "gates": "instrument.gates",
    "hold_amplitude": "dynamics.hold",
    "inspect_scan": "inspection.scan",
    "lever_near_surface": "instrument.surface",
    "load": "io.export",
    "load_calibration": "instrument.calibration",
    "load_instrument": "instrument.toml",
    "load_probe": "probe",
    "map_energy": "inversion.properties",
    "map_files": "batch.files",
    "map_properties": "inversion.properties",
    "models": "contact.models",
    "noise_from_bandwidth": "instrument.noise_sources",
    "noise_from_pair": "instrument.noise",
    "noise_from_scan": "instrument.noise_sources",
    "open_curve": "io.curves",
    "open_ladder": "io.ladder",
    "open_scan": "io.observables",
    "plan_experiment": "planning.experiment",
    "preset": "presets",
    "probe_of": "readings",
    "read_channels": "io.registry",
    "read_quadratures": "io.quadratures",
    "read_spectrum": "io.spectrum",
    "read_trace": "io.traces",
    "reconstruct_force": "inversion.reconstruction",
    "resonance_from_ladder": "instrument.surface",
    "sample": "contact.sample",
    "save": "io.export",
    "save_calibration": "instrument.calibration",
    "save_instrument": "instrument.toml",
    "save_probe": "probe",
    "simulate_approach": "instrument.curve",
    "simulate_far_field": "instrument.curve",
    "simulate_scan": "instrument.scan",
    "stack_scans": "population.stack",
    "static_sensitivity": "instrument.sensitivity",
    "steady_states": "dynamics.steady",
    "tabor_parameter": "contact.validity",
    "thermal_noise_density": "instrument.thermal_noise",
    "thermal_spectrum": "instrument.thermal",
    "tip_radius": "instrument.tip",
    "tip_wear": "instrument.tip",
    "to_force_harmonics": "harmonics",
    "to_observables": "harmonics",
    "write_paper": "report.paper",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        message = f"module 'overtone' has no attribute {name!r}"
        raise AttributeError(message)
    return getattr(import_module(f"overtone.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)

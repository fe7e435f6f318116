"""Kernels compiled once on a computer before its workers need them, all of them at the same moment."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import xarray as xr

from overtone.batch.mapping import map_observables
from overtone.batch.settings import POPULATION, Settings
from overtone.demo import demo_probe
from overtone.readings import Reading, with_reading

_READINGS = {
    "A0": 20e-12,
    "A1": 39e-9,
    "phi1": 2.0,
    "A2": 60e-12,
    "phi2": 4.0,
    "A3": 30e-12,
    "phi3": 1.0,
}
_PIXELS = 4


def warm_up(settings: Settings) -> None:
    """Map a few pixels as files with these settings are mapped; what goes wrong there is the files' to tell.

    Processes that compile the same kernel at once write to the same place on the disk.
    """
    like = {name: ("point", np.full(_PIXELS, value)) for name, value in _READINGS.items()}
    scan = with_reading(xr.Dataset(like), Reading(settings.probe or demo_probe(), corrected=True))
    method = "posterior" if settings.method == POPULATION else settings.method
    with suppress(Exception):
        map_observables(scan, replace(settings, method=method, calibration=None, noise=None))

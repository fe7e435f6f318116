"""What a microscope's file holds, before anything is concluded from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Channel:
    """One recorded channel.

    Parameters
    ----------
    name : str
        Label as in the file, without line direction and vendor junk, for example ``Amplitude`` or ``M2A``.
    values : array, dims of the recording
        Values in ``unit``; row 0 of a map is the top of the image.
    unit : str or None
        SI unit (``m``, ``rad``, ``V``, ``Hz``), None where the file states none.
    direction : str or None
        ``trace`` or ``retrace`` where the file says so.
    nap : bool
        Whether it belongs to a Nap or Lift pass, which never mixes with the main one.
    flattened : bool or None
        Whether a plane or line fit was subtracted, None where the file does not say.
    """

    name: str
    values: npt.NDArray[np.float64]
    unit: str | None
    direction: str | None = None
    nap: bool = False
    flattened: bool | None = None


@dataclass(frozen=True)
class Fact:
    """A number the file states about the instrument, in SI units, with the key it stands under."""

    value: float
    unit: str
    key: str
    factory_default: bool = False
    """True where the value is the vendor's placeholder for "never calibrated"."""


@dataclass(frozen=True)
class Resonance:
    """A pair of resonance frequency [Hz] and quality factor that the file holds."""

    source: str
    """``tune`` or ``thermal``: how it was measured; ``nominal`` where nobody is known to have."""
    frequency: float
    quality_factor: float
    keys: tuple[str, str]
    factory_default: bool = False


@dataclass(frozen=True)
class Recording:
    """All channels of one file with its coordinates and metadata.

    Parameters
    ----------
    path : Path
        The file.
    format : str
        Key of the format that read it.
    vendor : str
        Key of the vendor preset that names its channels.
    dims : tuple of str
        Dimensions of every channel: ``("y", "x")`` for a map, ``("frame", "y", "x")`` for a video, ``("point",)`` for
        a curve or a table, ``("time",)`` for what was demodulated.
    coords : mapping
        Coordinate arrays by dimension, in metres and ``time`` in seconds; absent where the file has none. A curve
        over ``z`` may have ``time`` as well.
    channels : tuple of Channel
        In the order of the file.
    facts : mapping
        Facts by name: ``stiffness``, ``drive_frequency``, ``free_amplitude``, ``free_phase``,
        ``setpoint_amplitude``, ``tune_amplitude``, ``amplitude_sensitivity``,
        ``second_lockin_frequency``, ``drive_amplitude`` [V], ``drive_phase``; ``scale:<channel>`` [m/V], what a volt of
        that channel means, ``offset:<channel>``, what to add to it, ``deflection_sensitivity`` [m/V];
        ``free_amplitude_volts``, ``setpoint_volts`` and ``setpoint_fraction`` where the file has these;
        ``sampling_step`` [s] between the points of a curve or a plain wave; of files with a lift pass
        ``lift_height``, ``lift_drive_frequency`` and ``lift_drive_amplitude`` [V].
    resonances : tuple of Resonance
        Every (frequency, quality factor) pair in the file.
    metadata : mapping
        Raw header, key to text. ``zero of z`` says where z is zero in a netCDF file that knows.
    notes : tuple of str
        What the reader noticed, for a person to read.
    """

    path: Path
    format: str
    vendor: str
    dims: tuple[str, ...]
    coords: Mapping[str, npt.NDArray[np.float64]]
    channels: tuple[Channel, ...]
    facts: Mapping[str, Fact] = field(default_factory=dict)
    resonances: tuple[Resonance, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

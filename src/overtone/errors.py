"""Errors and warnings: every message says what was expected, what arrived and what to try."""

from __future__ import annotations


def _closed(sentence: str) -> str:
    """Return the sentence with a full stop, unless it ends with a mark of its own."""
    return sentence if sentence.endswith((".", "?", "!")) else sentence + "."


class OvertoneError(Exception):
    """Base class of every error raised by overtone on purpose.

    Parameters
    ----------
    problem : str
        What went wrong, one clause.
    expected, got, hint : str, optional
        What was expected, what arrived, and what to try.

    Examples
    --------
    >>> print(OvertoneError("no stiffness", expected="a positive number", got="-1 N/m", hint="check the probe"))
    no stiffness: expected a positive number, got -1 N/m. Try: check the probe.
    """

    def __init__(
        self, problem: str, *, expected: str | None = None, got: str | None = None, hint: str | None = None
    ) -> None:
        parts = [f"expected {expected}" if expected else "", f"got {got}" if got else ""]
        detail = ", ".join(part for part in parts if part)
        message = f"{problem}: {detail}" if detail else problem
        message = _closed(message)
        if hint:
            message += f" Try: {_closed(hint)}"
        super().__init__(message)


class UnitError(OvertoneError):
    """A quantity without a unit, with an unknown one, or with one that does not fit."""


class FileFormatError(OvertoneError):
    """A file that is missing, damaged, or not what its name says."""


class ChannelError(OvertoneError):
    """A channel that is missing, ambiguous, or of the wrong kind."""


class ProbeError(OvertoneError):
    """A probe description that is incomplete or unphysical."""


class ObservablesError(OvertoneError):
    """A dataset that does not keep the contract of its kind."""


class ContactModelError(OvertoneError):
    """An unknown contact model, or parameters that do not fit it."""


class InversionError(OvertoneError):
    """A call for an inversion that cannot be made with these arguments."""


class CalibrationError(OvertoneError):
    """Data that cannot calibrate an instrument, or a calibration that does not fit its scan."""


class OvertoneWarning(UserWarning):
    """Base class of overtone's warnings: doubtful data, never a wrong call."""


class UncalibratedWarning(OvertoneWarning):
    """The file carries factory defaults where a calibration belongs, or the probe is a nominal one."""


class ResonanceWarning(OvertoneWarning):
    """The file holds several resonances or none that fits, or a mode of the lever meets a harmonic."""


class PhaseReferenceWarning(OvertoneWarning):
    """The zero of the phase is not established."""


class DistortionWarning(OvertoneWarning):
    """A higher harmonic looks like detector distortion as much as like contact."""


class ChannelWarning(OvertoneWarning):
    """A channel is missing, has no unit, or was flattened."""


class CurveWarning(OvertoneWarning):
    """An approach curve jumps, ends too early, or does not follow from one force."""


class CalibrationWarning(OvertoneWarning):
    """A calibration that leaves something open, or data that do not quite fit it."""

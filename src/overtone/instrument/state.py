"""What is believed of an instrument while a scan is corrected: as it was calibrated, and as it is now.

The two differ by what has drifted. A lift pass measures what is now. The reference material measures the drift: the
approach curve on it was corrected with the numbers of the calibration, so what is wrong with them is wrong in both, and
cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.errors import CalibrationError
from overtone.instrument.calibration import Calibration
from overtone.instrument.unknowns import NAMES

_Floats = npt.NDArray[np.float64]


class State(NamedTuple):
    """Unknowns of an instrument with their joint covariance."""

    values: dict[str, float]
    """Now."""
    calibrated: dict[str, float]
    """As calibrated, which measurements may move as well."""
    names: tuple[str, ...]
    covariance: _Floats
    """(2 name, 2 name): as calibrated, then now."""

    @property
    def left(self) -> _Floats:
        """Covariance (name, name) of what is now."""
        return self.covariance[len(self.names) :, len(self.names) :]

    def error(self, name: str) -> float:
        """Return the standard deviation of an unknown now, 0 for one that is not among them."""
        if name not in self.names:
            return 0.0
        index = self.names.index(name)
        return math.sqrt(max(float(self.left[index, index]), 0.0))

    def row(self, **weights: float) -> _Floats:
        """Return the derivatives (name,) of a sum of unknowns; those that are not there do not count."""
        return np.array([weights.get(name, 0.0) for name in self.names])

    def measured(self, off: _Floats, H: _Floats, variance: _Floats) -> State:
        """Return the state after measurements of what is now.

        Parameters
        ----------
        off : array (measurement,)
            What was measured less what the state predicts.
        H : array (measurement, name)
            Derivatives of the prediction.
        variance : array (measurement,)
            Of independent errors.
        """
        return self._updated(off, np.concatenate([np.zeros_like(H), H], axis=1), variance)

    def compared(self, off: _Floats, H: _Floats, before: _Floats, variance: _Floats) -> State:
        """Return the state after measurements of ``H @ now - before @ calibrated``; arguments as in `measured`."""
        return self._updated(off, np.concatenate([-before, H], axis=1), variance)

    def _updated(self, off: _Floats, H: _Floats, variance: _Floats) -> State:
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale[scale == 0.0] = 1.0
        C, H = self.covariance / np.outer(scale, scale), H * scale
        S = H @ C @ H.T + np.diag(variance)
        # rows of all sizes, from metres to radians
        size = np.sqrt(np.diag(S))
        K = np.linalg.solve(S / np.outer(size, size), (H @ C) / size[:, None]).T / size
        change = scale * (K @ off)
        # Joseph's form stays positive whatever rounding does
        left = np.eye(C.shape[0]) - K @ H
        covariance = left @ C @ left.T + (K * variance) @ K.T
        covariance = 0.5 * (covariance + covariance.T) * np.outer(scale, scale)
        count = len(self.names)
        return State(
            _moved(self.values, self.names, change[count:]),
            _moved(self.calibrated, self.names, change[:count]),
            self.names,
            covariance,
        )


def _moved(values: Mapping[str, float], names: tuple[str, ...], change: _Floats) -> dict[str, float]:
    return {**values, **{name: values[name] + float(d) for name, d in zip(names, change, strict=True)}}


def drifting(calibration: Calibration, drift: Mapping[str, float]) -> State:
    """Return the state of an instrument that may have drifted since its calibration.

    Parameters
    ----------
    calibration : Calibration
        As it was.
    drift : mapping of str to float
        Standard deviation of the change of each unknown [SI]; those that the calibration lacks do not count.

    Raises
    ------
    CalibrationError
        If a name is no unknown, or a number makes no sense.
    """
    for name, width in drift.items():
        if name not in NAMES:
            raise CalibrationError(f"{name!r} is no unknown of an instrument", expected=", ".join(NAMES))
        if not 0.0 <= width < math.inf:
            raise CalibrationError(
                f"the drift of {name} makes no sense",
                expected="a standard deviation, 0 or more",
                got=repr(width),
            )
    C = calibration.covariance
    walk = np.diag([drift.get(name, 0.0) ** 2 for name in calibration.names])
    return State(
        dict(calibration.values),
        dict(calibration.values),
        calibration.names,
        np.block([[C, C], [C, C + walk]]),
    )

"""The force of a contact model, and its harmonics on a motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact.models import ContactModel, contact_model
from overtone.contact.motion import harmonics_on_motion
from overtone.contact.parameters import Values, check_shapes, resolve
from overtone.errors import ContactModelError


def force(model: str, gap: Any, velocity: Any = 0.0, **parameters: Any) -> npt.NDArray[np.float64]:
    """Return the force between tip and sample, repulsion positive.

    Parameters
    ----------
    model : str
        Key of a contact model.
    gap : array, any shape
        Gap d [m], negative in contact.
    velocity : array, broadcast against ``gap``
        d(gap)/dt [m/s]; positive on retraction.
    **parameters
        Parameters of the model in SI units, broadcast against ``gap``.

    Returns
    -------
    array
        Force [N].

    Raises
    ------
    ContactModelError
        If a parameter is missing, unknown or out of range, or shapes do not fit.

    Examples
    --------
    >>> float(round(1e9 * force("hertz", -2e-9, radius=10e-9, modulus=1e9, poisson_ratio=0.3), 3))
    13.005
    """
    record = contact_model(model)
    values = resolve(model, tuple(q for q in record.parameters if q.name != "frequency"), parameters)
    d, v = np.asarray(gap, dtype=float), np.asarray(velocity, dtype=float)
    check_shapes(values, gap=d, velocity=v)
    return np.asarray(sum(term.law(values, d, v) for term in record.terms))


def force_harmonics(
    model: str,
    *,
    amplitude: Any,
    indentation: Any,
    n_max: int = 3,
    higher: Any = None,
    **parameters: Any,
) -> npt.NDArray[np.complex128]:
    """Return the harmonics of the force on the motion ``d = -delta_max + A1 (1 + cos theta)``.

    Parameters
    ----------
    model : str
        Key of a contact model.
    amplitude : array, any shape
        A1 [m], positive.
    indentation : array, broadcast
        delta_max [m]; negative where the tip stays out of contact.
    n_max : int
        Highest harmonic.
    higher : array, optional
        Harmonics of the motion beyond eq 10: ``b_n = A_n exp(i (n phi1 - phi_n))`` [m], complex, last axis
        n = 2, 3, ..., broadcast in front. ``indentation`` then is the one at theta = pi,
        ``A1 - Z - A0 - sum (-1)^n A_n cos(n phi1 - phi_n)``. By quadrature instead of the closed form.
    **parameters
        Parameters of the model in SI units, broadcast against ``amplitude``; ``frequency`` [Hz] only where
        the model has a loss that depends on speed.

    Returns
    -------
    array
        ``CONS_n - i DISS_n`` [N], the broadcast shape with a last axis n = 0..n_max.

    Raises
    ------
    ContactModelError
        If a parameter is missing, unknown or out of range, or shapes do not fit.

    Examples
    --------
    >>> f = force_harmonics("hertz", amplitude=40e-9, indentation=2e-9, radius=10e-9, modulus=1e9, poisson_ratio=0.3)
    >>> [float(round(1e9 * x, 4)) for x in f.real]
    [0.7727, -1.5325, 1.4943, -1.4321]
    """
    record = contact_model(model)
    if n_max < 0:
        raise ContactModelError("n_max is out of range", expected="0 or more", got=str(n_max))
    values = resolve(model, record.parameters, parameters)
    A, delta = np.asarray(amplitude, dtype=float), np.asarray(indentation, dtype=float)
    if not np.all(np.isfinite(A) & (A > 0.0)) or not np.all(np.isfinite(delta)):
        raise ContactModelError("amplitude and indentation must be finite, the amplitude positive")
    check_shapes(values, amplitude=A, indentation=delta)
    if higher is not None:
        return _on_motion(record, values, A, delta, np.asarray(higher, dtype=complex), n_max)
    parts = [term.harmonics(values, A, delta / (2.0 * A), n_max) for term in record.terms]
    return np.asarray(sum(parts), dtype=complex)


def _on_motion(
    record: ContactModel,
    values: Values,
    amplitude: npt.NDArray[np.float64],
    indentation: npt.NDArray[np.float64],
    higher: npt.NDArray[np.complex128],
    n_max: int,
) -> npt.NDArray[np.complex128]:
    """Return the harmonics on a motion with higher harmonics, point by point along one axis."""
    shapes = [amplitude.shape, indentation.shape, higher.shape[:-1], *(v.shape for v in values.values())]
    shape = np.broadcast_shapes(*shapes)
    flat = {name: np.broadcast_to(value, shape).reshape(-1, 1) for name, value in values.items()}
    A, delta = (np.broadcast_to(array, shape).ravel() for array in (amplitude, indentation))
    b = np.broadcast_to(higher, (*shape, higher.shape[-1])).reshape(-1, higher.shape[-1])
    # the ends of the linear tail and of a neck, where they differ between points the smallest serves as a cut
    kinks = [2.0 * flat["intermolecular_distance"].min()] if "intermolecular_distance" in flat else []
    kinks += [flat["rupture_distance"].min()] if "rupture_distance" in flat else []

    def law(gap: npt.NDArray[np.float64], velocity: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(sum(term.law(flat, gap, velocity) for term in record.terms))

    frequency = float(np.max(values.get("frequency", np.asarray(1.0))))
    result = harmonics_on_motion(law, A, delta, b, n_max, frequency, tuple(kinks))
    return result.reshape(*shape, n_max + 1)

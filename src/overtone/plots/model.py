"""A contact model at a glance: its force against the gap, and its harmonics against indentation."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from overtone.contact.evaluate import force as model_force
from overtone.contact.evaluate import force_harmonics
from overtone.contact.models import contact_model
from overtone.errors import ContactModelError

_RECONSTRUCTED = 200  # harmonics behind the force curve: enough for the sharpest onset that a figure shows
_DEEPEST = 0.25


def model_figure(key: str, values: Mapping[str, float], amplitude: float = 40e-9) -> Figure:
    """Return the force along a tapping cycle, and harmonics 0 to 3 over the indentation.

    Parameters
    ----------
    key : str
        Key of a contact model.
    values : mapping of str to float
        Every parameter of the model [SI].
    amplitude : float
        A1 of the motion [m].
    """
    figure = Figure(figsize=(10.0, 4.0), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    depth = min(5e-9, _DEEPEST * amplitude)
    theta = np.linspace(0.0, 2.0 * math.pi, 8001)
    gap = -depth + amplitude * (1.0 + np.cos(theta))
    force = _along(key, values, amplitude, depth, theta)
    near = gap < 2.5 * depth
    for half, label, style in ((theta <= math.pi, "approach", "-"), (theta >= math.pi, "retraction", "--")):
        left.plot(gap[near & half] * 1e9, force[near & half] * 1e9, style, label=label)
    left.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    left.axvline(0.0, color="0.8", linewidth=0.8, zorder=0)
    left.set(xlabel="gap d [nm]", ylabel="force [nN]", title=f"{key}: one tap")
    left.legend(frameon=False)
    indentation = np.linspace(-0.5 * depth, 2.0 * depth, 150)
    f = force_harmonics(key, amplitude=amplitude, indentation=indentation, n_max=3, **values)
    for n in range(4):
        right.plot(indentation * 1e9, f[:, n].real * 1e9, color=f"C{n}", label=f"CONS {n}")
        if abs(f[:, n].imag).max() > 1e-12 * abs(f).max():
            right.plot(indentation * 1e9, -f[:, n].imag * 1e9, ":", color=f"C{n}", label=f"DISS {n}")
    right.set(
        xlabel="maximum indentation [nm]", ylabel="force harmonic [nN]", title=f"A1 = {amplitude * 1e9:g} nm"
    )
    right.legend(frameon=False, fontsize=8)
    return figure


def _along(
    key: str,
    values: Mapping[str, float],
    amplitude: float,
    depth: float,
    theta: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Return the force along the cycle: from the law, or from many harmonics where it depends on history."""
    speed = 2.0 * math.pi * values.get("frequency", 0.0) * amplitude
    given = {name: value for name, value in values.items() if name != "frequency"}
    try:
        return model_force(
            key, -depth + amplitude * (1.0 + np.cos(theta)), -max(speed, 1e-12) * np.sin(theta), **given
        )
    except ContactModelError:
        pass
    f = force_harmonics(key, amplitude=amplitude, indentation=depth, n_max=_RECONSTRUCTED, **values)
    # Lanczos factors take the ringing off a force with steps
    orders = np.arange(_RECONSTRUCTED + 1)
    smooth = f * np.sinc(orders / (_RECONSTRUCTED + 1))
    return np.asarray((smooth @ np.exp(1j * orders[:, None] * theta)).real)


def example_values(key: str) -> dict[str, float]:
    """Return an ordinary value of every parameter of a model, for a first look."""
    parameters = contact_model(key).parameters
    return {q.name: q.example if q.default is None else q.default for q in parameters}

"""An approach curve before and after its correction, and the fit on the reference (figures 8 and 9 of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from overtone.errors import ObservablesError
from overtone.instrument.calibrate import split_curve
from overtone.instrument.calibration import Calibration
from overtone.instrument.far_field import FarPoints, ladder_points
from overtone.instrument.signals import Signals, in_the_frame_of_the_first, signals_of
from overtone.instrument.unknowns import HIGHER, distortion, undo, wrapped
from overtone.plots.categories import PALETTE
from overtone.plots.scales import Array, Mask
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, set_title, typeset, with_unit
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.quantities import quantity
from overtone.units import display_unit, format_quantity

_COLUMNS = 3
_COLUMN_WIDTH = 3.4
_RATIO = 0.75
_MARGIN = 0.06
_FAR = 1.2  # of the way in contact: so much of the far part is drawn
_SEEN = 4.0  # of the noise of an amplitude: its phase means something
_SAME = 0.25  # [rad] from the phase of the fit: another branch of the curve has the same amplitudes
_BAND = 2.0  # standard deviations
_KEY_ROOM = 0.3  # of the height of a panel, for a legend above its data
_SMALLEST = {"m": 1e-15, "rad": 1e-6}  # what is drawn as nothing

_RAW, _FIT = "0.62", "0.1"
_CORRECTED = PALETTE[0]
_DISTORTION = PALETTE[5]
_DOTS: Mapping[str, Any] = {"linestyle": "", "marker": "o", "markersize": 2.6, "markeredgewidth": 0.0}
_Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class _Curve:
    """Readings over the height above the onset, from near to far, as far as they are drawn."""

    x: Array
    """[nm], negative in contact."""
    raw: Signals
    clean: Signals
    fit: Mapping[int, _Complex]
    """What the reference says at the amplitude of each reading: mean deflection, and e_n in the frame of the first."""
    noise: Mapping[int, float]
    """Standard deviation of a corrected reading: of the mean, and of each quadrature of a harmonic [m]."""
    offset: float
    """Mean deflection as read far away [m]."""
    clear: float
    """From where on nothing is felt [nm]."""


def calibration_figure(
    raw: xr.Dataset,
    corrected: xr.Dataset,
    calibration: Calibration,
    far_field: xr.Dataset | None = None,
    heading: str = "",
) -> Figure:
    """Return an approach curve before and after its correction, and how well the fit on the reference follows it.

    Parameters
    ----------
    raw : Dataset
        Observables over ``z`` as the microscope stored them, those that were calibrated with.
    corrected : Dataset
        The same, out of `overtone.correct`.
    calibration : Calibration
        Without a reference there is no fit to be drawn.
    far_field : Dataset, optional
        The ladder that was calibrated with: shows distortion against amplitude.
    heading : str, optional
        What stands above the panels.

    Raises
    ------
    ObservablesError
        If the two curves have not the same heights.
    CalibrationError
        If the raw curve is none, begins in contact or never touches.
    """
    curve, left_out = _curve(raw, corrected, calibration)
    panels = _panels(curve)
    if curve.fit:
        panels += [partial(_draw_fit, curve=curve, n=n) for n in sorted(curve.fit)]
        if set(curve.fit) & set(curve.noise):
            panels.append(partial(_draw_residuals, curve=curve))
    points = ladder_points(far_field) if far_field is not None else None
    if points is not None:
        orders = [n for n in HIGHER if n in points.signals.phasor]
        panels += [partial(_draw_ladder, points=points, calibration=calibration, n=n) for n in orders]
    sheet = Sheet.new(len(panels), _COLUMNS, _COLUMN_WIDTH, _RATIO)
    for axes, draw in zip(sheet.cells, panels, strict=True):
        draw(axes)
    name = calibration.reference.name if calibration.reference is not None else ""
    return sheet.lay_out(
        " ".join(filter(None, (heading, left_out))), _legend(sheet.figure, curve, name, points)
    )


# --- what is drawn ------------------------------------------------------------------------------------------------


def _curve(raw: xr.Dataset, corrected: xr.Dataset, calibration: Calibration) -> tuple[_Curve, str]:
    """Return the part of both curves that is drawn, and a sentence on what is not."""
    parts = split_curve(raw)
    height = np.asarray(raw["z"].values, dtype=float)
    if corrected["A1"].dims != ("z",) or not np.array_equal(height, corrected["z"].values, equal_nan=True):
        raise ObservablesError(
            "raw and corrected curve do not fit",
            expected=f"the same {height.size} heights",
            got=str(dict(corrected["A1"].sizes)),
            hint="corrected = overtone.correct(raw, calibration)",
        )
    above = height - parts.onset
    farthest = -_FAR * float(np.nanmin(above))
    order = np.argsort(above)  # what has no height comes last
    order = order[above[order] <= farthest]
    x = above[order]
    lost = int(np.count_nonzero(above > farthest))
    left_out = (
        f"{lost} of {height.size} readings, beyond {1e9 * farthest:.3g} nm, are not drawn." if lost else ""
    )
    read, clean = _taken(signals_of(raw), order), _taken(signals_of(corrected), order)
    mean = parts.signals.mean
    offset = float(np.median(mean[parts.far])) if mean is not None else 0.0
    noise = {
        n: calibration.noise[f"A{n}"] / abs(calibration.values[f"gain{n}"])
        for n in (0, *HIGHER)
        if f"A{n}" in calibration.noise
    }
    clear = float(parts.height[parts.far].min()) - parts.onset
    fit = _on_the_reference(clean, calibration)
    return _Curve(1e9 * x, read, clean, fit, noise, offset, 1e9 * clear), left_out


def _taken(signals: Signals, order: npt.NDArray[np.intp]) -> Signals:
    mean = signals.mean[order] if signals.mean is not None else None
    return Signals(mean, {n: a[order] for n, a in signals.phasor.items()})


def _on_the_reference(clean: Signals, calibration: Calibration) -> dict[int, _Complex]:
    """Return what the fit says of the mean and of e_n [m] at each amplitude, NaN where it says nothing."""
    curve = calibration.curve
    if calibration.reference is None or "A1" not in curve:
        return {}
    from scipy.interpolate import PchipInterpolator

    known, first = np.unique(curve["A1"], return_index=True)
    if known.size < 2:
        return {}
    A, phase = np.abs(clean.phasor[1]), -np.angle(clean.phasor[1])

    def at(values: npt.ArrayLike) -> Array:
        between = PchipInterpolator(known, np.asarray(values)[first], extrapolate=False)
        return np.asarray(between(A), dtype=float)

    there = np.abs(wrapped(phase - at(curve["phi1"]))) < _SAME
    found: dict[int, _Complex] = {}
    if "A0" in curve and clean.mean is not None:
        found[0] = np.where(there, at(curve["A0"]), np.nan) + 0j
    for n in HIGHER:
        if f"e{n}_re" in curve and n in clean.phasor:
            found[n] = np.where(there, at(curve[f"e{n}_re"]) + 1j * at(curve[f"e{n}_im"]), np.nan)
    return found


def _panels(curve: _Curve) -> list[Callable[[Axes], None]]:
    """Return what draws readings before and after: the first harmonic, then the others."""
    raw, clean = curve.raw, curve.clean
    A = {n: (np.abs(raw.phasor[n]), np.abs(clean.phasor[n])) for n in raw.phasor if n in (1, *HIGHER)}
    whole = np.ones(curve.x.size, dtype=bool)
    panels: list[Callable[[Axes], None]] = [
        partial(_draw_both, curve=curve, title="amplitude", name="A1", before=A[1][0], after=A[1][1]),
        _phase_panel(curve, 1, "phase", whole),
    ]
    if 2 in A:
        # both quadratures of the noise, as stated and as it is where nothing is felt
        left = A[2][1][(curve.x > curve.clear) & np.isfinite(A[2][1])]
        scatter = math.sqrt(float(left @ left) / (2.0 * left.size)) if left.size else 0.0
        seen = A[2][1] > _SEEN * max(curve.noise.get(2, 0.0), scatter)
        panels.append(
            _phase_panel(curve, 2, "phase of harmonic 2, corrected where A2 is above its noise", seen)
        )
    if raw.mean is not None and clean.mean is not None:
        sign = "+" if curve.offset < 0.0 else "−"
        title = f"mean deflection, raw {sign} {format_quantity(abs(curve.offset), 'm')}"
        panels.append(
            partial(
                _draw_both,
                curve=curve,
                title=title,
                name="A0",
                before=raw.mean - curve.offset,
                after=clean.mean,
            )
        )
    for n in HIGHER:
        if n in A:
            title = f"amplitude of harmonic {n}"
            panels.append(
                partial(_draw_both, curve=curve, title=title, name=f"A{n}", before=A[n][0], after=A[n][1])
            )
    return panels


def _phase_panel(curve: _Curve, n: int, title: str, seen: Mask) -> Callable[[Axes], None]:
    """Return what draws a phase without jumps of a turn; where its amplitude is noise, so is the corrected one."""
    after = np.where(seen, -np.angle(curve.clean.phasor[n]), np.nan)
    shown = after[np.isfinite(after)]
    centre = float(np.angle(np.mean(np.exp(1j * shown)))) % (2.0 * math.pi) if shown.size else math.pi
    after = centre + wrapped(after - centre)
    before = -np.angle(curve.raw.phasor[n])
    known = np.isfinite(before)
    before[known] = np.unwrap(before[known])
    contact = float(np.median(before[known & (curve.x < 0.0)]))  # there is contact, or there is no onset
    before = before - 2.0 * math.pi * round((contact - centre) / (2.0 * math.pi))
    fit = None
    if n in curve.fit:  # back from the frame of the first harmonic
        fit = centre + wrapped(-np.angle(curve.fit[n]) - n * np.angle(curve.clean.phasor[1]) - centre)
    return partial(_draw_both, curve=curve, title=title, name=f"phi{n}", before=before, after=after, fit=fit)


# --- how it is drawn ----------------------------------------------------------------------------------------------


def _draw_both(
    axes: Axes, *, curve: _Curve, title: str, name: str, before: Array, after: Array, fit: Array | None = None
) -> None:
    """Draw readings before and after, and the fit where it says something that the readings do not define."""
    set_title(axes, title)
    unit, label = _unit(name, before, after)
    axes.plot(curve.x, before * unit, color=_RAW, label="raw", zorder=2, **_dots(3.6))
    axes.plot(curve.x, after * unit, color=_CORRECTED, label="corrected", zorder=3, **_DOTS)
    if fit is not None:
        axes.plot(curve.x, fit * unit, color=_FIT, linewidth=1.2, label="fit", zorder=4)
    _finish(axes, curve, label, np.concatenate([before, after]) * unit)


def _draw_fit(axes: Axes, *, curve: _Curve, n: int) -> None:
    """Draw corrected readings with the fit on the reference, and the noise about it."""
    fit = curve.fit[n].real if n == 0 else np.abs(curve.fit[n])
    after = curve.clean.mean if n == 0 else np.abs(curve.clean.phasor[n])
    assert after is not None  # there is no fit without it
    set_title(axes, "mean deflection and its fit" if n == 0 else f"harmonic {n} and its fit")
    unit, label = _unit(f"A{n}", after, fit)
    axes.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    axes.plot(curve.x, after * unit, color=_CORRECTED, label="corrected", zorder=3, **_DOTS)
    if n in curve.noise:
        # far away there is nothing, and what is read of an amplitude is noise alone
        middle = np.where(curve.x > curve.clear, 0.0, fit)
        side = _BAND * curve.noise[n]
        low = middle - side if n == 0 else np.maximum(middle - side, 0.0)
        axes.fill_between(
            curve.x, low * unit, (middle + side) * unit, color="0.85", linewidth=0.0, label="noise", zorder=1
        )
    axes.plot(curve.x, fit * unit, color=_FIT, linewidth=1.2, label="fit", zorder=4)
    _finish(axes, curve, label, np.concatenate([after, fit]) * unit)


def _draw_residuals(axes: Axes, *, curve: _Curve) -> None:
    """Draw what the fit leaves of each signal, in standard deviations of a reading."""
    set_title(axes, "corrected less fit, over the noise of a reading")
    frame = in_the_frame_of_the_first(curve.clean)
    rows: list[tuple[str, Array]] = []
    for n in sorted(set(curve.fit) & set(curve.noise)):
        if n == 0 and curve.clean.mean is not None:
            rows.append(("$A_0$", (curve.clean.mean - curve.fit[0].real) / curve.noise[0]))
        elif n > 0:
            left = (frame[n] - curve.fit[n]) / curve.noise[n]
            rows += [(f"Re $e_{n}$", left.real), (f"Im $e_{n}$", left.imag)]
    axes.axhspan(-_BAND, _BAND, color="0.9", linewidth=0.0, zorder=0)
    axes.axhline(0.0, color=_FIT, linewidth=0.8, zorder=1)
    for k, (label, values) in enumerate(rows):
        axes.plot(curve.x, values, color=PALETTE[k % len(PALETTE)], label=label, zorder=3, **_DOTS)
    values = np.concatenate([row for _, row in rows] + [np.array([-2.0 * _BAND, 2.0 * _BAND])])
    _finish(axes, curve, "residual / noise", values, above=_KEY_ROOM, contact=True)
    axes.legend(
        loc="upper left",
        ncols=3,
        frameon=False,
        fontsize=TICK_SIZE,
        borderaxespad=0.1,
        columnspacing=0.9,
        handletextpad=0.1,
        labelspacing=0.2,
        markerscale=1.6,
    )


def _draw_ladder(axes: Axes, *, points: FarPoints, calibration: Calibration, n: int) -> None:
    """Draw a harmonic without a sample against the first: as read, what is left, and what the detector makes of it."""
    set_title(axes, f"harmonic {n} without a sample")
    read, drive = points.signals, points.drive
    A, before = np.abs(read.phasor[1]), np.abs(read.phasor[n])
    clean = undo(read, calibration.values, calibration.amplitude)
    # crosstalk is known at the drive of the scan only
    after = np.where(np.isclose(drive, 1.0, rtol=1e-3), np.abs(clean.phasor[n]), np.nan)
    swept = np.linspace(0.0, float(np.nanmax(A, initial=0.0)), 200)
    first = np.asarray(swept, dtype=complex)
    fitted = np.abs(distortion(first, n, calibration.amplitude, calibration.values))
    unit, label = _unit(f"A{n}", before, fitted)
    across, below = _unit("A1", swept)
    axes.plot(A * across, before * unit, color=_RAW, zorder=3, **_dots(4.5))
    axes.plot(A * across, after * unit, color=_CORRECTED, zorder=4, **_dots(4.5))
    axes.plot(swept * across, fitted * unit, color=_DISTORTION, linewidth=1.4, zorder=2)
    high = float(np.nanmax(np.concatenate([before, fitted]), initial=1e-15)) * unit
    axes.set_xlim(0.0, float(swept[-1]) * across * (1.0 + _MARGIN) or 1.0)
    axes.set_ylim(-_MARGIN * high, (1.0 + _MARGIN) * high)
    _ticks(axes, below, label)


def _dots(size: float) -> dict[str, Any]:
    return {**_DOTS, "markersize": size}


def _unit(name: str, *arrays: Array) -> tuple[float, str]:
    """Return the factor to the unit in which arrays read best, and what to write at their axis."""
    record = quantity(name)
    assert record is not None  # names come from this module
    largest = max(float(np.abs(a[np.isfinite(a)]).max(initial=0.0)) for a in arrays)
    unit = display_unit(max(largest, _SMALLEST[record.unit]), record.unit)
    return unit.factor, with_unit(typeset(record.symbol), unit.label)


def _finish(
    axes: Axes, curve: _Curve, label: str, values: Array, above: float = 0.0, contact: bool = False
) -> None:
    """Set limits that hold all values, room above them, the onset, ticks and labels."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min(initial=math.inf)), float(finite.max(initial=-math.inf))
    if low > high:
        low, high = 0.0, 1.0
    if 0.0 < low < 0.4 * high:
        low = 0.0
    margin = _MARGIN * (high - low) or abs(high) or 1.0
    axes.set_ylim(low - margin, high + margin + above * (high - low))
    left, right = float(curve.x.min()), 0.0 if contact else float(curve.x.max())
    room = _MARGIN / 2.0 * (right - left) or 1.0
    axes.set_xlim(left - room, right + room)
    axes.axvline(0.0, color="0.75", linewidth=0.8, linestyle=":", zorder=0)
    _ticks(axes, with_unit("$Z$ above the onset", "nm"), label)


def _ticks(axes: Axes, below: str, beside: str) -> None:
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 6)).put_on(axes.xaxis)
    linear_ticks(*axes.get_ylim(), min(y_room, 6)).put_on(axes.yaxis)
    axes.set_xlabel(below, fontsize=LABEL_SIZE)
    axes.set_ylabel(beside, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _legend(figure: Figure, curve: _Curve, reference: str, points: FarPoints | None) -> Legend:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=colour, label=label, **_dots(5.0))
        for colour, label in ((_RAW, "raw"), (_CORRECTED, "corrected"))
    ]
    if curve.fit:
        handles.append(
            Line2D([], [], color=_FIT, linewidth=1.2, label=f"fit on {reference or 'the reference'}")
        )
        if curve.noise:
            handles.append(Patch(color="0.85", label=f"± {_BAND:g} standard deviations of a reading"))
    if points is not None:
        handles.append(
            Line2D(
                [],
                [],
                color=_DISTORTION,
                linewidth=1.4,
                label="distortion by the detector, without crosstalk",
            )
        )
    legend = figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
    for text in legend.get_texts():  # the name of a material is no formula
        text.set_parse_math(False)
    return legend

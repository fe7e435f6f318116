"""Observables to maps of material properties, with what each pixel can be trusted for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.contact.models import contact_model, models
from overtone.contact.parameters import DISTANCE, POISSON_RATIO
from overtone.errors import InversionError
from overtone.harmonics import UNDETERMINED, energy, far_phase, read_receptance, regime, to_force_harmonics
from overtone.instrument.calibration import Calibration
from overtone.instrument.correct import calibration_of
from overtone.instrument.noise import complete_noise
from overtone.instrument.shared import shared_forces
from overtone.instrument.signals import Positions, Signals, positions, signals_of
from overtone.inversion import least_squares
from overtone.inversion.linear import Contact
from overtone.inversion.profile import CHI2_90, CHI2_999, modulus_range
from overtone.probe import Probe, format_probe, required_radius
from overtone.quantities import harmonic_orders, named_array
from overtone.readings import reading_of

DETERMINED = 0
NOT_DETERMINED = 1
START_DEPENDENT = 2
POOR_FIT = 3
AT_BOUND = 4
NOT_CONVERGED = 5
MISSING_DATA = 6
STATUS_MEANINGS = {
    DETERMINED: "determined",
    NOT_DETERMINED: "not_determined_by_these_data",
    START_DEPENDENT: "answer_depends_on_start",
    POOR_FIT: "model_does_not_fit",
    AT_BOUND: "at_bound",
    NOT_CONVERGED: "not_converged",
    MISSING_DATA: "missing_data",
}
STATUS_FLAGS = {"flag_values": list(STATUS_MEANINGS), "flag_meanings": " ".join(STATUS_MEANINGS.values())}

HARMONIC_SETS = ((0, 1, 2), (1, 2, 3))
METHODS = {"least-squares": "the published estimator, for reproduction"}
POOR_RESIDUAL = 0.1
WIDEST_DETERMINED = math.log(10.0)
_SAME_ANSWER = 1e-3  # range of ln E below which two starting points found the same minimum
_BLOCK = 256
_LEVELS = np.array([CHI2_90, CHI2_999])


def map_properties(
    observables: xr.Dataset,
    probe: Probe,
    *,
    model: str,
    poisson_ratio: float,
    method: str = "least-squares",
    harmonics: Sequence[int] = (0, 1, 2),
    noise: Mapping[str, float] | None = None,
    intermolecular_distance: float = 0.2e-9,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Map modulus, adhesion and indentation, and how far the data determine them.

    Parameters
    ----------
    observables : Dataset
        Observables of the harmonics asked for, any dimensions. Where their reading (see
        `overtone.readings`) doubts one of these harmonics, every pixel is "not determined".
    probe : Probe
        With a tip radius.
    model : str
        Key of an invertible contact model.
    poisson_ratio : float
        Poisson's ratio of the sample; it has no default.
    method : str
        ``least-squares``, the published estimator, for reproduction.
    harmonics : sequence of int
        (0, 1, 2) or (1, 2, 3).
    noise : mapping, optional
        Standard deviation of each observable [m, rad], ``{"A0": 5e-12, "phi1": 2e-3, "A2": 1e-12}``;
        `overtone.instrument.noise.ORDINARY_NOISE` where not stated.
    intermolecular_distance : float
        a0 [m].
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Returns
    -------
    Dataset
        On the dimensions of A1: ``modulus`` [Pa], ``adhesion`` [N], ``indentation`` [m], NaN unless the
        status is "determined"; the same names with ``_unscreened`` for what the estimator returned at
        every pixel it finished; ``residual`` (N_r), ``amplification`` (norm of d ln E per independent
        relative error of each harmonic), ``uncertainty`` (the same with the stated noise: linearised
        standard deviation of ln E), ``modulus_lower`` and ``modulus_upper`` (every modulus that some
        indentation and adhesion reconcile with the data at 90 %), ``start_spread`` (range of ln E over the
        starting points), ``status``.

    Raises
    ------
    InversionError, ContactModelError, ObservablesError, OvertoneError
        If the method or model is unknown, a harmonic or the tip radius is missing, or a ratio is out of range.

    Notes
    -----
    The linearised uncertainty is itself a lower bound: far from the minimum the valley bends. Errors that the whole
    scan shares (1 pm of A0, 1 degree of phase) count in it, and in the range of moduli, where the scan was corrected
    with a calibration (`overtone.correct`); they do not average out over pixels. Without one both hold noise only. The
    tip radius counts there by half of its relative error, as if independent of the rest: a reference of known modulus
    ties it to the gains, which makes the range wider than it need be. The model's own error, of which the bare cosine
    of eq 10 alone is 1 to 6 % of the modulus, comes on top.
    """
    if method not in METHODS:
        raise InversionError("unknown method", expected=", ".join(METHODS), got=repr(method))
    record = contact_model(model)
    if not record.invertible or record.tail is None:
        raise InversionError(
            f"model {model!r} cannot be inverted",
            expected=", ".join(m.key for m in models() if m.invertible),
            hint="the one of these nearest to it",
        )
    POISSON_RATIO.check(poisson_ratio)
    DISTANCE.check(intermolecular_distance)
    radius = required_radius(probe)
    orders = tuple(harmonics)
    if orders not in HARMONIC_SETS:
        raise InversionError(
            "harmonics do not fit the method", expected="(0, 1, 2) or (1, 2, 3)", got=str(orders)
        )
    missing = [n for n in orders if n not in harmonic_orders(observables)]
    if missing:
        raise InversionError(
            f"harmonic {missing[0]} was not measured",
            expected=f"harmonics {orders}",
            got=f"harmonics {harmonic_orders(observables)}",
            hint="another set of harmonics, or energy and virial, which need A1 and phi1 only",
        )
    sigma = complete_noise(noise, orders)
    force = to_force_harmonics(observables, probe)
    dims = observables["A1"].dims
    # (pixel, harmonic), every array on the dimensions of A1
    flat = {
        name: observables[name].broadcast_like(observables["A1"]).transpose(*dims).values.ravel()
        for name in _needed(orders)
    }
    cons = force["F_cons"].sel(harmonic=list(orders)).transpose(*dims, "harmonic").values
    cons = np.ascontiguousarray(cons.reshape(-1, len(orders)))
    count = cons.shape[0]

    unknowns = [*record.unknowns, None]
    n = len(unknowns)
    lower = np.log([p.lower if p else least_squares.MIN_INDENTATION for p in unknowns])
    upper = np.log([p.upper if p else 1.0 for p in unknowns])
    starts = [np.log([E, F, d] if n == 3 else [E, d]) for E, F, d in least_squares.STARTS]
    contact = Contact(
        record.tail,
        intermolecular_distance,
        (1.0 - probe.tip.poisson_ratio**2) / probe.tip.modulus,
        1.0 - poisson_ratio**2,
        4.0 / 3.0 * math.sqrt(radius),
    )
    calibration = calibration_of(observables)
    shared = _Shared.of(observables, calibration, orders) if calibration is not None else None
    best = np.full((count, n), math.nan)
    residual, amplification = np.full(count, math.nan), np.full(count, math.nan)
    uncertainty, spread = np.full(count, math.nan), np.full(count, math.nan)
    low, high = np.full((count, _LEVELS.size), math.nan), np.full((count, _LEVELS.size), math.nan)
    status = np.full(count, MISSING_DATA, np.int8)

    def run(block: slice) -> None:
        F, observed = cons[block], {name: values[block] for name, values in flat.items()}
        usable = np.isfinite(F).all(axis=1) & (F != 0.0).all(axis=1) & (observed["A1"] > 0.0)
        if not usable.any():
            return
        pixels = np.flatnonzero(usable) + block.start
        F = np.ascontiguousarray(F[usable])
        fits = [_fit(F, observed["A1"][usable], orders, contact, lower, upper, start) for start in starts]
        solution, norm, gain, outcome = (np.stack(parts) for parts in zip(*fits, strict=True))
        chosen = np.argmin(norm, axis=0)[None, :]
        pick = np.take_along_axis
        gain = pick(gain, chosen[..., None], 0)[0]
        best[pixels] = pick(solution, chosen[..., None], 0)[0]
        residual[pixels] = pick(norm, chosen, 0)[0]
        amplification[pixels] = np.linalg.norm(gain, axis=1)
        errors = _force_errors({k: v[usable] for k, v in observed.items()}, orders, probe, sigma)
        if shared is not None:
            errors = np.concatenate([errors, shared.forces(pixels)], axis=-1)
        relative = errors / abs(F)[..., None]
        uncertainty[pixels] = np.linalg.norm(np.einsum("pi,pij->pj", gain, relative), axis=1)
        spread[pixels] = np.ptp(solution[..., 0], axis=0)
        softest, stiffest = np.empty((pixels.size, _LEVELS.size)), np.empty((pixels.size, _LEVELS.size))
        misfit = np.empty(pixels.size)
        modulus_range(
            F,
            _whitening(errors, F),
            np.array(orders),
            observed["A1"][usable],
            contact,
            lower,
            upper,
            _LEVELS,
            softest,
            stiffest,
            misfit,
        )
        misfit[residual[pixels] < 1e-6] = 0.0  # met exactly, between two nodes of the scan
        # The scan is coarser than the narrowest solutions: the fit's own neighbourhood belongs to the range.
        reach = uncertainty[pixels, None] * np.sqrt(_LEVELS)
        found = best[pixels, :1]
        softest, stiffest = np.fmin(softest, found - reach), np.fmax(stiffest, found + reach)
        if shared is not None:  # E* goes as 1/sqrt(R)
            of_the_tip = 0.5 * shared.calibration.error("radius") / shared.calibration.values["radius"]
            uncertainty[pixels] = np.hypot(uncertainty[pixels], of_the_tip)
            tip = np.sqrt(_LEVELS) * of_the_tip
            softest, stiffest = (
                found - np.hypot(found - softest, tip),
                found + np.hypot(stiffest - found, tip),
            )
        low[pixels] = np.clip(softest, lower[0], upper[0])
        high[pixels] = np.clip(stiffest, lower[0], upper[0])
        status[pixels] = _judge(
            pick(outcome, chosen, 0)[0],
            residual[pixels],
            misfit,
            uncertainty[pixels],
            (high - low)[pixels, 1],
            spread[pixels],
        )

    run_blocks(run, count, _BLOCK, progress)
    reading = reading_of(observables)
    doubts = [reading.doubts[n] for n in orders if n in reading.doubts] if reading else []
    if doubts:
        status[status != MISSING_DATA] = NOT_DETERMINED
    values = np.exp(best)
    values[(status == MISSING_DATA) | (status == NOT_CONVERGED)] = math.nan
    names = [p.name if p else "indentation" for p in unknowns]
    coords, shape = observables["A1"].coords, observables["A1"].shape
    arrays: dict[str, xr.DataArray] = {}
    for j, name in enumerate(names):
        determined = np.where(status == DETERMINED, values[:, j], math.nan)
        arrays[name] = named_array(name, determined.reshape(shape), dims, coords)
        arrays[f"{name}_unscreened"] = named_array(
            f"{name}_unscreened", values[:, j].reshape(shape), dims, coords
        )
    quality = {
        "residual": residual,
        "amplification": amplification,
        "uncertainty": uncertainty,
        "start_spread": spread,
    }
    for name, array in quality.items():
        arrays[name] = named_array(name, array.reshape(shape), dims, coords)
    for name, bound in (("modulus_lower", low[:, 0]), ("modulus_upper", high[:, 0])):
        arrays[name] = named_array(name, np.exp(bound).reshape(shape), dims, coords)
    arrays["status"] = named_array("status", status.reshape(shape), dims, coords, **STATUS_FLAGS)
    attributes = {"model": model, "method": method, "method_note": METHODS[method]}
    if doubts:
        reasons = dict.fromkeys(line for doubt in doubts for line in doubt.splitlines())
        attributes["cannot_conclude"] = " ".join(f"{reason}." for reason in reasons)
    result = xr.Dataset(arrays, attrs=dict(observables.attrs) | attributes)
    return provenance.record(
        result,
        "map_properties",
        probe=format_probe(probe),
        model=model,
        method=method,
        harmonics=orders,
        poisson_ratio=poisson_ratio,
        intermolecular_distance=intermolecular_distance,
        noise=sigma,
        noise_stated=sorted(noise or {}),
    )


class _Shared(NamedTuple):
    """What a calibration leaves uncertain, for the pixels of a scan, flat."""

    calibration: Calibration
    signals: Signals
    where: Positions
    orders: tuple[int, ...]

    @classmethod
    def of(cls, observables: xr.Dataset, calibration: Calibration, orders: tuple[int, ...]) -> _Shared:
        """Return it for a corrected scan."""
        signals, where = signals_of(observables), positions(observables)
        flat = Signals(
            signals.mean.ravel() if signals.mean is not None else None,
            {n: a.ravel() for n, a in signals.phasor.items()},
        )
        return cls(calibration, flat, Positions(*(part.ravel() for part in where)), orders)

    def forces(self, pixels: npt.NDArray[np.intp]) -> npt.NDArray[np.float64]:
        """Return what each shared error does to the conservative harmonics of some pixels (pixel, harmonic, source)."""
        signals, where = self.signals, Positions(*(part[pixels] for part in self.where))
        chosen = Signals(
            signals.mean[pixels] if signals.mean is not None else None,
            {n: a[pixels] for n, a in signals.phasor.items()},
        )
        return shared_forces(chosen, self.calibration, self.orders, **where._asdict())[0]


def undetermined_properties(observables: xr.Dataset, model: str, reason: str) -> xr.Dataset:
    """Return property maps that are NaN and "not determined" at every pixel, with the reason.

    Parameters
    ----------
    observables : Dataset
        Gives dimensions and coordinates.
    model : str
        Key of the contact model that was asked for.
    reason : str
        Why nothing can be concluded.
    """
    amplitude = observables["A1"]
    unknowns = [*(parameter.name for parameter in contact_model(model).unknowns), "indentation"]
    empty = np.full(amplitude.shape, math.nan)
    arrays = {name: named_array(name, empty, amplitude.dims, amplitude.coords) for name in unknowns}
    status = np.full(amplitude.shape, NOT_DETERMINED, np.int8)
    arrays["status"] = named_array("status", status, amplitude.dims, amplitude.coords, **STATUS_FLAGS)
    attributes = dict(observables.attrs) | {"model": model, "cannot_conclude": reason}
    return provenance.record(xr.Dataset(arrays, attrs=attributes), "undetermined_properties", reason=reason)


def map_energy(
    observables: xr.Dataset, probe: Probe, *, noise: Mapping[str, float] | None = None
) -> xr.Dataset:
    """Map force harmonics, dissipated energy, virial and regime: what is known without A0 and A2.

    Parameters
    ----------
    observables : Dataset
        At least A1 and phi1. Where their reading (see `overtone.readings`) leaves other probes open, a
        regime they do not share is undetermined; where it says the phase has no established zero, all are.
    probe : Probe
        No tip radius needed.
    noise : mapping, optional
        As for `map_properties`; the one of phi1 decides which sign of CONS_1 can be told.

    Returns
    -------
    Dataset
        ``F_cons``, ``F_diss``, ``dissipation``, ``virial``, ``regime``.
    """
    force = to_force_harmonics(observables, probe)
    reading = reading_of(observables)
    alternatives = reading.alternatives if reading else ()
    signs = regime(observables, probe, alternatives, noise=complete_noise(noise, (1,))["phi1"])
    if reading and not reading.phase_established:
        signs = signs.copy(data=np.full(signs.shape, UNDETERMINED, np.int8))
    return force.drop_vars(["A1", "phi1"]).merge(energy(force, probe)).assign(regime=signs)


def _needed(orders: tuple[int, ...]) -> list[str]:
    names = ["A1", "phi1"]
    for n in orders:
        names += ["A0"] if n == 0 else [f"A{n}", f"phi{n}"] if n > 1 else []
    return names


def _fit(
    F: npt.NDArray[np.float64],
    amplitude: npt.NDArray[np.float64],
    orders: tuple[int, ...],
    contact: Contact,
    lower: npt.NDArray[np.float64],
    upper: npt.NDArray[np.float64],
    start: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.int8]]:
    count, n = F.shape[0], start.size
    solution, norm = np.empty((count, n)), np.empty(count)
    gain, outcome = np.empty((count, 3)), np.empty(count, np.int8)
    least_squares.fit_pixels(
        F, np.array(orders), amplitude, contact, lower, upper, start, solution, norm, gain, outcome
    )
    return solution, norm, gain, outcome


def _force_errors(
    observed: Mapping[str, npt.NDArray[np.float64]],
    orders: tuple[int, ...],
    probe: Probe,
    sigma: Mapping[str, float],
) -> npt.NDArray[np.float64]:
    """Return the error of each conservative harmonic per independent error, times its sigma.

    Shape (pixel, harmonic, source). The first-harmonic phase is one source for all: it turns every
    harmonic (theory of the phase reference), so its errors are correlated between them.
    """
    drive = probe.drive
    receptance = read_receptance(probe, np.array(orders) * drive.frequency)
    phase = observed["phi1"]
    sources = ["phi1", *(f"A{n}" for n in orders), *(f"phi{n}" for n in orders if n > 1)]
    out = np.zeros((phase.size, len(orders), len(sources)))
    for i, (n, G) in enumerate(zip(orders, receptance, strict=True)):
        column = sources.index(f"A{n}")
        if n == 0:
            out[:, i, column] = sigma["A0"] / abs(G)
        elif n == 1:
            turn = drive.free_amplitude * np.exp(1j * (phase - far_phase(probe)))
            out[:, i, column] = sigma["A1"] * (1.0 / G).real
            out[:, i, 0] = sigma["phi1"] * (-1j * turn / G).real
        else:
            unit = np.exp(1j * (n * phase - observed[f"phi{n}"]))
            amplitude = observed[f"A{n}"]
            across = sigma.get(f"phi{n}", math.nan) * amplitude if f"phi{n}" in sigma else sigma[f"A{n}"]
            out[:, i, column] = sigma[f"A{n}"] * (unit / G).real
            out[:, i, sources.index(f"phi{n}")] = across * (-1j * unit / G).real
            out[:, i, 0] = sigma["phi1"] * amplitude * (1j * n * unit / G).real
    return out


def _whitening(errors: npt.NDArray[np.float64], force: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the inverse Cholesky factor of the covariance of each pixel's force harmonics.

    A ten-billionth of the variances and a billionth of each force are added on the diagonal, so that
    observables stated as free of noise cannot make the covariance singular.
    """
    covariance = np.einsum("pij,pkj->pik", errors, errors)
    diagonal = np.einsum("pii->pi", covariance)
    diagonal += 1e-10 * diagonal.sum(axis=1, keepdims=True) + (1e-9 * force) ** 2
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _judge(
    outcome: npt.NDArray[np.int8],
    residual: npt.NDArray[np.float64],
    misfit: npt.NDArray[np.float64],
    uncertainty: npt.NDArray[np.float64],
    width: npt.NDArray[np.float64],
    spread: npt.NDArray[np.float64],
) -> npt.NDArray[np.int8]:
    """Return the status of each fitted pixel; where several apply, the gravest.

    Determined means two things: amplification times the stated noise is at most 1, and no modulus outside
    one decade fits (``width``, the 99.9 % range of ln E). The first alone fails: noise throws one stiff pixel
    in four onto a soft solution with a small amplification, which would pass for determined. A model fits
    badly where N_r exceeds what the method's paper accepts, or where chi-squared is beyond noise (99.9 %).
    """
    status = np.full(outcome.shape, DETERMINED, np.int8)
    status[spread > _SAME_ANSWER] = START_DEPENDENT
    status[~((uncertainty <= 1.0) & (width <= WIDEST_DETERMINED))] = NOT_DETERMINED
    status[(residual > POOR_RESIDUAL) | (misfit > CHI2_999)] = POOR_FIT
    status[outcome == least_squares.AT_BOUND] = AT_BOUND
    status[outcome == least_squares.STALLED] = NOT_CONVERGED
    return status

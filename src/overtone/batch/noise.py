"""What the noise of a scan is, stated or told from a source, and the sentence that says which."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from overtone.errors import OvertoneError
from overtone.units import format_quantity, parse_amplitude_density, parse_quantity

SCATTER = "scatter"
PAIR = "pair"
BANDWIDTH = "bandwidth"
_LOCK_IN = (BANDWIDTH, "detector", "temperature")
_EXAMPLE = '--noise "bandwidth=500 Hz, detector=50 fm/rtHz, temperature=300 K"'
_KINDS = 'A0="5 pm", scatter, pair, or "bandwidth=500 Hz, detector=50 fm/rtHz"'


@dataclass(frozen=True)
class NoiseRequest:
    """What is said of the noise, before any file is opened."""

    stated: Mapping[str, float] = field(default_factory=dict)
    """Observable to standard deviation [m or rad]; stands before any source."""
    source: str | None = None
    """``scatter`` of neighbouring pixels, ``pair`` of trace and retrace, ``bandwidth`` of lever, detector and lock-in;
    None where no source was named."""
    lock_in: Mapping[str, float] = field(default_factory=dict)
    """``bandwidth`` [Hz], ``detector`` [m/sqrt(Hz)] and ``temperature`` [K] where given."""


def noise_request(texts: Sequence[str]) -> NoiseRequest:
    """Return what --noise options say, before any file is opened.

    Parameters
    ----------
    texts : sequence of str
        Any number of ``A0=5 pm``, and at most one source: ``scatter``, ``pair``, or
        ``bandwidth=500 Hz, detector=50 fm/rtHz`` with ``temperature=300 K`` if known. Commas separate as options do.

    Raises
    ------
    OvertoneError
        If a part is not understood, something is said twice, or the detector of a bandwidth is missing.

    Examples
    --------
    >>> noise_request(["scatter", "A0=5 pm"])
    NoiseRequest(stated={'A0': 5e-12}, source='scatter', lock_in={})
    """
    sources: list[str] = []
    pairs: dict[str, str] = {}
    for part in (part.strip() for text in texts for part in text.split(",")):
        if part in (SCATTER, PAIR):
            sources.append(part)
            continue
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and value):
            raise OvertoneError(
                "--noise is not understood",
                expected=f'A0="5 pm", scatter, pair, or {_EXAMPLE.removeprefix("--noise ")}',
                got=repr(part),
            )
        if name in pairs:
            raise OvertoneError(f"--noise states {name} twice", got=f"{pairs[name]} and {value}")
        pairs[name] = value
    lock_in = {name: pairs.pop(name) for name in _LOCK_IN if name in pairs}
    if lock_in:
        sources.append(BANDWIDTH)
    if len(sources) > 1:
        raise OvertoneError("--noise names several sources", expected="one of them", got=", ".join(sources))
    return NoiseRequest(_stated(pairs), sources[0] if sources else None, _lock_in(lock_in))


def _stated(pairs: Mapping[str, str]) -> dict[str, float]:
    """Return the standard deviations of observables in SI units."""
    from overtone.instrument.noise import complete_noise
    from overtone.quantities import quantity

    stated = {}
    for name, text in pairs.items():
        record = quantity(name)
        if record is None or record.kind != "observable":
            raise OvertoneError(
                f"--noise {name} is not an observable", expected="A0, A1, phi1, A2, ...", hint=_KINDS
            )
        stated[name] = parse_quantity(text, record.unit, f"--noise {name}")
    complete_noise(stated, ())  # refuses what cannot be a standard deviation
    return stated


def _lock_in(texts: Mapping[str, str]) -> dict[str, float]:
    missing = [name for name in (BANDWIDTH, "detector") if name not in texts]
    if texts and missing:
        raise OvertoneError(
            f"--noise from a bandwidth needs the {missing[0]}",
            expected="bandwidth and detector, neither of which has a default",
            got=", ".join(texts),
            hint=_EXAMPLE,
        )
    values: dict[str, float] = {}
    for name, text in texts.items():
        label = f"--noise {name}"
        if name == "detector":
            values[name] = parse_amplitude_density(text, "m", label)
        else:
            values[name] = parse_quantity(text, "Hz" if name == BANDWIDTH else "K", label)
    return values


def resolve_noise(
    request: NoiseRequest,
    observables: Any,
    probe: Any,
    *,
    pair: Callable[[], tuple[Any, Any]] | None = None,
) -> tuple[dict[str, float], str]:
    """Return the noise of a scan and a sentence that says where it comes from.

    Parameters
    ----------
    request : NoiseRequest
        Of `noise_request`.
    observables : Dataset
        The scan as it is mapped, corrected or not.
    probe : Probe
        Lever, drive and detector.
    pair : callable, optional
        Opens trace and retrace, as stored; raises an `OvertoneError` where the file does not hold both.

    Returns
    -------
    noise : dict
        Observable to standard deviation [m or rad], as ``noise=`` of `overtone.map_properties` takes it. Empty
        where an ordinary noise has to be assumed for all.
    sentence : str
        For the findings of a report.

    Raises
    ------
    OvertoneError
        If the source that was asked for cannot tell the noise of this scan.

    Notes
    -----
    Where neither a source nor a value is given, trace and retrace tell it if both are there; an ordinary noise is
    assumed elsewhere, and for what is not stated where single values are.

    What is told of readings as stored or of the detector is divided by the gains that a correction has taken out.
    """
    if request.source is None and not request.stated and pair is not None:
        try:
            found = _from_pair(pair, observables)
        except OvertoneError:  # the other way was not recorded, or not with the same channels
            return _assumed(request, observables)
        return found, f"Noise, from trace and retrace: {_listed(found)}."
    if request.source is None:
        return _assumed(request, observables)
    if request.source == PAIR:
        if pair is None:
            raise OvertoneError(
                "there is no pair to tell the noise from",
                expected="a scan with trace and retrace",
                hint="--noise scatter",
            )
        found, origin, limit = _from_pair(pair, observables), "trace and retrace", ""
    elif request.source == SCATTER:
        from overtone.instrument.noise_sources import noise_from_scan

        found = noise_from_scan(observables, skip=tuple(request.stated))
        origin = "the scatter of neighbouring pixels"
        limit = (
            " What sample and feedback do from one pixel to the next counts as noise; it is a lower bound where "
            "the lock-in is slower than a pixel."
        )
    else:
        found, origin, limit = _from_lock_in(request.lock_in, observables, probe)
    told = {name: value for name, value in found.items() if name not in request.stated}
    own = f"; as stated: {_listed(request.stated)}" if request.stated else ""
    return told | dict(request.stated), f"Noise, from {origin}: {_listed(told)}{own}.{limit}"


def _assumed(request: NoiseRequest, observables: Any) -> tuple[dict[str, float], str]:
    """Return what was stated, and say what is assumed of the rest."""
    from overtone.instrument.noise import complete_noise
    from overtone.quantities import harmonic_orders

    stated = dict(request.stated)
    every = complete_noise(stated, harmonic_orders(observables))
    rest = {name: value for name, value in every.items() if name not in stated}
    if not stated:
        return {}, f"Noise was not stated, an ordinary one is assumed: {_listed(rest)}."
    own = f"Noise, as stated: {_listed(stated)}"
    return stated, f"{own}; an ordinary one is assumed of the rest: {_listed(rest)}." if rest else f"{own}."


def _from_pair(pair: Callable[[], tuple[Any, Any]], observables: Any) -> dict[str, float]:
    from overtone.instrument.noise import noise_from_pair

    return _as_corrected(noise_from_pair(*pair()), observables)


def _from_lock_in(
    lock_in: Mapping[str, float], observables: Any, probe: Any
) -> tuple[dict[str, float], str, str]:
    from overtone.instrument.noise_sources import noise_from_bandwidth
    from overtone.instrument.thermal_noise import ROOM_TEMPERATURE
    from overtone.quantities import harmonic_orders

    amplitude = float(observables["A1"].median())
    temperature = lock_in.get("temperature", ROOM_TEMPERATURE)
    noise = noise_from_bandwidth(
        probe,
        bandwidth=lock_in[BANDWIDTH],
        detector_noise=lock_in["detector"],
        amplitude=amplitude,
        orders=harmonic_orders(observables),
        temperature=temperature,
    )
    origin = (
        f"a bandwidth of {format_quantity(lock_in[BANDWIDTH], 'Hz')}, a detector of "
        f"{format_quantity(lock_in['detector'], 'm')}/√Hz and a lever at {temperature:g} K"
    )
    limit = f" That of phi1 is the one at {format_quantity(amplitude, 'm')}; drift and 1/f noise of A0 are not in it."
    return _as_corrected(noise, observables), origin, limit


def _as_corrected(noise: Mapping[str, float], observables: Any) -> dict[str, float]:
    """Return the noise of readings as that of a scan whose gains were taken out by a calibration."""
    from overtone.instrument.correct import calibration_of

    corrected = calibration_of(observables)
    if corrected is None:
        return dict(noise)
    gains = {f"A{n}": corrected.values[f"gain{n}"] for n in (0, 2, 3)}
    return {name: value / gains.get(name, 1.0) for name, value in noise.items()}


def _listed(noise: Mapping[str, float]) -> str:
    from overtone.quantities import quantity

    return ", ".join(
        f"{name} {format_quantity(value, getattr(quantity(name), 'unit', '1'))}"
        for name, value in noise.items()
    )

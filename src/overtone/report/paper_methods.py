"""A draft of the methods paragraphs of a paper, from what the datasets say of how they were made."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import xarray as xr

from overtone.contact.models import contact_model
from overtone.errors import ContactModelError
from overtone.instrument.calibration import Calibration, summary_rows
from overtone.quantities import quantity
from overtone.report.materials import (
    UNRESOLVED,
    interval,
    law_sentences,
    materials_properties,
    sentence,
    verdict_text,
)
from overtone.report.paper_facts import Facts
from overtone.report.results import PROPERTIES
from overtone.units import format_quantity

REFERENCES = (
    "N. H. Shaik, R. G. Reifenberger and A. Raman, Nanomechanical mapping in air or vacuum using multi-harmonic "
    "signals in tapping mode atomic force microscopy, Nanotechnology 31, 455502 (2020).",
)
_UNKNOWN = "[not recorded]"
_FEW_PERCENT = 0.3  # error of a logarithm from which it is told as a factor
_METHODS = {
    "population": (
        "The pixels of one phase were described by a common normal distribution of the logarithms of their properties, "
        "whose mean and covariance were inferred from all of its pixels together; errors that the whole scan shares "
        "were marginalised outside of the product over pixels, so that no number of pixels averages them out. Pixels "
        "that belong to no phase were inverted alone. Values are posterior medians with 90 % credible intervals."
    ),
    "posterior": (
        "The posterior of every pixel was integrated numerically over the indentation; values are medians with 90 % "
        "credible intervals."
    ),
}
_PRIORS = {
    "log-range": "log-uniform from {} to {}",
    "range": "uniform from {} to {}",
    "log-normal": "log-normal with median {}, and a standard deviation of a factor of {}",
    "normal": "normal with mean {} and standard deviation {}, truncated at zero",
}
_PRIOR = re.compile(r"(\w+) (log-range|log-normal|range|normal) (\S+) (\S+)")


def methods_paragraphs(facts: Facts, result: xr.Dataset) -> tuple[str, ...]:
    """Return the paragraphs: measurement, calibration, inversion, results, software.

    Parameters
    ----------
    facts : Facts
        Of the same result. What is not known of it stands as "[not recorded]", for its author to fill in.
    result : Dataset
        Result of `overtone.map_properties` by ``population``.
    """
    return (
        _measurement(facts),
        _calibration(facts.calibration),
        _inversion(facts),
        _phases(facts, result),
        f"Inversion and figures were made with overtone {facts.version}.",
    )


def methods_text(title: str, paragraphs: Sequence[str], left_out: Sequence[str] = ()) -> str:
    """Return the paragraphs with their references as Markdown."""
    parts = [f"# Methods: {_escaped(title)}", *map(_escaped, paragraphs), "## References"]
    parts += [f"{k}. {_escaped(reference)}" for k, reference in enumerate(REFERENCES, start=1)]
    if left_out:
        parts += ["## Not part of this report", "\n".join(f"- {_escaped(line)}" for line in left_out)]
    return "\n\n".join(parts) + "\n"


def _escaped(text: str) -> str:
    """Return a text in which nothing is an instruction of Markdown or HTML."""
    plain = " ".join(text.split())
    return re.sub(r"([\\`*_#<>|]|(?<!\w)\[(?=[^\]]*\]\())", r"\\\1", plain)


# --- paragraphs -----------------------------------------------------------------------------------


def _measurement(facts: Facts) -> str:
    rows, columns = facts.pixels
    size = f"{columns} x {rows} pixels"
    if facts.area is not None:
        width, height = (format_quantity(side, "m") for side in facts.area)
        size += f" ({width} x {height})"
    said = [f"Tapping-mode maps of {size} were recorded{_from(facts.sources)}."]
    probe = facts.probe
    if probe is None:
        said.append(f"Cantilever and drive: {_UNKNOWN}.")
    else:
        mode = probe.cantilever.modes[0]
        radius = format_quantity(probe.tip.radius, "m") if probe.tip.radius is not None else _UNKNOWN
        said.append(
            f"The cantilever had a stiffness of {format_quantity(mode.stiffness, 'N/m', 4)}, a resonance frequency of "
            f"{format_quantity(mode.frequency, 'Hz', 6)}, a quality factor of {mode.quality_factor:.4g} and a tip "
            f"radius of {radius}. It was driven at {format_quantity(probe.drive.frequency, 'Hz', 6)} to a free "
            f"amplitude of {format_quantity(probe.drive.free_amplitude, 'm', 4)}"
            + (
                f" and scanned at a set-point A1/A1far of {facts.setpoint:.3g}."
                if math.isfinite(facts.setpoint)
                else "."
            )
        )
    higher = [n for n in facts.orders if n > 0]
    mean = "the mean deflection and " if 0 in facts.orders else ""
    said.append(
        f"At every pixel {mean}amplitude and phase of {_harmonics(higher)} of the drive frequency were recorded, and "
        "turned into Fourier coefficients of the force between tip and sample by the linear response of the lever [1]."
    )
    return " ".join(said)


def _calibration(calibration: Calibration | None) -> str:
    if calibration is None:
        return (
            "The scan was not corrected with a calibration of the instrument: intervals hold noise only, and offsets, "
            "gains and phases of the detection are taken as they were read."
        )
    source = f" ({calibration.source})" if calibration.source else ""
    said = [
        f"Offsets, distortion, gains and phases of the detection were calibrated{source} and removed from the scan."
    ]
    known = calibration.reference
    if known is not None:
        stated = [
            f"{name} {format_quantity(median, _unit(name))} known to {_known_to(error)}"
            for name, (median, error) in known.properties.items()
        ]
        said.append(
            f"The approach curve was recorded on {known.name} (Poisson's ratio {known.poisson_ratio:.3g}"
            + "".join(f"; {part}" for part in stated)
            + f"), with the contact model {known.model}."
        )
    left = [f"{_of(label)} {error}" for label, _, error in summary_rows(calibration) if not _is_none(error)]
    if left:
        said.append(
            f"Standard deviations of what the calibration left uncertain for the whole scan: {'; '.join(left)}. Their "
            "joint covariance is part of every interval."
        )
    return " ".join(said)


def _inversion(facts: Facts) -> str:
    said = [f"The contact was described by {_model(facts.argument('model'))}"]
    ratio, distance = facts.argument("poisson_ratio"), facts.argument("intermolecular_distance")
    said[0] += f", with a Poisson's ratio of the sample of {_plain(ratio)}"
    if isinstance(distance, int | float):
        said[0] += f" and an intermolecular distance of {format_quantity(float(distance), 'm')}"
    said[0] += "."
    cons, diss = (_orders(facts.argument(name)) for name in ("harmonics", "dissipative_harmonics"))
    used = f"the conservative force harmonics {_listed(cons)}" if cons else f"force harmonics {_UNKNOWN}"
    if diss:
        used += f" and the dissipative ones {_listed(diss)}"
    motion = {
        "full": ", on the motion of the tip with its higher harmonics",
        "cosine": ", on a motion of the tip taken as a cosine",
    }.get(str(facts.argument("motion")), "")
    said.append(f"Properties were inferred from {used}{motion}.")
    said.append(_noise(facts))
    priors = [_prior(part) for part in facts.priors]
    said.append(f"Priors: {'; '.join(priors) if priors else _UNKNOWN}.")
    return " ".join(said)


def _noise(facts: Facts) -> str:
    noise = facts.argument("noise")
    if not isinstance(noise, Mapping) or not noise:
        return f"Noise of the observables: {_UNKNOWN}."
    stated = facts.argument("noise_stated") or ()
    parts = [
        f"{name} {format_quantity(float(value), _unit(str(name)))}{'' if name in stated else ' (assumed)'}"
        for name, value in noise.items()
    ]
    return f"Standard deviations of the noise of one pixel: {', '.join(parts)}."


def _phases(facts: Facts, result: xr.Dataset) -> str:
    names = [str(name) for name in result["material"].values]
    method = _METHODS.get(str(facts.argument("method")), f"Method: {_plain(facts.argument('method'))}.")
    said = [_divided(facts.arguments.get("phases")), method]
    note = sentence(str(facts.attributes.get("phase_note", "")))
    found = (
        "No phases were told apart"
        if not names
        else f"{len(names)} phase{'s' * (len(names) > 1)} of the sample"
    )
    said.append(f"{found}{': ' + ', '.join(n.replace('_', ' ') for n in names) if names else ''}.")
    said.append(note)
    absolute = facts.attributes.get("verdict") in (None, "absolute")
    for k, name in enumerate(names):
        said.append(_material(result, k, name.replace("_", " "), absolute=absolute))
    said += law_sentences(result)
    said.append(verdict_text(result))
    return " ".join(part for part in said if part)


def _divided(phases: Any) -> str:
    """Say how the phases came about, from how `overtone.map_properties` was called."""
    if phases == "given":
        return "Pixels were put to phases by labels given beforehand."
    number = f", their number being given as {phases}," if isinstance(phases, int) else ""
    return f"Phases were found in the space of the observables{number} before any contact model was applied."


def _material(result: xr.Dataset, k: int, name: str, *, absolute: bool) -> str:
    """Return one sentence on a material: moduli in pascal only where the verdict allows them."""

    def of(what: str) -> float:
        return float(result[what].values[k]) if what in result else math.nan

    where = (
        f"{name} ({of('material_pixels'):.0f} pixels" if math.isfinite(of("material_pixels")) else f"{name} ("
    )
    if math.isfinite(of("material_domains")):
        where += f" in {of('material_domains'):.0f} domain{'s' * (of('material_domains') != 1)}"
    if of("material_resolved") == 0:
        where += f"; {UNRESOLVED}"
    parts = []
    for prop in materials_properties(result):
        stem, unit = f"material_{prop}", _unit(prop)
        if math.isfinite(of(stem)) and (absolute or prop not in ("modulus", "stiffness")):
            parts.append(
                f"{PROPERTIES.get(prop, prop)} {format_quantity(of(stem), unit)} "
                f"({interval(of(f'{stem}_lower'), of(f'{stem}_upper'), unit)})"
            )
        ratio = of(f"{stem}_ratio")
        if math.isfinite(ratio) and of("material_reference") != 1:
            ends = interval(of(f"{stem}_ratio_lower"), of(f"{stem}_ratio_upper"), "1")
            parts.append(f"{PROPERTIES.get(prop, prop)} over that of the reference {ratio:.3g} ({ends})")
    return sentence(f"{where}): {', '.join(parts)}" if parts else f"{where})")


# --- words ----------------------------------------------------------------------------------------


def _from(sources: Sequence[str]) -> str:
    return f" ({', '.join(sources)})" if sources else ""


def _harmonics(orders: Sequence[int]) -> str:
    if not orders:
        return f"harmonics {_UNKNOWN}"
    return f"harmonic{'s' * (len(orders) > 1)} {_listed(orders)}"


def _listed(values: Iterable[Any]) -> str:
    texts = [str(value) for value in values]
    return texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + f" and {texts[-1]}" if texts else ""


def _orders(value: Any) -> list[int]:
    return [int(n) for n in value] if isinstance(value, list | tuple) else []


def _plain(value: Any) -> str:
    return (
        f"{value:.4g}"
        if isinstance(value, int | float) and not isinstance(value, bool)
        else str(value or _UNKNOWN)
    )


def _model(key: Any) -> str:
    if key is None:
        return f"a contact model {_UNKNOWN}"
    if key == "auto":
        return "the contact model that the data of each pixel prefer"
    try:
        return f"the contact model {key} ({contact_model(str(key)).title})"
    except ContactModelError:
        return f"the contact model {key}"


def _unit(name: str) -> str:
    record = quantity(name)
    return record.unit if record else "1"


def _known_to(error: float) -> str:
    """Write the standard deviation of a logarithm."""
    return f"{100.0 * error:.2g} %" if error < _FEW_PERCENT else f"a factor of {math.exp(error):.2g}"


def _of(label: str) -> str:
    """Turn a label such as "A0: zero" into "zero of A0", and leave out what a factor is relative to."""
    subject, mark, what = label.partition(": ")
    if what.startswith(("added", "lost")):
        return f"{subject} {what}"
    return f"{what} of {subject}" if mark else label.partition(",")[0]


def _is_none(error: str) -> bool:
    return float(error.split()[0]) == 0.0


def _prior(text: str) -> str:
    """Return a prior as `overtone.inversion.priors.format_priors` writes it in words, others as they are."""
    match = _PRIOR.fullmatch(text.strip())
    if match is None:
        return text.strip()
    name, kind, *numbers = match.groups()
    units = (_unit(name), "1" if kind == "log-normal" else _unit(name))
    values = [format_quantity(float(number), unit) for number, unit in zip(numbers, units, strict=True)]
    return f"{PROPERTIES.get(name, name)} {_PRIORS[kind].format(*values)}"

"""Method ``population``: pixels of one phase share one distribution, and all of them one calibration.

Phases are told apart in what was measured. The joint posterior of their materials has what the calibration left open
outside of the product over pixels, so that no number of pixels sharpens a wrong number; a reference of known modulus
takes part in it. A pixel is then pulled towards its phase as far as its own data leave it open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.blocks import run_blocks
from overtone.errors import InversionError
from overtone.instrument.calibration import Calibration
from overtone.instrument.material import Reference
from overtone.instrument.reference import reference_pixels
from overtone.inversion.columns import Columns
from overtone.inversion.motion import FEW, follow
from overtone.inversion.pixels import Setting
from overtone.inversion.priors import LOG_NORMAL, LOG_RANGE, Prior, for_kernel
from overtone.inversion.result import (
    DETERMINED,
    MISSING_DATA,
    NO_CONTACT,
    NOT_DETERMINED,
    POOR_FIT,
    WIDEST_DETERMINED,
    Sheet,
)
from overtone.population.deviation import settle_pixels
from overtone.population.draws import mixture_of, quantities_of, tilts, without_motion
from overtone.population.evidence import TILES, Harvest, Known, beyond_scatter, harvest
from overtone.population.joint import Joint, infer
from overtone.population.materials import Question
from overtone.population.other_laws import laws_of
from overtone.population.phases import NONE, Phases, find_phases, labels_as_phases
from overtone.population.pooled import QUANTILES, pool
from overtone.population.table import Material, Materials, materials_of
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.intp]

SCAN_DIMS = ("scan", "setpoint", "direction")
"""Dimensions along which scans of one area are stacked."""
_BLOCK = 2048
_FEWEST = 30  # pixels of a phase that is pooled
_GRADIENT = 0.35
"""Smallest change of ln of a property that would explain what wanders within a phase, from which it is none."""
_UNEXPLAINED = 0.03  # share of the variance
_EVEN = 0.6
"""Share of an even slope in what is smooth, from which it is no second material."""
_DEPTHS = (2, 1)
"""Pixels from the edge of a phase from which on a pixel tells of its material, if so many are left."""
_LEAST_KEPT = 0.25
_OUTLIER = 1e-4
_BAND = 6  # pixels of another phase, or of none, that together are more than odd ones
_WIDER = (0.2, 5.0)  # of what is left open at a pixel, over that at the median of its phase
_MARKED = 0.5  # share of the marked pixels that make a phase the reference


@dataclass(frozen=True)
class Request:
    """How phases and reference are given.

    Parameters
    ----------
    phases : None, int or DataArray (y, x)
        Chosen by the scan, their number, or labels (-1 for none).
    reference : Reference, optional
        Material of known modulus in the scan.
    reference_pixels : DataArray or sequence, optional
        Mask or rectangle (x0, y0, x1, y1) [m] of the reference.
    seed : int
        Of the draws.
    """

    phases: int | xr.DataArray | None = None
    reference: Reference | None = None
    reference_pixels: xr.DataArray | Sequence[float] | None = None
    seed: int = 0


def split_scans(observables: xr.Dataset) -> list[xr.Dataset]:
    """Return the scans of a stack, one without a stacking dimension by itself.

    Raises
    ------
    InversionError
        If the scans are not maps over two dimensions.
    """
    dims = [dim for dim in SCAN_DIMS if dim in observables["A1"].dims]
    scans = [observables]
    for dim in dims:
        scans = [scan.isel({dim: i}, drop=True) for scan in scans for i in range(scan.sizes[dim])]
    if len(scans[0]["A1"].dims) != 2:
        raise InversionError(
            "phases are found in maps",
            expected="observables over (y, x), or a stack of them along scan, setpoint or direction",
            got=str(tuple(map(str, observables["A1"].dims))),
            hint='method="posterior" takes any dimensions',
        )
    return scans


@dataclass(frozen=True)
class Found:
    """What the pixels of a scan share, before any of them is told of it.

    Parameters
    ----------
    settings : sequence of Setting
        Scans of one area.
    data : Harvest
        Their forces.
    question : Question
        Model, harmonics, lever, priors.
    exponent : float
        Change of ln of the elastic unknown with ln R at a given force.
    seed : int
        Of the draws.
    phases : Phases
        Which pixel belongs to which.
    names : sequence of str
        Of the phases.
    members : sequence of array
        Pixels of each phase.
    at_border : array (pixel,)
        Pixels that are told nothing: beside another phase, or beside a band of none.
    materials : sequence of Material
        Of each phase.
    table : Materials
        Of all of them.
    """

    settings: Sequence[Setting]
    data: Harvest
    question: Question
    exponent: float
    seed: int
    phases: Phases
    names: Sequence[str]
    members: Sequence[_Indices]
    at_border: npt.NDArray[np.bool_]
    materials: Sequence[Material]
    table: Materials


def find_materials(
    settings: Sequence[Setting],
    scans: Sequence[xr.Dataset],
    columns: Columns,
    priors: Mapping[str, Prior],
    probe: Probe,
    exponent: float,
    request: Request,
    *,
    full_motion: bool,
) -> Found:
    """Return the phases of a scan and the joint posterior of their materials.

    Parameters
    ----------
    settings, scans : sequence of Setting, of Dataset
        Scans of one area.
    columns, priors, probe
        The model, what is known before, and the lever.
    exponent : float
        Change of ln of the elastic unknown with ln R at a given force.
    request : Request
        Phases and reference.
    full_motion : bool
        Whether the harmonics of the motion count.
    """
    like = scans[0]["A1"]
    data = harvest(settings)
    setting = settings[0]
    question = Question(
        columns,
        setting.rows,
        follow(probe, setting.known, FEW if full_motion else 0),
        for_kernel(priors, next(iter(priors))),
        even="adhesion" in priors and priors["adhesion"].kind in (LOG_RANGE, LOG_NORMAL),
    )
    found = _phases(request, like, data)
    label = found.label.ravel()
    members = [np.flatnonzero((label == k) & data.usable) for k in range(found.count)]
    calibration = setting.shared.calibration if setting.shared is not None else None
    which, known, anchored = _reference(
        request, scans[0], calibration, members, columns.contact.sample_factor
    )
    called = [_name(k, which, request, calibration) for k in range(found.count)]
    inner = [_away_from_edges(pixels, like.shape) for pixels in members]
    tile = _tile_numbers(like.shape)
    drawn = isinstance(request.phases, xr.DataArray)
    mixed = [not drawn and bool(found.merged[k]) and found.trend[k] < _EVEN for k in range(found.count)]
    usual = [k for k in range(found.count) if len(members[k]) >= _FEWEST]
    together = [k for k in usual if not (anchored and k == which)]
    joints: dict[int, tuple[Joint, int]] = {}
    for group in (together, [which] if anchored and which in usual else []):
        if not group:
            continue
        facts = [Known(group.index(k), fact[0], fact[1], exponent) for k, fact in known.items() if k in group]
        joints |= _inferred(settings, data, inner, tile, question, facts, mixed, group, request.seed)
    materials = []
    for k in range(found.count):
        joint, place = joints.get(k, (None, 0))
        merged = mixed[k]
        if joint is not None and not drawn:
            merged = merged or _wanders(joint, place) > _GRADIENT
        materials.append(
            Material(k, len(members[k]), int(found.domains[k]), not merged, k == which, joint, place)
        )
    table = materials_of(
        materials,
        called,
        question,
        setting.rows,
        exponent,
        known,
        found.note.split("; ")[0].rstrip("."),
        anchored,
        calibration is not None,
        laws_of(materials, question, exponent, called),
    )
    # what a user has left out may be the same material
    told = found.label >= 0 if drawn else data.usable.reshape(found.label.shape)
    at_border = _at_borders(found, told).ravel()
    return Found(
        settings, data, question, exponent, request.seed, found, called, members, at_border, materials, table
    )


def pool_scan(found: Found, sheet: Sheet, progress: Callable[[int, int], None] | None) -> None:
    """Sharpen the posteriors of a sheet by what the pixels of its phases share.

    Parameters
    ----------
    found : Found
        Phases and materials.
    sheet : Sheet
        With the posterior of every pixel; what is pooled is replaced, what it was kept as ``<name>_unpooled``.
    progress : callable, optional
        Called with (pixels done, pixels in all).
    """
    names = quantities_of(found.question)
    for name in names:
        for variant in ("", "_lower", "_upper"):
            source = f"{name}_unscreened" if not variant else f"{name}{variant}"
            sheet.values[f"{name}_unpooled{variant}"] = sheet.values[source].copy()
    if found.settings[0].shared is not None:
        sheet.add("uncertainty_statistical", "uncertainty_systematic")
    sheet.add("shrinkage", fill=0.0)
    sheet.add("phase", fill=NONE, dtype="int8")
    sheet.add("phase_probability", fill=0.0)
    sheet.values["phase"][:] = found.phases.label.ravel()
    sheet.values["phase_probability"][:] = found.phases.probability.ravel()
    for material in found.materials:
        if material.joint is not None and material.resolved:
            _pool_phase(found, material, names, sheet, progress)
    sheet.attributes["phase"] = {
        "flag_values": [NONE, *range(len(found.names))],
        "flag_meanings": " ".join(["none", *found.names]),
    }


def _inferred(
    settings: Sequence[Setting],
    data: Harvest,
    members: Sequence[_Indices],
    tile: _Indices,
    question: Question,
    facts: Sequence[Known],
    mixed: Sequence[bool],
    group: Sequence[int],
    seed: int,
) -> dict[int, tuple[Joint, int]]:
    """Return the joint posterior of a group of phases, without those that the model cannot make."""
    joint = infer(
        settings, data, [members[k] for k in group], tile, question, facts, [mixed[k] for k in group], seed
    )
    if joint is not None:
        return {k: (joint, i) for i, k in enumerate(group)}
    if len(group) == 1:
        return {}
    # one of them cannot be made: the others by themselves
    fine = []
    for i, k in enumerate(group):
        own = [fact._replace(material=0) for fact in facts if fact.material == i]
        if infer(settings, data, [members[k]], tile, question, own, [mixed[k]], seed) is not None:
            fine.append(k)
    if not fine or len(fine) == len(group):
        return {}
    kept = [f._replace(material=fine.index(group[f.material])) for f in facts if group[f.material] in fine]
    return _inferred(settings, data, members, tile, question, kept, mixed, fine, seed)


def _phases(request: Request, like: xr.DataArray, data: Harvest) -> Phases:
    y = np.where(data.usable[:, None], data.y, math.nan)
    features = y.reshape(*like.shape, -1)
    noise = _local_scatter(features, data.noise)
    if isinstance(request.phases, xr.DataArray):
        labels = request.phases
        if set(labels.dims) != set(like.dims) or any(labels.sizes[d] != like.sizes[d] for d in like.dims):
            raise InversionError(
                "the labels of the phases do not fit the scan",
                expected=str(dict(like.sizes)),
                got=str(dict(labels.sizes)),
            )
        return labels_as_phases(labels.transpose(*like.dims).values, features, noise)
    return find_phases(features, noise, count=request.phases, seed=request.seed)


def _local_scatter(features: _Floats, noise: _Floats) -> _Floats:
    """Return the covariance of a pixel about its neighbours, no less than that of the noise.

    The feedback holds the amplitude a little off at each pixel, and the material differs: noise, for telling phases.
    """
    steps = (features[:, 1:] - features[:, :-1]).reshape(-1, features.shape[-1])
    steps = steps[np.isfinite(steps).all(axis=1)]
    if len(steps) < 50:
        return noise
    W = np.linalg.inv(np.linalg.cholesky(noise))
    length = ((steps @ W.T) ** 2).sum(axis=1)
    calm = steps[length <= np.quantile(length, 0.8)]
    # the quietest four fifths of a Gaussian of so many dimensions hold less than its covariance
    from scipy.stats import chi2

    size = features.shape[-1]
    cut = chi2.ppf(0.8, size)
    share = chi2.cdf(cut, size + 2) / 0.8
    seen = calm.T @ calm / len(calm) / 2.0 / share
    values, vectors = np.linalg.eigh(W @ seen @ W.T)
    root = np.linalg.inv(W) @ vectors * np.sqrt(np.maximum(values, 1.0))
    return np.asarray(root @ root.T)


def _reference(
    request: Request,
    scan: xr.Dataset,
    calibration: Calibration | None,
    members: Sequence[_Indices],
    sample_factor: float,
) -> tuple[int, dict[int, tuple[float, float]], bool]:
    """Return which phase is the reference (-1 none), what is known of it, and whether it anchored the scan before.

    ``sample_factor`` is 1 - nu^2 of the map.
    """
    mask, anchored = None, False
    ratio, value, error = 0.0, None, 0.0
    if request.reference is not None:
        if request.reference.modulus is None:
            raise InversionError(
                "the modulus of the reference is not known",
                expected="Reference(modulus=..., modulus_error=...)",
                hint="its modulus, or no reference",
            )
        ratio = request.reference.poisson_ratio
        value, error = request.reference.modulus, request.reference.modulus_error
        if request.reference_pixels is None:
            raise InversionError(
                "where the reference lies is not said",
                expected="a mask or a rectangle",
                hint="reference_pixels=",
            )
    if request.reference_pixels is not None:
        if request.reference is None:
            raise InversionError(
                "pixels of a reference without its modulus", expected="reference=Reference(...)"
            )
        mask = reference_pixels(scan, request.reference_pixels).ravel()
    elif "reference" in scan and calibration is not None and calibration.reference is not None:
        stated = calibration.reference.properties.get("modulus")
        if stated is not None:
            mask, anchored = np.asarray(scan["reference"].values).ravel() == 1, True
            ratio = calibration.reference.poisson_ratio
            value, error = stated
    if mask is None or value is None:
        return -1, {}, False
    # what is measured is E/(1 - nu^2), and all materials are told by the ratio of the map
    value *= sample_factor / (1.0 - ratio**2)
    shares = [float(mask[pixels].mean()) * (mask[pixels].sum() / max(mask.sum(), 1)) for pixels in members]
    hits = [float(mask[pixels].sum()) / max(int(mask.sum()), 1) for pixels in members]
    if not hits or max(hits) < _MARKED:
        if anchored:
            return -1, {}, False
        raise InversionError(
            "the pixels of the reference belong to no one phase",
            expected=f"half of them or more in one of {len(members)} phases",
            got=", ".join(f"{100 * hit:.0f} %" for hit in hits) or "no phases",
            hint="phases=, a mask of your own, or a rectangle inside of the reference",
        )
    which = int(np.argmax(shares))
    return which, {which: (math.log(value), max(error, 1e-3))}, anchored


def _name(k: int, which: int, request: Request, calibration: Calibration | None) -> str:
    if k == which:
        if request.reference is not None:
            return "_".join(request.reference.name.split())
        if calibration is not None and calibration.reference is not None:
            return "_".join(calibration.reference.name.split()) or "reference"
    return f"phase_{k + 1}"


def _away_from_edges(pixels: _Indices, shape: tuple[int, ...]) -> _Indices:
    """Return the pixels of a phase that no other phase or edge is next to: the tip, and the interphase, mix there."""
    from scipy.ndimage import binary_erosion

    mask = np.zeros(shape, bool)
    mask.ravel()[pixels] = True
    for depth in _DEPTHS:
        kept = binary_erosion(mask, np.ones((3, 3), bool), iterations=depth, border_value=1)
        if kept.sum() >= max(_FEWEST, _LEAST_KEPT * len(pixels)):
            return np.flatnonzero(kept.ravel())
    return pixels


def _at_borders(phases: Phases, known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which pixels (y, x) have another phase beside them, or known pixels of none; a few odd ones do not count.

    Most of them are of an interphase, however sure it is which side they are nearer to.
    """
    from scipy.ndimage import binary_dilation
    from scipy.ndimage import label as connected

    eight = np.ones((3, 3))
    border = np.zeros(phases.label.shape, bool)
    for k in range(NONE, phases.count):
        parts, _ = connected((phases.label == k) & known, eight)
        large = np.bincount(parts.ravel()) >= _BAND
        large[0] = False
        border |= binary_dilation(large[parts], eight) & (phases.label != k)
    return border


def _tile_numbers(shape: tuple[int, ...]) -> _Indices:
    rows, columns = shape
    y = np.arange(rows) * TILES // rows
    x = np.arange(columns) * TILES // columns
    return np.asarray((y[:, None] * TILES + x[None, :]).ravel(), dtype=np.intp)


def _wanders(joint: Joint, place: int) -> float:
    """Return the least change of ln of properties that explains what wanders smoothly within a phase."""
    tiles, response = joint.tiles[place], joint.responses[place]
    unit = joint.evidence.unit
    shared = tiles.changes.shape[2]
    z = joint.draws.z[:, :shared].mean(axis=0)
    # slopes that the instrument adds are none of the sample
    away = tiles.changes - np.average(tiles.changes, axis=0, weights=tiles.pixels)
    count = tiles.pixels.astype(float)
    between = beyond_scatter((tiles.y - away @ z) / unit, count, tiles.within / unit**2)
    # what is left over may be the bend of the harmonics: a tenth of what wanders need not be explained
    V = tiles.within / unit**2 / float(np.median(count)) + np.diag(
        _UNEXPLAINED * np.maximum(np.diag(between), 0.0)
    )
    # a change of 1 in ln of every property alike beforehand
    J = response.J
    G = J.T @ np.linalg.inv(J @ J.T + V)
    changes = G @ between @ G.T
    return math.sqrt(max(float(np.linalg.eigvalsh(changes)[-1]), 0.0))


def _pool_phase(
    found: Found,
    material: Material,
    names: tuple[str, ...],
    sheet: Sheet,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Replace the answers of the pixels of a phase."""
    from scipy.stats import chi2

    settings, data = found.settings, found.data
    pixels = found.members[material.index]
    pixels = pixels[~found.at_border[pixels]]
    if not pixels.size:
        return
    joint, k = material.joint, material.place
    assert joint is not None
    tiles, unit = joint.tiles[k], joint.evidence.unit
    mixture, about, precision = mixture_of(
        settings,
        found.question,
        joint,
        k,
        tilts(settings, tiles, pixels),
        data.noise,
        found.exponent,
        found.seed,
    )
    y = (data.y[pixels] - (data.amplitude[pixels] - tiles.amplitude) @ tiles.slope.T) / unit
    shared = settings[0].shared
    place = np.zeros((len(pixels), 3))
    if shared is not None:
        centre = np.average(tiles.place, axis=0, weights=tiles.pixels)
        place = np.stack([part[pixels] for part in shared.where], axis=1) - centre
    quantiles = np.empty((len(pixels), len(names), len(QUANTILES)))
    spreads = np.empty((len(pixels), len(names)))
    settled = np.zeros(len(pixels), bool)
    bare = without_motion(joint.draws.scene)
    along = mixture.along[mixture.centre]
    levels = np.array(QUANTILES)

    def run(block: slice) -> None:
        mine = y[block]
        solved = np.empty((len(mine), along.shape[1]))
        covariance = np.empty((len(mine), *2 * solved.shape[1:]))
        settle_pixels(bare, k, about, mine, place[block], solved, covariance, settled[block])
        left = np.sqrt(np.einsum("qa,pab,qb->pq", along, covariance, along))
        wider = np.clip(np.nan_to_num(left / mixture.spread[mixture.centre], nan=1.0), *_WIDER)
        pool(mine, place[block], solved, wider, mixture, levels, quantiles[block], spreads[block])

    run_blocks(run, len(pixels), _BLOCK, progress)
    # a pixel unlike the others of its phase is not told by them what it is
    off = y - np.average(y, axis=0)
    distance = np.einsum("pi,ij,pj->p", off, precision, off)
    fits = distance < chi2.isf(_OUTLIER, y.shape[1]) * max(
        float(np.median(distance)) / chi2.median(y.shape[1]), 1.0
    )
    fits &= settled
    fits &= sheet.values["status"][pixels] != MISSING_DATA
    fits &= sheet.values["status"][pixels] != NO_CONTACT
    sheet.values["phase"][pixels[~fits]] = NONE
    pixels, quantiles, spreads = pixels[fits], quantiles[fits], spreads[fits]
    values = np.exp(quantiles)
    width = quantiles[:, 0, 2] - quantiles[:, 0, 0]
    status = np.where(width <= WIDEST_DETERMINED, DETERMINED, NOT_DETERMINED).astype(np.int8)
    if material.misfit_probability < 1e-3:
        status[:] = POOR_FIT
    for q, name in enumerate(names):
        narrow = quantiles[:, q, 2] - quantiles[:, q, 0] <= WIDEST_DETERMINED
        fine = narrow & (status != POOR_FIT)
        if name == "modulus":
            fine = status == DETERMINED
        sheet.put(name, pixels, np.where(fine, values[:, q, 1], math.nan))
        sheet.put(f"{name}_unscreened", pixels, values[:, q, 1])
        sheet.put(f"{name}_lower", pixels, values[:, q, 0])
        sheet.put(f"{name}_upper", pixels, values[:, q, 2])
    sheet.put("status", pixels, status)
    alone = np.asarray(sheet.values["uncertainty"][pixels], dtype=float)
    sheet.put("uncertainty", pixels, spreads[:, 0])
    own = float(np.sqrt(np.mean(mixture.spread[:, 0] ** 2)))
    if "uncertainty_statistical" in sheet.values:
        sheet.put("uncertainty_statistical", pixels, own)
        sheet.put("uncertainty_systematic", pixels, np.sqrt(np.maximum(spreads[:, 0] ** 2 - own**2, 0.0)))
    with np.errstate(invalid="ignore", divide="ignore"):
        shrunk = 1.0 - (spreads[:, 0] / alone) ** 2
    sheet.put("shrinkage", pixels, np.clip(np.nan_to_num(shrunk), 0.0, 1.0))

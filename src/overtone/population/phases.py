"""The phases of a scan, told apart in what was measured and not in what is inferred from it: none is invented.

A scan is divided in two, and its parts again, as long as each division stands three tests (in `divide`): found in one
half of the tiles, a valley in density separates its sides in the other half; the features step across their edge within
a few pixels; and neither side wanders by more than a part of that step. So a homogeneous material, however it scatters,
is one phase, and a gradient is none that could be resolved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from overtone.errors import InversionError
from overtone.population.assign import assign, cloud_of, covariance_of
from overtone.population.coherence import coherence_of
from overtone.population.divide import Division, divide, halve

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]
_Labels = npt.NDArray[np.int8]

NONE = -1
"""Label of a pixel of no phase."""
_FEWEST = (30, 0.003)  # pixels of a phase: that many, and that share of the scan
_DOMAIN = 9  # pixels of a domain that counts
_ASIDE = 4.0  # pixels
_DEEPEST = 6  # divisions one within the other
_SMOOTH = 0.25  # share of the variance
_GAIN = 0.05  # in ln of density per pixel
_GRADED, _EVEN = 0.2, 0.7  # share of the variance that is smooth, and of that which is one even surface


@dataclass(frozen=True)
class Phases:
    """The phases of a scan: those that were found the largest first, those of labels in their order.

    Parameters
    ----------
    label : array (y, x) of int8
        Phase of each pixel; -1 for none: between two phases, unlike any, or not known.
    probability : array (y, x)
        That the pixel belongs to its phase, or to the likeliest one where it has none; 0 where it is not known.
    mean : array (phase, feature)
        Of the features of its pixels, in their units.
    covariance : array (phase, feature, feature)
        Of one pixel within the phase, noise included.
    pixels, domains : array (phase,) of int
        Pixels, and connected domains of at least a few.
    merged : array (phase,) of bool
        Merged, not resolved: the phase changes evenly across the scan, or is more than one cloud and its parts are
        coherent regions, but no valley or no edge separates them.
    smooth_share : array (phase,)
        Share of the variance that is smooth, between tiles of 8 pixels, in the direction where it is largest.
    smooth_size : array (phase,)
        Standard deviation of that smooth part, in standard deviations of the noise of a pixel.
    trend : array (phase,)
        Share of that smooth part which is one even surface across the scan, of second order: a gradient has most of it.
    note : str
        How the number of phases came about, in a sentence.
    """

    label: _Labels
    probability: _Floats
    mean: _Floats
    covariance: _Floats
    pixels: npt.NDArray[np.intp]
    domains: npt.NDArray[np.intp]
    merged: _Mask
    smooth_share: _Floats
    smooth_size: _Floats
    trend: _Floats
    note: str

    @property
    def count(self) -> int:
        """Number of phases."""
        return len(self.mean)


def find_phases(
    features: npt.ArrayLike, noise: npt.ArrayLike, *, count: int | None = None, seed: int = 0
) -> Phases:
    """Return the phases of a scan.

    Parameters
    ----------
    features : array (y, x, feature)
        Observables, any units; a pixel with one that is not finite has no phase.
    noise : array (feature, feature)
        Covariance of the noise of one pixel, with what else makes equal pixels differ across the scan.
    count : int, optional
        Number of phases; chosen by the scan unless given.
    seed : int
        Of the choice of pixels that the search looks at.

    Raises
    ------
    InversionError
        If shapes do not fit, the covariance is none, or the number of phases is not positive.

    Notes
    -----
    Assumes noise that is Gaussian and independent between pixels. Two materials that read alike are one phase.
    """
    z, known, root = _whitened(features, noise)
    if count is not None and not 1 <= count <= np.iinfo(np.int8).max:
        raise InversionError("a scan has another number of phases", expected="1 to 127", got=f"{count!r}")
    if not known.any():
        return _record(
            z, np.full(known.shape, NONE, np.int8), np.zeros(known.shape), root, features, "No pixel is known"
        )
    generator = np.random.default_rng(seed)
    fewest = max(_FEWEST[0], round(_FEWEST[1] * known.size))
    whole = _grown(z, known, fewest, generator, 0)
    found = len(_leaves(whole))
    lines = any(leaf.lines for leaf in _leaves(whole))
    if count is not None:
        whole = _with_count(z, whole, count, fewest)
    cores = [leaf.core for leaf in _leaves(whole)]
    label, probability = assign(z, known, cores, [cloud_of(z[core]) for core in cores])
    label = _by_size(label)
    return _record(z, label, probability, root, features, _note(found, count, int(label.max()) + 1, lines))


def _by_size(label: _Labels) -> _Labels:
    """Return labels with the largest phase first and none without pixels."""
    pixels = np.bincount(label[label >= 0])
    order = np.argsort(-pixels, kind="stable")[: np.count_nonzero(pixels)]
    sorted_label = np.full(label.shape, NONE, np.int8)
    for k, old in enumerate(order):
        sorted_label[label == old] = k
    return sorted_label


@dataclass(frozen=True)
class _Region:
    """A part of the scan without the pixels along its borders, and what it was divided into."""

    core: _Mask
    ratio: float = np.inf
    parts: tuple[_Region, ...] = ()
    lines: bool = False


def _grown(z: _Floats, core: _Mask, fewest: int, generator: np.random.Generator, level: int) -> _Region:
    """Return a region divided as often as the tests allow."""
    division, lines = divide(z, core, fewest, generator) if level < _DEEPEST else (None, False)
    if division is None:
        return _Region(core, lines=lines)
    parts = tuple(_grown(z, part, fewest, generator, level + 1) for part in _parts(division))
    return _Region(core, division.ratio, parts)


def _parts(division: Division) -> tuple[_Mask, _Mask]:
    """Return the two sides of a division, without what lies along their common border as far as enough is left."""

    def inner(side: _Mask, distance: _Floats) -> _Mask:
        for away, share in ((4.0, 0.6), (3.0, 0.4), (2.0, 0.3)):
            part = side & (distance >= away)
            if part.sum() > share * side.sum():
                return np.asarray(part)
        return side

    return inner(division.side, division.to_other), inner(division.other, division.to_side)


def _leaves(region: _Region) -> list[_Region]:
    """Return the parts of a region that are not divided."""
    return [leaf for part in region.parts for leaf in _leaves(part)] if region.parts else [region]


def _with_count(z: _Floats, whole: _Region, count: int, fewest: int) -> _Region:
    """Return a scan of a given number of phases: weakest divisions undone, or the best ones there are made."""
    while len(_leaves(whole)) > count:
        last = max(_divided(whole), key=lambda region: region.ratio)
        whole = _replaced(whole, last, _Region(last.core))
    while len(_leaves(whole)) < count:
        offers = [
            (leaf, offer) for leaf in _leaves(whole) if (offer := halve(z, leaf.core, fewest)) is not None
        ]
        if not offers:
            break
        leaf, (division, _) = max(offers, key=lambda found: found[1][1])
        whole = _replaced(whole, leaf, _Region(leaf.core, np.inf, tuple(map(_Region, _parts(division)))))
    return whole


def _divided(region: _Region) -> list[_Region]:
    """Return the regions both of whose parts are whole."""
    if not region.parts:
        return []
    inside = [found for part in region.parts for found in _divided(part)]
    return inside or [region]


def _replaced(region: _Region, old: _Region, new: _Region) -> _Region:
    """Return a region with one within it replaced."""
    if region is old:
        return new
    return _Region(region.core, region.ratio, tuple(_replaced(part, old, new) for part in region.parts))


def labels_as_phases(labels: npt.ArrayLike, features: npt.ArrayLike, noise: npt.ArrayLike) -> Phases:
    """Return phases as the user has drawn them.

    Parameters
    ----------
    labels : array (y, x) of int
        Phase of each pixel, 0 or more; negative for none.
    features, noise
        As in `find_phases`.

    Returns
    -------
    Phases
        In the order of the labels. A pixel with a feature that is not finite has none.

    Raises
    ------
    InversionError
        If shapes do not fit, labels are no whole numbers, or a phase has no pixel.
    """
    z, known, root = _whitened(features, noise)
    asked = np.asarray(labels)
    whole = np.isfinite(asked) & (asked == np.round(np.where(np.isfinite(asked), asked, 0.5)))
    if asked.shape != known.shape or not whole.all() or asked.max(initial=0) > np.iinfo(np.int8).max:
        raise InversionError(
            "these are no labels of phases",
            expected=f"whole numbers up to 127 of shape {known.shape}",
            got=f"shape {asked.shape}" if asked.shape != known.shape else "something else",
        )
    label = np.where(known & (asked >= 0), asked, NONE).astype(np.int8)
    if not (label >= 0).any():
        raise InversionError("no pixel is labelled as a phase", expected="labels of 0 or more")
    missing = sorted(set(range(int(asked.max()) + 1)) - set(np.unique(label).tolist()))
    if missing:
        raise InversionError(
            f"phase {', '.join(map(str, missing))} has no usable pixel", hint="labels without gaps"
        )
    return _record(z, label, (label >= 0).astype(float), root, features, "labels as given")


def _whitened(features: npt.ArrayLike, noise: npt.ArrayLike) -> tuple[_Floats, _Mask, _Floats]:
    """Return features in units of the noise, 0 where unknown; which pixels are known; and the root of the noise."""
    values, covariance = np.asarray(features, float), np.asarray(noise, float)
    if values.ndim != 3 or 0 in values.shape or covariance.shape != 2 * values.shape[-1:]:
        raise InversionError(
            "features of a scan and their noise do not fit",
            expected="arrays (y, x, feature) and (feature, feature)",
            got=f"shapes {values.shape} and {covariance.shape}",
        )
    size = np.sqrt(np.abs(np.diag(covariance)))
    fine = bool(np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all())
    if fine:
        correlation = covariance / np.outer(size, size)
        fine = np.allclose(correlation, correlation.T) and np.linalg.eigvalsh(correlation)[0] > 1e-12
    if not fine:
        raise InversionError(
            "the noise of the features is no covariance", expected="symmetric and positive definite"
        )
    root = size[:, None] * np.linalg.cholesky(correlation)
    known = np.isfinite(values).all(axis=-1)
    middle = np.median(values[known], axis=0) if known.any() else 0.0
    about = (np.where(known[..., None], values, middle) - middle) / size
    z = about @ np.linalg.inv(root / size[:, None]).T
    return np.ascontiguousarray(z), known, root


def _record(
    z: _Floats, label: _Labels, probability: _Floats, root: _Floats, features: npt.ArrayLike, note: str
) -> Phases:
    """Return phases with all that is known of them."""
    from scipy.ndimage import label as connected

    values = np.asarray(features, float)
    masks = [label == k for k in range(int(label.max()) + 1)]
    parts = [coherence_of(z, _apart(mask, (label >= 0) & ~mask)) for mask in masks]
    graded = np.array([p.share > _GRADED and p.trend > _EVEN for p in parts], bool)
    merged = graded | np.array([p.share > _SMOOTH and p.gain > _GAIN for p in parts], bool)
    domains = [np.bincount(connected(mask, np.ones((3, 3)))[0].ravel())[1:] for mask in masks]
    named = [
        (merged & ~graded, "{} merged, not resolved: coherent parts that no valley or no edge separates"),
        (graded, "{} merged, not resolved: it changes evenly across the scan"),
    ]
    for flags, text in named:
        if flags.any():
            which = " and ".join(str(k + 1) for k in np.flatnonzero(flags))
            note += "; " + text.format("it is" if len(masks) == 1 else f"phase {which} is")
    size = values.shape[-1]
    return Phases(
        label=label,
        probability=probability,
        mean=np.array([values[mask].mean(axis=0) for mask in masks]).reshape(-1, size),
        covariance=np.array([root @ covariance_of(z[mask]) @ root.T for mask in masks]).reshape(
            -1, size, size
        ),
        pixels=np.array([mask.sum() for mask in masks], np.intp),
        domains=np.array([(d >= _DOMAIN).sum() for d in domains], np.intp),
        merged=merged,
        smooth_share=np.array([p.share for p in parts]),
        smooth_size=np.array([p.size for p in parts]),
        trend=np.array([p.trend for p in parts]),
        note=note + ".",
    )


def _apart(mask: _Mask, others: _Mask) -> _Mask:
    """Return the pixels of a phase away from all others, if enough are left: near them it varies for another reason."""
    from scipy.ndimage import distance_transform_edt

    if not others.any():
        return mask
    inner = mask & (distance_transform_edt(~others) > _ASIDE)
    return inner if inner.sum() > 0.3 * mask.sum() else mask


def _note(found: int, count: int | None, made: int, lines: bool) -> str:
    """Return how a number of phases came about."""
    if count is not None:
        own = f"the scan itself supports {found}" if found != count else "as the scan itself supports"
        short = "" if made == count else f", of which {made} could be made"
        return f"{count} phase{'s' * (count > 1)} asked for{short}; {own}"
    if found == 1:
        text = "One phase: nothing divides the scan by both a valley in density and a sharp edge"
    else:
        text = (
            f"{found} phases, each set apart by a valley in the density of tiles held out and by a sharp edge"
        )
    if lines:
        text += "; a step from one scan line to the next counts for none, as it is what a change of the tip looks like"
    return text

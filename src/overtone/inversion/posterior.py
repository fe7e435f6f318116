"""The whole posterior of a pixel, by quadrature over the indentation and the modulus.

With Gaussian errors the force of adhesion and the loss integrate out in closed form at each indentation and modulus,
within their bounds; the two that are left are summed over a grid that follows the valley of the misfit, wherever it
bends. What comes out are marginal distributions, as medians and 90 % intervals, and the evidence: the probability of
the data under the model and the priors. Out of contact the attraction alone is left, and the sum is over the gap.

The grid is as coarse as honest intervals allow: against sums on dense grids their ends lie within 8 % of their width,
most within 3 %, and ln Z within 0.1. Where a property has a bound in the middle of a wide posterior the error is
largest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.apart import apart, gap_range, has_reach
from overtone.inversion.columns import Columns, adhesive
from overtone.inversion.histogram import (
    EMPTY,
    LEVELS,
    add_gaussian,
    add_group,
    fill_quantiles,
    gauss_between,
    gauss_mass,
    joined,
    joins,
    smear,
    spread_over,
    sum_steps,
)
from overtone.inversion.linear import Contact, sample_modulus, stiffness
from overtone.inversion.motion import Followed, difference_at, gauss_rule, new_room
from overtone.inversion.search import columns_at, pixel_at
from overtone.inversion.stretches import MODES, REACH, STRIDE, find_stretches, partition
from overtone.inversion.table import DEEPEST, NODES, SHALLOWEST, Table, locate
from overtone.inversion.valley import (
    Box,
    Reduced,
    Scratch,
    best_F,
    best_S,
    chi2_at,
    edge_of_S,
    new_scratch,
    reduce,
    set_places,
    solved,
    whiten,
)
from overtone.kernels import inner, kernel, lean

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

QUANTITIES = 5
MODULUS_, ADHESION_, INDENTATION_, LOSS_, TANGENT_ = 0, 1, 2, 3, 4
"""Quantities of an answer: ln of the first unknown, F_ad, indentation, S tan(delta), tan(delta)."""
SUMMARIES = 5
MEAN_, SPREAD_, EVIDENCE_, CONTACT_, MISFIT_ = 0, 1, 2, 3, 4
"""Summaries of an answer: mean and spread of ln of the first unknown, ln Z, probability of contact, chi-squared."""

_INNER_REACH = 14.0
_ACROSS, _MOST_ACROSS = 9, 37  # even nodes along ln E at one indentation
_ALONG, _MOST_ALONG = 21, 61  # nodes along the indentation
_WIDTH_ALONG = 0.2  # of t, between nodes where the valley is long
_WIDTH_ACROSS = 0.6
_WIDTH_OF_A_PIECE, _MOST_PIECES = 1.5, 7  # of ln E, of Gauss's rule between two bends
_BINS = 160
_GAP_NODES = 61
_NEGLIGIBLE = 5e-4  # of the largest weight of a node, below which one is in no marginal
_PLACES = 3  # at which the difference that the harmonics of the motion make is found
_BESIDE = 0.2
_MOST_PASSES = 8
_SMALL = 0.05  # standard deviations of the noise
_ALONE = 0.2  # of them, that one pass leaves: about the difference, times its share of the data
_DECADES = 8.0  # of S tan(delta), below its largest


_GAUSS = gauss_rule(6)
_WIDEST = max(_MOST_ACROSS, 5 * _MOST_PIECES * 6)
_LOG_ROOT_2PI = 0.5 * math.log(2.0 * math.pi)


class Prior(NamedTuple):
    """What is known of a pixel before it was measured, as the kernel takes it."""

    log_low: float
    """Bounds of ln of the first unknown (modulus, stiffness, prefactor)."""
    log_high: float
    centre: float
    """Mean of ln of the first unknown, and"""
    precision: float
    """one over its variance; 0 for all of it alike."""
    adhesion_low: float
    """Bounds of F_ad [N]."""
    adhesion_high: float
    adhesion_mean: float
    adhesion_precision: float
    """As for the first unknown, of F_ad itself."""
    tangent_high: float
    """Largest loss tangent; all of them alike from 0."""
    shallowest: float
    """Smallest indentation, or gap out of contact [m]; all of their logarithms alike, up to"""
    deepest: float
    """the largest indentation [m], or nearly twice the amplitude."""
    contact: float
    """Probability of contact."""


class Grid(NamedTuple):
    """What is kept of every node (along, across)."""

    weight: _Floats
    x: _Floats
    F: _Floats
    F_spread: _Floats
    """(along,)."""
    c: _Floats
    c_spread: _Floats
    S: _Floats
    shift: _Floats
    """Of ln E*, from what the residual says of the radius."""
    t: _Floats
    """(along,)."""
    cell: _Floats
    """(along,): half of its width in t."""
    members: npt.NDArray[np.int64]
    """(along,): nodes across."""


@inner
def new_grid() -> Grid:
    """Return a grid for a pixel."""
    most = 3 * MODES * _MOST_ALONG
    return Grid(
        np.zeros((most, _WIDEST)),
        np.zeros((most, _WIDEST)),
        np.zeros((most, _WIDEST)),
        np.zeros(most),
        np.zeros((most, _WIDEST)),
        np.zeros((most, _WIDEST)),
        np.zeros((most, _WIDEST)),
        np.zeros((most, _WIDEST)),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most, np.int64),
    )


@lean
def _across(
    m: Reduced,
    box: Box,
    tangent_high: float,
    contact: Contact,
    S_low: float,
    S_high: float,
    first: float,
    last: float,
    whole_width: bool,
    bends: _Floats,
    across: _Floats,
) -> int:
    """Fill places and weights of a sum over ln of the first unknown at one indentation; return how many.

    Evenly where the integrand falls off on both sides; else by Gauss's rule between the ends and where a bound of the
    force of adhesion or of the loss begins to hold: it turns off sharply there.
    """
    count = 0
    for k in range(4):
        S = math.nan
        if k < 2 and m.beta2 > 0.0 and m.F1 != 0.0:
            S = ((box.weakest if k == 0 else box.strongest) - m.F0) / m.F1
        elif k >= 2 and m.gamma2 > 0.0:
            # no loss, or the largest loss tangent
            slope = m.c1 + m.c2 * m.F1 - (tangent_high if k == 3 else 0.0)
            S = -(m.c0 + m.c2 * m.F0) / slope if slope != 0.0 else math.nan
        if S_low < S < S_high:
            bends[count] = math.log(sample_modulus(contact, S))
            count += 1
    if count == 0 and whole_width:
        members = min(_ACROSS + 2 * int((last - first) / _WIDTH_ACROSS), _MOST_ACROSS)
        span = (last - first) / (members - 1)
        for k in range(members):
            across[0, k] = first + span * k
            across[1, k] = span * (0.5 if k == 0 or k == members - 1 else 1.0)
        return members
    bends[count] = last
    for i in range(count):  # few: by exchange
        for j in range(i + 1, count):
            if bends[j] < bends[i]:
                bends[i], bends[j] = bends[j], bends[i]
    members, start = 0, first
    for i in range(count + 1):
        width = bends[i] - start
        pieces = min(1 + int(width / _WIDTH_OF_A_PIECE), _MOST_PIECES)
        for j in range(pieces):
            for k in range(_GAUSS.shape[1]):
                across[0, members] = start + width * (j + _GAUSS[0, k]) / pieces
                across[1, members] = width * _GAUSS[1, k] / pieces
                members += 1
        start = bends[i]
    return members


@kernel
def posterior_pixels(
    y: _Floats,
    whitening: _Floats,
    amplitude: _Floats,
    usable: npt.NDArray[np.bool_],
    columns: Columns,
    table: Table,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    attraction: npt.NDArray[np.int64],
    prior: Prior,
    followed: Followed,
    f_known: _Complex,
    radius_pull: _Floats,
    radius_variance: _Floats,
    whole: bool,
    quantiles: _Floats,
    summary: _Floats,
) -> None:
    """Sum the posterior of every pixel.

    Parameters
    ----------
    y, whitening : array (pixel, row), (pixel or 1, row, row)
        Force harmonics [N] and what whitens their errors.
    amplitude, usable : array (pixel,)
        Of the tip [m]; False where there is nothing to invert.
    columns, table : Columns, Table
        The model, and its table for these amplitudes.
    orders, lossy : array (row,)
        As `overtone.inversion.forces.Rows` has them.
    attraction : array (1,)
        Row of CONS_1, whose sign says whether the tip may stay out of contact; -1 without.
    prior : Prior
        Of the material and the indentation.
    followed : Followed
        The lever, or without harmonics for a bare cosine.
    f_known : array (pixel, harmonic)
        Forces of the harmonics that were measured, complex [N].
    radius_pull, radius_variance : array (pixel or 1, row), (pixel or 1,)
        What a whitened residual says of ln of the first unknown through the radius of the tip, and the variance of it
        that is left.
    whole : bool
        Whether quantiles are wanted beside the summary.
    quantiles : array (pixel, QUANTITIES, 3)
        Filled: 5, 50 and 95 % of every quantity, given contact where that is the more likely, else out of it.
    summary : array (pixel, SUMMARIES)
        Filled.
    """
    rows = orders.shape[0]
    places = _PLACES if followed.tip.shape[0] > 0 else 0
    s = new_scratch(rows + 1, table.elastic.shape[2] - 1, places)
    bare = new_scratch(rows + 1, table.elastic.shape[2] - 1, 0)
    room, out, whitened = new_room(followed), np.zeros(rows), np.zeros(rows)
    sticky, loss = adhesive(columns), columns.loss > 0.0
    contact = columns.contact
    bounded = np.empty((NODES - 1) // STRIDE + 1)
    ends, cores, parts = np.empty((MODES, 2)), np.empty((MODES, 2)), np.empty((3 * MODES, 2))
    grid = new_grid()
    bends, across = np.empty(5), np.empty((2, _WIDEST))
    along = np.empty(grid.t.shape[0])
    bins, work = np.empty((3, _BINS)), np.empty(_BINS)
    root_F = math.sqrt(prior.adhesion_precision)
    if root_F > 0.0:
        s.wb[rows], s.first[rows] = root_F, root_F * prior.adhesion_mean
        bare.wb[rows], bare.first[rows] = s.wb[rows], s.first[rows]
    box = Box(
        stiffness(contact, math.exp(prior.log_low))[0],
        stiffness(contact, math.exp(prior.log_high))[0],
        prior.adhesion_low,
        prior.adhesion_high,
    )
    # densities of the priors
    log_prior = -math.log(prior.log_high - prior.log_low)
    if prior.precision > 0.0:
        mass, more = gauss_mass(prior.log_low, prior.log_high, prior.centre, 1.0 / math.sqrt(prior.precision))
        log_prior = 0.5 * math.log(prior.precision) - _LOG_ROOT_2PI - math.log(mass) - more
    log_prior_F = 0.0
    if sticky:
        log_prior_F = -math.log(prior.adhesion_high - prior.adhesion_low)
        if root_F > 0.0:
            mass, more = gauss_mass(
                prior.adhesion_low, prior.adhesion_high, prior.adhesion_mean, 1.0 / root_F
            )
            log_prior_F = math.log(root_F) - _LOG_ROOT_2PI - math.log(mass) - more
    for i in range(y.shape[0]):
        quantiles[i], summary[i] = math.nan, math.nan
        if not usable[i]:
            continue
        A = amplitude[i]
        slot, share = locate(table, A)
        if slot < 0:
            continue
        W = whitening[min(i, whitening.shape[0] - 1)]
        u = radius_pull[min(i, radius_pull.shape[0] - 1)]
        variance_R = radius_variance[min(i, radius_variance.shape[0] - 1)]
        whiten(W, y[i], s.first)
        log_norm = -rows * _LOG_ROOT_2PI
        for r in range(rows):
            log_norm += math.log(W[r, r])
        bottom = max(math.log(prior.shallowest / (2.0 * A - prior.shallowest)), SHALLOWEST)
        top = DEEPEST
        if prior.deepest < 2.0 * A / (1.0 + math.exp(-DEEPEST)):
            top = math.log(prior.deepest / (2.0 * A - prior.deepest))
        if not bottom < top:
            continue
        log_prior_t = -math.log(math.log((1.0 + math.exp(-bottom)) / (1.0 + math.exp(-top))))
        pixel = pixel_at(columns, A, table, slot, share, orders, lossy, W, box)
        # where the bare cosine puts the valley, and what the harmonics of the motion make of it
        whiten(W, y[i], bare.first)
        count, least, best_t = find_stretches(pixel, bare, bounded, bottom, top, places == 0, ends, cores)
        if places > 0:
            out[:] = 0.0
            s.shifts[:] = 0.0
            size = 0.0
            for r in range(rows):
                size = max(size, abs(bare.first[r]))
            # where the difference moves the valley off the places that it was found at, it is found again
            for _ in range(_MOST_PASSES):
                low, high = ends[0, 0] - _BESIDE, ends[count - 1, 1] + _BESIDE
                set_places(s, low, high)
                for j in range(places):
                    room.b[:] = 0.0
                    # one that is large, and matters, also for the material that it leaves
                    for _ in range(_MOST_PASSES):
                        difference_at(s.places[j], pixel, followed, f_known[i], bare, room, out)
                        whiten(W, out, whitened)
                        whole_size, change = 0.0, 0.0
                        for r in range(rows):
                            whole_size = max(whole_size, abs(whitened[r]))
                            change = max(change, abs(whitened[r] - s.shifts[j, r]))
                            s.shifts[j, r] = whitened[r]
                        if whole_size * whole_size < _ALONE * size or change < _SMALL:
                            break
                    s.shifts[j, rows] = 0.0
                count, least, best_t = find_stretches(pixel, s, bounded, bottom, top, True, ends, cores)
                if ends[0, 0] >= low and ends[count - 1, 1] <= high:
                    break
        nodes, total, most = 0, 0.0, 0.0
        mean, square = 0.0, 0.0
        count = partition(ends, cores, count, parts)
        for stretch in range(count):
            low, high = parts[stretch, 0], parts[stretch, 1]
            n = min(max(_ALONG, int((high - low) / _WIDTH_ALONG) + 1), _MOST_ALONG)
            # an end may be a bound, at which the sum stops short: every node in the middle of its cell
            step = (high - low) / n
            for j in range(n):
                t = low + step * (j + 0.5)
                Delta = columns_at(pixel, t, s)
                m = reduce(s, sticky, loss)
                grid.t[nodes], grid.cell[nodes], grid.members[nodes] = t, 0.5 * step, 0
                along[nodes] = 0.0
                S = best_S(m, box)
                here = chi2_at(m, S, box)
                target = here + _INNER_REACH
                S_low = max(edge_of_S(m, box, target, -1.0), box.softest)
                S_high = min(edge_of_S(m, box, target, 1.0), box.stiffest)
                if not S_low < S_high:
                    nodes += 1
                    continue
                first = math.log(sample_modulus(contact, S_low)) if S_low > box.softest else prior.log_low
                last = math.log(sample_modulus(contact, S_high)) if S_high < box.stiffest else prior.log_high
                whole_width = S_low > box.softest and S_high < box.stiffest
                members = _across(
                    m,
                    box,
                    prior.tangent_high,
                    contact,
                    S_low,
                    S_high,
                    first,
                    last,
                    whole_width,
                    bends,
                    across,
                )
                constant = log_prior + log_prior_t + log_prior_F
                if m.beta2 > 0.0:
                    constant += _LOG_ROOT_2PI - 0.5 * math.log(m.beta2)
                if m.gamma2 > 0.0:
                    constant += _LOG_ROOT_2PI - 0.5 * math.log(m.gamma2) - math.log(prior.tangent_high)
                factor = step * (1.0 - Delta) * math.exp(constant)
                uy, ua, ub, uv = 0.0, 0.0, 0.0, 0.0
                for r in range(u.shape[0]):
                    uy += u[r] * s.wy[r]
                    ua += u[r] * s.wa[r]
                    ub += u[r] * s.wb[r]
                    uv += u[r] * s.wv[r]
                sigma_F = 1.0 / math.sqrt(m.beta2) if m.beta2 > 0.0 else 0.0
                for k in range(members):
                    x = across[0, k]
                    S = contact.factor / (contact.tip_compliance + contact.sample_factor * math.exp(-x))
                    away = S - m.S
                    exponent = -0.5 * (m.rest + m.alpha2 * away * away - least)
                    F, c, spread_c, mass, shift = 0.0, 0.0, 0.0, 1.0, 0.0
                    typical, spread_F = 0.0, 0.0
                    if m.beta2 > 0.0:
                        F = m.F0 + m.F1 * S
                        mass, more, typical, spread_F = gauss_between(
                            prior.adhesion_low, prior.adhesion_high, F, sigma_F
                        )
                        exponent += more
                    if m.gamma2 > 0.0:
                        c = m.c0 + m.c1 * S + m.c2 * typical
                        spread_c = math.sqrt(1.0 / m.gamma2 + m.c2 * m.c2 * spread_F * spread_F)
                        part, more = gauss_mass(0.0, prior.tangent_high * S, c, spread_c)
                        mass *= part / S
                        exponent += more
                    if prior.precision > 0.0:
                        exponent -= 0.5 * prior.precision * (x - prior.centre) ** 2
                    weight = factor * across[1, k] * mass * math.exp(exponent)
                    # what the residual says of the radius, through errors that both share
                    if variance_R > 0.0:
                        shift = uy - S * ua - F * ub - c * uv
                        # of a sample beside its tip: the tip's own compliance takes no part
                        x += shift / (1.0 - contact.tip_compliance * S / contact.factor)
                    grid.weight[nodes, k], grid.x[nodes, k] = weight, x
                    grid.F[nodes, k] = F
                    if loss:
                        grid.c[nodes, k], grid.c_spread[nodes, k], grid.S[nodes, k] = c, spread_c, S
                        grid.shift[nodes, k] = shift
                    total += weight
                    mean += weight * x
                    square += weight * x * x
                    along[nodes] += weight
                    most = max(most, weight)
                grid.members[nodes], grid.F_spread[nodes] = members, sigma_F
                nodes += 1
        evidence, variance_E = 0.0, variance_R
        if total > 0.0:
            mean /= total
            # the radius moves E*: of a stiff sample its modulus by more
            stiff = stiffness(contact, math.exp(mean))[0]
            variance_E = variance_R / (1.0 - contact.tip_compliance * stiff / contact.factor) ** 2
            summary[i, MEAN_] = mean
            summary[i, SPREAD_] = math.sqrt(max(square / total - mean * mean, 0.0) + variance_E)
            evidence = total
        reference = least
        apart_total = 0.0
        if attraction[0] >= 0 and y[i, attraction[0]] > 0.0 and has_reach(columns) and prior.contact < 1.0:
            for r in range(rows):
                s.wy[r] = s.first[r]
            apart_total, least_apart = _out_of_contact(
                A,
                columns,
                orders,
                lossy,
                W,
                prior,
                log_prior_F,
                s,
                quantiles[i],
                bins,
                whole,
            )
            reference = min(least, least_apart)
            apart_total *= math.exp(-0.5 * (least_apart - reference)) * (1.0 - prior.contact)
        together = evidence * math.exp(-0.5 * (least - reference)) * prior.contact
        if together + apart_total > 0.0:
            summary[i, CONTACT_] = together / (together + apart_total)
            summary[i, EVIDENCE_] = math.log(together + apart_total) - 0.5 * reference + log_norm
        summary[i, MISFIT_] = reference
        if least <= reference:
            # of the data alone: a prior of adhesion is none of them
            columns_at(pixel, best_t, s)
            _, m, S = solved(reduce(s, sticky, loss), s, sticky, box)
            F = best_F(m, S, box)
            c = m.c0 + m.c1 * S + m.c2 * F
            misfit = 0.0
            for r in range(rows):
                left_over = s.wy[r] - S * s.wa[r] - F * s.wb[r] - c * s.wv[r]
                misfit += left_over * left_over
            summary[i, MISFIT_] = misfit
        if not total > 0.0 or not whole or summary[i, CONTACT_] < 0.5:
            continue
        F_low, F_high = prior.adhesion_high, prior.adhesion_low
        x_low, x_high, c_high, tangent_high = math.inf, -math.inf, 0.0, 0.0
        c_low, tangent_low = math.inf, math.inf
        for j in range(nodes):
            for k in range(grid.members[j]):
                if grid.weight[j, k] > _NEGLIGIBLE * most:
                    x_low, x_high = min(x_low, grid.x[j, k]), max(x_high, grid.x[j, k])
                    F_low = min(F_low, grid.F[j, k] - 4.0 * grid.F_spread[j])
                    F_high = max(F_high, grid.F[j, k] + 4.0 * grid.F_spread[j])
                    if loss:
                        top = max(grid.c[j, k], 0.0) + 4.0 * grid.c_spread[j, k]
                        top = min(top, prior.tangent_high * grid.S[j, k])
                        c_high, tangent_high = max(c_high, top), max(tangent_high, top / grid.S[j, k])
                        low = max(min(grid.c[j, k] - 4.0 * grid.c_spread[j, k], top), 0.0)
                        c_low, tangent_low = min(c_low, low), min(tangent_low, low / grid.S[j, k])
        F_low, F_high = max(F_low, prior.adhesion_low), min(F_high, prior.adhesion_high)
        # one quantity after the other into the same bins
        for q in range(QUANTITIES):
            if q == INDENTATION_ or (q == ADHESION_ and not sticky) or (q >= LOSS_ and not loss):
                continue
            least_q = prior.adhesion_low if q == ADHESION_ else 0.0
            more = 4.0 * math.sqrt(variance_E) + 1e-9 + 0.02 * (x_high - x_low)
            low, high = x_low - more, x_high + more
            if q == ADHESION_:
                low, high = F_low, F_high
            elif q == LOSS_:
                more = 6.0 * math.sqrt(variance_R)  # viscosity goes with the radius as E* does
                high = math.log(c_high) + more
                low = max(
                    math.log(c_low) - more if c_low > 0.0 else -math.inf, high - _DECADES * math.log(10.0)
                )
            elif q == TANGENT_:
                low, high = tangent_low, tangent_high
            width = (high - low) / _BINS
            if not width > 0.0:
                quantiles[i, q] = low
                continue
            fineness = 1.0 / width
            bins[:] = 0.0
            values = grid.x if q == MODULUS_ else grid.F if q == ADHESION_ else grid.c
            for j in range(nodes):
                same = grid.members[j]
                ahead = j + 1 < nodes and grid.members[j + 1] == same
                back = j > 0 and grid.members[j - 1] == same
                alike = EMPTY
                for k in range(same):
                    weight = grid.weight[j, k]
                    if not weight > _NEGLIGIBLE * most:
                        continue
                    # half of the way to the next node along the valley, at the same place across it
                    middle, half = values[j, k], 0.0
                    if ahead:
                        half = 0.5 * abs(values[j + 1, k] - middle)
                    if back:
                        half = max(half, 0.5 * abs(values[j - 1, k] - middle))
                    if half == 0.0 and k + 1 < same:
                        half = 0.5 * abs(values[j, k + 1] - middle)
                    if q == MODULUS_:
                        spread_over(bins, low, fineness, middle - half, middle + half, weight)
                        continue
                    sigma, limit, factor_q = grid.F_spread[j], prior.adhesion_high, 1.0
                    if q != ADHESION_:
                        sigma, limit = grid.c_spread[j, k], prior.tangent_high * grid.S[j, k]
                        half = min(half, 2.0 * sigma)
                        factor_q = 1.0 / grid.S[j, k] if q == TANGENT_ else math.exp(grid.shift[j, k])
                    middle, half, sigma = factor_q * middle, factor_q * half, factor_q * sigma
                    if not joins(alike, middle, sigma, factor_q * limit):
                        add_group(bins, low, fineness, alike, least_q, q == LOSS_)
                        alike = EMPTY
                    alike = joined(alike, middle, half, sigma, factor_q * limit, weight)
                add_group(bins, low, fineness, alike, least_q, q == LOSS_)
            histogram = sum_steps(bins)
            of_radius = variance_E if q == MODULUS_ else variance_R if q == LOSS_ else 0.0
            if of_radius > (0.3 * width) ** 2:
                smear(histogram, math.sqrt(of_radius) / width, work)
            fill_quantiles(histogram, low, width, quantiles[i, q])
            if q == LOSS_:
                for level in range(LEVELS.shape[0]):
                    quantiles[i, q, level] = math.exp(quantiles[i, q, level])
        # the indentation is the node itself
        below, level = 0.0, 0
        for j in range(nodes):
            above = below + along[j]
            while level < LEVELS.shape[0] and above >= LEVELS[level] * total and along[j] > 0.0:
                left, right = grid.t[j] - grid.cell[j], grid.t[j] + grid.cell[j]
                t = left + (right - left) * (LEVELS[level] * total - below) / along[j]
                quantiles[i, INDENTATION_, level] = 2.0 * A / (1.0 + math.exp(-t))
                level += 1
            below = above


@inner
def _out_of_contact(
    A: float,
    columns: Columns,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    W: _Floats,
    prior: Prior,
    log_prior_F: float,
    s: Scratch,
    quantiles: _Floats,
    bins: _Floats,
    whole: bool,
) -> tuple[float, float]:
    """Sum over the gap where the tip stays out of contact; return the sum over exp(-chi2/2) and chi-squared.

    Quantiles of F_ad and of the indentation, negative, are filled.
    """
    start, stop = gap_range(columns, A)
    start = max(start, math.log(prior.shallowest))
    log_prior_gap = -math.log(stop - start)
    rows = orders.shape[0]
    best, where = math.inf, start
    width = (stop - start) / (_GAP_NODES - 1)
    # where it fits, coarse and then fine
    for k in range(_GAP_NODES):
        chi2, _, _ = apart(A, math.exp(start + width * k), columns, orders, lossy, W, s)
        if chi2 < best:
            best, where = chi2, start + width * k
    low, high = max(where - width, start), min(where + width, stop)
    for _ in range(40):
        third = (high - low) / 3.0
        left = apart(A, math.exp(low + third), columns, orders, lossy, W, s)[0]
        right = apart(A, math.exp(high - third), columns, orders, lossy, W, s)[0]
        if left < right:
            high -= third
        else:
            low += third
        if high - low < 1e-4:
            break
    where = 0.5 * (low + high)
    best = apart(A, math.exp(where), columns, orders, lossy, W, s)[0]
    ends = np.empty(2)
    for side in range(2):
        limit, away = (start, -1e-3) if side == 0 else (stop, 1e-3)
        edge = where
        while True:
            edge = where + away
            if (edge - limit) * away >= 0.0:
                edge = limit
                break
            if apart(A, math.exp(edge), columns, orders, lossy, W, s)[0] > best + REACH:
                break
            away *= 1.5
        ends[side] = edge
    n = _GAP_NODES
    step = (ends[1] - ends[0]) / (n - 1)
    total = 0.0
    weights, F, spread = np.empty(n), np.empty(n), np.empty(n)
    F_low, F_high = math.inf, 0.0
    for k in range(n):
        _, _, bb = apart(A, math.exp(ends[0] + step * k), columns, orders, lossy, W, s)
        free, by = 0.0, 0.0
        precision = bb + prior.adhesion_precision
        for r in range(rows):
            by += s.wb[r] * s.wy[r]
        middle = (by + prior.adhesion_precision * prior.adhesion_mean) / precision
        for r in range(rows):
            left = s.wy[r] - middle * s.wb[r]
            free += left * left
        free += prior.adhesion_precision * (middle - prior.adhesion_mean) ** 2
        F[k], spread[k] = middle, 1.0 / math.sqrt(precision)
        mass, more = gauss_mass(prior.adhesion_low, prior.adhesion_high, middle, spread[k])
        exponent = -0.5 * (free - best) + more + _LOG_ROOT_2PI - 0.5 * math.log(precision)
        weights[k] = (
            mass * math.exp(exponent + log_prior_F + log_prior_gap) * step * (0.5 if k in (0, n - 1) else 1.0)
        )
        total += weights[k]
        F_low, F_high = min(F_low, F[k] - 4.0 * spread[k]), max(F_high, F[k] + 4.0 * spread[k])
    if whole and total > 0.0:
        bins[:] = 0.0
        F_low, F_high = max(F_low, prior.adhesion_low), min(F_high, prior.adhesion_high)
        width = (F_high - F_low) / _BINS
        below, level = 0.0, LEVELS.shape[0] - 1
        for k in range(n):
            half = 0.5 * abs(F[min(k + 1, n - 1)] - F[max(k - 1, 0)]) * (0.5 if 0 < k < n - 1 else 1.0)
            if width > 0.0:
                add_gaussian(
                    bins,
                    F_low,
                    1.0 / width,
                    F[k],
                    half,
                    spread[k],
                    prior.adhesion_low,
                    prior.adhesion_high,
                    False,
                    weights[k],
                )
            # gaps rise, indentations fall: the levels come from the other end
            above = below + weights[k]
            while level >= 0 and above >= (1.0 - LEVELS[level]) * total and weights[k] > 0.0:
                share = ((1.0 - LEVELS[level]) * total - below) / weights[k]
                quantiles[INDENTATION_, level] = -math.exp(ends[0] + step * (k - 0.5 + share))
                level -= 1
            below = above
        if width > 0.0:
            fill_quantiles(sum_steps(bins), F_low, width, quantiles[ADHESION_])
    return total, best

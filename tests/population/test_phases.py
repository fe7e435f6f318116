"""Phases of made-up scans: what is there is found, and nothing else.

A scan is three hidden properties of each pixel, seen through a curved map as six features, with noise of variance 1.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label
from scipy.stats import norm

from overtone.errors import InversionError
from overtone.population.assign import assign, cloud_of
from overtone.population.coherence import coherence_of
from overtone.population.divide import averaged, by_edge, coherent_directions, halve, pixel_covariance
from overtone.population.mixture import clouds_along, density_along
from overtone.population.modes import divisions, modes_of, valleys
from overtone.population.phases import NONE, find_phases, labels_as_phases

STIFF, SOFT, THIRD = (0.0, 0.0, 0.0), (-3.0, 2.0, 1.0), (-1.4, 1.2, 0.6)  # ln of modulus, adhesion, loss


def curved(theta):
    """Six features of three properties: exponentials, so that a cloud of properties is bent and skewed."""
    E, F, tan = np.moveaxis(theta, -1, 0)
    return np.stack(
        [
            6.0 * E,
            40.0 * np.exp(0.25 * E) + 3.0 * F,
            9.0 * F - 2.0 * E,
            5.0 * np.exp(0.3 * F),
            60.0 * np.exp(0.5 * (tan + F)),
            -12.0 * np.exp(0.5 * tan) + E,
        ],
        axis=-1,
    )


def scan_of(theta, generator, *, spread=0.15, correlation=0.0):
    """Features of a map of properties, each of a pixel's own spread, and noise."""
    e = generator.standard_normal(theta.shape)
    if correlation:
        e = gaussian_filter(e, (correlation, correlation, 0), mode="wrap")
        e /= e.std()
    features = curved(theta + spread * e)
    return features + generator.standard_normal(features.shape)


def discs(size, share, diameter, generator):
    """Round domains that cover a share of a scan."""
    y, x = np.mgrid[:size, :size]
    mask = np.zeros((size, size), bool)
    while mask.mean() < share:
        centre = generator.uniform(0, size, 2)
        mask |= (y - centre[0]) ** 2 + (x - centre[1]) ** 2 < (0.5 * diameter) ** 2
    return mask


def blend(size, materials, masks, border=0.0):
    """Properties of materials, the first one the matrix, with borders that run smoothly."""
    theta = np.broadcast_to(np.array(materials[0]), (size, size, 3))
    truth = np.zeros((size, size), int)
    for k, (material, mask) in enumerate(zip(materials[1:], masks, strict=True), 1):
        part = gaussian_filter(mask.astype(float), border)[..., None] if border else mask[..., None]
        theta = theta * (1.0 - part) + np.array(material) * part
        truth[mask] = k
    return theta, truth


def step_scan(size, share, separation, diameter, generator):
    """Two phases that differ by so many standard deviations of a pixel in some direction, and which is where."""
    mask = discs(size, share, diameter, generator)
    direction = generator.standard_normal(6)
    direction /= np.linalg.norm(direction)
    features = generator.standard_normal((size, size, 6)) + separation * mask[..., None] * direction
    return features, mask.astype(int)


def wrong(phases, truth):
    """Share of the pixels with a phase that have another one than the majority of it, and of pixels without one."""
    known = phases.label >= 0
    majority = [np.bincount(truth[phases.label == k]).argmax() for k in range(phases.count)]
    assert sorted(majority) == list(range(truth.max() + 1))
    return (np.array(majority)[phases.label[known]] != truth[known]).mean(), 1.0 - known.mean()


# what is there


def test_two_materials_with_a_border_between_them() -> None:
    generator = np.random.default_rng(1)
    theta, truth = blend(96, (STIFF, SOFT), [discs(96, 0.35, 20, generator)], border=0.8)
    phases = find_phases(scan_of(theta, generator), np.eye(6))
    assert phases.count == 2
    share_wrong, none = wrong(phases, truth)
    assert share_wrong < 0.002
    assert none < 0.25
    assert not phases.merged.any()
    assert phases.pixels[0] > phases.pixels[1]
    assert "2 phases" in phases.note


def test_pixels_between_phases_belong_to_none() -> None:
    generator = np.random.default_rng(2)
    mask = np.zeros((96, 96), bool)
    mask[:, 48:] = True
    theta, _ = blend(96, (STIFF, SOFT), [mask], border=1.0)
    phases = find_phases(scan_of(theta, generator, spread=0.05), np.eye(6))
    assert phases.count == 2
    assert (phases.label[:, 47:49] == NONE).mean() > 0.95
    assert (phases.label[:, :42] == phases.label[0, 0]).mean() > 0.99
    assert (phases.label[:, 54:] == phases.label[0, 95]).mean() > 0.99


def test_third_phase_of_five_percent_between_two_others() -> None:
    generator = np.random.default_rng(3)
    soft = discs(128, 0.3, 26, generator)
    third = discs(128, 0.05, 14, generator)
    theta, truth = blend(128, (STIFF, SOFT, THIRD), [soft, third], border=0.6)
    phases = find_phases(scan_of(theta, generator, spread=0.1), np.eye(6))
    assert phases.count == 3
    assert wrong(phases, truth)[0] < 0.02


@pytest.mark.parametrize(("share", "separation"), [(0.02, 4.0), (0.05, 3.0), (0.35, 1.5)])
def test_phase_that_a_pixel_alone_hardly_tells(share: float, separation: float) -> None:
    generator = np.random.default_rng(4)
    features, truth = step_scan(128, share, separation, 13 if share < 0.1 else 24, generator)
    phases = find_phases(features, np.eye(6))
    assert phases.count == 2
    assert wrong(phases, truth)[0] < 0.02
    assert phases.domains[1] >= label(truth)[1] - 3


def test_units_and_correlated_noise_do_not_matter() -> None:
    generator = np.random.default_rng(5)
    features, _ = step_scan(64, 0.3, 4.0, 18, generator)
    mixing = np.diag([1e-9, 3e-12, 1.0, 1e3, 1e-6, 1e-10]) @ (
        np.eye(6) + 0.4 * generator.standard_normal((6, 6))
    )
    plain = find_phases(features, np.eye(6))
    scaled = find_phases(features @ mixing.T + 5.0 * np.diag(mixing), mixing @ mixing.T)
    assert (plain.label == scaled.label).mean() > 0.995
    expected = mixing @ plain.covariance[0] @ mixing.T
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        scaled.covariance[0] / np.outer(size, size), expected / np.outer(size, size), atol=0.02
    )
    assert scaled.mean[0] / size == pytest.approx(
        (mixing @ plain.mean[0] + 5.0 * np.diag(mixing)) / size, abs=0.02
    )


def test_correlated_spread_within_phases_makes_no_more_of_them() -> None:
    generator = np.random.default_rng(6)
    theta, truth = blend(128, (STIFF, SOFT), [discs(128, 0.35, 22, generator)], border=0.6)
    phases = find_phases(scan_of(theta, generator, correlation=4.0), np.eye(6))
    assert phases.count == 2
    assert wrong(phases, truth)[0] < 0.002


# what is not there


@pytest.mark.parametrize("material", [STIFF, SOFT])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("correlation", [0.0, 2.0, 6.0])
def test_homogeneous_material_is_one_phase(material, seed: int, correlation: float) -> None:
    generator = np.random.default_rng([seed, int(correlation)])
    theta = np.broadcast_to(np.array(material), (80, 80, 3))
    phases = find_phases(scan_of(theta, generator, spread=0.2, correlation=correlation), np.eye(6))
    assert phases.count == 1
    assert (phases.label == 0).mean() > 0.99
    assert phases.note.startswith("One phase")
    if not correlation:
        assert not phases.merged[0]
        assert phases.smooth_share[0] < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_one_phase(seed: int) -> None:
    features = np.random.default_rng(seed).standard_normal((96, 96, 6))
    phases = find_phases(features, np.eye(6))
    assert phases.count == 1
    assert not phases.merged[0]
    np.testing.assert_allclose(phases.covariance[0], np.eye(6), atol=0.1)
    assert phases.smooth_size[0] < 0.15


@pytest.mark.parametrize("factor", [5.0, 30.0])
def test_gradient_is_merged_not_resolved(factor: float) -> None:
    generator = np.random.default_rng(7)
    theta = np.zeros((96, 96, 3))
    theta[..., 0] = np.linspace(0.0, -np.log(factor), 96)
    phases = find_phases(scan_of(theta, generator, spread=0.1), np.eye(6))
    assert phases.count == 1
    assert phases.merged[0]
    assert phases.trend[0] > 0.9
    assert "merged, not resolved" in phases.note


def test_slight_gradient_is_one_phase() -> None:
    generator = np.random.default_rng(8)
    theta = np.zeros((96, 96, 3))
    theta[..., 2] = np.linspace(0.0, 0.15, 96)[:, None]
    phases = find_phases(scan_of(theta, generator), np.eye(6))
    assert phases.count == 1
    assert not phases.merged[0]
    assert 0.01 < phases.smooth_share[0] < 0.3


def test_waves_and_slow_steps_make_no_phases() -> None:
    generator = np.random.default_rng(9)
    x = np.arange(128)
    for wave in (3.0 * np.sin(2 * np.pi * x / 24.0), 4.0 * np.tanh((x - 64) / 8.0)):
        features = generator.standard_normal((128, 128, 6))
        features[..., 0] += wave
        assert find_phases(features, np.eye(6)).count == 1


def test_outliers_make_no_phase_and_belong_to_none() -> None:
    generator = np.random.default_rng(10)
    features = generator.standard_normal((96, 96, 6))
    odd = generator.random((96, 96)) < 0.01
    features[odd] += 40.0 * generator.standard_normal((odd.sum(), 6))
    features[40] += 15.0
    phases = find_phases(features, np.eye(6))
    assert phases.count == 1
    clean = find_phases(
        np.where(odd[..., None], features + 100.0, generator.standard_normal((96, 96, 6))), np.eye(6)
    )
    assert (clean.label[odd] == NONE).all()


def test_a_change_of_the_tip_is_no_phase() -> None:
    generator = np.random.default_rng(11)
    features = generator.standard_normal((96, 96, 6))
    features[50:] += 3.0
    phases = find_phases(features, np.eye(6))
    assert phases.count == 1
    assert phases.merged[0]
    assert "change of the tip" in phases.note
    turned = find_phases(features.transpose(1, 0, 2), np.eye(6))
    assert turned.count == 2
    assert "change of the tip" not in turned.note


def test_gradient_that_looks_like_one_cloud_is_merged_all_the_same() -> None:
    generator = np.random.default_rng(31)
    features = generator.standard_normal((128, 128, 3))
    side = np.linspace(-1.0, 1.0, 128)
    features[..., 0] += 1.2 * (
        side[:, None] + side
    )  # the sum of two even distributions is nearly a normal one
    phases = find_phases(features, np.eye(3))
    assert phases.count == 1
    assert phases.merged[0]
    assert "evenly" in phases.note


def test_outliers_beside_two_phases_belong_to_none() -> None:
    generator = np.random.default_rng(32)
    features, truth = step_scan(96, 0.3, 5.0, 24, generator)
    odd = generator.random((96, 96)) < 0.005
    features[odd] += 30.0
    phases = find_phases(features, np.eye(6))
    assert phases.count == 2
    assert (phases.label[odd] == NONE).all()
    assert wrong(phases, truth)[1] < 0.05


# pixels without features, small scans, given numbers and labels


def test_pixels_without_features_have_no_phase() -> None:
    generator = np.random.default_rng(12)
    features, truth = step_scan(96, 0.3, 5.0, 20, generator)
    lost = generator.random((96, 96)) < 0.05
    features[lost, 2] = np.nan
    features[30:32] = np.nan
    phases = find_phases(features, np.eye(6))
    assert phases.count == 2
    gone = ~np.isfinite(features).all(-1)
    assert (phases.label[gone] == NONE).all()
    assert (phases.probability[gone] == 0.0).all()
    assert wrong(phases, truth)[0] < 0.01


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (5, 5), (16, 16), (40, 1)])
def test_few_pixels_are_one_phase(shape) -> None:
    phases = find_phases(np.random.default_rng(13).standard_normal((*shape, 6)), np.eye(6))
    assert phases.count == 1
    assert phases.pixels[0] == shape[0] * shape[1]
    assert np.isfinite(phases.covariance).all()


def test_scans_without_variation_or_without_pixels() -> None:
    assert find_phases(np.zeros((40, 40, 3)), np.eye(3)).count == 1
    nothing = find_phases(np.full((8, 8, 3), np.nan), np.eye(3))
    assert nothing.count == 0
    assert nothing.mean.shape == (0, 3)
    assert (nothing.label == NONE).all()


def test_one_feature_is_enough() -> None:
    features, truth = step_scan(96, 0.3, 4.0, 18, np.random.default_rng(14))
    direction = np.linalg.svd(features.reshape(-1, 6) - features.mean((0, 1)), full_matrices=False)[2][0]
    phases = find_phases((features @ direction)[..., None], np.eye(1))
    assert phases.count == 2
    assert wrong(phases, truth)[0] < 0.01


def test_given_number_of_phases() -> None:
    generator = np.random.default_rng(15)
    features, truth = step_scan(96, 0.3, 4.0, 20, generator)
    one, two, three = (find_phases(features, np.eye(6), count=count) for count in (1, 2, 3))
    assert (one.count, two.count) == (1, 2)
    assert one.merged[0]
    assert "supports 2" in one.note
    assert "as the scan itself supports" in two.note
    # nothing makes a third of noise: it is said that it is missing
    assert three.count == 3 or "of which 2 could be made" in three.note
    assert "supports 2" in three.note
    np.testing.assert_array_equal(two.label, find_phases(features, np.eye(6)).label)
    assert wrong(two, truth)[0] < 0.01


def test_two_phases_without_a_valley_are_found_when_asked_for() -> None:
    generator = np.random.default_rng(16)
    truth = discs(96, 0.4, 30, generator).astype(int)
    features = (
        generator.standard_normal((96, 96, 6)) + 2.0 * gaussian_filter(truth.astype(float), 5.0)[..., None]
    )
    assert find_phases(features, np.eye(6)).count == 1
    asked = find_phases(features, np.eye(6), count=2)
    assert asked.count == 2
    assert wrong(asked, truth)[0] < 0.15


def test_same_seed_same_phases() -> None:
    features, _ = step_scan(96, 0.3, 2.0, 20, np.random.default_rng(17))
    one, two = (find_phases(features, np.eye(6), seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.label, two.label)


def test_labels_of_the_user_are_kept() -> None:
    generator = np.random.default_rng(18)
    features, truth = step_scan(48, 0.3, 4.0, 14, generator)
    labels = np.where(generator.random((48, 48)) < 0.1, -1, 1 - truth)
    features[0, 0] = np.nan
    phases = labels_as_phases(labels, features, np.eye(6))
    expected = labels.copy()
    expected[0, 0] = -1
    np.testing.assert_array_equal(phases.label, expected)
    assert phases.count == 2
    np.testing.assert_allclose(phases.mean[0], features[expected == 0].mean(0))
    np.testing.assert_allclose(phases.covariance[1], np.cov(features[expected == 1].T), atol=0.15)
    np.testing.assert_array_equal(phases.pixels, [(expected == 0).sum(), (expected == 1).sum()])


def test_domains_of_a_few_pixels_do_not_count() -> None:
    labels = np.zeros((40, 40), int)
    labels[5:15, 5:15] = labels[25:35, 25:35] = 1
    labels[20, 2:4] = 1
    phases = labels_as_phases(labels, np.random.default_rng(19).standard_normal((40, 40, 2)), np.eye(2))
    np.testing.assert_array_equal(phases.domains, [1, 2])


@pytest.mark.parametrize(
    ("features", "noise", "match"),
    [
        (np.zeros((4, 4)), np.eye(4), "do not fit"),
        (np.zeros((4, 4, 3)), np.eye(2), "do not fit"),
        (np.zeros((4, 4, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]), "no covariance"),
        (np.zeros((4, 4, 2)), np.diag([1.0, 0.0]), "no covariance"),
        (np.zeros((4, 4, 2)), np.diag([1.0, np.nan]), "no covariance"),
    ],
)
def test_refusals(features, noise, match: str) -> None:
    with pytest.raises(InversionError, match=match):
        find_phases(features, noise)


def test_refusals_of_numbers_and_labels() -> None:
    features = np.zeros((4, 4, 2))
    with pytest.raises(InversionError, match="number of phases"):
        find_phases(features, np.eye(2), count=0)
    for labels, match in (
        (np.zeros((3, 4)), "no labels"),
        (np.full((4, 4), 0.5), "no labels"),
        (np.full((4, 4), np.nan), "no labels"),
        (np.full((4, 4), -1), "no pixel"),
        (np.full((4, 4), 1), "phase 0 has no"),
    ):
        with pytest.raises(InversionError, match=match):
            labels_as_phases(labels, features, np.eye(2))


# the parts


def test_bent_cloud_is_one_mode_and_two_clouds_are_two() -> None:
    generator = np.random.default_rng(20)
    angle = generator.normal(0.0, 0.5, 1500)
    bent = np.stack([10.0 * np.cos(angle), 10.0 * np.sin(angle)], -1) + 0.5 * generator.standard_normal(
        (1500, 2)
    )
    assert len(modes_of(bent, 20).modes) == 1
    two = generator.standard_normal((1500, 2)) + np.where(generator.random(1500) < 0.1, 7.0, 0.0)[:, None]
    found = modes_of(two, 20)
    assert len(found.modes) == 2
    far = two.sum(1) > 7.0
    side = np.isin(found.label, list(divisions(found)[0]))
    assert (side == far).mean() > 0.99 or (side == far).mean() < 0.01


def test_lowest_pass_comes_first() -> None:
    generator = np.random.default_rng(21)
    place = np.repeat([0.0, 5.0, 30.0], 600)
    points = np.stack([place, np.zeros(1800)], -1) + generator.standard_normal((1800, 2))
    found = modes_of(points, 20)
    assert len(found.modes) == 3
    first = np.isin(found.label, list(divisions(found)[0]))
    assert (first == (place == 30.0)).mean() > 0.99 or (first == (place < 30.0)).mean() > 0.99


def test_depth_and_place_of_a_valley() -> None:
    generator = np.random.default_rng(22)
    t = np.concatenate([generator.normal(0.0, 1.0, 40000), generator.normal(4.5, 1.0, 40000)])
    ratio, place = valleys(t, 0.0, 4.5)[0]
    ground = 2.0 * norm.pdf(2.25) / (norm.pdf(0.0) + norm.pdf(4.5))
    # a window is wider than the ground of the valley, and narrower than a summit
    assert ground < ratio < 2.0 * ground
    assert place == pytest.approx(2.25, abs=0.3)
    assert valleys(generator.normal(0.0, 1.0, 40000), -1.0, 1.0)[0][0] > 0.9


def test_averages_do_not_reach_across_an_edge() -> None:
    generator = np.random.default_rng(23)
    truth = np.zeros((60, 60))
    truth[:, 30:] = 20.0
    y = (truth + generator.standard_normal((60, 60)))[..., None]
    u, window = averaged(y, np.ones((60, 60), bool), 3)
    assert np.abs(u[..., 0] - truth).max() < 2.0
    # a mean of 9 has 1/3, the choice of windows adds a little
    inside = (u[..., 0] - truth)[2:-2, [*range(2, 27), *range(33, 58)]]
    assert 0.32 < inside.std() < 0.42
    assert abs(inside.mean()) < 0.03
    assert np.abs(window // 60 - np.arange(60)[:, None]).max() == 1


def test_averages_keep_to_their_region() -> None:
    y = np.zeros((20, 20, 1))
    y[:, 10:] = 1e6
    mask = np.zeros((20, 20), bool)
    mask[:, :10] = True
    u, _ = averaged(y, mask, 5)
    assert np.isnan(u[:, 10:]).all()
    assert np.abs(u[:, :10]).max() < 1e-6


def test_covariance_about_neighbours_ignores_what_is_smooth_and_edges() -> None:
    generator = np.random.default_rng(24)
    mixing = np.array([[2.0, 0.0], [1.0, 1.5]])
    z = generator.standard_normal((120, 120, 2)) @ mixing.T
    z += 10.0 * np.sin(np.arange(120) / 40.0)[:, None, None]
    z[:, 60:] += 100.0
    assert np.trace(np.cov(z.reshape(-1, 2).T)) > 1000.0
    np.testing.assert_allclose(pixel_covariance(z, np.ones((120, 120), bool)), mixing @ mixing.T, rtol=0.08)
    # the noise is the least
    small = pixel_covariance(0.1 * z, np.ones((120, 120), bool))
    assert np.linalg.eigvalsh(small)[0] == pytest.approx(1.0)


def test_direction_in_which_neighbours_are_alike() -> None:
    generator = np.random.default_rng(25)
    smooth = gaussian_filter(generator.standard_normal((128, 128)), 6.0, mode="wrap")
    z = generator.standard_normal((128, 128, 4))
    z[..., 1] *= 5.0
    mask = np.ones((128, 128), bool)
    assert coherent_directions(z, mask)[0].shape == (4, 0)
    z += (smooth / smooth.std())[..., None] * np.array([0.6, 0.0, 0.8, 0.0])
    directions, strength = coherent_directions(z, mask)
    assert directions.shape == (4, 1)
    np.testing.assert_allclose(np.abs(directions[:, 0]), [0.6, 0.0, 0.8, 0.0], atol=0.1)
    assert strength[0] == pytest.approx(1.0, rel=0.2, abs=0)


def test_smooth_part_and_trend() -> None:
    generator = np.random.default_rng(26)
    z = generator.standard_normal((128, 128, 3))
    slope = np.linspace(-1.0, 1.0, 128) * np.sqrt(3.0) * 0.5
    z[..., 1] += slope
    part = coherence_of(z, np.ones((128, 128), bool))
    assert part.share == pytest.approx(0.25 / 1.25, rel=0.1, abs=0)
    assert part.size == pytest.approx(0.5, rel=0.1, abs=0)
    assert part.trend > 0.9


def test_mixture_along_a_line() -> None:
    generator = np.random.default_rng(27)
    t = np.concatenate([generator.normal(-3.0, 1.0, 3000), generator.normal(2.0, 0.5, 1000)])
    shares, means, variances = clouds_along(t, 2)
    order = np.argsort(means)
    assert shares[order] == pytest.approx([0.75, 0.25], abs=0.02)
    assert means[order] == pytest.approx([-3.0, 2.0], abs=0.1)
    assert np.sqrt(variances[order]) == pytest.approx([1.0, 0.5], abs=0.06)
    line = np.linspace(-20.0, 20.0, 4001)
    assert np.trapezoid(np.exp(density_along(line, shares, means, variances)), line) == pytest.approx(
        1.0, abs=1e-6
    )


def test_cloud_is_never_smaller_than_the_noise() -> None:
    generator = np.random.default_rng(28)
    points = generator.standard_normal((2000, 3)) * np.array([4.0, 0.1, 1.0])
    cloud = cloud_of(points)
    assert np.sqrt(np.diag(cloud.covariance)) == pytest.approx([4.0, 1.0, 1.0], rel=0.06, abs=0)
    assert np.linalg.eigvalsh(cloud.covariance)[0] >= 1.0 - 1e-9


def test_neighbours_decide_where_a_pixel_does_not() -> None:
    generator = np.random.default_rng(29)
    truth = np.zeros((80, 80), int)
    truth[:, 40:] = 1
    z = generator.standard_normal((80, 80, 1)) + 1.5 * truth[..., None]
    cores = [truth == 0, truth == 1]
    cores = [core & (np.abs(np.arange(80) - 39.5) > 5) for core in cores]
    found, probability = assign(z, np.ones((80, 80), bool), cores, [cloud_of(z[core]) for core in cores])
    alone = (z[..., 0] > 0.75).astype(int)
    assert (alone != truth).mean() > 0.2
    assert (found[found >= 0] != truth[found >= 0]).mean() < 0.01
    assert (found >= 0).mean() > 0.93
    assert probability[found >= 0].min() >= 0.9


def flat(truth, values, generator):
    """One feature: the value of each phase, and noise of variance 1."""
    return np.array(values)[truth][..., None] + generator.standard_normal((*truth.shape, 1))


def test_a_border_that_lies_within_a_wide_cloud_belongs_to_none() -> None:
    generator = np.random.default_rng(33)
    truth = np.zeros((80, 80), int)
    truth[:, 40:] = 1
    z = flat(truth, (0.0, 30.0), generator)
    z[:, 40:] += 6.0 * generator.standard_normal((80, 40, 1))
    z[:, 40:42] = 17.0  # half way, and two deviations of the wide cloud off its middle
    z[:, 60:62] = 17.0
    cores = [truth == 0, (truth == 1) & (np.arange(80) > 44)]
    label, _ = assign(z, np.ones((80, 80), bool), cores, [cloud_of(z[core]) for core in cores])
    assert (label[:, 40:42] == NONE).mean() > 0.99
    assert (label[:, 60:62] == 1).mean() > 0.99


def test_a_thin_band_between_two_phases_is_no_third() -> None:
    generator = np.random.default_rng(34)
    truth = np.zeros((80, 80), int)
    truth[:, 40:] = 1
    truth[:, 39:42] = 2
    truth[20:32, 10:22] = 2
    z = flat(truth, (0.0, 40.0, 15.0), generator)
    cores = [(truth == 0), (truth == 1), (truth == 2) & (np.arange(80) < 30)]
    label, _ = assign(z, np.ones((80, 80), bool), cores, [cloud_of(z[core]) for core in cores])
    assert (label[:, 39:42] == NONE).mean() > 0.99
    assert (label[21:31, 11:21] == 2).mean() > 0.95


def test_an_edge_that_only_the_averages_have_is_none() -> None:
    generator = np.random.default_rng(35)
    every = np.ones((128, 128), bool)
    y = generator.standard_normal((128, 128))
    u = averaged(y[..., None], every, 5)[0][..., 0]
    assert by_edge(y, every, u > 0.0, 0.0, 5, 30) is None
    real = y.copy()
    real[:, 70:] += 3.0
    u = averaged(real[..., None], every, 5)[0][..., 0]
    division = by_edge(real, every, u > 1.5, 0.0, 5, 30)
    assert division is not None
    assert division.side[:, 70:].mean() > 0.99
    assert division.other[:, :70].mean() > 0.99


def test_halves_of_a_gradient_lie_at_its_ends() -> None:
    generator = np.random.default_rng(30)
    z = generator.standard_normal((64, 64, 2))
    z[..., 1] += np.linspace(-6.0, 6.0, 64)
    made = halve(z, np.ones((64, 64), bool), 30)
    assert made is not None
    division, gain = made
    assert gain > 0.0
    # a gradient has no place to be cut at, but has ends
    ends = [division.side[:, :20].mean(), division.side[:, 44:].mean()]
    assert min(ends) < 0.01
    assert max(ends) > 0.99

"""The scatter of a scan against noise that was put in, and lever and detector against sampled noise in a lock-in."""

import math

import numpy as np
import pytest
import xarray as xr

from overtone.errors import ObservablesError, OvertoneError, ProbeError
from overtone.instrument.instrument import Instrument, noise_of
from overtone.instrument.low_pass import behind_the_lock_in, correlated, time_constant
from overtone.instrument.noise import add_noise, complete_noise, noise_from_pair
from overtone.instrument.noise_sources import FEWEST_PIXELS, noise_from_bandwidth, noise_from_scan
from overtone.instrument.thermal_noise import thermal_noise_density
from overtone.instrument.trace import lock_in
from overtone.probe import SLOPE, Cantilever, Detector, Drive, Mode, Probe

NOISE = {"A0": 4e-12, "A1": 30e-12, "phi1": 3e-3, "A2": 2e-12, "A3": 1e-12}
LEVER = Probe.simple(
    stiffness=16.4,
    frequency=162e3,
    quality_factor=287,
    radius=10e-9,
    drive_frequency=162e3,
    free_amplitude=94e-9,
)


def smooth(shape: tuple[int, int] = (128, 128)) -> xr.Dataset:
    """Return a scan whose signals vary by far more than any noise: slopes, and waves 64 pixels long."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    wave = np.sin(2 * np.pi * x / 64) * np.cos(2 * np.pi * y / 40)
    values = {
        "A0": 1e-10 + 1e-12 * x - 3e-12 * y + 2e-11 * wave,
        "A1": 4e-8 + 1e-10 * wave,
        "phi1": 0.5 + 5e-3 * x + 0.01 * wave,
        "A2": 1e-10 + 1e-11 * wave,
        "phi2": 4.0 + 0.01 * x,
        "A3": 5e-11 + 1e-13 * x + 0 * y,
        "phi3": 1.0 + 0.05 * wave,
    }
    return xr.Dataset({name: (("y", "x"), array) for name, array in values.items()})


def flat(shape: tuple[int, ...], dims: tuple[str, ...] = ("y", "x")) -> xr.Dataset:
    values = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.5, "A2": 1e-10, "phi2": 4.0}
    return xr.Dataset({name: (dims, np.full(shape, value)) for name, value in values.items()})


# --- the scan's own scatter -----------------------------------------------------------------------


def test_white_noise_on_a_varied_scan_is_found() -> None:
    found = noise_from_scan(add_noise(smooth(), NOISE, seed=1))
    assert list(found) == ["A1", "phi1", "A0", "A2", "A3"]
    for name in ("A0", "A1", "phi1"):
        assert found[name] == pytest.approx(NOISE[name], rel=0.03, abs=0), name
    # in the frame of the first, the noise of phi1 moves a phasor across its direction by n A_n sigma(phi1)
    for n, amplitude in ((2, 1e-10), (3, 5.6e-11)):
        across = n * amplitude * NOISE["phi1"]
        expected = math.sqrt(NOISE[f"A{n}"] ** 2 + across**2 / 2)
        assert found[f"A{n}"] == pytest.approx(expected, rel=0.03, abs=0), n
    assert complete_noise(found, (0, 1, 2, 3)) == pytest.approx(found, rel=1e-12, abs=0)


def test_it_is_right_on_average_and_scatters_as_stated() -> None:
    """Of A0 alone: 300 scans of 40 x 52 pixels, 2000 of which have both neighbours."""
    scan = flat((40, 52))
    generator = np.random.default_rng(2)
    others = ("A1", "phi1", "A2")
    found = []
    for _ in range(300):
        noisy = scan.assign(A0=scan["A0"] + generator.normal(0.0, 4e-12, scan["A0"].shape))
        found.append(noise_from_scan(noisy, skip=others)["A0"])
    spread = float(np.std(found)) / 4e-12
    assert np.mean(found) == pytest.approx(4e-12, rel=4 * spread / math.sqrt(300), abs=0)
    assert spread == pytest.approx(1.4 / math.sqrt(2000), rel=0.15, abs=0)


def test_it_agrees_with_trace_and_retrace() -> None:
    trace, retrace = (add_noise(smooth(), NOISE, seed=seed) for seed in (1, 2))
    pair = noise_from_pair(trace, retrace)
    for name, sigma in noise_from_scan(trace).items():
        assert sigma == pytest.approx(pair[name], rel=0.04, abs=0), name


def test_lines_may_differ_by_anything_and_x_is_the_fast_axis() -> None:
    noisy = add_noise(smooth(), NOISE, seed=3)
    here = noise_from_scan(noisy)
    jumps = xr.DataArray(np.random.default_rng(4).uniform(-1.0, 1.0, 128), dims="y")
    moved = noisy.assign(
        A0=noisy["A0"] + 1e-9 * jumps, phi1=noisy["phi1"] + jumps, phi2=noisy["phi2"] + 2 * jumps
    )
    moved = moved.assign(phi3=noisy["phi3"] + 3 * jumps)
    assert noise_from_scan(moved) == pytest.approx(here, rel=1e-6, abs=0)
    assert noise_from_scan(noisy.transpose("x", "y")) == pytest.approx(here, rel=1e-12, abs=0)
    assert noise_from_scan(noisy.isel(x=slice(None, None, -1))) == pytest.approx(here, rel=1e-9, abs=0)
    # the other way round the same jumps are all there is
    turned = moved.rename(x="y", y="x")
    assert noise_from_scan(turned)["A0"] > 50 * here["A0"]


def test_a_phase_that_passes_a_full_turn_is_no_jump() -> None:
    scan = add_noise(smooth(), NOISE, seed=5)
    wrapped = scan.assign(phi1=np.mod(scan["phi1"] + 5.6, 2 * np.pi))
    assert float(wrapped["phi1"].max() - wrapped["phi1"].min()) > 6.0
    found = noise_from_scan(wrapped)["phi1"]
    assert found == pytest.approx(noise_from_scan(scan)["phi1"], rel=1e-6, abs=0)


@pytest.mark.parametrize(("width", "more"), [(100, 1.024), (50, 1.049), (20, 1.134)])
def test_boundaries_add_what_is_stated(width: int, more: float) -> None:
    """A share e = 2/width of the differences is lost to them: the median is the (1/2)/(1 - e) quantile of the rest."""
    scan = flat((200, 1000))
    scan["A0"] = scan["A0"] + 1e-9 * ((scan["x"] // width) % 2)
    scan["A0"] = scan["A0"] + np.random.default_rng(width).normal(0.0, 4e-12, scan["A0"].shape)
    found = noise_from_scan(scan, skip=("A1", "phi1", "A2"))["A0"]
    assert found / 4e-12 == pytest.approx(more, rel=0.01, abs=0)


@pytest.mark.parametrize(("memory", "share"), [(0.135, 0.909), (0.5, 0.645), (0.9, 0.265)])
def test_a_slow_filter_makes_it_a_lower_bound(memory: float, share: float) -> None:
    assert math.sqrt((1 - memory) * (3 - memory) / 3) == pytest.approx(share, rel=2e-3, abs=0)
    scan = flat((200, 1000))
    scan["A0"] = scan["A0"] + 4e-12 * correlated((200, 1000), memory, np.random.default_rng(6))
    found = noise_from_scan(scan, skip=("A1", "phi1", "A2"))["A0"]
    assert found / 4e-12 == pytest.approx(share, rel=0.015, abs=0)


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0])
def test_steps_as_coarse_as_the_noise_cost_a_fifth_at_most(step: float) -> None:
    scan = flat((200, 1000))
    noisy = scan["A0"] + np.random.default_rng(7).normal(0.0, 4e-12, scan["A0"].shape)
    scan["A0"] = np.round(noisy / (step * 4e-12)) * step * 4e-12
    found = noise_from_scan(scan, skip=("A1", "phi1", "A2"))["A0"]
    assert 0.9 < found / 4e-12 < 1.22


def test_lost_pixels_do_not_count() -> None:
    scan = add_noise(smooth(), NOISE, seed=8)
    here = noise_from_scan(scan)
    lost = scan.copy(deep=True)
    lost["A0"][:, ::9] = np.nan
    lost["A1"][:, 4::11] = 0.0  # a lock-in that lost its signal
    lost["phi1"][3, 4] = np.inf
    found = noise_from_scan(lost)
    for name, sigma in here.items():
        # 0/0 of a lost phasor takes phi1 and higher harmonics out; its A1 = 0 counts as a boundary, 3 of 11 differences
        if name != "A1":
            assert found[name] == pytest.approx(sigma, rel=0.05, abs=0), name


def test_too_few_pixels_are_refused_and_as_many_as_needed_are_not() -> None:
    enough = add_noise(flat((1, FEWEST_PIXELS + 2)), NOISE, seed=9)
    assert noise_from_scan(enough)["A0"] == pytest.approx(4e-12, rel=0.5, abs=0)
    with pytest.raises(OvertoneError, match=r"too few pixels.*A1.*100 or more.*99"):
        noise_from_scan(enough.isel(x=slice(-1)))
    # columns of two and of one have no pixel with both neighbours
    for width in (1, 2):
        with pytest.raises(OvertoneError, match=r"too few pixels.*got 0"):
            noise_from_scan(add_noise(flat((300, width)), seed=10))
    bad = enough.copy(deep=True)
    bad["A0"][0, 50] = np.nan
    with pytest.raises(OvertoneError, match=r"scatter of A0.*97"):
        noise_from_scan(bad)


def test_what_has_no_fast_axis_is_refused() -> None:
    with pytest.raises(ObservablesError, match=r"dimension x.*got dimensions point"):
        noise_from_scan(add_noise(flat((500,), ("point",)), seed=11))
    with pytest.raises(ObservablesError, match="lack phi1"):
        noise_from_scan(smooth().drop_vars("phi1"))


def test_a_channel_that_does_not_change_tells_nothing() -> None:
    scan = add_noise(smooth(), NOISE, seed=12)
    held = scan.assign(A1=scan["A1"] * 0.0 + 4e-8)
    with pytest.raises(OvertoneError, match=r"scatter of A1 cannot be told"):
        noise_from_scan(held)
    # what is known otherwise need not be told
    found = noise_from_scan(held, skip=("A1",))
    assert list(found) == ["phi1", "A0", "A2", "A3"]
    coarse = scan.assign(A0=(scan["A0"] * 0.0 + 1e-10).where(scan["x"] % 7 > 0, 2e-10))
    with pytest.raises(OvertoneError, match=r"scatter of A0 cannot be told"):
        noise_from_scan(coarse)


def test_only_what_was_measured_is_told() -> None:
    scan = add_noise(smooth(), NOISE, seed=13)
    assert list(noise_from_scan(scan.drop_vars(["A0", "phi2"]))) == ["A1", "phi1", "A3"]


# --- lever, detector, lock-in ---------------------------------------------------------------------


def test_it_is_what_the_virtual_microscope_adds() -> None:
    instrument = Instrument(bandwidth=700.0, detector_noise=45e-15, temperature=310.0)
    found = noise_from_bandwidth(
        LEVER, bandwidth=700.0, detector_noise=45e-15, temperature=310.0, amplitude=40e-9, orders=(3, 2, 1, 0)
    )
    assert list(found) == ["A0", "A1", "phi1", "A2", "A3"]
    for name, sigma in noise_of(instrument, LEVER).items():
        assert found[name] == pytest.approx(sigma, rel=1e-12, abs=0), name
    assert found["phi1"] == pytest.approx(found["A1"] / 40e-9, rel=1e-12, abs=0)


def test_scatter_behind_the_virtual_lock_in_is_the_lower_bound_of_it() -> None:
    """Pixels of 0.7 ms behind a first-order low-pass of 500 Hz."""
    instrument = Instrument(bandwidth=500.0, detector_noise=50e-15)
    memory = math.exp(-0.7e-3 / time_constant(instrument))
    generator = np.random.default_rng(14)
    read = behind_the_lock_in(flat((100, 400)), instrument, LEVER, memory, False, generator)
    stated = noise_from_bandwidth(
        LEVER, bandwidth=500.0, detector_noise=50e-15, amplitude=40e-9, orders=(0, 1, 2)
    )
    share = math.sqrt((1 - memory) * (3 - memory) / 3)
    assert 0.8 < share < 0.9
    for name, sigma in noise_from_scan(read).items():
        assert sigma == pytest.approx(share * stated[name], rel=0.03, abs=0), name


def test_thermal_motion_and_detector_sampled_through_a_lock_in() -> None:
    """A strongly damped lever of two modes under an optical lever, so that its spectrum is flat over the band."""
    modes = (Mode(2.0, 160e3, 2.0), Mode(80.0, 420e3, 3.0, slope_ratio=3.0))
    probe = Probe(Cantilever(modes), Drive(162e3, 40e-9), detector=Detector(SLOPE))
    rate, count, detector = 2e6, 2**21, 1e-13
    generator = np.random.default_rng(15)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    power = thermal_noise_density(probe, frequency, 300.0) ** 2
    # sampled with a one-sided density S: |FFT|^2 is S rate count / 2 on average
    spectrum = generator.normal(size=(2, frequency.size)) * np.sqrt(power * rate * count / 4)
    thermal = np.fft.irfft(spectrum[0] + 1j * spectrum[1], count)
    white = generator.normal(0.0, detector * math.sqrt(rate / 2), count)
    trace = xr.DataArray(thermal + white, dims="time", coords={"time": np.arange(count) / rate})
    phasors, bandwidth = lock_in(trace, 162e3, (0, 1, 2, 3), duration=300e-6)
    found = noise_from_bandwidth(
        probe,
        bandwidth=bandwidth,
        detector_noise=detector,
        amplitude=40e-9,
        orders=(0, 1, 2, 3),
        temperature=300.0,
    )
    assert phasors.sizes["window"] > 3000
    # what the lever adds is no small part of it
    assert found["A1"] > 1.1 * detector * math.sqrt(2 * bandwidth)
    for n in range(4):
        values = phasors.sel(harmonic=n).values
        measured = (
            values.real.std() if n == 0 else math.hypot(values.real.std(), values.imag.std()) / math.sqrt(2)
        )
        assert found[f"A{n}"] == pytest.approx(measured, rel=0.03, abs=0), n


@pytest.mark.parametrize(("bandwidth", "more"), [(1.0, 1.001), (100.0, 1.107), (500.0, 1.459)])
def test_at_resonance_it_is_an_upper_bound_by_as_much_as_stated(bandwidth: float, more: float) -> None:
    """The spectrum through a first-order low-pass, ``|H|^2 = 1/(1 + (2 pi nu/(4 B))^2)`` about the resonance."""
    nu = np.concatenate([np.linspace(0.0, 2e3, 400_001), np.linspace(2e3, 1.5e5, 300_001)[1:]])
    passed = 1.0 / (1.0 + (2 * np.pi * nu / (4 * bandwidth)) ** 2)
    sides = (
        thermal_noise_density(LEVER, 162e3 + nu, 295.0) ** 2
        + thermal_noise_density(LEVER, 162e3 - nu, 295.0) ** 2
    )
    true = math.sqrt(np.trapezoid(sides * passed, nu))
    found = noise_from_bandwidth(
        LEVER, bandwidth=bandwidth, detector_noise=0.0, amplitude=40e-9, orders=(1,), temperature=295.0
    )
    assert found["A1"] / true == pytest.approx(more, rel=2e-3, abs=0)
    ratio = math.sqrt(1 + 2 * 287 * 4 * bandwidth / (2 * np.pi * 162e3))
    assert ratio == pytest.approx(more, rel=1e-3, abs=0)


def test_it_grows_as_the_root_of_the_bandwidth_and_needs_no_first_harmonic() -> None:
    one, four = (
        noise_from_bandwidth(LEVER, bandwidth=b, detector_noise=50e-15, amplitude=1e-8, orders=(0, 2, 2, 5))
        for b in (100.0, 400.0)
    )
    assert list(one) == ["A0", "A2", "A5"]
    for name, sigma in one.items():
        assert four[name] == pytest.approx(2 * sigma, rel=1e-12, abs=0)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"bandwidth": 0.0}, "bandwidth = 0.0"),
        ({"bandwidth": math.inf}, "bandwidth = inf"),
        ({"detector_noise": -1e-15}, "detector_noise = -1e-15"),
        ({"detector_noise": math.nan}, "detector_noise = nan"),
        ({"amplitude": 0.0}, "amplitude = 0.0"),
        ({"amplitude": math.nan}, "amplitude = nan"),
        ({"orders": ()}, r"orders = \(\)"),
        ({"orders": (-1, 1)}, r"orders = \(-1, 1\)"),
    ],
)
def test_numbers_that_make_no_sense_are_named(wrong: dict[str, object], said: str) -> None:
    arguments: dict[str, object] = {
        "bandwidth": 5e2,
        "detector_noise": 5e-14,
        "amplitude": 4e-8,
        "orders": (0, 1),
    }
    with pytest.raises(OvertoneError, match=said):
        noise_from_bandwidth(LEVER, **(arguments | wrong))  # type: ignore[arg-type]


def test_an_impossible_temperature_is_refused() -> None:
    with pytest.raises(ProbeError, match="temperature"):
        noise_from_bandwidth(
            LEVER, bandwidth=5e2, detector_noise=5e-14, amplitude=4e-8, orders=(1,), temperature=-1.0
        )

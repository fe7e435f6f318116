"""What --noise takes, what it refuses, and the sentence that says where a noise comes from."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from overtone.batch.noise import NoiseRequest, noise_request, resolve_noise
from overtone.errors import OvertoneError, UnitError
from overtone.instrument.noise import add_noise, noise_from_pair
from overtone.instrument.noise_sources import noise_from_bandwidth, noise_from_scan
from overtone.probe import Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=162e3,
    quality_factor=287,
    radius=10e-9,
    drive_frequency=162e3,
    free_amplitude=94e-9,
)
NOISE = {"A0": 4e-12, "A1": 30e-12, "phi1": 3e-3, "A2": 2e-12}


def scan(seed: int) -> xr.Dataset:
    values = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.5, "A2": 1e-10, "phi2": 4.0}
    clean = xr.Dataset({name: (("y", "x"), np.full((40, 60), value)) for name, value in values.items()})
    return add_noise(clean, NOISE, seed=seed)


def both() -> tuple[xr.Dataset, xr.Dataset]:
    return scan(1), scan(2)


def no_pair() -> tuple[xr.Dataset, xr.Dataset]:
    raise OvertoneError("the retrace was not recorded")


# --- reading the options --------------------------------------------------------------------------


def test_options_are_read_in_si_units() -> None:
    assert noise_request([]) == NoiseRequest()
    assert noise_request(["A0=5 pm", "phi1=0.1 deg"]).stated == pytest.approx(
        {"A0": 5e-12, "phi1": np.deg2rad(0.1)}, rel=1e-12, abs=0
    )
    assert noise_request(["scatter"]) == NoiseRequest(source="scatter")
    assert noise_request([" pair ", "A2 = 1 pm"]) == NoiseRequest({"A2": 1e-12}, "pair")
    full = NoiseRequest({}, "bandwidth", {"bandwidth": 500.0, "detector": 5e-14, "temperature": 300.0})
    assert noise_request(["bandwidth=500 Hz, detector=50 fm/rtHz, temperature=300 K"]) == full
    # in parts, in any order, beside a value
    parts = noise_request(["detector=0.05 pm/√Hz", "A0=5 pm, bandwidth=0.5 kHz"])
    assert parts.source == "bandwidth"
    assert parts.lock_in == pytest.approx({"bandwidth": 500.0, "detector": 5e-14}, rel=1e-12, abs=0)
    assert parts.stated == {"A0": 5e-12}


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["scater"], "is not understood.*scatter, pair.*got 'scater'"),
        ([""], "is not understood.*got ''"),
        (["A0="], "is not understood"),
        (["A0=2,5 pm"], "A0 has no unit|is not understood.*got '5 pm'"),
        (["detektor=5 fm/rtHz"], "detektor is not an observable.*scatter, pair"),
        (["modulus=5 Pa"], "modulus is not an observable"),
        (["height=5 nm"], "not stated in a usable way"),
        (["A0=-5 pm"], "not stated in a usable way"),
        (["A0=5 pm", "A0=6 pm"], "A0 twice.*5 pm and 6 pm"),
        (["scatter", "pair"], "several sources.*scatter, pair"),
        (["scatter", "scatter"], "several sources"),
        (["pair", "bandwidth=500 Hz, detector=50 fm/rtHz"], "several sources.*pair, bandwidth"),
        (["bandwidth=500 Hz"], "needs the detector.*neither of which has a default"),
        (["detector=50 fm/rtHz"], "needs the bandwidth"),
        (["temperature=300 K"], "needs the bandwidth.*got temperature"),
    ],
)
def test_options_that_are_wrong_are_named(texts: list[str], said: str) -> None:
    with pytest.raises(OvertoneError, match=said):
        noise_request(texts)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("A0=5", "A0 has no unit"),
        ("A0=5 deg", "does not fit"),
        ("bandwidth=500, detector=50 fm/rtHz", "bandwidth has no unit"),
        ("bandwidth=500 Hz, detector=50 fm", "detector is no amplitude density"),
        ("bandwidth=500 Hz, detector=50 nV/rtHz", "does not fit"),
        ("bandwidth=500 Hz, detector=50 fm/rtHz, temperature=27 Hz", "does not fit"),
    ],
)
def test_units_are_asked_for(text: str, said: str) -> None:
    with pytest.raises(UnitError, match=said):
        noise_request([text])


def test_values_alone_are_read_as_before() -> None:
    assert noise_request(["A0=5 pm", "A2=1 pm"]).stated == {"A0": 5e-12, "A2": 1e-12}
    with pytest.raises(OvertoneError, match=r"height_noise is not an observable.*scatter"):
        noise_request(["height_noise=1 nm"])


# --- where the noise comes from -------------------------------------------------------------------


def test_the_scatter_of_the_scan() -> None:
    here = scan(1)
    found, sentence = resolve_noise(noise_request(["scatter"]), here, PROBE, pair=both)
    assert found == noise_from_scan(here)
    assert sentence.startswith("Noise, from the scatter of neighbouring pixels: A1 ")
    assert sentence.endswith("it is a lower bound where the lock-in is slower than a pixel.")
    for name in NOISE:
        assert f" {name} " in sentence


def test_a_stated_value_replaces_what_a_source_says() -> None:
    here = scan(1)
    found, sentence = resolve_noise(noise_request(["scatter", "A0=7 pm"]), here, PROBE)
    assert found == noise_from_scan(here) | {"A0": 7e-12}
    assert "; as stated: A0 7 pm." in sentence
    assert sentence.count("A0 ") == 1
    # and saves a source that cannot tell it
    held = here.assign(A1=here["A1"] * 0.0 + 4e-8)
    with pytest.raises(OvertoneError, match="scatter of A1 cannot be told"):
        resolve_noise(noise_request(["scatter"]), held, PROBE)
    found, _ = resolve_noise(noise_request(["scatter", "A1=20 pm"]), held, PROBE)
    assert found["A1"] == 20e-12


@pytest.mark.parametrize("texts", [["pair"], []])
def test_trace_and_retrace(texts: list[str]) -> None:
    """Asked for, or found where nothing is said."""
    found, sentence = resolve_noise(noise_request(texts), scan(1), PROBE, pair=both)
    assert found == noise_from_pair(*both())
    assert sentence.startswith("Noise, from trace and retrace: A1 ")


@pytest.mark.parametrize("pair", [None, no_pair])
def test_a_pair_that_is_asked_for_must_be_there(
    pair: Callable[[], tuple[xr.Dataset, xr.Dataset]] | None,
) -> None:
    with pytest.raises(OvertoneError, match=r"there is no pair|the retrace was not recorded"):
        resolve_noise(noise_request(["pair"]), scan(1), PROBE, pair=pair)
    found, sentence = resolve_noise(noise_request([]), scan(1), PROBE, pair=pair)
    assert found == {}
    assert sentence == (
        "Noise was not stated, an ordinary one is assumed: A0 5 pm, A1 20 pm, phi1 0.1 deg, A2 1 pm."
    )


def test_values_alone_leave_the_rest_ordinary_and_say_so() -> None:
    found, sentence = resolve_noise(noise_request(["A0=7 pm"]), scan(1), PROBE, pair=both)
    assert found == {"A0": 7e-12}
    assert sentence == (
        "Noise, as stated: A0 7 pm; an ordinary one is assumed of the rest: A1 20 pm, phi1 0.1 deg, A2 1 pm."
    )
    everything = ["A0=7 pm, A1=20 pm, phi1=0.1 deg, A2=1 pm"]
    assert resolve_noise(noise_request(everything), scan(1), PROBE)[1].endswith("A2 1 pm.")


def test_lever_detector_and_lock_in() -> None:
    here = scan(1)
    request = noise_request(["bandwidth=500 Hz, detector=50 fm/rtHz, temperature=310 K", "A2=3 pm"])
    found, sentence = resolve_noise(request, here, PROBE, pair=both)
    expected = noise_from_bandwidth(
        PROBE,
        bandwidth=500.0,
        detector_noise=5e-14,
        amplitude=float(here["A1"].median()),
        orders=(0, 1, 2),
        temperature=310.0,
    )
    assert found == pytest.approx(expected | {"A2": 3e-12}, rel=1e-12, abs=0)
    assert "from a bandwidth of 500 Hz, a detector of 50 fm/√Hz and a lever at 310 K: A0 1.12 pm" in sentence
    assert "; as stated: A2 3 pm. That of phi1 is the one at 40 nm;" in sentence
    # a room is assumed, and said
    assert (
        "a lever at 295 K"
        in resolve_noise(noise_request(["bandwidth=1 Hz, detector=0 m/rtHz"]), here, PROBE)[1]
    )


def test_gains_that_a_correction_took_out_are_taken_out_of_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of readings as stored; the scatter of a corrected scan has them out already, and so has what is stated."""

    class Corrected:
        values = {"gain0": 2.0, "gain2": 0.5, "gain3": 1.0}  # noqa: RUF012

    texts = (["pair"], ["scatter"], ["bandwidth=500 Hz, detector=50 fm/rtHz"], ["A0=7 pm, A2=1 pm"])
    before = [resolve_noise(noise_request(text), scan(1), PROBE, pair=both)[0] for text in texts]
    monkeypatch.setattr("overtone.instrument.correct.calibration_of", lambda _: Corrected)
    after = [resolve_noise(noise_request(text), scan(1), PROBE, pair=both)[0] for text in texts]
    for i in (0, 2):
        scaled = before[i] | {"A0": before[i]["A0"] / 2.0, "A2": before[i]["A2"] / 0.5}
        assert after[i] == pytest.approx(scaled, rel=1e-12, abs=0)
    assert (after[1], after[3]) == (before[1], before[3])

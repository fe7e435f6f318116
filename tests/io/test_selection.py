"""What a file keeps apart from a channel, lengths in volts, and videos."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.cli.options import ScanOptions, open_with, reading_arguments
from overtone.errors import ChannelError, ChannelWarning, OvertoneWarning, UncalibratedWarning, UnitError
from overtone.io import registry
from overtone.io.observables import open_scan
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.selection import Request, in_si, one_frame
from overtone.probe import Probe
from overtone.provenance import findings, history

Made = Callable[..., bytes]
VOLTS = np.array([[0.4, 0.5], [0.6, 0.7]])


def probe(free_amplitude: float = 60e-9) -> Probe:
    return Probe.simple(
        stiffness=26.0,
        frequency=300e3,
        quality_factor=400.0,
        drive_frequency=300e3,
        free_amplitude=free_amplitude,
    )


def converted(
    channel: Channel, *, name: str = "A1", facts: dict[str, Fact] | None = None, **request: object
) -> np.ndarray:
    return in_si({name: channel}, Request(**request), facts)[name]  # type: ignore[arg-type]


def said(call: Callable[[], object]) -> list[tuple[type[Warning], str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [(w.category, str(w.message)) for w in caught]


# --- what is added ----------------------------------------------------------------------------------


def test_a_difference_becomes_whole() -> None:
    facts = {
        "offset:AmplitudeError": Fact(0.55, "V", "@2:TMSetAmplitude"),
        "scale:AmplitudeError": Fact(5e-8, "m/V", "S"),
    }
    channel = Channel("AmplitudeError", VOLTS - 0.55, "V")
    assert said(lambda: converted(channel, facts=facts)) == [
        (
            ChannelWarning,
            "AmplitudeError stores only A - set-point; the set-point, 550 mV (@2:TMSetAmplitude), was added",
        ),
        (ChannelWarning, "AmplitudeError is in volts in the file; S, 50 nm/V, turned it into metres"),
    ]
    with pytest.warns(ChannelWarning):
        np.testing.assert_allclose(converted(channel, facts=facts), VOLTS * 5e-8, rtol=1e-14)
    # A scale of the user goes before that of the file, and what is added comes before either.
    with pytest.warns(ChannelWarning, match="was added"):
        mine = converted(channel, facts=facts, scales={"AmplitudeError": 1e-8})
    np.testing.assert_allclose(mine, VOLTS * 1e-8, rtol=1e-14)


def test_nothing_is_added_to_another_channel_or_in_another_unit() -> None:
    facts = {"offset:Other": Fact(1.0, "m", "key"), "offset:Amplitude": Fact(0.55, "V", "key")}
    channel = Channel("Amplitude", VOLTS, "m")
    np.testing.assert_array_equal(converted(channel, facts=facts), VOLTS)


# --- lengths in volts -------------------------------------------------------------------------------


def test_a_sensitivity_of_the_file_turns_volts_into_metres() -> None:
    facts = {"scale:Amplitude": Fact(139.3e-9, "m/V", "Tip Sensitivity")}
    with pytest.warns(
        ChannelWarning, match=r"Amplitude is in volts in the file; Tip Sensitivity, 139\.3 nm/V"
    ):
        np.testing.assert_allclose(converted(Channel("Amplitude", VOLTS, "V"), facts=facts), VOLTS * 139.3e-9)


def test_a_sensitivity_that_is_a_placeholder_is_named() -> None:
    facts = {"scale:Amplitude": Fact(1e-7, "m/V", "AmpInvOLS", factory_default=True)}
    kinds = dict(said(lambda: converted(Channel("Amplitude", VOLTS, "V"), facts=facts)))
    assert "AmpInvOLS is a factory default" in kinds[UncalibratedWarning]
    assert set(kinds) == {ChannelWarning, UncalibratedWarning}


def test_a_scale_of_the_user_turns_volts_into_metres_without_a_warning() -> None:
    facts = {"scale:Amplitude": Fact(1e-7, "m/V", "AmpInvOLS", factory_default=True)}
    for known in (facts, None):
        mine = converted(Channel("Amplitude", VOLTS, "V"), facts=known, scales={"Amplitude": 62e-9})
        np.testing.assert_allclose(mine, VOLTS * 62e-9, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "unit"), [("A1", "m"), ("A1", "Hz"), ("phi1", "V"), ("phi1", "rad"), ("height", "m")]
)
def test_a_scale_is_refused_where_the_channel_has_its_unit(name: str, unit: str) -> None:
    with pytest.raises(ChannelError, match=f"X has the unit {unit} in the file"):
        converted(Channel("X", VOLTS, unit), name=name, scales={"X": 1e-9})


def test_volts_without_a_sensitivity_are_no_length() -> None:
    with pytest.raises(ChannelError, match=r'A1 \(X\) has the unit V instead of m.*--scale X="60 nm/V"'):
        converted(Channel("X", VOLTS, "V"))
    # A sensitivity is for volts: an angle or a channel that is a length already takes none.
    facts = {"scale:X": Fact(1e-7, "m/V", "InvOLS")}
    np.testing.assert_array_equal(converted(Channel("X", VOLTS, "m"), facts=facts), VOLTS)
    with pytest.raises(ChannelError, match=r"phi1 \(X\) has the unit V instead of rad"):
        converted(Channel("X", VOLTS, "V"), name="phi1", facts=facts)


@pytest.mark.parametrize(("text", "value"), [("62 nm/V", 62e-9), ("62 nm", 62e-9), ("0.062 um/V", 62e-9)])
def test_scales_on_the_command_line(text: str, value: float) -> None:
    scales = reading_arguments(ScanOptions(scale=(f"Amplitude={text}",)))["scales"]
    assert scales == {"Amplitude": pytest.approx(value, rel=1e-12)}


def test_a_scale_per_second_is_none() -> None:
    with pytest.raises(UnitError):
        reading_arguments(ScanOptions(scale=("Amplitude=62 nm/s",)))


def test_a_made_file_from_volts_to_metres(nanoscope_file: Made, tmp_path: Path) -> None:
    """Its own sensitivity first, then what the user says instead."""
    counts = np.array([[8192, 8200], [8300, 8250]], dtype=np.int16)
    path = tmp_path / "made.spm"
    path.write_bytes(nanoscope_file(("AmplitudeActual", counts), ("Phase", counts)))
    volts = counts[::-1] * 4.0 / 65536.0
    with pytest.warns(
        ChannelWarning, match=r"AmplitudeActual is in volts in the file; @Sens\. AmplSens, 50 nm/V"
    ):
        scan = open_scan(path, probe=probe(), far_phase=0.0, phase_sign=-1)
    np.testing.assert_allclose(scan["A1"], volts * 50e-9, rtol=1e-12)
    assert any("AmplSens" in finding for finding in findings(scan))
    options = ScanOptions(far_phase="0 deg", phase_sign=-1, scale=("AmplitudeActual=60 nm/V",))
    mine = open_with(path, options, probe=probe())
    np.testing.assert_allclose(mine["A1"], volts * 60e-9, rtol=1e-12)


def test_a_scan_that_does_not_tap_decides_no_regime(nanoscope_file: Made, tmp_path: Path) -> None:
    counts = np.array([[8192, 8200], [8300, 8250]], dtype=np.int16)
    path = tmp_path / "made.spm"
    for mode, warned in (('S [ContactMode] "Contact"', True), ('S [TMMode] "Tapping"', False)):
        path.write_bytes(
            nanoscope_file(("AmplitudeActual", counts), ("Phase", counts), scan={"@MicroscopeList": mode})
        )
        text = "\n".join(m for _, m in said(lambda: open_scan(path, probe=probe(), far_phase=0.0)))
        assert ('the file says S [ContactMode] "Contact", not AC mode' in text) is warned


def test_the_hint_names_only_directions_that_hold_both(nanoscope_file: Made, tmp_path: Path) -> None:
    counts = np.full((2, 2), 8192, np.int16)
    own = [{}, {"Line Direction": "Trace"}, {"Line Direction": "Trace"}]
    path = tmp_path / "mixed.spm"
    path.write_bytes(
        nanoscope_file(("AmplitudeActual", counts), ("AmplitudeError", counts), ("Phase", counts), own=own)
    )
    with pytest.raises(ChannelError, match=r"do not mix.* Try: --direction trace\.$"):
        open_scan(path, probe=probe(), far_phase=0.0)


def test_a_free_phase_in_the_file_is_offered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recording = video(1)
    with_phase = Recording(
        **{
            **vars(one_frame(recording, 1)),
            "facts": {"free_phase": Fact(math.radians(70.7), "rad", "Ref. phase")},
        }
    )
    monkeypatch.setattr("overtone.io.observables.read_channels", lambda path: with_phase)
    with pytest.raises(
        ChannelError, match=r'--far-phase "70\.7 deg" if that is what Ref\. phase in the file means'
    ):
        open_scan(tmp_path / "any", probe=probe())


# --- videos -----------------------------------------------------------------------------------------


def video(frames: int) -> Recording:
    values = 20e-9 + np.arange(frames * 6.0).reshape(frames, 2, 3) * 1e-10
    return Recording(
        path=Path("video.h5-jpk"),
        format="made",
        vendor="made",
        dims=("frame", "y", "x"),
        coords={"frame": np.arange(float(frames)), "y": np.array([1e-9, 0.0]), "x": np.arange(3) * 1e-9},
        channels=(Channel("A1", values, "m"), Channel("phi1", np.full((frames, 2, 3), 1.2), "rad")),
    )


def test_one_frame_of_a_video() -> None:
    whole = video(4)
    for frame in (1, 4):
        one = one_frame(whole, frame)
        assert one.dims == ("y", "x")
        assert set(one.coords) == {"y", "x"}
        np.testing.assert_array_equal(one.channels[0].values, whole.channels[0].values[frame - 1])
    assert one_frame(video(1), None).dims == ("y", "x")


@pytest.mark.parametrize(("frame", "got"), [(None, "none"), (0, "0"), (5, "5"), (-1, "-1")])
def test_a_video_is_asked_which_frame(frame: int | None, got: str) -> None:
    with pytest.raises(ChannelError, match=rf"a video of 4 frames: .*1 to 4, got {got}\. Try: --frame 1\."):
        one_frame(video(4), frame)


def test_what_is_no_video_has_one_frame() -> None:
    plain = one_frame(video(2), 2)
    assert one_frame(plain, None) is plain
    assert one_frame(plain, 1) is plain
    with pytest.raises(ChannelError, match="holds no frames"):
        one_frame(plain, 2)


def test_a_frame_on_the_command_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = registry.Format(
        "made", "made", (".v",), lambda path, head: head == b"video", lambda path: video(3)
    )
    monkeypatch.setattr(registry, "FORMATS", (made, *registry.FORMATS))
    path = tmp_path / "video.v"
    path.write_bytes(b"video")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        scan = open_with(path, ScanOptions(far_phase="90 deg", frame=3), probe=probe())
    assert isinstance(scan, xr.Dataset)
    np.testing.assert_array_equal(scan["A1"], video(3).channels[0].values[2])
    assert history(scan)[-1]["arguments"]["frame"] == 3
    with pytest.raises(ChannelError, match="--frame 1"):
        open_with(path, ScanOptions(far_phase="90 deg"), probe=probe())

"""``overtone thermal`` as a user runs it: what it says, what it writes, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from overtone.cli.thermal import thermal
from overtone.errors import OvertoneError, UnitError
from overtone.instrument.thermal import BOLTZMANN, fit_thermal, resonance_density
from overtone.io.spectrum import read_spectrum
from overtone.probe import load_probe


@pytest.fixture
def spectrum_file(tmp_path: Path) -> Path:
    f = np.arange(50.0, 1.3e6, 50.0)
    mean = BOLTZMANN * 295 / 16.4 * resonance_density(f, 161.8e3, 287.0)
    mean += BOLTZMANN * 295 / 200.0 * resonance_density(f, 1.01e6, 700.0) + 40e-15**2
    drawn = mean * np.random.default_rng(1).gamma(40.0, 1 / 40.0, f.size)
    volts = np.sqrt(drawn) / 60e-9
    path = tmp_path / "thermal.csv"
    rows = "".join(f"{a / 1e3:.3f}, {b * 1e6:.6g}\n" for a, b in zip(f, volts, strict=True))
    path.write_text("frequency [kHz], density [uV/rtHz]\n" + rows, encoding="utf-8")
    return path


def run(*arguments: object) -> int:
    app = App(name="overtone")
    app.command(thermal)
    try:
        app(["thermal", *(str(argument) for argument in arguments)])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def printed(capsys: pytest.CaptureFixture[str]) -> str:
    return re.sub(r"[\s│┃]+", " ", capsys.readouterr().out)


def test_it_prints_what_the_library_gives(spectrum_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(spectrum_file, "--sensitivity", "60 nm/V", "--sensitivity-error", "4 %", "--modes", "2") == 0
    said = printed(capsys)
    fit = fit_thermal(read_spectrum(spectrum_file), sensitivity=60e-9, sensitivity_error=0.04, modes=2)
    assert fit.stiffness is not None
    assert fit.stiffness_error is not None
    expected = {
        "stiffness k1": (fit.stiffness, fit.stiffness_error),
        "resonance f1": (fit.frequency / 1e3, fit.frequency_error / 1e3),
        "quality factor Q1": (fit.quality_factor, fit.quality_factor_error),
        "resonance f2": (fit.higher[0].frequency / 1e6, fit.higher[0].frequency_error / 1e6),
    }
    for name, numbers in expected.items():
        row = re.search(name + r" ([\d.]+) (?:N/m |kHz |MHz )?([\d.]+) \(", said)
        assert row is not None, name
        assert float(row.group(1)) == pytest.approx(numbers[0], abs=0.1 * numbers[1])
        assert float(row.group(2)) == pytest.approx(numbers[1], rel=0.06, abs=0)
    floor = re.search(r"noise floor ([\d.]+) fm/√Hz", said)
    assert floor is not None
    assert float(floor.group(1)) == pytest.approx(60e6 * np.sqrt(fit.floor), rel=0.01, abs=0)
    assert f"{fit.bins} bins" in said
    assert "dynamic, of the first mode at the tip" in said


def test_without_a_sensitivity_there_is_no_stiffness(
    spectrum_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(spectrum_file) == 0
    said = printed(capsys)
    assert "needs --sensitivity" in said
    assert re.search(r"noise floor [67]\d\d nV/√Hz", said)
    with pytest.raises(OvertoneError, match="without a stiffness"):
        run(spectrum_file, "-o", tmp_path / "lever.toml")
    assert not (tmp_path / "lever.toml").exists()


def test_static_and_temperature_enter(spectrum_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = []
    for extra in ([], ["--static"], ["--temperature", "310 K"], ["--static", "--static-slope-ratio", "1.05"]):
        assert run(spectrum_file, "--sensitivity", "60 nm/V", *extra) == 0
        said = printed(capsys)
        values.append(float(re.search(r"stiffness k1 ([\d.]+)", said).group(1)))  # type: ignore[union-attr]
        assert "has no error" in said
    np.testing.assert_allclose(np.array(values[1:]) / values[0], [1.0897**-2, 310 / 295, 1.05**-2], rtol=0.01)


def test_it_writes_a_lever_and_a_picture(
    spectrum_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lever, picture = tmp_path / "lever.toml", tmp_path / "thermal.png"
    files = ["-o", lever, "--plot", picture]
    options = ["--sensitivity", "60 nm/V", "--sensitivity-error", "4 %"]
    assert run(spectrum_file, *options, "--between", "150 kHz to 175 kHz", *files) == 0
    assert f"wrote {lever}" in printed(capsys)
    assert picture.read_bytes().startswith(b"\x89PNG")
    text = lever.read_text(encoding="utf-8")
    lever.write_text(text + '[drive]\nfrequency = "161.8 kHz"\nfree_amplitude = "40 nm"\n', encoding="utf-8")
    first = load_probe(lever).cantilever.modes[0]
    fit = fit_thermal(
        read_spectrum(spectrum_file), sensitivity=60e-9, sensitivity_error=0.04, between=(150e3, 175e3)
    )
    assert first.stiffness == pytest.approx(fit.stiffness, rel=1e-5, abs=0)
    assert first.frequency == pytest.approx(fit.frequency, rel=1e-8, abs=0)
    assert first.quality_factor == pytest.approx(fit.quality_factor, rel=1e-5, abs=0)


def test_what_cannot_be_is_refused(spectrum_file: Path, tmp_path: Path) -> None:
    with pytest.raises(UnitError, match="--sensitivity"):
        run(spectrum_file, "--sensitivity", "60 nm")
    with pytest.raises(UnitError, match="--temperature"):
        run(spectrum_file, "--temperature", "295")
    with pytest.raises(OvertoneError, match="--between"):
        run(spectrum_file, "--between", "175 kHz")
    with pytest.raises(OvertoneError, match="--plot"):
        run(spectrum_file, "--plot", tmp_path / "thermal.jpg")
    with pytest.raises(OvertoneError, match="does not exist"):
        run(spectrum_file, "--plot", tmp_path / "nowhere" / "thermal.png")
    with pytest.raises(OvertoneError, match="--output"):
        run(spectrum_file, "-o", tmp_path / "lever.csv")

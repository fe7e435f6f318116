"""Calibration and correction: a whole scan at once against pixel by pixel, and what a calibration costs."""

import time
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
import xarray as xr
from pytest_benchmark.fixture import BenchmarkFixture

import overtone as ot
from overtone.demo import Session, demo_probe, record_session
from overtone.errors import CalibrationWarning
from overtone.instrument.calibration import Calibration
from overtone.instrument.signals import Signals, signals_of
from overtone.instrument.unknowns import undo


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        yield


@pytest.fixture(scope="module")
def session() -> Session:
    return record_session(shape=(256, 256))


def _calibrated(session: Session) -> Calibration:
    reference = ot.Reference(0.35, modulus=2e9, modulus_error=0.1, name="PS")
    return ot.calibrate(session.curve, demo_probe(), reference=reference, far_field=session.ladder)


@pytest.fixture(scope="module")
def calibration(session: Session) -> Calibration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return _calibrated(session)


def test_a_calibration(benchmark: BenchmarkFixture, session: Session) -> None:
    result = benchmark.pedantic(_calibrated, args=(session,), rounds=3, warmup_rounds=1)
    assert result.reference is not None


def test_the_correction_of_a_scan(
    benchmark: BenchmarkFixture, session: Session, calibration: Calibration
) -> None:
    """256 x 256 pixels: reference found, drift taken out, everything undone; and the same arithmetic in a loop."""
    corrected = benchmark.pedantic(ot.correct, args=(session.scan, calibration), rounds=3, warmup_rounds=1)
    read, values = signals_of(session.scan), calibration.values
    some = 300
    started = time.perf_counter()
    for i in range(some):
        at = np.unravel_index(i, read.phasor[1].shape)
        mean = None if read.mean is None else read.mean[at]
        undo(
            Signals(mean, {n: np.asarray(a[at]) for n, a in read.phasor.items()}),
            values,
            calibration.amplitude,
        )
    loop = (time.perf_counter() - started) / some
    pixels = corrected["A1"].size
    ours = benchmark.stats.stats.min / pixels
    benchmark.extra_info["pixels_per_second"] = round(1.0 / ours)
    benchmark.extra_info["times_faster_than_a_loop_of_the_subtraction_alone"] = round(loop / ours, 1)
    assert loop > 3.0 * ours


def test_readings_of_a_split_diode(benchmark: BenchmarkFixture) -> None:
    """65,536 motions through a photodiode, sampled over a period."""
    probe = demo_probe()
    shape = (256, 256)
    motion = xr.Dataset(
        {
            name: (("y", "x"), np.full(shape, value), {"units": "m" if name[0] == "A" else "rad"})
            for name, value in {
                "A0": 1e-10,
                "A1": 4e-8,
                "phi1": 0.5,
                "A2": 7e-11,
                "phi2": 4.0,
                "A3": 3e-11,
                "phi3": 1.0,
            }.items()
        }
    )
    from overtone.instrument.instrument import readings

    microscope = ot.Instrument(diode=ot.SplitDiode(900e-9, offset=30e-9))
    result = benchmark.pedantic(readings, args=(motion, microscope, probe), rounds=3, warmup_rounds=1)
    benchmark.extra_info["motions_per_second"] = round(motion["A1"].size / benchmark.stats.stats.min)
    assert np.isfinite(result["A2"]).all()

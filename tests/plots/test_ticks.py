import pytest

from overtone.plots.ticks import linear_ticks, log_ticks


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (-25.0, 75.0, ("−20", "0", "20", "40", "60")),
        (39.4402, 39.4408, ("39.4402", "39.4404", "39.4406", "39.4408")),
        (-1e6, 2e6, ("−1000000", "0", "1000000", "2000000")),
    ],
)
def test_labels_have_the_digits_that_tell_them_apart(low, high, labels):
    assert linear_ticks(low, high, 5).labels == labels


@pytest.mark.parametrize(("low", "high"), [(5e-16, 6e-2), (3e7, 2e11), (60.0, 190.0), (1e-9, 1.2e-9)])
@pytest.mark.parametrize("room", [1, 2, 8])
def test_logarithmic_ticks_lie_between_the_limits_and_fit(low, high, room):
    ticks = log_ticks(low, high, room)
    assert all(low * (1 - 1e-9) <= p <= high * (1 + 1e-9) for p in ticks.positions)
    assert 1 <= len(ticks.positions) <= room + 1
    assert len(set(ticks.labels)) == len(ticks.labels)


def test_limits_that_are_ticks_are_kept():
    assert linear_ticks(0.0, 0.1 * 3, 4).labels == ("0.0", "0.1", "0.2", "0.3")
    assert log_ticks(1.0, 1e3, 5).labels == ("1", "10", "100", "1000")


def test_powers_are_written_where_numbers_are_long():
    assert log_ticks(1e-6, 5.1e-6, 4).labels[:2] == ("1.5·10⁻⁶", "3·10⁻⁶")

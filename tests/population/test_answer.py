"""How the force on the motion goes with the material: against differences of passes that are brought to rest."""

import numpy as np
import pytest

from overtone.contact.models import contact_model
from overtone.demo import demo_probe
from overtone.inversion.columns import columns_of
from overtone.inversion.exact import C_, DELTA_, F_, S_
from overtone.inversion.forces import rows_of
from overtone.inversion.motion import FEW, difference_of, follow, new_room
from overtone.kernels import kernel
from overtone.population.answer import add_changes, differentiate, new_answer, renew

PROBE, AMPLITUDE = demo_probe(), 40e-9
FOLLOWED = follow(PROBE, (), FEW)
ROWS, _ = rows_of((0, 1, 2, 3), (1, 2, 3))
NOTHING = np.empty(0, complex)
REST = 30  # passes
ELASTIC, ADHESION, LOSS, DEEPER = range(4)
CHANGES = np.array(
    [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [0.4, 0.0, 0.4, 0.01],
    ]
)

given = {"poisson_ratio": 0.35, "thickness": 50e-9, "exponent": 1.7}


@kernel
def at_rest(A, x, columns, followed, nothing, theirs, f):
    room = new_room(followed)
    for _ in range(REST):
        if theirs:
            difference_of(A, x, columns, followed, nothing, room)
        else:
            renew(A, x, columns, followed, room)
    f[:] = room.f


@kernel
def changes_at(A, x, columns, followed, orders, lossy, changes, out):
    room = new_room(followed)
    answer = new_answer(room)
    lowest, count = 0.0, 0
    for _ in range(REST):
        lowest, count = renew(A, x, columns, followed, room)
    count = differentiate(A, x, columns, followed, lowest, count, room, answer)
    for i in range(changes.shape[0]):
        e, a, c, d = changes[i]
        add_changes(x, e, a, c, d, A, followed, orders, lossy, count, room, answer, out[i])


def material(model, depth):
    """Return columns, and (S, F, c, depth) of one whose forces are of the size of those of polymers."""
    record = contact_model(model)
    needed = {q.name: given[q.name] for q in record.given if q.name in given}
    columns = columns_of(record, PROBE, needed)
    peak = 20e-9  # N
    x = np.zeros(4)
    x[S_] = peak / sum(columns.shares * depth**columns.powers)
    x[F_] = 5e-9 if columns.contact.tail else 0.0
    x[C_] = 0.1 * x[S_] if columns.loss > 0.0 else 0.0
    x[DELTA_] = depth
    return columns, x


def moved(x, change, step):
    there = x.copy()
    there[S_] *= 1.0 + step * change[ELASTIC]
    there[F_] *= 1.0 + step * change[ADHESION]
    there[C_] *= 1.0 + step * change[LOSS]
    there[DELTA_] += 2.0 * AMPLITUDE * step * change[DEEPER]
    return there


def rows_at(columns, x):
    f = np.empty(FEW + 1, complex)
    at_rest(AMPLITUDE, x, columns, FOLLOWED, NOTHING, False, f)
    return np.where(ROWS.lossy, -f.imag[ROWS.orders], f.real[ROWS.orders])


@pytest.mark.parametrize("model", ["dmt-viscous", "kelvin-voigt-adhesion"])
def test_passes_end_where_those_of_the_motion_itself_do(model):
    columns, x = material(model, 2e-9)
    ours, theirs = np.empty(FEW + 1, complex), np.empty(FEW + 1, complex)
    at_rest(AMPLITUDE, x, columns, FOLLOWED, NOTHING, False, ours)
    at_rest(AMPLITUDE, x, columns, FOLLOWED, NOTHING, True, theirs)
    assert np.abs(theirs).max() > 1e-3 * x[S_] * x[DELTA_] ** columns.powers[0] * 0.1
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("depth", [1e-9, 6e-9])
@pytest.mark.parametrize(
    "model", ["dmt-viscous", "dmt-linear", "dmt-contact", "thin-layer", "flat-punch", "kelvin-voigt-adhesion"]
)
def test_one_look_says_how_rows_go_with_the_material(model, depth):
    """Models whose force jumps where contact begins among them; what is left is the third answer of the motion."""
    columns, x = material(model, depth)
    out = np.empty((len(CHANGES), ROWS.orders.size))
    changes_at(AMPLITUDE, x, columns, FOLLOWED, ROWS.orders, ROWS.lossy, CHANGES, out)
    for change, got in zip(CHANGES, out, strict=True):
        step = 1e-3 * (0.5 * depth / AMPLITUDE if change[DEEPER] else 1.0)
        want = (rows_at(columns, moved(x, change, step)) - rows_at(columns, moved(x, change, -step))) / (
            2.0 * step
        )
        if not want.any():
            assert not got.any()
            continue
        np.testing.assert_allclose(got, want, rtol=0, atol=3e-3 * np.abs(want).max())

"""The condensed model: W is the derivative of the equilibrium, and delta = W effort + delta_free.

Measured relative errors of W against central differences: 1e-8 and less, over both materials, both fingers, rest and
full actuation; the tests require 1e-7. Steps of 1e-3 N and 1e-6 m leave a truncation of about 1e-9 of W and, with
equilibria to 1e-14 m, a round-off of about 1e-8.
"""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from softgym_envs.extensions.beams.chamber import Chamber
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.units import effort_unit

FORCE, LENGTH = 1e-3, 1e-6


@pytest.fixture(params=[0.0, 1.0], ids=["at rest", "fully pulled"])
def pulled(request, finger):
    """A finger with the equilibrium at a part of its actuation; its statics solve to 1e-13 m."""
    count = len(finger.robot.actuators)
    finger.count = count
    finger.statics.tolerance = 1e-13
    finger.statics.unilateral[:] = False  # differences need both signs, at rest too
    # Unequal cables, so that no result holds only by symmetry.
    finger.state = finger.statics.solve(request.param * finger.robot.upper * np.array([1.0, 0.8])[:count])
    yield finger
    finger.model.nodal_loads[:] = 0.0


def from_state(case, target, mode):
    case.statics.restore(case.state.x, case.state.effort)
    return case.statics.solve(target, mode)


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


def test_actuator_columns_by_effort(pulled):
    W = pulled.state.condensed.W
    for j in range(pulled.count):
        step = np.zeros(pulled.count)
        step[j] = FORCE
        plus, minus = (
            from_state(pulled, pulled.state.effort[: pulled.count] + s * step, "effort").delta for s in (1, -1)
        )
        column = (plus - minus) / (2 * FORCE)
        assert relative(column[: pulled.count], W.aa[:, j]) < 1e-7
        assert relative(column[pulled.count :], W.ea[:, j]) < 1e-7


def test_actuator_blocks_by_displacement(pulled):
    """Driven in displacement, efforts change by W_aa^-1 and effectors by W_ea W_aa^-1."""
    W, n = pulled.state.condensed.W, pulled.count
    stiffness, motion = np.empty((n, n)), np.empty((3, n))
    for j in range(n):
        step = np.zeros(n)
        step[j] = LENGTH
        plus, minus = (from_state(pulled, pulled.state.delta[:n] + s * step, "displacement") for s in (1, -1))
        stiffness[:, j] = (plus.effort - minus.effort)[:n] / (2 * LENGTH)
        motion[:, j] = (plus.delta - minus.delta)[n:] / (2 * LENGTH)
    assert relative(np.linalg.inv(stiffness), W.aa) < 1e-7
    assert relative(motion @ np.linalg.inv(stiffness), W.ea) < 1e-7


def test_effector_columns_by_a_force_on_the_effector(pulled):
    """The force enters through the nodes, by the weights of the effector's embedding, without the constraint."""
    W, n, model = pulled.state.condensed.W, pulled.count, pulled.model
    embedding = model.constraints["e"][0].embedding
    columns = np.empty((n + 3, 3))
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            model.nodal_loads[:] = 0.0
            model.nodal_loads[embedding.node_ids[0], axis] = sign * FORCE * embedding.weights[0]
            ends.append(from_state(pulled, pulled.state.effort[:n], "effort").delta)
        columns[:, axis] = (ends[0] - ends[1]) / (2 * FORCE)
    assert relative(columns[n:], W.ee) < 1e-7
    assert relative(columns[:n], W.ae) < 1e-7


def test_W_is_symmetric_and_positive_definite(pulled):
    W = pulled.state.condensed.compliance
    assert relative(W, W.T) < 1e-10
    assert np.linalg.eigvalsh(W)[0] > 0.0
    # Before it is symmetrised, too: both triangles come from the same solves.
    linear = pulled.statics.linearisation
    raw = linear.H.T @ np.column_stack([linear.solve(column) for column in linear.H.T])
    assert relative(raw, raw.T) < 1e-10


def test_delta_is_W_effort_plus_delta_free(pulled):
    condensed, state = pulled.state.condensed, pulled.state
    np.testing.assert_allclose(condensed.delta.array, state.delta, rtol=0, atol=1e-15)
    np.testing.assert_allclose(condensed.lambda_.array, state.effort, rtol=0, atol=0)
    expected = condensed.compliance @ state.effort + condensed.free
    np.testing.assert_allclose(expected, state.delta, rtol=0, atol=1e-15)
    if not state.delta[: pulled.count].any():
        # At rest without loads the free displacement is the rest position itself.
        np.testing.assert_allclose(condensed.delta_free.a, 0.0, atol=1e-13)
        np.testing.assert_allclose(condensed.delta_free.e, pulled.robot.effector_rest, atol=1e-13)


def test_prediction_is_of_first_order(pulled):
    """delta(effort + d) - W (effort + d) - delta_free shrinks as d squared."""
    condensed, n = pulled.state.condensed, pulled.count
    errors = []
    for size in (0.4, 0.2, 0.1):
        effort = pulled.state.effort.copy()
        effort[:n] += size * np.array([1.0, -0.5])[:n]
        found = from_state(pulled, effort[:n], "effort").delta
        errors.append(np.abs(found - condensed.compliance @ effort - condensed.free).max())
    assert errors[0] > 1e-7
    ratios = np.array(errors[:-1]) / errors[1:]
    assert ((ratios > 3.5) & (ratios < 4.5)).all()


def test_W_follows_loads_and_gravity(finger):
    """With dead loads the tangent is that of the loaded shape."""
    model, statics, n = finger.model, finger.statics, len(finger.robot.actuators)
    model.set_gravity((0.0, 3.0, -9.81))
    statics.tolerance = 1e-13
    try:
        statics.reset()
        state = statics.solve(np.full(n, 5.0), "effort")
        for j in range(n):
            step = FORCE * np.eye(n)[j]
            plus, minus = (statics.solve(state.effort[:n] + s * step, "effort").delta for s in (1, -1))
            assert relative((plus - minus) / (2 * FORCE), state.condensed.compliance[:, j]) < 1e-7
    finally:
        model.set_gravity((0.0, 0.0, 0.0))


# -- the container --------------------------------------------------------------------------------------------------


@pytest.fixture
def batch(rng):
    half = rng.standard_normal((4, 5, 5))
    return CondensedModel(
        compliance=half @ np.swapaxes(half, 1, 2),
        free=rng.standard_normal((4, 5)),
        effort=rng.standard_normal((4, 5)),
        roles=(("a", 2), ("e", 3)),
    )


def test_blocks_by_role_of_a_batch(batch):
    assert batch.W.ea.shape == (4, 3, 2)
    assert batch.W.aa.shape == (4, 2, 2)
    assert batch.delta_free.e.shape == (4, 3)
    np.testing.assert_array_equal(batch.W.ea, batch.compliance[:, 2:, :2])
    np.testing.assert_array_equal(batch.lambda_.a, batch.effort[:, :2])
    for k in range(4):
        expected = batch.compliance[k] @ batch.effort[k] + batch.free[k]
        np.testing.assert_allclose(batch.delta.array[k], expected, atol=1e-13)


def test_unknown_roles_are_rejected(batch):
    with pytest.raises(AttributeError, match="no block 'ec'; roles: a, e"):
        batch.W.ec  # noqa: B018
    with pytest.raises(AttributeError, match="no role 'c'"):
        batch.delta_free.c  # noqa: B018
    with pytest.raises(AttributeError):
        batch.W.a  # noqa: B018


def test_reads_as_arrays(batch):
    np.testing.assert_array_equal(np.asarray(batch.W), batch.compliance)
    np.testing.assert_array_equal(np.asarray(batch.delta_free), batch.free)
    assert np.array(batch.W, dtype=np.float32).dtype == np.float32


def test_a_condensed_model_can_be_pickled(batch):
    again = pickle.loads(pickle.dumps(batch))
    np.testing.assert_array_equal(again.W.ae, batch.W.ae)
    assert again.roles == batch.roles


def test_views_by_role_can_be_copied(batch):
    for view in (batch.W, batch.delta_free):
        for again in (copy.copy(view), copy.deepcopy(view), pickle.loads(pickle.dumps(view))):
            np.testing.assert_array_equal(np.asarray(again), np.asarray(view))


# -- names and units ------------------------------------------------------------------------------------------------


def test_W_prints_with_names_and_units(box):
    nodes, tetrahedra = box((0.1, 0.02, 0.02), (5, 1, 1))
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=lambda x: x[:, 0] == 0.0, young_modulus=1e6, element="linear"
    )
    model.add_cable("upper", [[0.05, 0.01, 0.018], [0.09, 0.01, 0.018]], [-0.01, 0.01, 0.018])
    model.add_effector("tip", [0.1, 0.01, 0.01])
    condensed = Statics(model).solve([0.002]).condensed
    table = [line.split("  ") for line in str(condensed.W).splitlines()]
    header = [cell.strip() for cell in table[0] if cell]
    assert header == ["W", "upper [N]", "tip x [N]", "tip y [N]", "tip z [N]"]
    assert [line[0].strip() for line in table[1:]] == ["upper [m]", "tip x [m]", "tip y [m]", "tip z [m]"]
    numbers = [[float(cell) for cell in line[1:] if cell.strip()] for line in table[1:]]
    np.testing.assert_allclose(numbers, condensed.compliance, rtol=1e-3)
    lines = str(condensed.delta_free).splitlines()
    assert lines[0].strip() == "delta_free" and lines[2].startswith("tip x [m]")
    assert float(lines[2].split()[-1]) == pytest.approx(condensed.free[1], rel=1e-4)
    assert str(condensed.lambda_).splitlines()[1].split() == ["upper", "[N]", f"{condensed.effort[0]:.5g}"]
    assert repr(condensed) == "CondensedModel(upper, tip x, tip y, tip z)"


def test_rows_of_a_batch_and_rows_without_names(batch):
    assert str(batch.W).startswith("W of shape (4, 5, 5); rows: actuator 1 [?, ?], actuator 2")
    assert str(batch.delta).startswith("delta of shape (4, 5); rows: actuator 1")
    assert repr(batch) == "CondensedModel(actuator 1, actuator 2, effector 1, effector 2, effector 3; batch (4,))"


def test_units_of_pressure_and_angles():
    assert [effort_unit(unit) for unit in ("m", "m3", "rad", "1")] == ["N", "Pa", "N m", "N m"]
    for kind in (Bond, Cable, Cavity, Chamber, Point, Servo):
        assert effort_unit(kind.unit[0]) == kind.unit[1]


def test_fem_and_surrogate_name_their_rows_alike(fingers):
    from tests.helpers import untrained_potential

    robot, model = fingers(2, "corotational")
    surrogate, _ = untrained_potential(robot)
    assert surrogate.rows == Statics(model).solve([0.0, 0.0]).condensed.rows
    assert [row.name for row in surrogate.rows[:2]] == [actuator.name for actuator in robot.actuators]

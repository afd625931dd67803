"""An actuator and an element of one's own: a class each in one file, and no other file knows them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.control import InverseQP
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.constraint import Constraint
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.elements.block import ElementBlock, lower_pairs
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots import Actuator, Robot

ANCHORS = {"strut_x": (-0.1, 0.0, 0.05), "strut_y": (0.0, -0.1, 0.05)}
NOTHING = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)


class Strut(Constraint):
    """A telescope from a fixed point to the origin of a frame; delta [m] is how much longer it is than at rest."""

    size = 1

    def __init__(self, name, anchor, row, nodes):
        self.name, self.anchor, self.row = name, np.array(anchor), row
        self.dofs = 3 * row + np.arange(3)
        self.rest = np.linalg.norm(nodes[row] - self.anchor)

    def value(self, x):
        return np.array([np.linalg.norm(x[self.row] - self.anchor) - self.rest])

    def jacobian(self, x):
        arm = x[self.row] - self.anchor
        return (arm / np.linalg.norm(arm))[None]

    def hessian(self, x, effort):
        length = np.linalg.norm(x[self.row] - self.anchor)
        along = self.jacobian(x)[0]
        return effort[0] * (np.eye(3) - np.outer(along, along)) / length


class Rubber(ElementBlock):
    """Holds the origin of a frame where it rests, by ``stiffness |u|^2 / 2`` [N/m]; it has neither mass nor damping."""

    volume = mass = 0.0

    def __init__(self, nodes, rows, *, stiffness):
        self.row, self.stiffness = int(rows[0]), stiffness
        self.nodes_used = np.array([self.row])
        self.rest = nodes[self.row].copy()

    def stencils(self):
        return [lower_pairs((3 * self.row + np.arange(3))[None])]

    def add(self, x, gradient, values, scatter):
        u = x[self.row] - self.rest
        gradient[self.row] += self.stiffness * u
        if values is not None:
            entries, places = self.stiffness * np.eye(3)[np.tril_indices(3)], scatter[0].ravel()
            values[places[places >= 0]] += entries[places >= 0]
        return 0.5 * self.stiffness * float(u @ u), 0

    def add_damping(self, x, rates, gradient, values, scatter):
        return 0.0

    def nodal_masses(self, count):
        return np.zeros(count)

    def mass_entries(self, lumped):
        return NOTHING

    def add_warped(self, x, step, out):
        pass

    def laplacian_entries(self):
        return NOTHING


class Rig(Robot):
    """A point in rubber that two struts push."""

    name = "rig"
    effectors = ("point",)
    size = 0.1
    effector_rest = (0.0, 0.0, 0.05)
    effort_scale = (1.0, 1.0)
    design_space = DesignSpace(DesignVariable("stiffness", 50.0, 200.0, 100.0, "N/m", "of the rubber"))
    actuators = tuple(Actuator(name, -0.02, 0.02, 0.002, unilateral=False) for name in ANCHORS)

    def assemble(self, design):
        builder = ModelBuilder(floating=True)
        frame = builder.add_frame([0.0, 0.0, 0.05], fixed_spin=True)
        builder.add_element(Rubber, [frame], stiffness=design["stiffness"])
        model = builder.build()
        for name, anchor in ANCHORS.items():
            model.add("a", Strut(name, anchor, frame, model.nodes))
        model.add_effector("point", EmbeddedPoints.in_frame(frame, np.zeros(3), model.nodes))
        return model


def test_the_derivatives_of_the_actuator():
    nodes = np.array([[0.01, 0.02, 0.06]])
    strut = Strut("strut", (-0.1, 0.0, 0.0), 0, np.zeros((1, 3)))
    step = 1e-6 * np.eye(3)
    differences = [(strut.value(nodes + d) - strut.value(nodes - d))[0] / 2e-6 for d in step]
    np.testing.assert_allclose(strut.jacobian(nodes)[0], differences, atol=1e-9)
    second = [2.0 * (strut.jacobian(nodes + d) - strut.jacobian(nodes - d))[0] / 2e-6 for d in step]
    np.testing.assert_allclose(strut.hessian(nodes, np.array([2.0])), second, atol=1e-8)


def test_equilibria_and_the_condensed_model_are_exact():
    """Rubber moves along a strut, which it pulls back with its stiffness times the stroke."""
    model = Rig().build({"stiffness": 80.0})
    state = Statics(model).solve([0.004, 0.0], ["displacement", "effort"])
    np.testing.assert_allclose(state.condensed.delta.e, [0.004, 0.0, 0.05], atol=1e-9)
    np.testing.assert_allclose(state.effort[0], 80.0 * 0.004, rtol=1e-9)
    rest = Statics(model).solve([0.0, 0.0])
    np.testing.assert_allclose(rest.condensed.W.aa, np.eye(2) / 80.0, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rest.condensed.W.ea, np.eye(3)[:, :2] / 80.0, rtol=1e-9, atol=1e-12)
    assert [(row.name, row.unit, row.effort_unit) for row in rest.condensed.rows[:2]] == [
        ("strut_x", "m", "N"),
        ("strut_y", "m", "N"),
    ]


def test_environment_and_inverse_qp_take_them():
    env = gymnasium.make("SoftGym/Reach-v0", robot=Rig, design={"stiffness": 120.0})
    env.reset(options={"goal": [0.008, -0.006, 0.05]})
    body = env.unwrapped
    controller = InverseQP.for_robot(body.robot)
    for _ in range(12):
        state = body.state
        command = controller.solve(state.condensed, body.goal, state.command, state.slack)
        *_, info = env.step(body.spaces.action(command, state.command))
    assert info["distance"] == pytest.approx(0.0, abs=5e-5)
    assert not info["is_failed"] and info["converged"]

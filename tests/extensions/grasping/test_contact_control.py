"""Closed loops with contact: on finite elements, and the size of their steps on a backend without mechanics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.backend import Backend, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping import ContactControl, ContactQP, ForceGoal
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.contact.obstacles import Plane
from tests.verification.contact_control import distance_without_wall, force_goal, reach_along_wall


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_finger_comes_to_a_rod_and_presses_with_the_force_asked_for(friction):
    found = force_goal(friction, steps=12)
    assert found["relative_error"] < 1e-3
    assert found["steps_to_1_percent"] <= 8


def test_a_trunk_reaches_a_goal_along_a_wall_that_it_cannot_reach_without():
    found = reach_along_wall(layers=12, steps=12)
    assert found["with_wall_final_mm"] < 2.0  # the tolerance of goals
    assert found["without_wall_smallest_mm"] > 20.0
    assert distance_without_wall(samples=12, layers=12) > 20.0
    assert found["wall_force_N"] > 0.1


class Spring(Backend):
    """One actuator that moves a point towards a wall; the wall moves away or towards it by ``surprise`` per step.

    Args:
        surprise: how far the opening differs from its prediction, for each step [m].
        reach: largest step that has an equilibrium [m].
        stiffening: real over predicted change of the contact force.
    """

    def __init__(self, surprise=(), reach=1.0, stiffening=1.0):
        self.stiffening = stiffening
        self.surprise = list(surprise)
        self.reach = reach
        self.wall = 5e-3
        self.commands = []
        self._go(np.zeros(1))

    def _go(self, command):
        self.state = State(
            command, command, command / 1e-3, np.zeros((1, 3)), np.zeros(1, dtype=bool), self.model(command)
        )

    def model(self, command):
        W = 1e-3 * np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 1.5]])
        force = self.stiffening * max(0.0, float(command[0]) - self.wall) / 0.5e-3
        effort = np.array([float(command[0]) / 1e-3 + force, 0.0, force])
        delta = np.array([command[0], 0.0, max(0.0, self.wall - float(command[0]))])
        return CondensedModel(W, delta - W @ effort, effort, (("a", 1), ("e", 1), ("c", 1)))

    def contact_model(self, *, friction=False):
        return self.state.condensed

    def step(self, command, mode="displacement", *, force=None):
        if abs(command[0] - self.state.command[0]) > self.reach:
            raise ConvergenceError("too far")
        self.wall += self.surprise.pop(0) if self.surprise else 0.0
        self.commands.append(float(command[0]))
        self._go(command)
        return self.state

    def reset(self, design=None):
        raise NotImplementedError

    def restore(self, state):
        raise NotImplementedError


def loop_on(plant, rate=2e-3):
    controller = ContactQP(np.full(1, -0.05), np.full(1, 0.05), np.full(1, rate), np.zeros(1, dtype=bool))
    return ContactControl(plant, controller)


PRESS = [ForceGoal({"contact 1": 1.0}, 1.0)]


def test_steps_shrink_after_one_that_made_it_worse_and_grow_again():
    loop = loop_on(Spring([0.0, 4e-3]))
    sizes = []
    for _ in range(5):
        loop.step(None, forces=PRESS)
        sizes.append(loop.size)
    assert sizes[:3] == [1.0, 1.0, 0.5]
    assert sizes[3:] == [0.75, 1.0]


def test_a_new_goal_does_not_count_as_a_step_that_made_it_worse():
    loop = loop_on(Spring())
    for _ in range(8):
        loop.step(None, forces=PRESS)
    loop.step(None, forces=[ForceGoal({"contact 1": 1.0}, 5.0)])
    assert loop.size == 1.0


@pytest.mark.parametrize("stiffening", [0.5, 1.0, 1.9, 3.0])
def test_forces_that_change_more_or_less_than_predicted_are_reached(stiffening):
    """Without the measured ratio, a contact that is twice as stiff as in the model makes the loop swing for ever."""
    plant = Spring(stiffening=stiffening)
    loop = loop_on(plant)
    for _ in range(16):
        loop.step(None, forces=PRESS)
    assert plant.state.condensed.lambda_.c == pytest.approx([1.0], rel=2e-3)


def test_the_row_of_an_open_obstacle_is_that_of_a_point_which_actuators_move():
    """The base of the trunk is nearest to the wall, but it hardly moves."""
    wall = Plane((0.03, 0.0, 0.0), (-1.0, 0.0, 0.0), name="wall")
    fem = FEMBackend(make_robot("cable_trunk", obstacles=[wall], layers=8))
    model = fem.contact_model()
    nearest = 0.03 - fem.model.nodes[:, 0].max() - 5e-4
    assert model.delta.c[0] > nearest + 1e-3
    east = fem.robot.actuators.index(next(a for a in fem.robot.actuators if a.name == "long_east"))
    assert model.W.ca[0, east] < -1e-4


def test_steps_without_equilibrium_are_halved_and_the_loop_goes_on():
    plant = Spring(reach=0.6e-3)
    loop = loop_on(plant)
    states = loop.reach(None, forces=PRESS, steps=60)
    assert np.abs(np.diff([0.0, *plant.commands])).max() <= 0.6e-3
    assert states[-1].condensed.lambda_.c == pytest.approx([1.0], rel=1e-3)
    assert len(states) < 60

    stuck = loop_on(Spring(reach=1e-9))
    with pytest.raises(ConvergenceError, match="too far"):
        stuck.step(None, forces=PRESS)


def test_backends_without_contact_say_so():
    with pytest.raises(ValueError, match="Spring does not compute contacts"):
        Backend.contact_model(Spring())
    trunk = make_robot("cable_trunk", layers=4)
    with pytest.raises(ValueError, match="the model has no contact"):
        FEMBackend(trunk).contact_model()
    with pytest.raises(ValueError, match="dynamics=False"):
        FEMBackend(trunk, dynamics=True).contact_model()


class Pushed(Spring):
    """The same, commanded by the effort of its actuator."""

    def step(self, command, mode="displacement", *, force=None):
        assert mode == "effort"
        self.state = replace(super().step(1e-3 * command), command=command)
        return self.state


def test_a_loop_of_efforts_ends_when_they_hardly_change():
    free = np.full(1, np.inf)
    rates, loose = np.full(1, 0.5), np.zeros(1, dtype=bool)
    controller = ContactQP(-free, free, free, loose, effort_rates=rates, mode="effort")
    states = ContactControl(Pushed(reach=10.0), controller).reach(
        None, forces=[ForceGoal({"contact 1": 1.0}, 1.0)], steps=40
    )
    assert 10 < len(states) < 40
    assert abs(states[-1].command - states[-2].command) < 1e-5 * rates


def test_two_kinds_of_commands_at_once_are_refused():
    two = np.ones(2)
    controller = ContactQP(-two, two, two, np.zeros(2, dtype=bool), effort_rates=two, mode=["effort", "displacement"])
    with pytest.raises(ValueError, match="its ContactQP mixes two"):
        ContactControl(Spring(), controller)

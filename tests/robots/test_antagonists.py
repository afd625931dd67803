"""Groups of actuators that pull against each other."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.extensions.beams import Section, add_rod
from softgym_envs.mechanics import ModelBuilder, Statics
from softgym_envs.robots import Actuator, Robot


class Stalk(Robot):
    """A rod with four tendons, of which two pairs are antagonists."""

    name = "stalk"
    effectors = ("tip",)
    size = 0.2
    effector_rest = (0.0, 0.0, 0.2)
    effort_scale = (5.0,) * 4
    design_space = DesignSpace(DesignVariable("radius", 5e-4, 1e-3, 8e-4, "m", "radius of the rod"))
    actuators = tuple(Actuator(name, -0.006, 0.006, 0.0005) for name in ("east", "north", "west", "south"))
    antagonists = (("east", "west"), ("north", "south"))

    def assemble(self, design):
        """Bend a rod by four tendons."""
        discs = np.linspace(0.0, 0.2, 11)
        builder = ModelBuilder(gravity=self.gravity)
        section = Section.circle(design["radius"])
        rod = add_rod(
            builder, [[0, 0, 0], [0, 0, 0.2]], section=section, elements=discs, young_modulus=6e10, density=6450
        )
        model = builder.build()
        for k, actuator in enumerate(self.actuators):
            angle = 0.5 * np.pi * k
            offset = 0.006 * np.array([np.cos(angle), np.sin(angle)])
            rod.add_tendon(model, actuator.name, discs[1:], offset, compliance=1e-4)
        model.add_effector("tip", rod.points(0.2, (0.0, 0.0), model.nodes))
        return model


class Triple(Stalk):
    """Three of four in a group."""

    name = "triple"
    antagonists = (("east", "north", "west"),)


class Free(Stalk):
    """No groups."""

    name = "free"
    antagonists = ()


@pytest.mark.parametrize("robot", [Stalk(), Triple()])
def test_balanced_commands_sum_to_zero_within_the_range(robot):
    commands = robot.displacements(np.random.default_rng(0).random((200, 4)))
    names = [actuator.name for actuator in robot.actuators]
    for group in robot.antagonists:
        np.testing.assert_allclose(commands[:, [names.index(n) for n in group]].sum(axis=1), 0.0, atol=1e-15)
    assert (np.abs(commands) <= 0.006 + 1e-15).all() and np.abs(commands).max() > 0.0057
    np.testing.assert_allclose(robot.balanced(commands), commands, atol=1e-16)


def test_without_groups_nothing_changes():
    fractions = np.random.default_rng(1).random((5, 4))
    np.testing.assert_array_equal(Free().displacements(fractions), Free().lower + fractions * 0.012)


def test_tensors_are_balanced_as_arrays():
    torch = pytest.importorskip("torch")
    commands = np.random.default_rng(2).uniform(-0.006, 0.006, (7, 4))
    balanced = Triple().balanced(torch.as_tensor(commands))
    np.testing.assert_allclose(balanced.numpy(), Triple().balanced(commands), rtol=1e-14)


def test_efforts_of_balanced_commands_are_those_of_bending():
    """Antagonists that are pulled together compress the rod, which takes several times the efforts of bending it."""
    rng = np.random.default_rng(3)
    largest = []
    for robot in (Stalk(), Free()):
        statics = Statics(robot.build())
        rest = statics.solve(np.zeros(4))
        efforts = []
        for command in 0.5 * robot.displacements(rng.random((6, 4))):
            statics.restore(rest.x, rest.effort)
            efforts.append(np.abs(statics.solve(command).effort[:4]).max())
        largest.append(max(efforts))
    assert largest[1] > 3.0 * largest[0]


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ((("east", "up"),), "unknown actuator 'up'"),
        (("east", "west"), r"must be groups of two or more names, got 'east'"),
        ((("east",),), "must be groups of two or more names"),
        ((("east", "west"), ("west", "south")), "'west' is in two groups"),
    ],
)
def test_malformed_groups(groups, message):
    with pytest.raises(ValueError, match=message):
        type("Wrong", (Stalk,), {"antagonists": groups})()


def test_antagonists_need_one_range_with_both_signs():
    actuators = (*Stalk.actuators[:3], Actuator("south", 0.0, 0.006, 0.0005))
    with pytest.raises(ValueError, match=r"'south' has the range 0 to 0\.006; a group needs one range"):
        type("Pulling", (Stalk,), {"actuators": actuators})()

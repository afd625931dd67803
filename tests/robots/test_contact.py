"""Robots pressed against a wall, and the Soft Finger in contact with itself."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics import MechanicalModel, Plane, Statics
from softgym_envs.robots.registry import ROBOTS
from softgym_envs.robots.soft_finger import SoftFinger

#: Share of the range of each actuator, chosen so that no cable is slack.
PULLS = {
    "finger": (0.6, 0.4),
    "diamond": (0.7, 0.2, 0.2, 0.3),
    "cable_trunk": (0.3, 0.1, 0.1, 0.1, 0.4, 0.1, 0.1, 0.1),
    "sensorized_finger": (0.5,),
    "trunk": (0.5, 0.1, 0.1, 0.1, 0.4, 0.2),
    "contact_finger": (0.4, 0.3, 0.164, 0.1, 0.1, 0.0, 0.053, 0.059),
    "two_finger_gripper": (0.6, 0.3, 0.2, 0.3),
    "three_finger_gripper": (0.2, 0.3, 0.3, 0.1, 0.2, 0.4),
}

DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def wall_in_the_way(name):
    """A plane half way along the way that a command moves the outermost points of a robot, and that command."""
    robot = make_robot(name)
    command = np.array(PULLS[name]) * robot.upper
    model = robot.build()
    points = model.set_contact(excluded=np.flatnonzero(model.fixed)).surface.points[0]
    model.contact = None
    statics = Statics(model)
    states = [model.nodes, statics.solve(np.zeros(len(command))).x, statics.solve(command).x]
    reach = np.array([(points @ x @ DIRECTIONS.T).max(axis=0) for x in states])
    start = reach[:2].max(axis=0)
    best = int((reach[2] - start).argmax())
    assert reach[2, best] > start[best] + 1e-3
    normal = -DIRECTIONS[best]
    return Plane(-0.5 * (start[best] + reach[2, best]) * normal, normal, name="wall"), command


@pytest.mark.parametrize("name", PULLS)
def test_robot_presses_a_wall(name):
    """Nothing penetrates, and the force is the derivative of the energy by the wall's place."""
    wall, command = wall_in_the_way(name)
    normal = np.array(wall.normal)
    potential, h = {}, 1e-6
    for shift in (-h, 0.0, h):
        moved = Plane(wall.point + shift * normal, normal, name="wall")
        statics = Statics(make_robot(name, obstacles=[moved]).build(), tolerance=1e-12, max_iterations=60)
        for share in np.linspace(0.25, 1.0, 4):
            found = statics.solve(share * command)
            assert found.contacts.smallest_gap > 0.0
        potential[shift] = statics.model.energy(found.x) + statics.linearisation.contact.stored_energy(found.x)
        if not shift:
            force = found.contacts.total[0]
    pressing = force @ normal
    assert pressing > 1e-3
    np.testing.assert_allclose(force, pressing * normal, atol=1e-9 * pressing)
    assert (potential[h] - potential[-h]) / (2 * h) == pytest.approx(pressing, rel=1e-4)


TOUCHING = {"press_finger": "touch", "quadruped": "cross", "crawler": "cross"}
"""The bar lies flat on the finger; legs begin inside the trunk."""


@pytest.mark.parametrize("name", [name for name in ROBOTS if name not in TOUCHING])
def test_robot_may_touch_itself(name):
    model = make_robot(name, self_contact=True).build()
    surfaces = model.contact.between_surfaces(model.nodes)
    # The skin of the tendon-driven rod has a radius of half a millimetre, so its own points are that near.
    apart = 1e-5 if name == "tendon_rod" else 1e-4
    assert surfaces.minimum_distance(model.contact.surfaces.places(model.nodes)) > apart


@pytest.mark.parametrize(("name", "verb"), TOUCHING.items())
def test_surfaces_that_touch_at_rest_are_refused(name, verb):
    with pytest.raises(InfeasibleDesign, match=f"'{name}' at rest: surfaces of the body {verb} each other"):
        make_robot(name, self_contact=True).build()


class FineFinger(SoftFinger):
    """The finger of quadratic elements: with linear ones it is so stiff that its grooves never close."""

    def solid(self, mesh, design, *, fixed, density=1100.0):
        return MechanicalModel.from_mesh(
            mesh.nodes,
            mesh.tetrahedra,
            fixed=fixed,
            element="quadratic",
            young_modulus=design["young_modulus"],
            poisson_ratio=design["poisson_ratio"],
        )


def test_grooves_of_the_finger_close():
    """Without self-contact faces cross between 15 and 17.5 mm of pull; with it they never do, and W is exact."""
    checked = FineFinger(cables=1, self_contact=True).build()
    through = Statics(FineFinger(cables=1).build())
    for pull, crossed in ((0.010, False), (0.015, False), (0.0175, True)):
        x = through.solve([pull]).x
        assert (checked.contact.intersections(x) is not None) == crossed
    statics = Statics(checked, tolerance=1e-12)
    for pull in (0.010, 0.015, 0.0175):
        found = statics.solve([pull])
        assert checked.contact.intersections(found.x) is None
        assert found.contacts.smallest_gap > 0.0
    assert found.contacts.self_force > 1.0
    x, effort, W, h = statics.x, statics.effort, found.condensed.W, 1e-6
    ends = []
    for change in (h, -h):
        statics.restore(x, effort)
        ends.append(statics.solve([pull + change]))
    tension = (ends[0].effort[0] - ends[1].effort[0]) / (2 * h)
    assert tension == pytest.approx(1.0 / W.aa[0, 0], rel=1e-6)
    tip = (ends[0].delta[1:4] - ends[1].delta[1:4]) / (2 * h)
    np.testing.assert_allclose(tip, W.ea[:, 0] / W.aa[0, 0], rtol=1e-6, atol=1e-6 * np.abs(tip).max())


def test_tetrapod_presses_on_a_floor():
    """Friction holds the loaded centre, which the servos move by 4 mm without a floor; forces stay in the cone."""
    floor = Plane((0.0, 0.0, -0.160), (0.0, 0.0, 1.0), friction=0.5, name="floor")
    ends = []
    for obstacles in ([], [floor]):
        statics = Statics(make_robot("tetrapod", payload=1.0, obstacles=obstacles).build())
        rest = statics.solve(np.zeros(4))
        found = statics.solve([0.1, -0.03, -0.1, 0.02])
        ends.append(np.linalg.norm((found.delta - rest.delta)[4:7]))
    assert ends[0] > 3e-3 and ends[1] < 1e-5
    x, y, z = found.contacts.total[0]
    assert 0.1 < np.hypot(x, y) < 0.5 * z
    assert found.contacts.smallest_gap > 0.0

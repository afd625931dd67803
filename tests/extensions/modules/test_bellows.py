"""The bellows: a closed module under pressure, as finite elements, as superelement, and as actuator of an arm."""

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.extensions.modules import MODULES, learned_module
from softgym_envs.mechanics.solvers.statics import Statics

PRESSURE = 1.0e4


def test_the_cavity_of_the_bellows_has_the_volume_of_its_drawing():
    """Two frusta for each fold, inside the wall; the mesh is a polyhedron in it."""
    module = MODULES["bellows"]()
    design = module.design_space.complete({})
    cavity = module.model().constraints["a"][6]
    lean = 4.0 * design["amplitude"] / design["pitch"]
    half = 0.5 * design["thickness"] * np.hypot(1.0, lean)
    low, high = (design["radius"] + s * design["amplitude"] - half for s in (-1.0, 1.0))
    exact = 2.0 * np.pi / 3.0 * design["pitch"] * (low**2 + low * high + high**2)
    assert 0.9 * exact < cavity.rest_volume < exact


def test_a_superelement_stretches_under_pressure_as_finite_elements_do():
    learned = learned_module("bellows")
    design = {name: 0.4 * low + 0.6 * high for name, (low, high) in learned.box.items()} | {"young_modulus": 2e7}
    body = Statics(MODULES["bellows"]().model(design))
    rest = body.solve(np.zeros(7), "effort").condensed.W.aa
    stretched = body.solve(np.append(np.zeros(6), PRESSURE), "effort").condensed.delta.a
    named = {f"{name}_1": value for name, value in design.items() if name != "young_modulus"}
    arm = make_robot("modular_arm", cells=["bellows"])
    state = Statics(arm.build({**named, "young_modulus": 2e7})).solve(np.array([0.0, 0.0, PRESSURE]), "effort")
    moved = state.condensed.delta.e[2] - MODULES["bellows"]().length(MODULES["bellows"].design_space.complete(design))
    assert stretched[2] > 1e-4
    assert moved == pytest.approx(stretched[2], rel=0.03)
    assert state.condensed.delta.a[2] == pytest.approx(stretched[6], rel=0.03)
    assert state.condensed.W.aa[2, 2] == pytest.approx(rest[6, 6], rel=0.05)


def test_pressure_is_an_actuator_of_an_arm():
    """The tip of an arm of a bellows and a leaf, on superelements and on finite elements of the whole body."""
    found = {}
    for body in ("superelements", "solid"):
        robot = make_robot("modular_arm", cells=["bellows", "leaf_x"], body=body)
        assert [actuator.name for actuator in robot.actuators] == ["wire_x", "wire_y", "pressure_1"]
        found[body] = Statics(robot.build()).solve(np.array([0.001, 0.0, 1.0e-7])).condensed
    moved = found["solid"].delta.e - robot.effector_rest
    assert moved[2] > 1e-4 and abs(moved[0]) > 1e-3
    assert np.linalg.norm(found["superelements"].delta.e - found["solid"].delta.e) < 0.02 * np.linalg.norm(moved)
    assert found["superelements"].lambda_.a[2] == pytest.approx(found["solid"].lambda_.a[2], rel=0.05)


def test_bellows_are_not_among_the_kinds_of_free_cells():
    with pytest.raises(ValueError, match="kinds must not contain 'bellows'"):
        make_robot("modular_arm", cells=3, kinds=["leaf_x", "bellows"])

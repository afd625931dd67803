"""The robots of the examples: short, and what their pages say of them."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from softgym_envs.backends import make_backend
from softgym_envs.mechanics import Statics
from softgym_envs.viewer.surface import cable_radius

FOLDER = Path(__file__).parents[1] / "examples" / "robots"
ROBOTS = {"pneunet": "PneuNet", "valve_bender": "ValveBender", "finray": "FinRay", "tendon_arm": "TendonArm"}


@pytest.fixture
def made(monkeypatch):
    """Function that returns a robot by the name of its file."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return lambda name: getattr(importlib.import_module(name), ROBOTS[name])()


@pytest.mark.parametrize("name", ROBOTS)
def test_at_most_45_lines(name):
    lines = (FOLDER / f"{name}.py").read_text().splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 45


def test_chambers_of_the_bender_mirror_each_other(made):
    """Equal volumes bend it in its plane of symmetry, one of them sideways."""
    statics = Statics(made("pneunet").build())
    both = statics.solve([1e-6, 1e-6, 0.0])
    assert both.effort[0] == pytest.approx(both.effort[1], rel=0.05) and both.effort[0] > 0.0
    assert abs(both.condensed.delta.e[0]) < 1e-4 and both.condensed.delta.e[1] < -5e-4
    left = statics.solve([2e-6, 0.0, 0.0])
    assert left.condensed.delta.e[0] > 5e-4


def test_valves_fill_the_chambers_as_syringes_do(made):
    """The bender on valves is at the equilibrium of the volumes that its pressures pump."""
    valves, syringes = (make_backend("fem", made(name)) for name in ("valve_bender", "pneunet"))
    found = valves.step(np.array([4e3, 2e3, 0.002]))
    np.testing.assert_allclose(found.effort[:2], [4e3, 2e3])
    assert found.displacement[2] == pytest.approx(0.002) and (found.displacement[:2] > 1e-8).all()
    twin = syringes.step(found.displacement)
    np.testing.assert_allclose(twin.effector, found.effector, atol=1e-7)
    np.testing.assert_allclose(twin.effort, found.effort, rtol=1e-4)
    with pytest.raises(ValueError, match="all commanded in effort or all in displacement"):
        make_backend("surrogate", made("valve_bender"))


def test_the_rod_holds_the_finger_back(made):
    """The finger closes freely by 0.8 mm and then presses on the rod."""
    robot = made("finray")
    free = robot.build()
    free.contact = None
    tips = []
    for model in (free, robot.build()):
        statics = Statics(model)
        statics.solve([0.001])
        tips.append(statics.solve([0.0025]))
    assert tips[1].effort[0] != pytest.approx(tips[0].effort[0], rel=1e-3)
    assert tips[1].condensed.delta.e[0] != pytest.approx(tips[0].condensed.delta.e[0], abs=1e-4)


def test_balanced_tendons_bend_the_arm_with_moderate_tensions(made):
    robot = made("tendon_arm")
    statics = Statics(robot.build())
    rest = statics.solve(np.zeros(6))
    for command in robot.displacements(np.random.default_rng(0).random((6, 6))):
        statics.restore(rest.x, rest.effort)
        state = statics.solve(command)
        assert state.effort[:6].max() < 100.0
        assert np.linalg.norm(state.condensed.delta.e - robot.effector_rest) > 0.01


def test_tendons_do_not_hide_the_rod_in_pictures(made):
    assert cable_radius(made("tendon_arm").build(), 0.0027) == pytest.approx(0.001, rel=1e-6)  # an eighth of 8 mm
    assert cable_radius(made("pneunet").build(), 0.0007) == 0.0007  # one tendon

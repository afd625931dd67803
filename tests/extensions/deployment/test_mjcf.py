"""The chain of rigid links that MuJoCo gets bends as finite elements do."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable, make_robot
from softgym_envs.extensions.deployment.mjcf import chain_of, export_mjcf
from softgym_envs.mechanics import MechanicalModel, Statics
from softgym_envs.robots import Actuator, Robot
from tests.helpers import box_mesh

mujoco = pytest.importorskip("mujoco")


class Strip(Robot):
    """Beam of 80 x 10 x 8 mm along x, with a cable 3 mm above its axis."""

    name, effectors, size = "strip", ("tip",), 0.08
    design_space = DesignSpace(DesignVariable("young_modulus", 5e5, 2e6, 1e6, "Pa", "stiffness"))
    actuators = (Actuator("cable", low=0.0, high=0.004, rate=0.0005),)
    effector_rest, effort_scale = np.array([0.08, 0.005, 0.004]), np.array([1.0])

    def assemble(self, design):
        nodes, tetrahedra = box_mesh((0.08, 0.010, 0.008), (16, 2, 2))
        model = MechanicalModel.from_mesh(
            nodes, tetrahedra, fixed=nodes[:, 0] < 1e-9, element="quadratic", poisson_ratio=0.3, **design
        )
        guides = np.column_stack([np.linspace(0.0, 0.08, 17), np.full(17, 0.005), np.full(17, 0.007)])
        model.add_cable("cable", guides, pull_point=[-0.001, 0.005, 0.007])
        model.add_effector("tip", [0.08, 0.005, 0.004])
        return model


@pytest.fixture(scope="module")
def strip():
    return chain_of(Strip(), joints=8)


def test_joints_have_the_compliance_of_a_beam(strip):
    compliance = sum(1.0 / joint.stiffness for joint in strip.joints)  # about z, y and x, the softest last
    bending = 0.08 / (1e6 * np.array([0.008 * 0.010**3, 0.010 * 0.008**3]) / 12.0)
    assert compliance[:2] == pytest.approx(bending, rel=0.02)  # the clamp holds the shape of its section
    # Saint-Venant's torsion of a rectangle; here the clamp also holds the warping of its section.
    torsion = 0.08 / (1e6 / 2.6 * 0.010 * 0.008**3 * (1.0 / 3.0 - 0.21 * 0.8 * (1.0 - 0.8**4 / 12.0)))
    assert compliance[2] == pytest.approx(torsion, rel=0.05)
    assert sum(link.mass for link in strip.links) == pytest.approx(1100.0 * 0.08 * 0.010 * 0.008, rel=1e-9)
    axial = sum(1.0 / joint.axial for joint in strip.joints)
    assert axial == pytest.approx(0.08 / (1e6 * 0.010 * 0.008), rel=0.03)


def settle(path, robot, tension, force):
    """Return the effector [m] (3,) in MuJoCo after 12 seconds under tensions and a force at the effector."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = tension
    site = model.site(robot.effectors[0]).id
    mujoco.mj_forward(model, data)
    for _ in range(6000):
        data.qfrc_applied[:] = 0.0
        at, body = data.site_xpos[site], model.site_bodyid[site]
        mujoco.mj_applyFT(model, data, np.array(force), np.zeros(3), at, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-9
    return data.site_xpos[site].copy()


@pytest.mark.parametrize("tension", [(0.0, 0.0), (2.0, 0.0), (5.0, 5.0)])
@pytest.mark.parametrize("force", [(0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, -0.1, 0.2)])
def test_the_finger_bends_as_on_finite_elements(tension, force, tmp_path):
    robot = make_robot("finger")
    path = export_mjcf(robot, tmp_path / "finger.xml")
    statics = Statics(robot.build())
    rest = statics.solve(np.zeros(2), "effort").condensed.delta.e[:3]
    wanted = statics.solve(np.array(tension), "effort", effector_force=force).condensed.delta.e[:3]
    assert np.linalg.norm(settle(path, robot, tension, force) - wanted) < 0.05 * np.linalg.norm(wanted - rest)


def test_the_chain_can_be_mounted_on_an_arm(tmp_path):
    path = export_mjcf(Strip(), tmp_path / "strip.xml", joints=4)
    arm = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body name="arm"><joint name="shoulder" type="hinge" axis="0 0 1"/>'
        '<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01"/><site name="flange" pos="0.2 0 0"/></body>'
        "</worldbody></mujoco>"
    )
    arm.attach(mujoco.MjSpec.from_file(str(path)), site=arm.site("flange"), prefix="tool/")
    model = arm.compile()
    assert model.njnt == 1 + 4 * 4 and model.nu == 1


@pytest.mark.parametrize(
    "name, joints, message",
    [("trunk", 9, "made of one solid"), ("three_finger_gripper", 9, "parts"), ("finger", 0, "allowed: 1 to")],
)
def test_other_robots_are_refused(name, joints, message):
    with pytest.raises(ValueError, match=message):
        chain_of(make_robot(name), joints=joints)


def test_the_verb_writes_it(softgym, tmp_path):
    status, out, _ = softgym("export", "finger", tmp_path / "finger.xml", "--joints", "3")
    assert status == 0 and out == f"wrote {tmp_path / 'finger.xml'} (metres)\n"
    status, _, error = softgym("export", "finger", tmp_path / "finger.xml", "--joints", "99")
    assert status == 2 and "joints = 99 is out of bounds" in error

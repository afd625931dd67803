"""The examination of a robot finds the faults that its robot has, and none in a sound one."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.extensions.checks.checkup import check_robot, wall_layers
from softgym_envs.mechanics import MechanicalModel, Plane
from softgym_envs.robots import Actuator, Robot
from tests.helpers import box_mesh


class Beam(Robot):
    """Bar of 60 mm with two antagonistic cables, of quadratic elements."""

    name, effectors, size = "bar", ("tip",), 0.06
    design_space = DesignSpace(DesignVariable("young_modulus", 2e5, 1e6, 5e5, "Pa", "stiffness"))
    actuators = tuple(Actuator(name, low=0.0, high=0.003, rate=0.0005) for name in ("upper", "lower"))
    effector_rest, effort_scale = np.array([0.06, 0.005, 0.01]), np.full(2, 2.0)
    element = "quadratic"

    def assemble(self, design):
        nodes, tetrahedra = box_mesh((0.06, 0.01, 0.02), (6, 1, 2))
        model = MechanicalModel.from_mesh(
            nodes,
            tetrahedra,
            fixed=nodes[:, 0] < 1e-6,
            element=self.element,
            young_modulus=self.modulus(design),
            poisson_ratio=0.4,
        )
        for cable, z in (("upper", 0.018), ("lower", 0.002)):
            model.add_cable(cable, np.linspace([0.005, 0.005, z], [0.055, 0.005, z], 6), pull_point=[0.0, 0.005, z])
        model.add_effector("tip", [0.06, 0.005, 0.01])
        return model

    def modulus(self, design):
        return design["young_modulus"]


class Deaf(Beam):
    def modulus(self, design):
        return 5e5


class Elsewhere(Beam):
    effector_rest = np.array([0.055, 0.005, 0.01])


class Feeble(Beam):
    effort_scale = np.full(2, 1e-3)


class Slack(Beam):
    effort_scale = np.full(2, 1e5)


class Touching(Beam):
    def __init__(self):
        super().__init__(contact_distance=1e-3)

    def own_obstacles(self, model, design):
        return [Plane((0.0, 0.0, -0.01), (0.0, 0.0, 1.0))]


class Limited(Beam):
    actuators = tuple(Actuator(name, low=0.0, high=0.003, rate=0.0005, max_effort=1e-3) for name in ("upper", "lower"))


class Narrow(Beam):
    def modulus(self, design):
        if 2e5 < design["young_modulus"] < 9.9e5 and design["young_modulus"] != 5e5:
            raise InfeasibleDesign("only the ends can be made")
        return design["young_modulus"]


def examine(cls):
    return list(check_robot(cls(), bodies=2, commands=4))


def test_a_sound_robot_has_no_fault():
    findings = examine(Beam)
    notes = {finding.subject: finding.text for finding in findings if finding.verdict != "good"}
    assert set(notes) - {"film"} == {"STEP", "moulds"}, findings  # it is no drawing
    assert "no exact shape for STEP" in notes["STEP"] and "allowed: robots that draw their body" in notes["moulds"]
    inside = [finding.text for finding in findings if "inside the box" in finding.text]
    assert inside == ["2 of 2 bodies drawn inside the box can be built and held"]
    subjects = {finding.subject for finding in findings}
    assert {"baseline", "effector", "walls", "actuators", "commands", "efforts", "design box", "surrogate"} <= subjects


@pytest.mark.parametrize(
    "cls, subject, verdict, words",
    [
        (Deaf, "variable 'young_modulus'", "fault", "does not read it"),
        (Elsewhere, "effector", "note", "set it to [0.06, 0.005, 0.01] m"),
        (Feeble, "efforts", "note", "effort_scale (0.001) is too small"),
        (Slack, "actuators", "fault", "nothing holds it"),
        (Touching, "contact", "note", "up to 1 mm outside of the body, 10% of its thinnest wall"),
        (Limited, "surrogate", "note", "beyond max_effort"),
        (Narrow, "design box", "fault", "of 2 bodies drawn inside the box can be built and held; young_modulus ="),
        (Limited, "efforts", "note", "beyond max_effort = 0.001 N"),
    ],
)
def test_a_fault_is_found_with_its_remedy(cls, subject, verdict, words):
    found = [finding for finding in examine(cls) if finding.subject == subject and finding.verdict == verdict]
    assert any(words in f"{finding.text} {finding.remedy}" for finding in found), found


@pytest.mark.parametrize("label", ["bodies", "commands"])
def test_examining_nothing_is_refused(label):
    with pytest.raises(ValueError, match=f"{label} = 0 must be 1 or more"):
        next(check_robot(Beam(), **{label: 0}))


@pytest.mark.parametrize("layers", [1, 3])
def test_thickness_and_layers_of_a_plate(layers):
    nodes, tetrahedra = box_mesh((0.06, 0.06, 0.005 * layers), (12, 12, layers))
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=nodes[:, 0] < 1e-6, element="quadratic", young_modulus=1e6, poisson_ratio=0.3
    )
    thickness, across = wall_layers(model.nodes, model.solids[0])
    assert thickness == pytest.approx(0.005 * layers)
    assert across == pytest.approx(layers)


def test_the_verb_ends_with_status_one_for_a_fault(softgym, tmp_path, monkeypatch):
    (tmp_path / "deaf_robot.py").write_text("from tests.extensions.checks.test_checkup import Deaf\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    status, out, error = softgym("check", "deaf_robot:Deaf", "--bodies", "1", "--commands", "2", "--quiet")
    assert status == 1 and "FAULT  variable 'young_modulus'" in out and error == ""

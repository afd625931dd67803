"""Grasps as objectives: the scene, the mean over objects, and what a search refuses."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.config import load_config
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.design.bodies import StateEvaluator
from softgym_envs.extensions.design.config import OptimiseConfig, SensitivityConfig
from softgym_envs.extensions.grasping.metrics import GraspConfig

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "design"
COARSE = {"mesh_size": 0.04, "control_points": 7}
"""Quick to solve, and good enough to compare a finger with itself."""


@pytest.fixture(scope="module")
def finger():
    return make_robot("contact_aided_finger", **COARSE)


def grasp_of(status="ok", force=1.0, energy=1.0):
    return SimpleNamespace(status=status, reason="why", contact_force=force, grasp_energy=energy)


def test_torque_and_force_are_proportional_to_the_modulus(finger):
    config = GraspConfig(distance=0.004, angle=math.radians(9.0), angles=3)
    one, two = (config.evaluate(finger, {"young_modulus": modulus}) for modulus in (2e6, 4e6))
    assert one.contact_force > 0.02
    assert two.force == pytest.approx(2.0 * one.force, rel=1e-4, abs=1e-6)
    assert two.torque == pytest.approx(2.0 * one.torque, rel=1e-4)


def test_scene_of_a_grasp(finger, monkeypatch):
    seen = []

    def record(robot, design, target, **options):
        seen.append((target, options))
        return grasp_of()

    monkeypatch.setattr("softgym_envs.extensions.grasping.metrics.evaluate_grasp", record)
    GraspConfig(kind="sphere", distance=0.02, height=0.07, size=0.04, friction=0.3, angles=7).evaluate(finger, {})
    (target, options) = seen[0]
    assert (target.kind, target.distance, target.height, target.size, target.friction) == (
        "sphere",
        0.02,
        0.07,
        0.04,
        0.3,
    )
    assert options == {"angle": math.radians(30.0), "angles": 7, "self_friction": 0.85}


@pytest.mark.parametrize(("status", "error"), [("infeasible", InfeasibleDesign), ("no equilibrium", ConvergenceError)])
def test_failed_grasps_are_infeasible_evaluations(finger, monkeypatch, status, error):
    monkeypatch.setattr("softgym_envs.extensions.grasping.metrics.evaluate_grasp", lambda *a, **b: grasp_of(status))
    with pytest.raises(error, match="why"):
        GraspConfig().evaluate(finger, {})
    found = StateEvaluator(finger, ["grip_force"])(finger.design_space.baseline)
    assert not found.feasible and found.reason == "why"


def test_metrics_are_means_over_grasps(finger, monkeypatch):
    forces = {0.3: 1.0, 0.85: 3.0}
    monkeypatch.setattr(GraspConfig, "evaluate", lambda self, robot, design: grasp_of(force=forces[self.friction]))
    grasps = [{"friction": friction} for friction in forces]
    evaluator = StateEvaluator(finger, ["grip_force", "grip_energy"], sources={"grasps": grasps})
    assert evaluator.measure(finger.design_space.baseline) == {"grip_force": 2.0, "grip_energy": 1.0}


def test_what_cannot_grasp_is_refused(finger):
    with pytest.raises(ConfigError, match=r"'grip_force' needs robot 'contact_aided_finger', got 'finger'"):
        StateEvaluator(make_robot("finger"), ["grip_force"])
    with pytest.raises(ConfigError, match=r"'grip_energy' needs backend 'fem', got 'surrogate'"):
        StateEvaluator(finger, ["grip_energy"], backend="surrogate")


@pytest.mark.parametrize("name", ["front", "robust"])
def test_searches_of_the_thesis(name):
    config = load_config(CONFIGS / f"contact_aided_finger_{name}.yaml", OptimiseConfig)
    assert config.metrics == ("grip_force", "grip_energy", "grip_resistance")
    assert len(config.bodies.box()) == 15
    assert config.solver.starts[1]["e1"] == 0.01443


def test_sensitivity_around_design_b():
    config = load_config(CONFIGS / "contact_aided_finger_sensitivity.yaml", SensitivityConfig)
    box = config.bodies.box()
    assert np.all(np.abs(box.unit(box.reference)) <= 1.0)
    assert box.reference["d6"] == 0.0087

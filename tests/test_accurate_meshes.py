"""Judges of studies on accurate meshes, on a mesh that is quick."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import accurate_meshes
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.codesign.records import TrialResult

POLICY = "diamond_reach_designs"


@pytest.fixture(scope="module")
def diamond():
    shown = ["leg_width", "top_height", "elbow_height", "elbow_radius"]
    return EnvironmentConfig(id="SoftGym/DiamondReach-v0", design_in_observation=shown)


@pytest.fixture(scope="module")
def on_weights(diamond):
    """Body, goals, and commands and distances at the ends of the episodes of a policy on the surrogate."""
    design = dict(diamond.make_robot().design_space.baseline)
    goals = np.array([[0.01, 0.005, 0.130], [-0.006, 0.012, 0.134]])
    trial = TrialResult(0, "baseline", "", design)
    return design, goals, *accurate_meshes._on_weights(diamond, trial, POLICY, goals)


def test_ends_on_weights_are_those_of_an_evaluation(diamond, on_weights):
    design, goals, commands, distances = on_weights
    found = evaluate(POLICY, diamond, goals, design=design)
    assert distances == pytest.approx(found.distances, abs=2e-6)
    assert commands.shape == (2, 4)


def test_a_policy_ends_where_its_whole_episode_on_finite_elements_does(diamond, on_weights):
    design, goals, commands, _ = on_weights
    fem = diamond.on("fem")
    found = accurate_meshes._followed(POLICY, fem, design, goals, commands)
    whole = evaluate(POLICY, fem, goals, design=design)
    assert found["distance [mm]"] == pytest.approx(1e3 * whole.distances, abs=0.02)
    assert max(found["last motion [mm]"]) < 0.05
    assert found["equilibria"] == len(goals) * accurate_meshes.LAST_STEPS


def test_the_inverse_qp_settles_at_least_as_near(diamond, on_weights):
    design, goals, commands, _ = on_weights
    fem = diamond.on("fem")
    settled = accurate_meshes._settled(fem, design, goals, commands)
    followed = accurate_meshes._followed(POLICY, fem, design, goals, commands)
    assert (np.array(settled["distance [mm]"]) <= np.array(followed["distance [mm]"]) + 0.02).all()


def test_a_command_without_equilibrium_is_no_number(diamond, on_weights, monkeypatch):
    design, goals, commands, _ = on_weights
    fem = diamond.on("fem").make(sample_design=False).unwrapped.backend

    def lost(self, command, *args, **options):
        raise accurate_meshes.ConvergenceError("no equilibrium", fraction=0.0)

    monkeypatch.setattr(type(fem), "step", lost)
    found = accurate_meshes._followed(POLICY, diamond.on("fem"), design, goals, commands)
    assert np.isnan(found["distance [mm]"]).all() and found["equilibria"] == 0


def test_the_rest_of_the_error_is_extrapolated_to_elements_of_size_zero(monkeypatch):
    changes = {"accurate": np.full(3, -2.0), "refined": np.full(3, -1.7)}
    coarse, fine = (accurate_meshes.ROBOTS["finger"].meshes[mesh][0] for mesh in ("accurate", "refined"))
    left = accurate_meshes.remaining("finger", lambda mesh, count: changes[mesh])
    # A change that is linear in the size of the elements.
    assert -2.0 + left == pytest.approx(-1.7 + 0.3 * fine / (coarse - fine))
    unknowns = {"baseline: accurate: unknowns": 1000, "baseline: refined: unknowns": 8000}
    monkeypatch.setattr(accurate_meshes, "results", lambda name: unknowns)
    assert accurate_meshes.remaining("diamond", lambda mesh, count: changes[mesh]) == pytest.approx(0.6)

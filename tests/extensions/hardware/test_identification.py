"""What a policy did on the bench identifies the drives of the robot."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from softgym_envs.agents.policy import Policy
from softgym_envs.envs.plant import Plant
from softgym_envs.extensions.design import CalibrationConfig, calibrate
from softgym_envs.extensions.hardware.emulation import Losses

COLUMNS = ["cable_1_displacement", "cable_2_displacement"]


def test_the_log_of_a_policy_gives_back_gain_and_backlash(make_bench, tmp_path):
    """On finite elements with noise of 0.1 mm, lost and damaged packets, two goals and the ways home."""
    plant = Plant(gain=0.85, backlash=0.001, noise=0.1e-3 / 0.12)
    moved = make_bench(backend="fem", plant=plant, losses=Losses(lost=0.01, damaged=0.01, seed=2), late=2e-4)
    moved.bench.slow = 1.0
    log = tmp_path / "log.csv"
    env = gymnasium.make(
        "SoftGym/FingerReach-v0", backend="hardware", backend_options={"bench": moved.bench, "log": str(log)}
    )
    policy = Policy("finger_reach")
    for seed in (0, 4):
        seen, _ = env.reset(seed=seed)
        for _ in range(25):
            seen, *_ = env.step(policy(seen))
    env.reset()
    assert env.unwrapped.backend.timing.lost > 0
    env.unwrapped.backend.close()
    config = CalibrationConfig(
        name="bench",
        robot="finger",
        backend="fem",
        fit=["length"],
        data=str(log),
        intervals="linear",
        nuisances={
            "gain": {"kind": "gain", "columns": COLUMNS, "bounds": [0.7, 1.3], "unit": "1"},
            "play": {"kind": "backlash", "columns": COLUMNS, "bounds": [0.0, 0.003], "unit": "m"},
        },
    )
    found = calibrate(config)
    assert found.nuisances["gain"] == pytest.approx(plant.gain, abs=0.01)
    assert found.nuisances["play"] == pytest.approx(plant.backlash, abs=1e-4)
    assert found.design["length"] == pytest.approx(0.04, abs=1e-4)
    assert found.errors["effector"] < 0.15e-3
    assert np.isfinite(list(found.plant["gain"].values())).all()

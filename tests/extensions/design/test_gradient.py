"""Optimisation along gradients: descents end at optima of the box."""

import json

import numpy as np
import pytest

from softgym_envs.config import check_config
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.design.config import OptimiseConfig
from softgym_envs.extensions.design.gradient import WeightedCost, descend, optimise

BODIES = {
    "robot": "finger",
    "robot_options": {"cables": 1},
    "variables": ["length", "height", "joint_height"],
    "actuation": [0.01],
}


def configured(*objectives, **solver):
    data = {"name": "x", "bodies": BODIES, "objectives": list(objectives), "solver": {"method": "gradient", **solver}}
    return check_config(OptimiseConfig, data, "test")


def cost_of(config):
    return WeightedCost(config.objectives, config.bodies.learned(config.metrics), config.bodies.box(), 600)


def test_every_corner_leads_to_the_dexterity_optimum():
    config = configured({"metric": "bending_angle"})
    cost = cost_of(config)
    ends = [descend(cost, corner) for corner in cost.box.corners()]
    assert all(end.projected_gradient < 1e-5 for end in ends)
    best = min(end.cost for end in ends)
    assert max(end.cost for end in ends) - best < 1e-6
    dense = WeightedCost(config.objectives, cost.metrics, cost.box, 8000)
    value = float(cost.metrics(cost.box.values(_tensor(cost.box.unit(ends[0].end))))[0, 0])
    assert value >= dense.values.max() - 1e-9


def test_several_starts_find_several_local_optima():
    config = configured({"metric": "normal_force"})
    cost = cost_of(config)
    ends = np.array([descend(cost, corner).cost for corner in cost.box.corners()])
    assert ends.max() - ends.min() > 0.1 and ends.min() == pytest.approx(cost.costs.min(), abs=1e-6)


def test_target_and_weights(tmp_path):
    """An unreachable target (eq. 4.15) ranks bodies as its maximum does; weights move the optimum along the front."""
    by_target = optimise(configured({"metric": "bending_angle", "goal": 1.57}, check=False))
    by_goal = optimise(configured({"metric": "bending_angle", "goal": "maximize"}, check=False))
    for name in BODIES["variables"]:
        assert by_target.best.design[name] == pytest.approx(by_goal.best.design[name], abs=1e-6)
    found = []
    for weight in (0.1, 0.9):
        config = configured(
            {"metric": "bending_angle", "weight": weight},
            {"metric": "contact_force", "weight": 1 - weight},
            check=False,
        )
        found.append(optimise(config, tmp_path / str(weight)).best.surrogate)
    assert found[0]["contact_force"] > found[1]["contact_force"] + 0.5
    assert found[0]["bending_angle"] < found[1]["bending_angle"] - 0.001
    kept = json.loads((tmp_path / "0.9" / "result.json").read_text())
    assert kept["best"]["surrogate"] == found[1] and len(kept["descents"]) == 8
    assert (tmp_path / "0.9" / "descents.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="holds an optimisation with objectives"):
        optimise(config, tmp_path / "0.1")
    assert optimise(config, tmp_path / "0.9").best.surrogate == found[1]


def test_the_best_is_checked_on_fem():
    best = optimise(configured({"metric": "bending_angle"}, starts="grid", count=1)).best
    assert best.fem["bending_angle"] == pytest.approx(best.surrogate["bending_angle"], rel=0.005)


def test_wrong_configurations():
    with pytest.raises(ConfigError, match="needs bodies.backend = 'surrogate'"):
        data = {"bodies": {**BODIES, "backend": "fem"}, "objectives": [{"metric": "travel"}]}
        check_config(OptimiseConfig, {"name": "x", **data, "solver": {"method": "gradient"}}, "test")
    with pytest.raises(ConfigError, match="unknown metric 'beauty'"):
        configured({"metric": "beauty"})
    with pytest.raises(ConfigError, match="named twice"):
        configured({"metric": "travel"}, {"metric": "travel"})


def _tensor(point):
    import torch

    return torch.as_tensor(point[None])

"""Whether a learned Tetrapod would pay: accuracy and speed of a trial model beside the compiled beams.

``softgym bench tetrapod_surrogate`` learns the whole robot like the Diamond (four actuators, one effector; eight
dimensions), with its inertia, and compares one second of motion in open loop and the speed with finite elements. The
models and states are kept in ``results/tetrapod_surrogate``; nothing of it ships.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np

from benchmarks.beams import batch_speeds, environment
from benchmarks.motion import TEST, TRAINING, errors, lifted, lstm, on_surrogate, trajectories
from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.inertia import write_inertia
from softgym_envs.surrogate.inertia_training import fit_inertia
from softgym_envs.surrogate.training import FitConfig, fit

FOLDER, IDENTIFIER = Path("results/tetrapod_surrogate"), "SoftGym/TetrapodReach-v0"
CONFIG = FitConfig.model_validate(
    {
        "robot": "tetrapod",
        "data": {
            "train": {"groups": 300, "states": 12, "sequence": "halton"},
            "validation": {"groups": 30, "states": 12},
            "test": {"groups": 50, "states": 12},
            "groups_per_shard": 100,
        },
        "network": {"kind": "potential", "members": 1, "steps": 2000},
        "workers": 1,
    }
)
BATCH, STEPS = 32, 20


def speeds() -> dict[str, float]:
    """Control steps per CPU second, of one body and of a batch of different ones, in motion."""
    learned = {"backend": "surrogate", "backend_options": {"dynamics": True, "weights": str(FOLDER)}}
    alone = gymnasium.make(IDENTIFIER, max_episode_steps=10**6, disable_env_checker=True, **learned).unwrapped  # type: ignore[arg-type]
    beams = environment(IDENTIFIER, compiled=True)
    together = gymnasium.make_vec(IDENTIFIER, BATCH, max_episode_steps=10**6, sample_design=True, **learned)  # type: ignore[arg-type]
    found: dict[str, float] = {}
    for name, env, shape in (("beams", beams, ()), ("learned", alone, ()), ("learned, batched", together, (BATCH,))):
        env.reset(seed=0)
        rng, taken = np.random.default_rng(0), []
        for step in range(3 * STEPS):
            action = rng.uniform(-1.0, 1.0, (*shape, 4)).astype(np.float32)
            began = time.process_time()
            env.step(action)
            if step >= STEPS:  # the first ones compile
                taken.append(time.process_time() - began)
        found[f"{name} [steps/s]"] = (shape[0] if shape else 1) / float(np.mean(taken))
        env.close()
    return found | {"beams, batched [steps/s]": float(np.median(batch_speeds(IDENTIFIER, BATCH)))}


def tetrapod_surrogate() -> dict[str, object]:
    """Errors of the learned Tetrapod in statics and in motion, beside learned baselines, and its speed."""
    robot, result = make_robot("tetrapod"), {}
    static = fit(CONFIG, FOLDER, FOLDER / "data", progress=False)
    result |= {
        "statics: effector error, mean [mm]": 1e3 * static["effector_mean"],
        "statics: effector error, 99 % [mm]": 1e3 * static["effector_p99"],
        "statics: effector error, worst [mm]": 1e3 * static["effector_worst"],
        "statics: torque error, mean [% of largest]": 100 * static["effort_mean"],
    }
    inertia = fit_inertia(robot, bodies=256, states=4, degree=2)
    write_inertia(inertia, FOLDER)
    for kind in ("mean", "largest"):
        result[f"frequency error, {kind} [%]"] = 100 * float(inertia.card[f"{kind}_frequency_error"])
    data = trajectories(robot, FOLDER / "motion", workers=1)
    train, test = data.rows(0, TRAINING), data.rows(TRAINING, TRAINING + TEST)
    models = {
        "learned inertia": on_surrogate(robot, test, dynamics=True, weights=FOLDER)[0],
        "surrogate in equilibrium": on_surrogate(robot, test, dynamics=False, weights=FOLDER)[0],
        "LSTM": lstm(robot, train, test),
        "lifted linear model": lifted(robot, train, test),
    }
    for name, places in models.items():
        error = 100.0 * errors(test, places)
        result[f"{name}: error in open loop, mean [%]"] = float(error.mean())
        result[f"{name}: error in open loop, largest [%]"] = float(error.max())
    return result | speeds()


MODELS = ("learned inertia", "surrogate in equilibrium", "LSTM", "lifted linear model")


def motion_table() -> str:
    """Mean and largest error of each model in open loop."""
    found = results("tetrapod_surrogate")
    keys = [(model, kind) for model in MODELS for kind in ("mean", "largest")]
    values = {key: f"{found[f'{key[0]}: error in open loop, {key[1]} [%]']:.1f}" for key in keys}
    rows = [[model, values[model, "mean"], values[model, "largest"]] for model in MODELS]
    return markdown(["error in open loop [%]", "mean", "largest"], rows, "lrr")


TABLES = {"tetrapod_surrogate": motion_table}
"""Tables of pages by name."""

if __name__ == "__main__":
    json.dump(tetrapod_surrogate(), sys.stdout, indent=2)

"""Which learner judges decides which whip wins? Bodies of the whip under common throws and under their own.

    python studies/whip_throw/throw.py results/whip_throw

Eleven bodies that spread over the design box, and the baseline. Judges: the common throw; the throw of the baseline; a
throw by CMA-ES of six numbers (swings, their phase and growth, strokes of both segments, a shift) with 80 motions; a
throw along gradients from the common one (60 gradients). Ranges are means of six episodes with payloads of 15 to 25 g.
Everything is kept in the folder; a second call resumes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA
from scipy.stats import kendalltau, qmc

from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.training import train
from softgym_envs.robots.registry import make_robot
from softgym_envs.runs import provenance
from softgym_envs.storage import read_json, write_json

ID = "SoftGym/WhipThrow-v0"
GOALS = np.tile([0.5, 0.0, -0.6], (6, 1))
BODIES, STEPS, ROLLOUTS, THROW = 11, 1800, 80, 30
GAIT = {"period": THROW, "periods": 1, "learning_rate": 0.2, "excess": 5.0}
OTHERS: tuple[dict[str, Any], ...] = (
    {"robot_options": {"elements": 4}},
    {"backend_options": {"time_step": 0.001}},
    {"task_options": {"payload": [0.03, 0.04]}, "robot_options": {"payload": 0.035}},
)
"""A finer mesh, shorter time steps, heavier payloads."""


def environment(design: dict[str, float], **options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=ID, design=design, **options)


def reach(agent: str | Path, design: dict[str, float], **options: Any) -> float:
    """Mean range of six throws [m]."""
    return float(evaluate(agent, environment(design, **options), GOALS).tallies["range"].mean())


def gait(folder: Path, design: dict[str, float], seed: int = 0, **options: Any) -> tuple[Path, float]:
    """Policy of a throw along gradients, and its CPU time [s]."""
    config = TrainConfig(
        environment=environment(design, **options), learner="gait", steps=STEPS, report_every=STEPS,
        evaluation_episodes=1, num_envs=1, seed=seed, gait=GAIT,
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return path, float(read_json(path.with_suffix(".json"))["cpu_seconds"])


def swings(numbers: np.ndarray) -> np.ndarray:
    """Commands (30, 4) of a throw of six numbers, each about 1 in size."""
    rhythm, phase, growth, first, second, shift = numbers
    time_left = np.arange(THROW, dtype=float)[::-1] / THROW
    angle = 2.0 * np.pi * 2.0 * np.exp(0.3 * rhythm) * time_left + phase
    size = 3e-8 * np.exp(growth * (0.5 - time_left)) * (1.0 - time_left**8)
    strokes = [np.exp(0.7 * first) * np.sin(angle), np.exp(0.7 * second) * np.sin(angle + shift)]
    return np.concatenate([np.stack([-size * stroke, size * stroke], axis=1) for stroke in strokes], axis=1)


def evolve(design: dict[str, float], seed: int = 0) -> tuple[float, float]:
    """Mean range [m] of the best throw that CMA-ES finds, and its CPU time [s]."""
    env: Any = environment(design).make().unwrapped

    def thrown(numbers: np.ndarray, seed: int) -> float:
        env.reset(seed=seed)
        for command in swings(numbers):
            *_, info = env.step(env.spaces.action(command, env.command))
        return float(info["range"])

    search = CMA(mean=np.zeros(6), sigma=0.5, population_size=8, seed=seed)
    best, cpu = -np.inf, time.process_time()
    for generation in range(ROLLOUTS // search.population_size):
        scored = []
        for _ in range(search.population_size):
            numbers = search.ask()
            scored.append((numbers, -thrown(numbers, generation)))
        search.tell(scored)
        numbers, value = min(scored, key=lambda pair: pair[1])
        if -value > best:
            best, kept = -value, numbers
    cpu = time.process_time() - cpu
    found = float(np.mean([thrown(kept, 100 + seed) for seed in range(len(GOALS))]))
    env.close()
    return found, cpu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "bodies.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance(), "bodies": []}
    space = make_robot("whip").design_space
    units = 2.0 * qmc.Sobol(len(space), seed=0).random(16)[:BODIES] - 1.0
    designs = [dict(space.baseline), *(dict(space.from_unit(unit)) for unit in units)]
    for number, design in enumerate(designs):
        if number < len(data["bodies"]):
            continue
        policy, cpu = gait(folder / f"body_{number}", design)
        row = {"design": design, "common": reach("gait", design), "gradients": reach(policy, design), "cpu": cpu}
        data["bodies"].append(row)
        write_json(place, data)
        print(number, row["common"], row["gradients"], cpu, flush=True)
    for row, design in zip(data["bodies"], designs, strict=True):
        if "baseline_throw" not in row:
            row["baseline_throw"] = reach(folder / "body_0" / "policy.safetensors", design)
            write_json(place, data)
    for row, design in zip(data["bodies"], designs, strict=True):
        if "evolution" not in row:
            row["evolution"], row["evolution_cpu"] = evolve(design)
            write_json(place, data)
            print("cma", row["evolution"], row["evolution_cpu"], flush=True)
    judged = {name: [row[name] for row in data["bodies"]] for name in ("common", "baseline_throw", "evolution", "gradients")}
    data["tau"] = {name: float(kendalltau(values, judged["gradients"])[0]) for name, values in judged.items()}
    data["winners"] = {name: int(np.argmax(values)) for name, values in judged.items()}
    order = [int(k) for k in np.argsort(judged["gradients"])[::-1]]
    shown = list(dict.fromkeys([0, *data["winners"].values(), *order[:2], *order[-2:]]))
    if "table" not in data:
        paths = {k: folder / f"body_{k}" / "policy.safetensors" for k in shown}
        data["table"] = {"bodies": shown, "ranges": [[reach(paths[g], designs[b]) for b in shown] for g in shown]}
    write_json(place, data)


if __name__ == "__main__":
    main()

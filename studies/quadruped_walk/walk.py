"""Which learner judges decides which walker wins? Bodies of the quadruped under a common gait and under their own.

    python studies/quadruped_walk/walk.py results/quadruped_walk

Eleven bodies that spread over the design box, and the baseline. Judges: the common gait; a gait by CMA-ES of five numbers
(amplitudes of swing and stretch, their phase, frequency, a lean) with 56 motions; a gait along gradients from the common
one (20 gradients). Speeds are those of the second half of 5 s. Everything is kept in the folder; a second call resumes.
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

ID = "SoftGym/QuadrupedWalk-v0"
GOAL = np.array([[0.04, 0.0, 0.0]])
BODIES, STEPS, ROLLOUTS = 11, 600, 56
OTHERS = ({"elements": 8}, {"friction": 0.4}, {"friction": 1.2})
"""A finer mesh, and other grounds."""


def environment(design: dict[str, float], **robot_options: Any) -> EnvironmentConfig:
    return EnvironmentConfig(id=ID, design=design, robot_options=robot_options)


def speed(agent: str | Path, design: dict[str, float], **robot_options: Any) -> dict[str, float]:
    """Tallies of an episode [mm/s, mW]."""
    found = evaluate(agent, environment(design, **robot_options), GOAL)
    return {name: 1e3 * float(values[0]) for name, values in found.tallies.items()}


def gait(folder: Path, design: dict[str, float], seed: int = 0, **robot_options: Any) -> tuple[Path, float]:
    """Policy of a gait along gradients, and its CPU time [s]."""
    config = TrainConfig(
        environment=environment(design, **robot_options), learner="gait", steps=STEPS, report_every=STEPS,
        evaluation_episodes=1, num_envs=1, seed=seed,
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return path, float(read_json(path.with_suffix(".json"))["cpu_seconds"])


def sine(numbers: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Commands (k, 8) of a trot of five numbers, each about 1 in size, at times [s] (k,)."""
    swing, stretch, phase, rhythm, lean = numbers
    angle = 2.0 * np.pi * 2.0 * np.exp(0.5 * rhythm) * times[:, None] + np.pi * np.array([0.0, 1.0, 1.0, 0.0])
    bend = 2e-8 * (1.0 + swing) * np.sin(angle) + 1e-8 * lean
    longer = 1e-8 * (1.0 + stretch) * (1.0 + np.cos(angle + phase))
    return np.stack([longer - bend, longer + bend], axis=2).reshape(len(times), 8)


def evolve(design: dict[str, float], seed: int = 0) -> tuple[float, float]:
    """Speed [mm/s] of the best sine that CMA-ES finds, and its CPU time [s]."""
    env: Any = environment(design).make().unwrapped
    search = CMA(mean=np.zeros(5), sigma=0.5, population_size=8, seed=seed)
    best, cpu = -np.inf, time.process_time()
    for _ in range(ROLLOUTS // search.population_size):
        scored = []
        for _ in range(search.population_size):
            numbers = search.ask()
            env.reset(seed=0)
            for k in range(50):
                command = sine(numbers, 0.05 * np.array([k + 1.0]))[0]
                *_, info = env.step(env.spaces.action(command, env.command))
            scored.append((numbers, -float(info["effector"][0])))
        search.tell(scored)
        numbers, value = min(scored, key=lambda pair: pair[1])
        if -value > best:
            best, kept = -value, numbers
    cpu = time.process_time() - cpu
    env.reset(seed=0)
    for k in range(100):
        command = sine(kept, 0.05 * np.array([k + 1.0]))[0]
        *_, info = env.step(env.spaces.action(command, env.command))
    env.close()
    return 1e3 * float(info["speed"]), cpu


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "results.json"
    data: dict[str, Any] = read_json(place) if place.exists() else {"provenance": provenance(), "bodies": []}
    space = make_robot("quadruped").design_space
    units = 2.0 * qmc.Sobol(len(space), seed=0).random(16)[:BODIES] - 1.0
    designs = [dict(space.baseline), *(dict(space.from_unit(unit)) for unit in units)]
    for number, design in enumerate(designs):
        if number < len(data["bodies"]):
            continue
        policy, cpu = gait(folder / f"body_{number}", design)
        row = {"design": design, "common": speed("gait", design), "gradients": speed(policy, design), "cpu": cpu}
        data["bodies"].append(row)
        write_json(place, data)
        print(number, row["common"]["speed"], row["gradients"]["speed"], cpu, flush=True)
    common, own = ([row[judge]["speed"] for row in data["bodies"]] for judge in ("common", "gradients"))
    data["tau"] = list(kendalltau(common, own))
    by_common, winner = int(np.argmax(common)), int(np.argmax(own))
    data["winners"] = {"common": by_common, "gradients": winner}
    order = [int(k) for k in np.argsort(own)[::-1]]
    shown = list(dict.fromkeys([0, winner, by_common, *order[1:3], *order[-2:]]))
    if "table" not in data:
        paths = {k: folder / f"body_{k}" / "policy.safetensors" for k in shown}
        data["table"] = {"bodies": shown, "speeds": [[speed(paths[g], designs[b])["speed"] for b in shown] for g in shown]}
        write_json(place, data)
    data.setdefault("robust", [])
    for body in dict.fromkeys((0, winner, by_common)):
        for options in ({}, *OTHERS):
            for seed in range(1 if options else 3):
                if any(r["body"] == body and r["options"] == options and r["seed"] == seed for r in data["robust"]):
                    continue
                name = f"robust_{body}_{seed}_" + "_".join(f"{k}_{v}" for k, v in options.items())
                policy, _ = gait(folder / name, designs[body], seed, **options)
                found = {"body": body, "options": options, "seed": seed, **speed(policy, designs[body], **options)}
                data["robust"].append(found)
                write_json(place, data)
                print(found, flush=True)
    for row, design in list(zip(data["bodies"], designs, strict=True))[:6]:
        if "evolution" not in row:
            row["evolution"], row["evolution_cpu"] = evolve(design)
            write_json(place, data)
            print("cma", row["evolution"], row["evolution_cpu"], flush=True)
    write_json(place, data)


if __name__ == "__main__":
    main()

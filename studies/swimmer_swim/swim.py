"""Which learner judges decides which swimmer wins? Bodies of the swimmer under common gaits and under their own.

    python studies/swimmer_swim/swim.py results/swimmer_swim

Eleven bodies that spread over the design box, and the baseline. Judges: the common gait; the gait of the baseline; a gait
by CMA-ES of five numbers (amplitude, its growth to the tail, wave length, frequency, a shift) with 56 motions; a gait
along gradients from the common one (20 gradients). Speeds are those of the second half of 5 s. Everything is kept in the
folder; a second call resumes.
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

ID = "SoftGym/SwimmerSwim-v0"
GOAL = np.array([[0.015, 0.0, 0.0]])
BODIES, STEPS, ROLLOUTS = 11, 1200, 56
OTHERS = ({"elements": 3}, {"viscosity": 1.0}, {"viscosity": 10.0})
"""A finer mesh, and other fluids."""


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
        evaluation_episodes=1, num_envs=1, seed=seed, gait={"period": 20},
    )  # fmt: skip
    path = train(config, folder, progress=False)
    return path, float(read_json(path.with_suffix(".json"))["cpu_seconds"])


def wave(numbers: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Commands (k, 8) of a wave of five numbers, each about 1 in size, at times [s] (k,)."""
    size, growth, waves, rhythm, shift = numbers
    place = np.arange(4) / 5.0
    angle = 2.0 * np.pi * (np.exp(0.5 * rhythm) * times[:, None] - np.exp(0.5 * waves) * place) + shift
    bend = 3.5e-8 * (1.0 + size) * (1.0 + growth * (place - 0.3)) * np.sin(angle)
    return np.stack([bend, -bend], axis=2).reshape(len(times), 8)


def evolve(design: dict[str, float], seed: int = 0) -> tuple[float, float]:
    """Speed [mm/s] of the best wave that CMA-ES finds, and its CPU time [s]."""
    env: Any = environment(design).make().unwrapped
    search = CMA(mean=np.zeros(5), sigma=0.5, population_size=8, seed=seed)
    best, cpu = -np.inf, time.process_time()
    for _ in range(ROLLOUTS // search.population_size):
        scored = []
        for _ in range(search.population_size):
            numbers = search.ask()
            env.reset(seed=0)
            for k in range(60):
                command = wave(numbers, 0.05 * np.array([k + 1.0]))[0]
                *_, info = env.step(env.spaces.action(command, env.command))
            scored.append((numbers, -float(info["effector"][0])))
        search.tell(scored)
        numbers, value = min(scored, key=lambda pair: pair[1])
        if -value > best:
            best, kept = -value, numbers
    cpu = time.process_time() - cpu
    env.reset(seed=0)
    for k in range(100):
        command = wave(kept, 0.05 * np.array([k + 1.0]))[0]
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
    space = make_robot("swimmer").design_space
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
    for row, design in zip(data["bodies"], designs, strict=True):
        if "baseline_gait" not in row:
            row["baseline_gait"] = speed(folder / "body_0" / "policy.safetensors", design)
            write_json(place, data)
    common, own = ([row[judge]["speed"] for row in data["bodies"]] for judge in ("common", "gradients"))
    data["tau"] = list(kendalltau(common, own))
    of_baseline = [row["baseline_gait"]["speed"] for row in data["bodies"]]
    data["tau_baseline_gait"] = list(kendalltau(of_baseline, own))
    by_common, winner = int(np.argmax(common)), int(np.argmax(own))
    data["winners"] = {"common": by_common, "baseline_gait": int(np.argmax(of_baseline)), "gradients": winner}
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

"""Speed of `TorchVectorEnv` in steps per second: ``python -m benchmarks.gpu [--device cuda] [--num-envs 100000]``."""

from __future__ import annotations

import argparse
import gc
import json
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.extensions.gpu.environment import TorchVectorEnv
from softgym_envs.storage import write_json

#: Compiling takes most of the time of a run, and one robot is enough to show its effect.
COMPILED = "SoftGym/FingerReach-v0"


def robot_ids() -> list[str]:
    """The first environment ID of every robot on the surrogate."""
    first: dict[str, str] = {}
    for identifier, row in ENVIRONMENTS.items():
        if row.backend == "surrogate":
            first.setdefault(row.robot, identifier)
    return list(first.values())


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _seconds(work: Callable[[], object], repeats: int, device: torch.device) -> list[float]:
    times = []
    for _ in range(repeats):
        _synchronise(device)
        start = time.perf_counter()
        work()
        _synchronise(device)
        times.append(time.perf_counter() - start)
    return times


def measure(identifier: str, num_envs: int, device: torch.device, *, steps: int, repeats: int, **options: Any) -> dict:
    """Time steps with random actions inside an episode, and a reset of all episodes at once.

    Args:
        identifier: environment ID.
        num_envs: number of sub-environments.
        device: device of the environment.
        steps: steps in one repeat.
        repeats: number of repeats, whose median is reported.
        **options: options of `TorchVectorEnv`.

    Returns:
        Seconds of a step and of a reset; environment steps per second with one reset for each episode of the ID's
        length, and without resets; seconds until the first step was done; memory [bytes] on a CUDA device.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    env = TorchVectorEnv(identifier, num_envs, device=device, seed=0, max_episode_steps=10**9, **options)
    shape = (8, num_envs, *env.single_action_space.shape)
    actions = 2.0 * torch.rand(shape, generator=torch.Generator(device).manual_seed(0), device=device) - 1.0

    def walk() -> None:
        for step in range(steps):
            env.step(actions[step % len(actions)])

    start = time.perf_counter()
    env.reset()
    env.step(actions[0])
    _synchronise(device)
    first = time.perf_counter() - start
    walk()
    walks = [t / steps for t in _seconds(walk, repeats, device)]
    reset = statistics.median(_seconds(env.reset, repeats, device))
    step, episode = statistics.median(walks), ENVIRONMENTS[identifier].max_episode_steps
    result = {
        "steps_per_second": num_envs * episode / (episode * step + reset),
        "steps_per_second_without_resets": num_envs / step,
        "step_seconds": step,
        "step_seconds_range": [min(walks), max(walks)],
        "reset_seconds": reset,
        "first_step_seconds": first,
    }
    if device.type == "cuda":
        result["peak_memory_bytes"] = torch.cuda.max_memory_allocated(device)
    return result


def gpu(
    device: str | None = None,
    num_envs: int | None = None,
    *,
    steps: int = 10,
    repeats: int = 3,
    budget: float = 80.0,
    out: str | None = None,
) -> dict[str, object]:
    """Steps per second of the environments in torch, random actions: eager, as a CUDA graph, and one robot compiled.

    One thread of the host is used.

    Args:
        device: default ``"cuda"`` where there is one, else ``"cpu"``.
        num_envs: default 100,000 on a CUDA device, else 256.
        steps: steps in one repeat.
        repeats: number of repeats, whose median is reported.
        budget: seconds after which no further measurement begins; those left out are listed under ``"left_out"``.
        out: JSON file to write.

    Returns:
        One entry for each ID, kind of design and mode: what `measure` returns, or why it failed.
    """
    where = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    cuda = where.type == "cuda"
    count = num_envs or (100_000 if cuda else 256)
    name = torch.cuda.get_device_name(where) if cuda else platform.processor() or platform.machine()
    modes: dict[str, dict[str, bool]] = {"eager": {}}
    if cuda:
        modes["graph"] = {"cuda_graph": True}
    jobs = [(i, s, m) for m in modes for i in robot_ids() for s in (False, True)]
    if cuda:
        modes["compiled graph"] = {"compile": True, "cuda_graph": True}
        jobs += [(COMPILED, sampled, "compiled graph") for sampled in (False, True)]

    # For such small batches, several threads cost more than they gain.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    begun, rows, left_out = time.perf_counter(), {}, []
    for identifier, sampled, mode in jobs:
        label = f"{identifier.removeprefix('SoftGym/')}, {'sampled' if sampled else 'fixed'} design, {mode}"
        if time.perf_counter() - begun > budget:
            left_out.append(label)
            continue
        try:
            row = measure(identifier, count, where, steps=steps, repeats=repeats, sample_design=sampled, **modes[mode])
            text = (
                f"{row['steps_per_second']:>14,.0f} steps/s   step {1e3 * row['step_seconds']:8.3f} ms   "
                f"reset {1e3 * row['reset_seconds']:8.1f} ms   first {row['first_step_seconds']:5.1f} s"
            )
        except Exception as error:  # a mode that this device or torch version does not support is a result too
            row = {"error": f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"}
            text = row["error"]
        rows[label] = row
        print(f"{label:58s} {text}", flush=True)
        gc.collect()
        if cuda:
            torch.cuda.empty_cache()
    torch.set_num_threads(threads)
    if left_out:
        print(f"left out after {budget:g} s: {'; '.join(left_out)}")
    result: dict[str, object] = {
        "device": name,
        "torch": torch.__version__,
        "num_envs": count,
        "threads": 1,
        "steps": steps,
        "repeats": repeats,
        "seconds": time.perf_counter() - begun,
        "rows": rows,
        "left_out": left_out,
    }
    if out is not None:
        write_json(out, result)
    return result


def gpu_step() -> dict[str, object]:
    """Steps per second of the environments in torch, 100,000 at once on a GPU, or 256 where there is none."""
    result = gpu()
    rows: Any = result["rows"]
    about = {key: result[key] for key in ("device", "torch", "num_envs")}
    return about | {f"{label}: steps per second": row.get("steps_per_second", row) for label, row in rows.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", help="default cuda where there is one, else cpu")
    parser.add_argument("--num-envs", type=int, help="default 100000 on a CUDA device, else 256")
    parser.add_argument("--steps", type=int, default=10, help="steps in one repeat")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--budget", type=float, default=80.0, help="seconds after which no measurement begins")
    parser.add_argument("--out", help="JSON file to write")
    result = gpu(**vars(parser.parse_args()))
    print(json.dumps({key: value for key, value in result.items() if key != "rows"}))


if __name__ == "__main__":
    main()

"""Datasets of condensed models: atomic npz shards and a manifest; generation is parallel and resumable."""

from __future__ import annotations

import json
import multiprocessing
from dataclasses import asdict
from pathlib import Path

import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.robots import make_robot
from softgym_envs.storage import atomic_write, read_npz, write_json
from softgym_envs.surrogate.sampling import SamplingPlan, sample_group

__all__ = ["COLUMNS", "generate_dataset", "load_dataset"]

COLUMNS = ("design", "displacement", "effort", "effector", "compliance", "rest")
_FORMAT = 1


def _read_shard(path: Path) -> dict[str, np.ndarray]:
    shard = read_npz(path, COLUMNS)
    if not all(np.isfinite(v).all() for v in shard.values()):
        raise DataError(f"shard '{path}' holds values that are not finite")
    return shard


def _make_shard(job: tuple[str, dict, dict, int, int, str]) -> tuple[int, int]:
    """Worker: solve the groups of one shard and write it. Returns its number of states and of infeasible designs."""
    from threadpoolctl import threadpool_limits

    robot_name, options, plan_fields, first, last, path = job
    with threadpool_limits(1):
        global _robot
        if _robot is None or _robot[0] != (robot_name, json.dumps(options)):
            _robot = ((robot_name, json.dumps(options)), make_robot(robot_name, **options))
        plan = SamplingPlan(**plan_fields)
        parts = [sample_group(_robot[1], plan, group) for group in range(first, last)]
    found = [part for part in parts if part is not None]
    if not found:
        raise DataError(f"every design of groups {first}..{last - 1} is infeasible")
    shard = {name: np.concatenate([part[name] for part in found]) for name in COLUMNS}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **shard)
    return len(shard["rest"]), len(parts) - len(found)


_robot: tuple | None = None


def generate_dataset(
    folder: str | Path,
    robot: str,
    plan: SamplingPlan,
    *,
    robot_options: dict | None = None,
    groups_per_shard: int = 25,
    workers: int = 1,
    progress: bool = True,
) -> dict[str, np.ndarray]:
    """Generate a dataset, or finish an interrupted one, and return it.

    Finished shards are kept; a shard that cannot be read is renamed to ``*.corrupt`` and made again.

    Args:
        folder: where shards and ``manifest.json`` live.
        robot: registry name.
        plan: what to sample.
        robot_options: options of the robot.
        groups_per_shard: designs per shard.
        workers: processes, one thread each.
        progress: show a progress bar.

    Raises:
        DataError: if the folder holds a dataset of another plan.
    """
    from tqdm import tqdm

    folder = Path(folder)
    options = dict(robot_options or {})
    body = make_robot(robot, **options)
    manifest = {
        "format": _FORMAT,
        "robot": robot,
        "robot_options": options,
        "signature": body.signature,
        "plan": asdict(plan),
        "groups_per_shard": groups_per_shard,
        "columns": {
            "design": list(body.design_space.names),
            "displacement": [a.name for a in body.actuators],
            "effort": [a.name for a in body.actuators],
            "effector": [f"{e} {axis}" for e in body.effectors for axis in "xyz"],
            "compliance": "upper triangle of W over actuators then effectors, row by row",
        },
    }
    manifest = json.loads(json.dumps(manifest))  # as it will be read again: tuples are lists there
    path = folder / "manifest.json"
    if path.exists():
        kept = _read_manifest(path)
        if kept != manifest:
            changed = sorted(k for k in manifest if kept.get(k) != manifest[k])
            raise DataError(f"'{folder}' holds another dataset (different: {', '.join(changed)}); use a new folder")
    else:
        write_json(path, manifest)
    # The baseline mesh is made once, before the workers ask for it.
    body.build()
    jobs = []
    shards = []
    for number, first in enumerate(range(0, plan.groups, groups_per_shard)):
        shard = folder / f"shard_{number:05d}.npz"
        shards.append(shard)
        if shard.exists():
            try:
                _read_shard(shard)
                continue
            except DataError as error:
                aside = shard.with_suffix(".corrupt")
                shard.rename(aside)
                print(f"{error}; set aside as '{aside.name}' and made again")
        last = min(first + groups_per_shard, plan.groups)
        jobs.append((robot, options, asdict(plan), first, last, str(shard)))
    bar = tqdm(total=len(shards), initial=len(shards) - len(jobs), unit="shard", desc=folder.name, disable=not progress)
    infeasible = 0
    with bar:
        if workers <= 1:
            for job in jobs:
                infeasible += _make_shard(job)[1]
                bar.update()
        elif jobs:
            with multiprocessing.get_context("spawn").Pool(workers) as pool:
                for _, bad in pool.imap_unordered(_make_shard, jobs):
                    infeasible += bad
                    bar.update()
    if infeasible:
        print(f"{infeasible} designs were infeasible and left out")
    return load_dataset(folder)


def _read_manifest(path: Path) -> dict:
    try:
        manifest = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"manifest '{path}' cannot be read: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != _FORMAT:
        raise DataError(f"manifest '{path}' is not of format {_FORMAT}")
    return manifest


def load_dataset(folder: str | Path) -> dict[str, np.ndarray]:
    """Return the columns of a finished dataset; see `sample_group` for their meaning.

    Raises:
        DataError: if the manifest or a shard is missing or damaged.
    """
    folder = Path(folder)
    manifest = _read_manifest(folder / "manifest.json")
    count = -(-manifest["plan"]["groups"] // manifest["groups_per_shard"])
    shards = [_read_shard(folder / f"shard_{number:05d}.npz") for number in range(count)]
    return {name: np.concatenate([shard[name] for shard in shards]) for name in COLUMNS}

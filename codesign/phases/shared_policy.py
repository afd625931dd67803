"""The judge of strategies whose trials train nothing: one policy that sees the body, the same for all of them.

It is given (strategy ``"policy"``), or trained together with the bodies before the first trial (``"critic"``,
``"distribution"``; see `agents.joint`). Its most promising bodies then become trials.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from agents.config import TrainConfig
from agents.joint import PROPOSERS
from agents.policy import policy_path
from codesign.config import StudyConfig
from codesign.folder import StudyFolder
from codesign.scheduling.jobs import Job
from softgym_envs.storage import atomic_write, read_json

__all__ = ["JUDGE", "joint_config", "judge_jobs", "judge_policy", "promising_bodies"]

JUDGE = "judge/policy.safetensors"
"""The judge, relative to the folder of a study."""


def judge_jobs(folder: StudyFolder) -> list[Job]:
    """The job that makes the judge, or none where the strategy needs none."""
    config = folder.config
    if not config.plan.judges:
        return []
    return [Job(folder.path / "judge" / "judge.json", lambda: _make(folder))]


def judge_policy(folder: StudyFolder) -> Path:
    """The file of the judge, wherever it was made.

    Raises:
        DataError: if there is none.
    """
    return folder.policy(JUDGE)


def promising_bodies(folder: StudyFolder) -> list[tuple[str, dict[str, float]]]:
    """Origin and values [SI] of the bodies that joint training found best."""
    path = folder.path / "judge" / "judge.json"
    if folder.config.plan.proposer is None or not path.exists():
        return []
    bodies = read_json(path)["bodies"][: folder.config.joint.keep]
    return [(f"joint {index}", values) for index, values in enumerate(bodies)]


def joint_config(folder: StudyFolder) -> TrainConfig:
    """Configuration of the joint training, on the training goals of the study."""
    config = folder.config
    update: dict[str, Any] = {"design": dict(config.baseline), "sample_design": list(config.variables)}
    if len(goals := folder.goals["training"]):
        update["task_options"] = {**config.environment.task_options, "goals": goals.tolist()}
    joint = config.joint.model_dump(exclude={"keep", "options"})
    return TrainConfig(environment=config.environment.model_copy(update=update), **joint)


def _report_steps(config: StudyConfig) -> int:
    """Environment steps of the points of the learning curve of joint training."""
    joint = config.joint
    points = -(-joint.steps // joint.report_every)
    return points * joint.evaluation_episodes * config.episode_steps


def _make(folder: StudyFolder) -> dict[str, Any]:
    """Train or copy the judge; what is told of it is a job's result."""
    config = folder.config
    started, cpu = time.perf_counter(), time.process_time()
    bodies: list[dict[str, float]] = []
    steps, before = 0, 0.0
    if config.plan.proposer is None:
        assert config.policy is not None  # the configuration was checked
        source = policy_path(config.policy)
    else:
        from agents.training import cpu_before, train

        training = folder.path / "judge" / "training"
        options: dict[str, Any] = dict(config.joint.options)
        source = train(
            joint_config(folder), training, proposer=PROPOSERS[config.plan.proposer](**options), progress=False
        )
        before = cpu_before(source, cpu)
        found = read_json(training / "bodies.json")
        space = config.space
        bodies = [
            {name: float(space[name].from_unit(value)) for name, value in zip(found["names"], body, strict=True)}
            for body in found["bodies"]
        ]
        steps = config.joint.steps
    files = {
        name: path.read_bytes()
        for name, path in (
            (JUDGE, source),
            (Path(JUDGE).with_suffix(".json").as_posix(), source.with_suffix(".json")),
        )
    }
    for name, content in files.items():
        with atomic_write(folder.path / name) as stream:
            stream.write(content)
    folder.open_storage().publish(files)
    return {
        "policy": JUDGE,
        "bodies": bodies,
        "training_steps": steps,
        "report_steps": _report_steps(config) if steps else 0,
        "seconds": time.perf_counter() - started,
        "cpu_seconds": before + time.process_time() - cpu,
    }

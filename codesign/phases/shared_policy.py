"""Shared policy: it observes the body and scores every design when trials do not train.

It is given (strategy ``"policy"``), or trained together with the bodies before the first trial (``"critic"``,
``"distribution"``; see `softgym_envs.agents.joint`). The most promising bodies of that training then become trials.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.joint import PROPOSERS
from softgym_envs.agents.policy import policy_path
from softgym_envs.agents.training import cpu_before, train
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import SHARED_POLICY, SHARED_POLICY_RECORD, StudyFolder
from softgym_envs.codesign.records import Job, SharedPolicy
from softgym_envs.storage import atomic_write, read_signed


def shared_policy_jobs(folder: StudyFolder) -> list[Job]:
    """Return the job that makes the shared policy; none if the strategy needs no shared policy."""
    if not folder.config.plan.shares_policy:
        return []
    return [Job(folder.path / SHARED_POLICY_RECORD, lambda: _make(folder))]


def shared_policy(folder: StudyFolder) -> Path:
    """Return the file of the shared policy; one made on another machine is copied.

    Raises:
        DataError: if there is none.
    """
    return folder.policy(SHARED_POLICY)


def promising_bodies(folder: StudyFolder) -> list[tuple[str, dict[str, float]]]:
    """Return origin and values [SI] of the bodies that joint training found best."""
    path = folder.path / SHARED_POLICY_RECORD
    if folder.config.plan.proposer is None or not path.exists():
        return []
    bodies = SharedPolicy.read(path).bodies[: folder.config.joint.keep]
    return [(f"joint {index}", values) for index, values in enumerate(bodies)]


def joint_config(folder: StudyFolder) -> TrainConfig:
    """Return the configuration of the joint training, on the training goals of the study."""
    config = folder.config
    return config.joint.on(config.environment, folder.goals["training"], config.baseline, list(config.variables))


def _report_steps(config: StudyConfig) -> int:
    """Return the environment steps of the points of the learning curve of joint training."""
    joint = config.joint
    points = -(-joint.steps // joint.report_every)
    return points * joint.evaluation_episodes * config.episode_steps


def _make(folder: StudyFolder) -> SharedPolicy:
    """Train or copy the shared policy."""
    config = folder.config
    started, cpu = time.perf_counter(), time.process_time()
    record = SharedPolicy(SHARED_POLICY)
    before = 0.0
    if config.plan.proposer is None:
        assert config.policy is not None  # checked by the configuration
        source = policy_path(config.policy)
    else:
        training = folder.path / "shared_policy" / "training"
        options: dict[str, Any] = dict(config.joint.options)
        proposer = PROPOSERS[config.plan.proposer](**options)
        source = train(joint_config(folder), training, proposer=proposer, progress=False)
        before = cpu_before(source, cpu)
        found = read_signed(training / "bodies.json")
        space = config.space
        record.bodies = [
            {name: float(space[name].from_unit(value)) for name, value in zip(found["names"], body, strict=True)}
            for body in found["bodies"]
        ]
        record.training_steps, record.report_steps = config.joint.steps, _report_steps(config)
    card = Path(SHARED_POLICY).with_suffix(".json").as_posix()
    files = {SHARED_POLICY: source.read_bytes(), card: source.with_suffix(".json").read_bytes()}
    for name, content in files.items():
        with atomic_write(folder.path / name) as stream:
            stream.write(content)
    folder.open_storage().publish(files)
    record.seconds = time.perf_counter() - started
    record.cpu_seconds = before + time.process_time() - cpu
    return record

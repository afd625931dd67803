"""Shared policy: it observes the body and scores every design when trials do not train (strategy ``"policy"``)."""

from __future__ import annotations

from pathlib import Path

from softgym_envs.agents.policy import policy_path
from softgym_envs.codesign.folder import SHARED_POLICY, SHARED_POLICY_RECORD, StudyFolder
from softgym_envs.codesign.records import Job, SharedPolicy
from softgym_envs.storage import atomic_write


def shared_policy_jobs(folder: StudyFolder) -> list[Job]:
    """Return the job that copies the shared policy; none if the strategy needs no shared policy."""
    if not folder.config.plan.shares_policy:
        return []
    return [Job(folder.path / SHARED_POLICY_RECORD, lambda: _copy(folder))]


def shared_policy(folder: StudyFolder) -> Path:
    """Return the file of the shared policy; one made on another machine is copied.

    Raises:
        DataError: if there is none.
    """
    return folder.policy(SHARED_POLICY)


def _copy(folder: StudyFolder) -> SharedPolicy:
    assert folder.config.policy is not None  # checked by the configuration
    source = policy_path(folder.config.policy)
    card = Path(SHARED_POLICY).with_suffix(".json").as_posix()
    files = {SHARED_POLICY: source.read_bytes(), card: source.with_suffix(".json").read_bytes()}
    for name, content in files.items():
        with atomic_write(folder.path / name) as stream:
            stream.write(content)
    folder.open_storage().publish(files)
    return SharedPolicy(SHARED_POLICY)

"""Jobs that several processes share: each is one file, made by whoever gets its lock first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codesign.folder import StudyFolder
from softgym_envs.storage import write_json

__all__ = ["Job", "run_jobs"]


@dataclass(frozen=True)
class Job:
    """One result file and how to make it.

    Args:
        path: the JSON file.
        make: returns its content.
    """

    path: Path
    make: Callable[[], dict[str, Any]]


def run_jobs(folder: StudyFolder, jobs: Iterable[Job]) -> None:
    """Do every job that is not done yet; when this returns all are, here or by another process.

    First those that no other process is at, then, where one was stopped, what it left.
    """
    from filelock import Timeout

    missing = list(jobs)
    for timeout in (0, -1):
        for job in missing:
            if job.path.exists():
                continue
            try:
                with folder.lock(f"{job.path.parent.name}-{job.path.stem}").acquire(timeout=timeout):
                    if not job.path.exists():
                        write_json(job.path, job.make())
            except Timeout:
                continue

"""Jobs that several processes share: each is one file, made by whoever gets to it first."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codesign.folder import StudyFolder
from softgym_envs.storage import write_json

__all__ = ["Job", "missing_jobs", "run_jobs"]

POLL = 0.5
"""Time between two looks at jobs that are all in other hands [s]."""


@dataclass(frozen=True)
class Job:
    """One result file and how to make it.

    Args:
        path: the JSON file.
        make: returns its content.
    """

    path: Path
    make: Callable[[], dict[str, Any]]


def missing_jobs(folder: StudyFolder, jobs: Iterable[Job]) -> list[Job]:
    """Jobs that nobody has done; what was done on other machines is copied into the folder."""
    missing = [job for job in jobs if not job.path.exists()]
    if missing:
        storage = folder.open_storage()
        for job in missing:
            if (content := storage.fetch(job.path.relative_to(folder.path).as_posix())) is not None:
                write_json(job.path, json.loads(content))
    return [job for job in missing if not job.path.exists()]


def run_jobs(folder: StudyFolder, jobs: Iterable[Job]) -> None:
    """Do every job that is not done yet; when this returns all are, here or by another process.

    First those that no other process is at, then, where one was stopped, what it left.
    """
    storage = folder.open_storage()
    missing = list(jobs)
    while missing:
        busy = []
        for job in missing:
            name = job.path.relative_to(folder.path).as_posix()
            if job.path.exists():
                continue
            with storage.attempt(name) as mine:
                if (content := storage.fetch(name)) is not None:  # it is done, and perhaps elsewhere
                    if not job.path.exists():
                        write_json(job.path, json.loads(content))
                elif mine:
                    made = job.make()
                    storage.publish({name: json.dumps(made).encode()})
                    first = storage.fetch(name)  # of two that did it, where a restart of the server let them
                    write_json(job.path, made if first is None else json.loads(first))
                else:
                    busy.append(job)
        if len(busy) == len(missing):
            time.sleep(POLL)
        missing = busy

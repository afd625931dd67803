"""Jobs that several processes share: each makes one file, and runs in the first process that gets to it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import Job
from softgym_envs.storage import write_signed

POLL = 0.5
"""Time between two looks at jobs that other processes are running [s]."""


def missing_jobs(folder: StudyFolder, jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs that nobody has done; files made on other machines are copied into the folder."""
    missing = [job for job in jobs if not job.path.exists()]
    if missing:
        storage = folder.open_storage()
        for job in missing:
            if (content := storage.fetch(job.path.relative_to(folder.path).as_posix())) is not None:
                write_signed(job.path, json.loads(content))
    return [job for job in missing if not job.path.exists()]


def run_pending(folder: StudyFolder, jobs: Iterable[Job]) -> None:
    """Run every job that is not done yet; return when all are done, here or in another process.

    Free jobs come first; a job whose process stopped is taken over after them.
    """
    storage = folder.open_storage()
    missing = list(jobs)
    while missing:
        busy = []
        for job in missing:
            name = job.path.relative_to(folder.path).as_posix()
            if job.path.exists():
                continue
            if not all(path.exists() for path in job.needs):
                busy.append(job)
                continue
            with storage.attempt(name) as mine:
                if (content := storage.fetch(name)) is not None:  # done, perhaps on another machine
                    if not job.path.exists():
                        write_signed(job.path, json.loads(content))
                elif mine:
                    made = job.make().to_json()
                    storage.publish({name: json.dumps(made).encode()})
                    # After a restart of the server two processes may have run the job: the first result counts.
                    first = storage.fetch(name)
                    write_signed(job.path, made if first is None else json.loads(first))
                else:
                    busy.append(job)
        if len(busy) == len(missing):
            time.sleep(POLL)
        missing = busy

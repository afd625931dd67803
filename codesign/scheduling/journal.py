"""Storage of a study on one machine: Optuna's journal in its folder, with locks of the operating system."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from softgym_envs.codesign.scheduling.storage import StudyStorage, file_lock
from softgym_envs.storage import drop_torn_line

if TYPE_CHECKING:
    import optuna

JOURNAL_LOCK = "journal"

T = TypeVar("T")


class JournalStorage(StudyStorage):
    """Optuna's journal in the folder of a study."""

    study = "codesign"
    shared = False

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._optuna = self._open()

    def _open(self) -> optuna.storages.BaseStorage:
        from optuna import storages
        from optuna.storages.journal import JournalFileBackend

        path = self.folder / "journal.log"
        lock = file_lock(self.folder, JOURNAL_LOCK)
        with lock:
            # Nobody else writes while we hold the lock, so a crash cut this line off and nobody has acted on it.
            drop_torn_line(path)
        # Unlike Optuna's own lock files, these are freed by the kernel when their holder is killed.
        return storages.JournalStorage(JournalFileBackend(str(path), lock_obj=lock))  # type: ignore[arg-type]

    @property
    def optuna(self) -> optuna.storages.BaseStorage:
        return self._optuna

    def exclusively(self, action: Callable[[], T]) -> T:
        with file_lock(self.folder, "study"):
            return action()

    def patiently(self, action: Callable[[], T]) -> T:
        return action()

    @contextmanager
    def present(self, worker: str) -> Iterator[None]:
        lock = file_lock(self.folder, worker)
        with lock:
            try:
                yield
            finally:
                Path(lock.lock_file).unlink(missing_ok=True)

    def lives(self, worker: str) -> bool:
        with self.attempt(worker) as free:
            if free:
                (self.folder / "locks" / f"{worker}.lock").unlink(missing_ok=True)
            return not free

    def outlived(self, call: str, worker: str) -> bool:
        return self.lives(call)  # a lock ends with its holder

    @contextmanager
    def attempt(self, job: str) -> Iterator[bool]:
        from filelock import Timeout

        lock = file_lock(self.folder, job.replace("/", "-"))
        try:
            lock.acquire(timeout=0)
        except Timeout:
            yield False
            return
        try:
            yield True
        finally:
            lock.release()

    def publish(self, files: Mapping[str, bytes]) -> None:
        """Do nothing: the files are in the folder already."""

    def fetch(self, name: str) -> bytes | None:
        path = self.folder / name
        return path.read_bytes() if path.exists() else None

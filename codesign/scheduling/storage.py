"""Where the trials of a study are kept, and how its processes stay out of each other's way.

`JournalStorage` is Optuna's journal in the folder of the study, for the processes of one machine, with locks of the
operating system. `codesign.scheduling.postgres.PostgresStorage` is a PostgreSQL database, for many machines.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from codesign.config import JOURNAL, StudyConfig
from softgym_envs.storage import drop_torn_line

if TYPE_CHECKING:
    import optuna
    from filelock import BaseFileLock

__all__ = ["JournalStorage", "StudyStorage", "file_lock", "open_storage"]

JOURNAL_LOCK = "journal"

T = TypeVar("T")


def file_lock(folder: Path, name: str) -> BaseFileLock:
    """Return a lock shared by all processes of a study. The operating system frees it when its holder dies."""
    from filelock import FileLock

    (folder / "locks").mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "locks" / f"{name}.lock", poll_interval=0.01)


def open_storage(folder: Path, config: StudyConfig) -> StudyStorage:
    """Open the storage that a configuration names; a database that does not answer is waited for.

    Raises:
        ConfigError: if the database cannot be opened.
    """
    if config.storage == JOURNAL:
        return JournalStorage(folder)
    from codesign.scheduling.postgres import PostgresStorage

    return PostgresStorage(config.storage, config.name, grace=config.heartbeat, patience=config.patience, wait=True)


class StudyStorage(ABC):
    """The trials of one study and what its workers must agree on.

    Attributes:
        study: name of the Optuna study.
        shared: whether workers may lie on other machines, with folders of their own. What they have to know of each
            other is then kept here: results of trials, and files by `publish`.
    """

    study: str
    shared: bool

    @property
    @abstractmethod
    def optuna(self) -> optuna.storages.BaseStorage:
        """Storage to open the Optuna study with; ask anew for it in each call of `exclusively`."""

    @abstractmethod
    def exclusively(self, action: Callable[[], T]) -> T:
        """Return what ``action`` does while no other process of the study is here.

        It may be called again, after its first effects on the database were taken back: beyond the database it must
        have none.
        """

    @abstractmethod
    def patiently(self, action: Callable[[], T]) -> T:
        """Return what ``action`` does, called again whenever the storage went away under it."""

    @abstractmethod
    def present(self, worker: str) -> AbstractContextManager[None]:
        """Show a worker as alive while the block runs."""

    @abstractmethod
    def lives(self, worker: str) -> bool:
        """Tell whether a worker shows as alive."""

    @abstractmethod
    def outlived(self, call: str, worker: str) -> bool:
        """Tell whether ``call`` shows as alive, and did so well after the last sign of a worker that is dead."""

    @abstractmethod
    def attempt(self, job: str) -> AbstractContextManager[bool]:
        """Try to be the only one at a job while the block runs, and tell whether this came true."""

    @abstractmethod
    def publish(self, files: Mapping[str, bytes]) -> None:
        """Give files, by path in the folder of the study, to the other machines; a published file does not change."""

    @abstractmethod
    def fetch(self, name: str) -> bytes | None:
        """Content of a published file, or None."""


class JournalStorage(StudyStorage):
    """Optuna's journal in the folder of a study; a crash in the middle of its last line is mended.

    Args:
        folder: the folder of the study.
    """

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
            # Whoever held this lock is gone, so a line without an end was cut off by a crash and was never acted upon.
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
        """Do nothing: they lie in the folder already."""

    def fetch(self, name: str) -> bytes | None:
        path = self.folder / name
        return path.read_bytes() if path.exists() else None

"""Storage of a study on one machine: Optuna's journal in its folder, with locks of the operating system."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from softgym_envs.codesign.scheduling.storage import StudyStorage
from softgym_envs.errors import DataError
from softgym_envs.runs import file_lock
from softgym_envs.storage import RESTORE, drop_torn_line

if TYPE_CHECKING:
    import optuna
    from filelock import BaseFileLock

JOURNAL_LOCK = "journal"

T = TypeVar("T")


def open_journal(path: Path, lock: BaseFileLock | None = None, *, mend: bool = True) -> optuna.storages.JournalStorage:
    """Return Optuna's journal in a file, without a last line that a crash cut off.

    Args:
        path: the file, which is made if it does not exist.
        lock: what its writers hold; default Optuna's own lock file.
        mend: whether to remove that line; else it is ignored, and nothing is written.

    Raises:
        DataError: if a line is not a record of a journal, or the records contradict each other.
    """
    from optuna import storages
    from optuna.storages.journal import JournalFileBackend

    # Nobody else writes while we hold the lock, so a crash cut this line off and nobody has acted on it.
    if mend:
        with lock or nullcontext():
            drop_torn_line(path)
    try:
        return storages.JournalStorage(JournalFileBackend(str(path), lock_obj=lock))  # type: ignore[arg-type]
    except OSError:
        raise
    except Exception:  # Optuna replays the records, so that a wrong one may cause any exception
        for number, line in enumerate(path.read_bytes().splitlines(), start=1):
            if not _is_record(line):
                raise DataError(f"'{path}' cannot be read: line {number} is damaged; {RESTORE}") from None
        raise DataError(f"'{path}' cannot be read: its records contradict each other; {RESTORE}") from None


def _is_record(line: bytes) -> bool:
    try:
        return "op_code" in json.loads(line)
    except (ValueError, TypeError):
        return False


class JournalStorage(StudyStorage):
    """Optuna's journal in the folder of a study."""

    shared = False

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self._optuna = self._open()
        begun = self._optuna.get_all_studies()
        self.study = begun[0].study_name if begun else name  # a study may be renamed later

    def _open(self) -> optuna.storages.BaseStorage:
        # Unlike Optuna's own lock files, these are freed by the kernel when their holder is killed.
        return open_journal(self.folder / "journal.log", file_lock(self.folder, JOURNAL_LOCK))

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

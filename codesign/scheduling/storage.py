"""Storage and locks of a study: what its processes share.

`softgym_envs.codesign.scheduling.journal.JournalStorage` keeps trials in the folder of the study, for the processes of
one machine. Storages for many machines, such as a database, are those of installed packages (`STORAGES`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TypeVar

from softgym_envs.codesign.metrics.metric import Direction
from softgym_envs.registry import Registry

if TYPE_CHECKING:
    import optuna

T = TypeVar("T")

JOURNAL = "journal"
"""``storage`` of a study whose folder keeps the trials."""


class StudyStorage(ABC):
    """The trials of one study, and what its workers must agree on.

    A ``shared`` storage has workers on several machines, each with a folder of its own. It keeps everything that they
    need from each other: results of trials, and files (`publish`).
    """

    study: str  # name of the Optuna study
    shared: bool
    opened: optuna.Study | None = None  # it caches finished trials

    @property
    @abstractmethod
    def optuna(self) -> optuna.storages.BaseStorage:
        """Storage of the Optuna study."""

    @abstractmethod
    def exclusively(self, action: Callable[[], T]) -> T:
        """Return the result of ``action``, which runs while no other process changes the study.

        It may be called again after its first effects on the database were undone, so it must have no other effects.
        """

    @abstractmethod
    def patiently(self, action: Callable[[], T]) -> T:
        """Return the result of ``action``, called again whenever the connection to the storage breaks."""

    @abstractmethod
    def present(self, worker: str) -> AbstractContextManager[None]:
        """Mark a worker as alive while the block runs."""

    @abstractmethod
    def lives(self, worker: str) -> bool:
        """Return whether a worker is marked as alive."""

    @abstractmethod
    def outlived(self, call: str, worker: str) -> bool:
        """Return whether ``call`` is alive, and clearly was so after the last heartbeat of a dead worker."""

    @abstractmethod
    def attempt(self, job: str) -> AbstractContextManager[bool]:
        """Try to lock a job while the block runs, and return whether the lock was free."""

    @abstractmethod
    def publish(self, files: Mapping[str, bytes]) -> None:
        """Send files, by path in the folder of the study, to the other machines; a published file does not change."""

    @abstractmethod
    def fetch(self, name: str) -> bytes | None:
        """Return the content of a published file, or None."""


class SharedStorage(StudyStorage):
    """A storage for many machines.

    Args:
        address: ``scheme://...``, where the scheme is the name of the storage.
        study: name of the study.
        grace: time without a heartbeat after which a worker counts as dead [s].
        patience: how long to wait for a server that does not answer [s].
        wait: whether to wait for the server when the storage is opened.
    """

    shared = True
    form: str  # of addresses, for messages

    @abstractmethod
    def __init__(
        self, address: str, study: str, *, grace: float = 60.0, patience: float = 600.0, wait: bool = False
    ) -> None: ...

    @classmethod
    @abstractmethod
    def takes(cls, address: str) -> bool:
        """Return whether an address, which may be any text, is one of this storage."""

    @abstractmethod
    def agree(
        self, accept: Callable[[dict[str, Any] | None], dict[str, Any]], directions: Sequence[Direction] = ("minimize",)
    ) -> dict[str, Any]:
        """Find or make the study, and return what all its machines share, with the ``id`` of the study.

        ``accept`` takes what is shared so far (None for a new study) and returns what to share from now on, as plain
        data. If it raises, nothing changes. Each trial has a value for each of the ``directions``.
        """

    @abstractmethod
    def has_files(self, folder: str) -> bool:
        """Return whether a folder of the study has published files."""


STORAGES = Registry(
    "storage", {}, base="softgym_envs.codesign.scheduling.storage:SharedStorage", group="softgym_envs.storages"
)
"""Storages for many machines of installed packages, by the scheme of their addresses."""


def find_storage(address: str) -> type[SharedStorage]:
    """Return the storage for many machines that takes an address.

    Raises:
        ValueError: if none does; the message does not repeat the address, which may hold a password.
    """
    for storage in STORAGES.values():
        if storage.takes(address):
            found: type[SharedStorage] = storage
            return found
    raise ValueError(f"allowed: {', '.join([JOURNAL, *(storage.form for storage in STORAGES.values())])}")

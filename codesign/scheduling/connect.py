"""Opening the storage that a configuration names. Only this module knows which storages there are."""

from __future__ import annotations

from pathlib import Path

from codesign.config import JOURNAL, StudyConfig
from codesign.scheduling.storage import StudyStorage


def open_storage(folder: Path, config: StudyConfig, *, wait: bool = True) -> StudyStorage:
    """Open the storage of a study.

    Args:
        folder: the folder of the study.
        config: names the storage.
        wait: whether to wait for a database that does not answer; otherwise a wrong address is reported at once.

    Raises:
        ConfigError: if the database cannot be opened.
    """
    if config.storage == JOURNAL:
        from codesign.scheduling.journal import JournalStorage

        return JournalStorage(folder)
    from codesign.scheduling.postgres import PostgresStorage

    return PostgresStorage(config.storage, config.name, grace=config.heartbeat, patience=config.patience, wait=wait)

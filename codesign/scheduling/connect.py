"""Opening the storage that a configuration names."""

from __future__ import annotations

from pathlib import Path

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.scheduling.storage import JOURNAL, StudyStorage, find_storage


def open_storage(folder: Path, config: StudyConfig, *, wait: bool = True) -> StudyStorage:
    """Open the storage that the configuration of a study names.

    Without ``wait``, a database that does not answer is a ConfigError at once, as for a wrong address.
    """
    if config.storage == JOURNAL:
        from softgym_envs.codesign.scheduling.journal import JournalStorage

        return JournalStorage(folder, config.name)
    storage: StudyStorage = find_storage(config.storage)(
        config.storage, config.name, grace=config.heartbeat, patience=config.patience, wait=wait
    )
    return storage

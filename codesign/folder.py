"""A study on disk: where everything lies, and what its processes share."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.config import StudyConfig
from codesign.goals import draw_goals
from softgym_envs.config import load_config, save_resolved
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.storage import write_json

if TYPE_CHECKING:
    from filelock import BaseFileLock

__all__ = ["StudyFolder"]

# What may change between two runs of one study.
EXTENSIBLE = ("name", "title", "trials", "workers", "finalists")


class StudyFolder:
    """The folder of a study.

    It holds::

        config.yaml  provenance.json  goals.json
        journal.log                    Optuna's journal
        screen/000.json ...            QP score of each candidate of the screen
        trials/0000/ ...               training of each trial, and its result.json once it is finished
        finalists/*.json               one evaluation each
        account.json                   time spent, and the command
        locks/                         locks of the operating system: they die with their holder
        results.json  trials.csv  finalists.csv  report.html

    Every file is either whole or absent.

    Args:
        path: the folder; see `create` for a new one.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).resolve()

    @classmethod
    def create(cls, path: str | Path, config: StudyConfig) -> StudyFolder:
        """Make the folder of a study, or open it to continue.

        Raises:
            ConfigError: if the folder holds another study.
        """
        folder = cls(path)
        folder.path.mkdir(parents=True, exist_ok=True)
        with folder.lock("study"):
            if not (folder.path / "config.yaml").exists():
                if (folder.path / "journal.log").exists():
                    raise ConfigError(f"folder '{path}' holds a journal but no config.yaml; use another folder")
                save_resolved(folder.path, config)
            else:
                folder._accept(config, str(path))
            if not (folder.path / "goals.json").exists():
                write_json(folder.path / "goals.json", draw_goals(config))
        return folder

    def _accept(self, config: StudyConfig, shown: str) -> None:
        old, new = (c.model_dump(mode="json") for c in (self.config, config))
        for key in new:
            if key not in EXTENSIBLE and old[key] != new[key]:
                raise ConfigError(
                    f"folder '{shown}' holds a study with another '{key}'; use another folder, or change only: "
                    f"{', '.join(EXTENSIBLE)}"
                )
        if old != new:
            save_resolved(self.path, config)
            del self.config

    @cached_property
    def config(self) -> StudyConfig:
        """The resolved configuration."""
        if not (self.path / "config.yaml").exists():
            raise DataError(f"'{self.path}' is not the folder of a co-design study: it has no config.yaml")
        return load_config(self.path / "config.yaml", StudyConfig)

    @cached_property
    def goals(self) -> dict[str, np.ndarray]:
        """Goals [m] by use: ``training`` (k, 3), ``selection`` (k, p, 3), ``unseen`` (k, p, 3)."""
        stored = json.loads((self.path / "goals.json").read_text())
        return {name: np.array(stored[name], dtype=float) for name in ("training", "selection", "unseen")}

    def account(self) -> dict[str, Any]:
        """Command that last ran the study, and wall-clock time of each phase so far [s]."""
        path = self.path / "account.json"
        return json.loads(path.read_text()) if path.exists() else {"command": "", "wall_seconds": {}}

    def lock(self, name: str) -> BaseFileLock:
        """Return a lock shared by all processes of the study. The operating system frees it when its holder dies."""
        from filelock import FileLock

        (self.path / "locks").mkdir(parents=True, exist_ok=True)
        return FileLock(self.path / "locks" / f"{name}.lock", poll_interval=0.01)

    def trial(self, number: int) -> Path:
        """Folder of a trial."""
        return self.path / "trials" / f"{number:04d}"

    def result(self, number: int) -> dict[str, Any] | None:
        """Result of a trial, or None if it is not finished."""
        path = self.trial(number) / "result.json"
        return json.loads(path.read_text()) if path.exists() else None

    def results(self) -> list[dict[str, Any]]:
        """Results of all finished trials, by number."""
        paths = sorted((self.path / "trials").glob("[0-9]*/result.json"))
        return [json.loads(path.read_text()) for path in paths]

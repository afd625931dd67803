"""A study on disk: where everything lies, and what its processes share."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.config import JOURNAL, StudyConfig
from codesign.goals import draw_goals
from codesign.scheduling.storage import StudyStorage, file_lock, open_storage
from softgym_envs.config import check_compatible, check_config, load_config, save_resolved
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.storage import atomic_write, read_json, write_json

if TYPE_CHECKING:
    from filelock import BaseFileLock

__all__ = ["StudyFolder"]

# What may change between two runs of one study.
EXTENSIBLE = (
    *("name", "title", "trials", "workers", "executor", "heartbeat", "patience", "attempts"),
    *("finalists.count", "finalists.choose", "finalists.seeds", "finalists.steps", "finalists.fem_options"),
)
MADE_BY = ("finalists.steps", "finalists.fem_options")  # how tests of finalists were made
TESTED = """
SELECT EXISTS (SELECT FROM codesign_files JOIN studies USING (study_id)
               WHERE study_name = :study AND path LIKE 'finalists/%')
"""
"""Whether a database has tests of finalists of a study."""


class StudyFolder:
    """The folder of a study.

    It holds::

        config.yaml  provenance.json  goals.json
        journal.log                    Optuna's journal; or study.json, which study of the database this is
        screen/000.json ...            QP score of each candidate of the screen
        trials/0000/ ...               training of each trial, and its result.json once it is finished
        finalists/*.json               one evaluation each
        account.json                   time spent, and the command
        locks/                         locks of the operating system: they die with their holder
        results.json  trials.csv  finalists.csv  report.html

    Every file is either whole or absent. With a database, every machine may have such a folder: it then holds copies of
    all results, and the policies and training files of the trials that ran there.

    Args:
        path: the folder; see `create` for a new one.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).resolve()

    @classmethod
    def create(cls, path: str | Path, config: StudyConfig, *, wait: bool = False) -> StudyFolder:
        """Make the folder of a study, or open it to continue.

        Args:
            path: the folder.
            config: the study.
            wait: whether to wait for a database that does not answer; by default a wrong address is told at once.

        Raises:
            ConfigError: if the folder, or the study of this name in the database, is of another study, or FEM does not
                take ``finalists.fem_options``.
        """
        from codesign.phases.finalists import check_tests  # whose module needs this one

        folder = cls(path)
        folder.path.mkdir(parents=True, exist_ok=True)
        with folder.lock("study"):
            new = not (folder.path / "config.yaml").exists()
            if new and (folder.path / "journal.log").exists():
                raise ConfigError(f"folder '{path}' holds a journal but no config.yaml; use another folder")
            if not new:
                _accept(folder.config, config, f"folder '{path}'", "folder", folder._made())
            if new or folder.config.finalists != config.finalists:
                check_tests(config)  # now, and not after hours of trials
            goals = folder._agree(config, str(path), wait) if config.storage != JOURNAL else None
            if new or folder.config != config:
                save_resolved(folder.path, config)
                folder.__dict__.pop("config", None)
            if not (folder.path / "goals.json").exists():
                write_json(folder.path / "goals.json", draw_goals(config) if goals is None else goals)
        return folder

    def _agree(self, config: StudyConfig, shown: str, wait: bool) -> dict[str, Any]:
        """Agree with the other machines on configuration and goals of a study; return the goals."""
        from codesign.scheduling.postgres import PostgresStorage

        storage = PostgresStorage(
            config.storage, config.name, grace=config.heartbeat, patience=config.patience, wait=wait
        )
        known = self.path / "study.json"
        mine = read_json(known)["id"] if known.exists() else None

        def accept(shared: dict[str, Any] | None) -> dict[str, Any]:
            if shared is None:
                if mine is not None:
                    raise ConfigError(
                        f"the study '{config.name}' of folder '{shown}' is not in storage '{config.storage}'; use "
                        "another folder to begin anew"
                    )
                return {"config": config.model_dump(mode="json"), "goals": draw_goals(config)}
            where = f"storage '{config.storage}'"
            if "config" not in shared:
                raise ConfigError(f"{where} holds a study '{config.name}' that is none of co-design; use another name")
            if mine not in (None, shared["id"]):
                raise ConfigError(f"{where} holds another study '{config.name}' than folder '{shown}'; use another one")
            old = check_config(StudyConfig, shared["config"], f"study '{config.name}' of {where}")
            made = MADE_BY if storage.execute(TESTED, study=config.name) else self._made()
            _accept(old, config, where, "name", made)
            return {"config": config.model_dump(mode="json"), "goals": shared["goals"]}

        shared = storage.agree(accept, 1 + len(config.also))
        if mine is None:
            write_json(known, {"id": shared["id"]})
        return shared["goals"]

    def _made(self) -> tuple[str, ...]:
        """Keys of the configuration by which tests of finalists, or policies for them, in the folder were made."""
        if any(self.path.glob("finalists/*.json")):
            return MADE_BY
        return MADE_BY[:1] if any(self.path.glob("finalists/*/")) else ()

    def open_storage(self) -> StudyStorage:
        """Open the storage of the trials.

        Raises:
            ConfigError: if the database cannot be opened.
        """
        return open_storage(self.path, self.config)

    @cached_property
    def config(self) -> StudyConfig:
        """The resolved configuration."""
        if not (self.path / "config.yaml").exists():
            raise DataError(f"'{self.path}' is not the folder of a co-design study: it has no config.yaml")
        return load_config(self.path / "config.yaml", StudyConfig)

    @cached_property
    def goals(self) -> dict[str, np.ndarray]:
        """Goals [m] by use: ``training`` (k, 3), ``selection`` (k, p, 3), ``unseen`` (k, p, 3)."""
        stored = read_json(self.path / "goals.json")
        return {name: np.array(stored[name], dtype=float) for name in ("training", "selection", "unseen")}

    def account(self) -> dict[str, Any]:
        """Command that last ran the study, and wall-clock time of each phase so far, added up over calls [s]."""
        path = self.path / "account.json"
        return read_json(path) if path.exists() else {"command": "", "wall_seconds": {}}

    def lock(self, name: str) -> BaseFileLock:
        """Return a lock shared by all processes of the folder; see `codesign.scheduling.storage.file_lock`."""
        return file_lock(self.path, name)

    def policy(self, name: str) -> Path:
        """Return the file of a policy; it and its card are copied from the storage where another machine made them.

        Args:
            name: its path in the folder.

        Raises:
            DataError: if it is in neither.
        """
        path = self.path / name
        missing = [file for file in (path, path.with_suffix(".json")) if not file.exists()]
        storage = self.open_storage() if missing else None
        for file in missing:
            known = file.relative_to(self.path).as_posix()
            content = storage.fetch(known) if storage is not None else None
            if content is None:
                raise DataError(
                    f"policy '{known}' is neither in folder '{self.path}' nor in storage '{self.config.storage}'"
                )
            with atomic_write(file) as stream:
                stream.write(content)
        return path

    def trial(self, number: int) -> Path:
        """Folder of a trial."""
        return self.path / "trials" / f"{number:04d}"

    def result(self, number: int) -> dict[str, Any] | None:
        """Result of a trial, or None if it is not finished."""
        path = self.trial(number) / "result.json"
        return read_json(path) if path.exists() else None

    def results(self) -> list[dict[str, Any]]:
        """Results of all finished trials, by number."""
        paths = sorted((self.path / "trials").glob("[0-9]*/result.json"))
        return [read_json(path) for path in paths]


def _accept(old: StudyConfig, new: StudyConfig, where: str, use: str, made: tuple[str, ...]) -> None:
    """Raise unless a study can go on with a new configuration.

    Args:
        old: its configuration so far.
        new: what it is to be now.
        where: that holds the study.
        use: what to change to begin another one.
        made: keys by which tests of finalists were made, and which must stay therefore.
    """
    fixed = made if new.storage == JOURNAL else ("name", *made)
    extensible = [key for key in EXTENSIBLE if key not in fixed] + ["storage"] * (new.storage != JOURNAL)
    if (old.storage == JOURNAL) != (new.storage == JOURNAL):
        raise ConfigError(f"{where} holds a study with storage '{old.storage}', got '{new.storage}'; use another {use}")
    check_compatible(old, new, f"{where} holds a study", may_change=extensible, use=use)

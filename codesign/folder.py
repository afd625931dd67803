"""The folder of a study: which file is where, and who may continue it."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.codesign.config import JOURNAL, StudyConfig
from softgym_envs.codesign.goals import draw_goals
from softgym_envs.codesign.records import Account, TrialResult
from softgym_envs.codesign.scheduling.connect import open_storage
from softgym_envs.codesign.scheduling.storage import SharedStorage, StudyStorage
from softgym_envs.config import check_config
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.runs import RunFolder, check_compatible
from softgym_envs.storage import RESTORE, atomic_write, read_json, read_signed, write_json, write_signed

EXTENSIBLE = (
    *("name", "title", "trials", "workers", "heartbeat", "patience", "attempts"),
    *("finalists.count", "finalists.choose", "finalists.seeds", "finalists.steps", "finalists.fem_options"),
    *("finalists.test", "finalists.last_steps", "finalists.refinement"),
)
"""Keys that may change between two runs of one study."""

TEST_SETTINGS = (
    *("finalists.steps", "finalists.fem_options"),
    *("finalists.test", "finalists.last_steps", "finalists.refinement"),
)
"""Keys of `EXTENSIBLE` that must not change once finalists were tested with them."""


SHARED_POLICY = "shared_policy/policy.safetensors"
"""File of the shared policy, relative to the folder of a study."""
SHARED_POLICY_RECORD = "shared_policy/shared_policy.json"
"""File of its `softgym_envs.codesign.records.SharedPolicy`, relative to the folder of a study."""


class StudyFolder(RunFolder[StudyConfig]):
    """The folder of a study.

    It contains::

        config.yaml  provenance.json  goals.json
        journal.log                    Optuna's journal; or study.json, which identifies the study in the database
        screen/000.json ...            score of each candidate of the screen
        shared_policy/                 policy that scores every body, for strategies that have one
        trials/0000/ ...               training of each trial, and its result.json once it is finished
        finalists/*.json               one test each, those of many goals joined from finalists/parts/*.json
        account.json                   time spent, and the command
        locks/                         locks of the operating system, which end with their holder
        results.json  trials.csv  finalists.csv  report.html

    Every file is either whole or absent. With a database, each machine may have a folder of its own: it contains copies
    of all results, and the policies and training files of the trials that ran there.

    Args:
        path: the folder; see `create` for a new one.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(Path(path).resolve(), StudyConfig, "a co-design study")

    @classmethod
    def create(cls, path: str | Path, config: StudyConfig, *, wait: bool = False) -> StudyFolder:
        """Make the folder of a study, or open it to continue; ``wait`` for a database that does not answer.

        Raises:
            ConfigError: if the folder, or the study of this name in the database, belongs to another study.
        """
        folder = cls(path)
        folder.path.mkdir(parents=True, exist_ok=True)
        with folder.lock("study"):
            new = not folder.begun
            if new and (folder.path / "journal.log").exists():
                raise ConfigError(f"folder '{path}' holds a journal but no config.yaml; use another folder")
            if not new:
                _accept(folder.config, config, f"folder '{path}'", "folder", folder._tested_with())
            goals = None if config.storage == JOURNAL else folder._agree(config, str(path), wait)
            if new:
                folder.begin(config)
            elif folder.config != config:
                folder.keep(config)
            if not new:
                folder.check_complete()
            if not (folder.path / "goals.json").exists():
                write_signed(folder.path / "goals.json", draw_goals(config) if goals is None else goals)
            elif goals is not None and goals != folder.stored_goals:
                raise DataError(
                    f"'{folder.path / 'goals.json'}' has other goals than storage '{config.storage}'; {RESTORE}"
                )
        return folder

    def _agree(self, config: StudyConfig, shown: str, wait: bool) -> dict[str, Any]:
        """Agree with the other machines on the configuration and the goals of a study; return the goals."""
        storage = open_storage(self.path, config, wait=wait)
        assert isinstance(storage, SharedStorage)
        known = self.path / "study.json"
        mine = read_json(known)["id"] if known.exists() else None

        def accept(shared: dict[str, Any] | None) -> dict[str, Any]:
            if shared is None:
                if mine is not None:
                    raise ConfigError(
                        f"the study '{config.name}' of folder '{shown}' is not in storage '{config.storage}'; use "
                        "another folder to start again"
                    )
                return {"config": config.model_dump(mode="json"), "goals": draw_goals(config)}
            where = f"storage '{config.storage}'"
            if "config" not in shared:
                raise ConfigError(
                    f"{where} holds a study '{config.name}' that is not a co-design study; use another name"
                )
            if mine not in (None, shared["id"]):
                raise ConfigError(
                    f"{where} holds another study '{config.name}' than folder '{shown}'; use another folder"
                )
            old = check_config(StudyConfig, shared["config"], f"study '{config.name}' of {where}")
            fixed = TEST_SETTINGS if storage.has_files("finalists") else self._tested_with()
            _accept(old, config, where, "name", fixed)
            return {"config": config.model_dump(mode="json"), "goals": shared["goals"]}

        shared = storage.agree(accept, config.directions)
        if mine is None:
            write_json(known, {"id": shared["id"]})
        return shared["goals"]

    def check_complete(self) -> None:
        """Raise DataError if there are results of trials without the files that they follow from."""
        needed = ["provenance.json", "goals.json", *(["journal.log"] if self.config.storage == JOURNAL else [])]
        missing = next((name for name in needed if not (self.path / name).exists()), None)
        if missing is not None and self.result_files():
            raise DataError(f"'{self.path / missing}' is missing, but there are results of trials; {RESTORE}")

    def _tested_with(self) -> tuple[str, ...]:
        """Return the settings with which finalists in the folder were tested, or trained for their tests.

        A training that has not ended depends on none of them: with another number of steps it begins again.
        """
        if any(self.path.glob("finalists/*.json")) or any(self.path.glob("finalists/parts/*.json")):
            return TEST_SETTINGS
        return TEST_SETTINGS[:1] if any(self.path.glob("finalists/*/policy.safetensors")) else ()

    def open_storage(self) -> StudyStorage:
        """Open the storage of the trials."""
        return open_storage(self.path, self.config)

    @cached_property
    def goals(self) -> dict[str, np.ndarray]:
        """Goals [m] by use: ``training`` (k, 3), ``selection`` (k, p, 3), ``unseen`` (k, p, 3)."""
        stored = self.stored_goals
        return {name: np.array(stored[name], dtype=float) for name in ("training", "selection", "unseen")}

    @property
    def stored_goals(self) -> dict[str, Any]:
        """The goals as plain data, as `draw_goals` returns them."""
        return read_signed(self.path / "goals.json")

    def account(self) -> Account:
        """Return the time spent so far."""
        path = self.path / "account.json"
        return Account.read(path) if path.exists() else Account()

    def policy(self, name: str) -> Path:
        """Return the file of a policy, from its path in the folder.

        A policy that was made on another machine is copied from the storage, with its card.

        Raises:
            DataError: if the policy is in neither.
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
        """Return the folder of a trial."""
        return self.path / "trials" / f"{number:04d}"

    def result(self, number: int) -> TrialResult | None:
        """Return the result of a trial, or None if it is not finished."""
        path = self.trial(number) / "result.json"
        return TrialResult.read(path) if path.exists() else None

    def result_files(self) -> list[Path]:
        """Return the results of all finished trials, by number."""
        return sorted((self.path / "trials").glob("[0-9]*/result.json"))

    def results(self) -> list[TrialResult]:
        """Read the results of all finished trials, by number.

        Raises:
            DataError: if a file is damaged, or that of another trial.
        """
        results = []
        for path in self.result_files():
            result = TrialResult.read(path)
            if self.trial(result.number) != path.parent:
                raise DataError(f"'{path}' is the result of trial {result.number}; {RESTORE}")
            results.append(result)
        return results


def _accept(old: StudyConfig, new: StudyConfig, where: str, use: str, fixed: tuple[str, ...]) -> None:
    """Raise ConfigError unless the study at ``where`` can continue with a new configuration.

    The keys ``fixed`` of `EXTENSIBLE` must stay, except that a finer mesh may be added: no test has depended on it. To
    start another study, the message says to use another ``use``.
    """
    if old.finalists.refinement is None:
        fixed = tuple(key for key in fixed if key != "finalists.refinement")
    fixed = fixed if new.storage == JOURNAL else ("name", *fixed)
    extensible = [key for key in EXTENSIBLE if key not in fixed] + ["storage"] * (new.storage != JOURNAL)
    if (old.storage == JOURNAL) != (new.storage == JOURNAL):
        raise ConfigError(f"{where} holds a study with storage '{old.storage}', got '{new.storage}'; use another {use}")
    check_compatible(old, new, f"{where} holds a study", may_change=extensible, use=use)

"""Whether the files of a study are those that its journal tells of."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import EXTENSIBLE, StudyFolder
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.scheduling.journal import open_journal
from softgym_envs.config import check_config, difference
from softgym_envs.errors import ConfigError, DataError, SoftGymError
from softgym_envs.storage import RESTORE

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial


def check_journal(folder: StudyFolder, results: Sequence[TrialResult]) -> None:
    """Check configuration, goals and results of trials against the journal of a study, which may be running.

    Args:
        folder: of the study, with a journal.
        results: results of its trials, read before this call.

    Raises:
        DataError: one line that names the file that differs, and the remedy.
    """
    path = folder.path / "journal.log"
    storage = open_journal(path, mend=False)
    begun = storage.get_all_studies()
    if not begun:
        if results:
            raise DataError(f"'{path}' holds no study, but there are results of trials; {RESTORE}")
        return
    study = storage.get_study_id_from_name(begun[0].study_name)
    _check_inputs(folder, storage.get_study_user_attrs(study), path)
    trials = storage.get_all_trials(study, deepcopy=False)
    known = {result.number for result in results}
    for trial in trials:
        file = folder.trial(trial.number) / "result.json"
        if trial.state.name in ("COMPLETE", "PRUNED") and trial.number not in known and not file.exists():
            raise DataError(f"'{file}' is missing, but '{path}' says that the trial is finished; {RESTORE}")
    for result in results:
        file = folder.trial(result.number) / "result.json"
        if result.number >= len(trials):
            raise DataError(f"'{path}' does not have the trial of '{file}'; {RESTORE}")
        if what := _difference(folder.config, trials[result.number], result):
            raise DataError(f"'{file}' and '{path}' differ in {what}; {RESTORE}")


def _check_inputs(folder: StudyFolder, kept: dict[str, Any], path: Path) -> None:
    if not {"config", "goals"} <= kept.keys():  # a process was killed while it made the study
        return
    try:
        begun = check_config(StudyConfig, kept["config"], f"the configuration in '{path}'")
    except ConfigError as error:
        raise DataError(f"{error}; {RESTORE}") from None
    if other := difference(begun, folder.config, ignore=EXTENSIBLE):
        raise DataError(f"'{path}' and '{folder.path / 'config.yaml'}' are of different studies: {other}; {RESTORE}")
    if kept["goals"] != folder.stored_goals:
        raise DataError(f"'{folder.path / 'goals.json'}' has other goals than '{path}'; {RESTORE}")


def _difference(config: StudyConfig, trial: FrozenTrial, result: TrialResult) -> str:
    """Return in what a result differs from the journal, which may not know its end yet; empty if in nothing."""
    known = trial.user_attrs
    try:
        design, options = config.body(trial.params)
    except (SoftGymError, ValueError, KeyError) as error:
        return f"the body, which the journal has with {trial.params}: {error}"
    rows: list[tuple[str, Any, Any]] = [
        ("origin", known.get("origin"), result.origin),
        ("sampler_seed", known.get("sampler_seed"), result.sampler_seed),
        ("design", design, result.design),
        ("options", options, result.options),
    ]
    if trial.state.is_finished():
        state = "COMPLETE" if result.state == "complete" else "PRUNED"
        rows += [
            ("state", trial.state.name, state),
            # Optuna gives pruned trials their last report as a value.
            ("scores", config.signed(trial.values) if trial.state.name == "COMPLETE" else [], result.scores),
            ("values", known.get("values"), result.values),
            ("controller", known.get("controller"), result.controller),
        ]
    for name, journal, file in rows:
        if json.dumps(journal, sort_keys=True) != json.dumps(file, sort_keys=True):  # NaN equals NaN
            return f"{name}: {json.dumps(file)} and {json.dumps(journal)}"
    return ""

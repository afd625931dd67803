"""The Optuna study behind a co-design study: its sampler, its pruner and the ranges of its variables."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.parts import PRUNERS
from softgym_envs.codesign.sampling import construct, make_sampler
from softgym_envs.codesign.scheduling.storage import StudyStorage
from softgym_envs.designs import DesignVariable
from softgym_envs.errors import DataError

if TYPE_CHECKING:
    import optuna


def make_pruner(config: StudyConfig) -> optuna.pruners.BasePruner:
    """Return the pruner of a study; pruners that count resources count environment steps."""
    import optuna

    options = dict(config.pruner.options)
    if config.pruner.name in ("hyperband", "successive_halving"):
        options.setdefault("min_resource", config.training.report_every)
    if config.pruner.name == "hyperband":
        options.setdefault("max_resource", config.training.steps)
    return construct(getattr(optuna.pruners, PRUNERS[config.pruner.name]), options)


def distributions(variables: Mapping[str, DesignVariable]) -> dict[str, optuna.distributions.BaseDistribution]:
    """Return the range of each variable [SI]; of a choice, the middle of each of its values."""
    import optuna

    return {
        name: optuna.distributions.CategoricalDistribution([k + 0.5 for k in range(len(variable.choices))])
        if variable.choices
        else optuna.distributions.FloatDistribution(variable.low, variable.high, log=variable.log)
        for name, variable in variables.items()
    }


def trial_id(storage: optuna.storages.BaseStorage, study: optuna.Study, number: int) -> int:
    """Return the ID by which a storage knows a trial of a study."""
    return storage.get_trial_id_from_study_id_trial_number(storage.get_study_id_from_name(study.study_name), number)


def tell(study: optuna.Study, number: int, values: Sequence[float] = ()) -> None:
    """Finish a trial with its values, or as pruned: samplers rank it last, but would ignore a failed one."""
    import optuna

    if values:
        study.tell(number, list(values))
    else:
        study.tell(number, state=optuna.trial.TrialState.PRUNED)


def open_study(folder: StudyFolder, storage: StudyStorage | None = None, number: int = 0) -> optuna.Study:
    """Open the Optuna study of a folder, with a sampler that proposes the trial ``number``.

    Raises:
        DataError: if the database no longer has the study.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = folder.open_storage() if storage is None else storage
    if storage.opened is None:
        storage.opened = _load(folder.config, storage)
    study = storage.opened
    study.sampler, study.pruner = make_sampler(folder.config.sampler, number), make_pruner(folder.config)
    if study.metric_names is None:
        if not storage.shared:  # a shared one has them already
            study.set_user_attr("config", folder.config.model_dump(mode="json"))
            study.set_user_attr("goals", folder.stored_goals)
        _describe(study, folder.config)
    return study


def _load(config: StudyConfig, storage: StudyStorage) -> optuna.Study:
    import optuna

    try:
        return optuna.load_study(study_name=storage.study, storage=storage.optuna)
    except KeyError:
        if storage.shared:
            raise DataError(f"storage '{config.storage}' has no study '{storage.study}'") from None
        return optuna.create_study(study_name=storage.study, storage=storage.optuna, directions=config.directions)


def _describe(study: optuna.Study, config: StudyConfig) -> None:
    """Tell Optuna's own tools what a study is about."""
    study.set_user_attr("environment", config.environment.id)
    study.set_user_attr("strategy", config.strategy)
    name_metrics(study, config.titles)


def name_metrics(study: optuna.Study, names: Sequence[str]) -> None:
    """Tell Optuna's own tools what the values of a study are called."""
    import optuna

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study.set_metric_names(list(names))

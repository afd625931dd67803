"""Who runs which trial.

Every change of it happens while no other process is at it, so no trial is lost, run twice or one too many. A trial
belongs to a worker, and a worker shows that it lives (`codesign.scheduling.storage`): a trial whose worker does not was
left behind (``kill -9``, power cut). Its result is taken over if it was already written; else its body is queued again.

A body is blamed for the death of its worker if the call that had started the worker outlived it, or if it was an error
that is a bug. It is not if the call has ended as well: Ctrl-C, ``kill -9`` of everything and a power cut say nothing
about a body. One that takes its call down with it (all memory of the machine) cannot be told from these and is not
blamed either; whoever starts the call again sees it. Nor is one whose worker died while it claimed the trial, before it
looked at the body.
"""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from codesign.config import PRUNERS, StudyConfig
from codesign.folder import StudyFolder
from codesign.sampling import construct, make_sampler, trial_seed
from codesign.scheduling.storage import StudyStorage
from softgym_envs.errors import DataError
from softgym_envs.storage import write_json

if TYPE_CHECKING:
    import optuna

__all__ = ["Ledger", "open_study"]

T = TypeVar("T")

CALL = "SOFTGYM_STUDY_CALL"
"""Environment variable by which workers know the ledger of the call that started them."""

TOLD = ("success_rate", "mean_distance", "mean_return")
"""What Optuna is told of an evaluation beside its score, for people who look there (``optuna-dashboard``)."""


def _reports(trials: Sequence[optuna.trial.FrozenTrial], number: int) -> dict[int, float]:
    """What was reported by a trial and by those that it replaces, by step: a worker may die before it says it again."""
    chain = [trials[number]]
    while "replaces" in chain[-1].user_attrs:
        chain.append(trials[chain[-1].user_attrs["replaces"]])
    found: dict[int, float] = {}
    for trial in reversed(chain):
        found |= trial.intermediate_values
    return dict(sorted(found.items()))


def make_pruner(config: StudyConfig) -> optuna.pruners.BasePruner:
    """Pruner of a study; those that count resources count environment steps."""
    import optuna

    options = dict(config.pruner.options)
    if config.pruner.name in ("hyperband", "successive_halving"):
        options.setdefault("min_resource", config.training.report_every)
    if config.pruner.name == "hyperband":
        options.setdefault("max_resource", config.training.steps)
    return construct(getattr(optuna.pruners, PRUNERS[config.pruner.name]), options)


def distributions(config: StudyConfig) -> dict[str, optuna.distributions.BaseDistribution]:
    """Range of each optimised variable [SI]."""
    import optuna

    space = config.space
    return {
        name: optuna.distributions.FloatDistribution(space[name].low, space[name].high, log=space[name].log)
        for name in config.variables
    }


def open_study(folder: StudyFolder, storage: StudyStorage | None = None, number: int = 0) -> optuna.Study:
    """Open the Optuna study of a folder; it always maximises the scores, see `codesign.objectives`.

    Args:
        folder: the study.
        storage: its storage, opened anew by default.
        number: trial that the sampler is for.

    Raises:
        DataError: if a database does not have it any more.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = folder.open_storage() if storage is None else storage
    sampler, pruner = make_sampler(folder.config.sampler, number), make_pruner(folder.config)
    try:
        return optuna.load_study(study_name=storage.study, storage=storage.optuna, sampler=sampler, pruner=pruner)
    except KeyError:
        if storage.shared:
            raise DataError(f"storage '{folder.config.storage}' has no study '{storage.study}'") from None
    directions = [optuna.study.StudyDirection.MAXIMIZE] * (1 + len(folder.config.also))
    return optuna.create_study(
        study_name=storage.study, storage=storage.optuna, directions=directions, sampler=sampler, pruner=pruner
    )


class Ledger:
    """The trials of a study, as one worker sees them. Use it as a context: the worker lives as long as it is open.

    The call that starts workers has one too, and must have it open as long as they run.

    Args:
        folder: the study.
    """

    def __init__(self, folder: StudyFolder) -> None:
        self.folder = folder
        self.worker = f"worker-{uuid.uuid4().hex[:12]}"
        self.call = os.environ.get(CALL)
        self.storage = folder.open_storage()
        self._presence = self.storage.present(self.worker)
        self._claimed: set[int] = set()
        self._mirrored: set[int] = set()
        self._exclusively(lambda study: None)

    def __enter__(self) -> Ledger:
        self._presence.__enter__()
        os.environ[CALL] = self.worker
        return self

    def __exit__(self, *exception: Any) -> None:
        if self.call is None:
            os.environ.pop(CALL, None)
        else:
            os.environ[CALL] = self.call
        self._presence.__exit__(*exception)

    @property
    def study(self) -> optuna.Study:
        """The Optuna study, to be read."""
        return open_study(self.folder, self.storage)

    def enqueue(self, bodies: list[tuple[str, dict[str, float]]]) -> None:
        """Queue bodies, each once however often this is called.

        Args:
            bodies: unique origin (such as ``"baseline"``) and value of each optimised variable [SI].
        """

        def action(study: optuna.Study) -> None:
            known = {trial.user_attrs.get("origin") for trial in study.get_trials(deepcopy=False)}
            for origin, values in bodies:
                if origin not in known:
                    study.enqueue_trial(values, user_attrs={"origin": origin})

        self._exclusively(action)

    def claim(self) -> optuna.Trial | None:
        """Take the next trial, or None if the study has as many as were asked for."""
        trial = self._exclusively(self._claim)
        if trial is not None:
            self._claimed.add(trial.number)
            self._inherit_folder(trial)
        return trial

    def finish(self, result: dict[str, Any]) -> bool:
        """Enter the result of a trial.

        Returns:
            False if the trial was taken from this worker, which was thought dead: the result is then dropped.
        """

        def action(study: optuna.Study) -> bool:
            from optuna.trial import TrialState

            trial = study.get_trials(deepcopy=False)[result["number"]]
            if trial.state == TrialState.RUNNING and trial.user_attrs.get("worker") == self.worker:
                self._tell(study, trial, result)
                return True
            return trial.user_attrs.get("result") == result  # it was entered, and the answer got lost

        self._publish(result)
        return self._exclusively(action)

    def left(self) -> int:
        """Number of trials still to be finished, running ones included."""
        from optuna.trial import TrialState

        trials = self._exclusively(lambda study: study.get_trials(deepcopy=False))
        done = sum(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
        queued = sum(trial.state in (TrialState.WAITING, TrialState.RUNNING) for trial in trials)
        return max(self.folder.config.trials - done, queued)

    def claimable(self) -> bool:
        """Tell whether there is a trial to take, after taking over what dead workers left behind."""
        return self._exclusively(self._claimable)

    def mirror(self) -> None:
        """Copy the results of trials that ran on other machines into the folder."""
        from optuna.trial import TrialState

        if not self.storage.shared:
            return
        for trial in self.storage.patiently(lambda: self.study.get_trials(deepcopy=False)):
            if trial.number in self._mirrored or not trial.state.is_finished():
                continue
            path = self.folder.trial(trial.number) / "result.json"
            if trial.state == TrialState.FAIL:  # its body runs, or ran, again
                path.unlink(missing_ok=True)
            elif self.folder.result(trial.number) != trial.user_attrs["result"]:
                write_json(path, trial.user_attrs["result"])
            self._mirrored.add(trial.number)

    def _publish(self, result: dict[str, Any]) -> None:
        """Give the policy of a trial to other machines, before they can learn of it."""
        if self.storage.shared and result["agent"] != "qp":
            policy = Path(result["agent"])
            names = [path.as_posix() for path in (policy, policy.with_suffix(".json"))]
            self.storage.publish({name: (self.folder.path / name).read_bytes() for name in names})

    def _exclusively(self, action: Callable[[optuna.Study], T]) -> T:
        """Return what ``action`` does with the study while no other process is at it."""
        return self.storage.exclusively(lambda: action(open_study(self.folder, self.storage)))

    # -- what happens exclusively -----------------------------------------------------------------------------------

    def _claim(self, study: optuna.Study) -> optuna.Trial | None:
        import optuna
        from optuna.trial import TrialState

        config = self.folder.config
        for taken in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if taken.user_attrs.get("worker") == self.worker and taken.number not in self._claimed:
                # It was claimed, and the answer got lost.
                return optuna.Trial(study, taken._trial_id)
        if not self._claimable(study):
            return None
        number = len(study.get_trials(deepcopy=False))
        trial = open_study(self.folder, self.storage, number).ask(distributions(config))
        if self.call is not None:
            trial.set_user_attr("call", self.call)
        trial.set_user_attr("process", f"{socket.gethostname()}:{os.getpid()}")
        if "origin" not in trial.user_attrs:
            trial.set_user_attr("origin", f"sampler {trial.number}")
            trial.set_user_attr("sampler_seed", trial_seed(config.sampler, trial.number))
        if "replaces" in trial.user_attrs:
            for step, value in _reports(study.get_trials(deepcopy=False), trial.user_attrs["replaces"]).items():
                trial.report(value, step)
        trial.set_user_attr("worker", self.worker)  # the last: without it, it was not claimed
        return trial

    def _claimable(self, study: optuna.Study) -> bool:
        from optuna.trial import TrialState

        self._recover(study)
        trials = study.get_trials(deepcopy=False)
        counted = sum(trial.state != TrialState.FAIL for trial in trials)
        return counted < self.folder.config.trials or any(trial.state == TrialState.WAITING for trial in trials)

    def _tell(self, study: optuna.Study, trial: optuna.trial.FrozenTrial, result: dict[str, Any]) -> None:
        from optuna.trial import TrialState

        told = {key: value for key, value in (result.get("evaluation") or {}).items() if key in TOLD}
        if result.get("reason"):
            told["reason"] = result["reason"]
        if self.storage.shared:
            told["result"] = result
        for key, value in told.items():
            self.storage.optuna.set_trial_user_attr(trial._trial_id, key, value)
        if result["state"] == "complete":
            study.tell(trial.number, result["scores"])
        else:
            # An infeasible body is pruned without a value: samplers then rank it last, while failures teach nothing.
            study.tell(trial.number, state=TrialState.PRUNED)

    def _recover(self, study: optuna.Study) -> None:
        from optuna.trial import TrialState

        trials = study.get_trials(deepcopy=False)
        replaced = {trial.user_attrs.get("replaces") for trial in trials}
        for trial in trials:
            if trial.state != TrialState.RUNNING or self._lives(trial.user_attrs.get("worker")):
                continue
            result = self.folder.result(trial.number)
            if result is not None and result["number"] == trial.number:
                self._publish(result)
                self._tell(study, trial, result)
                continue
            # Queued before it is written off: a crash between the two does not lose it, and the mark keeps it single.
            if trial.number not in replaced:
                complete = set(trial.params) == set(self.folder.config.variables)
                values = trial.params if complete else trial.system_attrs.get("fixed_params")
                if values:  # else it died before its body was drawn: the next one is drawn in its place
                    marks: dict[str, Any] = {"origin": f"sampler {trial.number}", "replaces": trial.number}
                    for key in ("origin", "sampler_seed"):
                        if key in trial.user_attrs:
                            marks[key] = trial.user_attrs[key]
                    earlier = trial.user_attrs.get("replaces")
                    known = {} if earlier is None else _reports(trials, earlier)
                    progress = len(_reports(trials, trial.number)) > len(known)
                    blamed = self._blamed(trial)
                    marks["attempt"] = 1 if progress else trial.user_attrs.get("attempt", 1) + blamed
                    study.enqueue_trial(values, user_attrs=marks)
            study.tell(trial.number, state=TrialState.FAIL)

    def _lives(self, worker: str | None) -> bool:
        # Without a worker it was left by one that was killed in here.
        return worker is not None and (worker == self.worker or self.storage.lives(worker))

    def _blamed(self, trial: optuna.trial.FrozenTrial) -> bool:
        """Tell whether a trial counts as the cause of its worker's death; see the module."""
        if "worker" not in trial.user_attrs:  # it was killed while it claimed the trial, before it looked at the body
            return False
        call = trial.user_attrs.get("call")
        if "raised" in trial.user_attrs or call is None or call == self.worker:
            return True
        return self.storage.outlived(call, trial.user_attrs["worker"])

    # ---------------------------------------------------------------------------------------------------------------

    def _inherit_folder(self, trial: optuna.Trial) -> None:
        """Give a trial that runs again what those before it left here of its training."""
        new, marks = self.folder.trial(trial.number), trial.user_attrs
        if "replaces" not in marks:
            return
        trials = self.storage.patiently(lambda: self.study.get_trials(deepcopy=False))
        while not new.exists() and "replaces" in marks:
            old = self.folder.trial(marks["replaces"])
            if old.exists():
                old.rename(new)
                (new / "result.json").unlink(missing_ok=True)
            marks = trials[marks["replaces"]].user_attrs

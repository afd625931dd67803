"""Queue of a study's trials.

Workers change the queue one at a time, so no trial is lost, run twice or added beyond the budget. A trial belongs to
one worker, which shows that it is alive (`softgym_envs.codesign.scheduling.storage`). If the worker dies (``kill -9``,
power cut), the trial is recovered: its result is used if it was already written, otherwise its body is queued again.

A body counts as the cause of its worker's death if the call that started the worker is still alive. It does not if the
call ended as well: Ctrl-C, ``kill -9`` of all processes and a power cut say nothing about a body. A body that also ends
its call, for example because it fills the memory of the machine, looks the same; whoever restarts the call will notice.
A worker that dies while it claims a trial has not used the body yet, so the body is not to blame either. Exceptions
are bugs: they end the study with their traceback, and its next call runs the body again.
"""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.sampling import trial_seed
from softgym_envs.codesign.scheduling.optuna_study import distributions, open_study, tell, trial_id

if TYPE_CHECKING:
    import optuna

T = TypeVar("T")

CALL = "SOFTGYM_STUDY_CALL"
"""Environment variable that tells workers the queue of the call that started them."""

REPORTED_METRICS = ("success_rate", "mean_distance", "mean_return")
"""Metrics of an evaluation that Optuna stores besides the scores, for people who look there (``optuna-dashboard``)."""


def _reports(trials: Sequence[optuna.trial.FrozenTrial], number: int) -> dict[int, float]:
    """Return what a trial and those that it replaces reported, by step."""
    chain = [trials[number]]
    while "replaces" in chain[-1].user_attrs:
        chain.append(trials[chain[-1].user_attrs["replaces"]])
    found: dict[int, float] = {}
    for trial in reversed(chain):  # a worker may die before it repeats the reports of the trial that it continues
        found |= trial.intermediate_values
    return dict(sorted(found.items()))


class TrialQueue:
    """The trials of a study, as one worker sees them.

    Use it as a context manager: the worker counts as alive while the context is open. The call that starts workers has
    a queue of its own, which must be open while they run.

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

    def __enter__(self) -> TrialQueue:
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
        """The Optuna study, for reading only."""
        return open_study(self.folder, self.storage)

    def enqueue(self, bodies: list[tuple[str, dict[str, float]]]) -> None:
        """Add bodies to the queue, each only once however often this is called.

        Args:
            bodies: unique origin (such as ``"baseline"``) and value of each optimised variable [SI].
        """

        def action(study: optuna.Study) -> None:
            known = {trial.user_attrs.get("origin") for trial in study.get_trials(deepcopy=False)}
            for origin, values in bodies:
                if origin not in known:
                    study.enqueue_trial(values, user_attrs={"origin": origin})

        self._exclusively(action)

    def ask(self) -> list[optuna.Trial]:
        """Take the next trial, in a list; none if the study has all its trials."""
        trial = self.claim()
        return [] if trial is None else [trial]

    def tell(self, trial: optuna.Trial, result: TrialResult) -> None:
        """Record the result of a trial; see `finish`."""
        self.finish(result)

    def claim(self) -> optuna.Trial | None:
        """Take the next trial; None if the study has all its trials."""
        trial = self._exclusively(self._claim)
        if trial is not None:
            self._claimed.add(trial.number)
            self._inherit_folder(trial)
        return trial

    def finish(self, result: TrialResult) -> bool:
        """Record the result of a trial.

        Returns:
            False if the trial was reassigned because this worker seemed dead; its result is then dropped.
        """

        def action(study: optuna.Study) -> bool:
            from optuna.trial import TrialState

            trial = study.get_trials(deepcopy=False)[result.number]
            if trial.state == TrialState.RUNNING and trial.user_attrs.get("worker") == self.worker:
                self._tell(study, trial, result)
                return True
            return trial.user_attrs.get("result") == result.to_json()  # recorded, but the answer got lost

        self._publish(result)
        return self._exclusively(action)

    def left(self) -> int:
        """Return the number of unfinished trials, running ones included."""
        from optuna.trial import TrialState

        trials = self._exclusively(lambda study: study.get_trials(deepcopy=False))
        done = sum(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
        queued = sum(trial.state in (TrialState.WAITING, TrialState.RUNNING) for trial in trials)
        return max(self.folder.config.trials - done, queued)

    def claimable(self) -> bool:
        """Return whether there is a trial to claim, after recovering the trials of dead workers."""
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
            if trial.state == TrialState.FAIL:  # another trial repeats it
                path.unlink(missing_ok=True)
            else:
                result = TrialResult.from_json(trial.user_attrs["result"])
                if self.folder.result(trial.number) != result:
                    result.write(path)
            self._mirrored.add(trial.number)

    def _publish(self, result: TrialResult) -> None:
        """Send the policy of a trial to other machines, before they can learn of it."""
        if self.storage.shared and result.controller != "qp":
            policy = Path(result.controller)
            names = [path.as_posix() for path in (policy, policy.with_suffix(".json"))]
            self.storage.publish({name: (self.folder.path / name).read_bytes() for name in names})

    def _exclusively(self, action: Callable[[optuna.Study], T]) -> T:
        """Return the result of ``action`` on the study, which no other process changes meanwhile."""
        return self.storage.exclusively(lambda: action(open_study(self.folder, self.storage)))

    # -- called exclusively ------------------------------------------------------------------------------------------

    def _claim(self, study: optuna.Study) -> optuna.Trial | None:
        import optuna
        from optuna.trial import TrialState

        config = self.folder.config
        for taken in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if taken.user_attrs.get("worker") == self.worker and taken.number not in self._claimed:
                # Claimed, but the answer got lost.
                return optuna.Trial(study, trial_id(self.storage.optuna, study, taken.number))
        if not self._claimable(study):
            return None
        number = len(study.get_trials(deepcopy=False))
        trial = open_study(self.folder, self.storage, number).ask(distributions(config.optimised))
        if self.call is not None:
            trial.set_user_attr("call", self.call)
        trial.set_user_attr("process", f"{socket.gethostname()}:{os.getpid()}")
        if "origin" not in trial.user_attrs:
            trial.set_user_attr("origin", f"sampler {trial.number}")
            trial.set_user_attr("sampler_seed", trial_seed(config.sampler, trial.number))
        if "replaces" in trial.user_attrs:
            for step, value in _reports(study.get_trials(deepcopy=False), trial.user_attrs["replaces"]).items():
                trial.report(value, step)
        trial.set_user_attr("worker", self.worker)  # last: a trial without it was not claimed
        return trial

    def _claimable(self, study: optuna.Study) -> bool:
        from optuna.trial import TrialState

        self._recover(study)
        trials = study.get_trials(deepcopy=False)
        counted = sum(trial.state != TrialState.FAIL for trial in trials)
        return counted < self.folder.config.trials or any(trial.state == TrialState.WAITING for trial in trials)

    def _tell(self, study: optuna.Study, trial: optuna.trial.FrozenTrial, result: TrialResult) -> None:
        attributes: dict[str, Any] = {}
        if result.evaluation is not None:
            attributes = {name: getattr(result.evaluation, name) for name in REPORTED_METRICS}
        attributes |= {"design": result.design, "values": result.values, "controller": result.controller}
        if result.reason:
            attributes["reason"] = result.reason
        if self.storage.shared:
            attributes["result"] = result.to_json()
        known = trial_id(self.storage.optuna, study, trial.number)
        for key, value in attributes.items():
            self.storage.optuna.set_trial_user_attr(known, key, value)
        complete = result.state == "complete"
        tell(study, trial.number, self.folder.config.signed(result.scores) if complete else ())

    def _recover(self, study: optuna.Study) -> None:
        from optuna.trial import TrialState

        trials = study.get_trials(deepcopy=False)
        replaced = {trial.user_attrs.get("replaces") for trial in trials}
        for trial in trials:
            if trial.state != TrialState.RUNNING or self._lives(trial.user_attrs.get("worker")):
                continue
            result = self.folder.result(trial.number)
            if result is not None and result.number == trial.number:
                self._publish(result)
                self._tell(study, trial, result)
                continue
            # Queue it before it is marked as failed: a crash in between does not lose it, and ``replaces`` keeps it
            # from being queued twice.
            if trial.number not in replaced:
                complete = set(trial.params) == set(self.folder.config.variables)
                values = trial.params if complete else trial.system_attrs.get("fixed_params")
                if values:  # otherwise the worker died before the sampler proposed a body
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
        # A trial without a worker was left by one that was killed in `_claim`.
        return worker is not None and (worker == self.worker or self.storage.lives(worker))

    def _blamed(self, trial: optuna.trial.FrozenTrial) -> bool:
        """Return whether a trial counts as the cause of its worker's death; see the module docstring."""
        if "worker" not in trial.user_attrs:  # killed while it claimed the trial, before it looked at the body
            return False
        if "raised" in trial.user_attrs:  # an exception ended the study: it is a bug to fix, not a property of the body
            return False
        call = trial.user_attrs.get("call")
        if call is None or call == self.worker:
            return True
        return self.storage.outlived(call, trial.user_attrs["worker"])

    # ---------------------------------------------------------------------------------------------------------------

    def _inherit_folder(self, trial: optuna.Trial) -> None:
        """Move the training files of the trials that this one repeats into its folder."""
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

"""Design search without gradients: Optuna, one objective or several (thesis, sec. 3.2.5)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.sampling import make_sampler
from softgym_envs.codesign.scheduling.journal import open_journal
from softgym_envs.codesign.scheduling.optuna_study import trial_id
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.design.config import OptimiseConfig, SearchConfig
from softgym_envs.extensions.design.evaluation import Evaluation, evaluate_each
from softgym_envs.extensions.design.plots import draw_front
from softgym_envs.extensions.design.records import FrontDesign, SearchResult
from softgym_envs.runs import RunFolder
from softgym_envs.storage import atomic_write, write_json
from softgym_envs.wording import counted

if TYPE_CHECKING:
    import optuna


def search(config: OptimiseConfig, folder: str | Path, *, progress: bool = True) -> SearchResult:
    """Search for the best designs with an Optuna sampler; continues a search that was interrupted.

    Optuna's journal gets proposals in batches and results one by one. A batch is filled up until it has as many
    feasible designs as its size. The result does not depend on interruptions or on the number of workers, with one
    exception: ``qmc`` skips the points of a batch that was interrupted while it was proposed.

    Args:
        config: a configuration with solver ``"search"``.
        folder: where the journal, ``result.json``, ``trials.csv`` and a picture go.
        progress: show a progress bar.

    Raises:
        ConfigError: if the folder holds results of another configuration or tool, or another process uses it.
        ConvergenceError: if no design is feasible.
    """
    may_change = ("name", "workers", "solver.trials")
    run = RunFolder(folder, OptimiseConfig, "a search")
    with run.reserve(config, may_change, progress=progress) as place:
        study = _Search(config, place)
        study.run(progress)
        result, values, front = study.result()
        write_json(place / "result.json", {**run.stamp(), **result.to_json()})
        study.write_table(place / "trials.csv")
        draw_front(place / "front.png", [o.find() for o in config.objectives], values, front)
    return result


class _Search:
    """The Optuna study of a search, in the journal of its folder.

    Args:
        config: the search.
        folder: its folder, used by this process alone.
    """

    def __init__(self, config: OptimiseConfig, folder: Path) -> None:
        import optuna

        assert isinstance(config.solver, SearchConfig)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.config, self.solver = config, config.solver
        self.box = config.bodies.box()
        self._storage = open_journal(folder / "journal.log")
        self._study = optuna.create_study(
            study_name="search",
            storage=self._storage,
            load_if_exists=True,
            directions=["minimize"] * len(config.objectives),
            sampler=make_sampler(self.solver.sampler, 0),
        )
        self._discard_unfinished_batch()

    def _discard_unfinished_batch(self) -> None:
        """Fail the trials of a batch that was interrupted while it was proposed; all of it is then proposed again.

        The journal has a trial before its parameters, so some trials may lack theirs.
        """
        import optuna

        proposed = self._study.user_attrs.get("proposed", 0)
        for trial in self._study.get_trials(deepcopy=False)[proposed:]:
            if not trial.state.is_finished():
                known = trial_id(self._storage, self._study, trial.number)
                self._storage.set_trial_state_values(known, optuna.trial.TrialState.FAIL)

    def trials(self) -> list[optuna.trial.FrozenTrial]:
        """Return all trials except those of discarded batches."""
        trials = self._study.get_trials(deepcopy=False)
        return [trial for trial in trials if "evaluation" in trial.user_attrs or not trial.state.is_finished()]

    def run(self, progress: bool) -> None:
        """Propose and evaluate designs until the search has as many trials as it should."""
        import click

        evaluator = self.config.bodies.evaluator(self.config.metrics)
        known = {self._key(trial): _evaluation(trial) for trial in reversed(self.trials()) if trial.state.is_finished()}
        with click.progressbar(length=self.solver.trials, label="designs", hidden=not progress) as bar:
            while True:
                trials = self.trials()
                bar.update(sum(trial.state.is_finished() for trial in trials) - bar.pos)
                batch: Sequence[Any] = [trial for trial in trials if not trial.state.is_finished()]
                if not batch:
                    if len(trials) >= self.solver.trials:
                        return
                    batch = self._propose(trials)
                new = {self._key(trial): trial for trial in batch if self._key(trial) not in known}
                for trial in batch:
                    if new.get(self._key(trial)) is not trial and self._key(trial) in known:
                        self._tell(trial, replace(known[self._key(trial)], seconds=0.0, repeated=True))
                by_number = {trial.number: trial for trial in new.values()}
                designs = [(number, {**self.box.reference, **trial.params}) for number, trial in by_number.items()]
                for number, evaluation in evaluate_each(evaluator, designs, self.config.workers):
                    known[self._key(by_number[number])] = evaluation
                    self._tell(by_number[number], evaluation)
                    bar.update(1)

    def _propose(self, trials: Sequence[optuna.trial.FrozenTrial]) -> list[optuna.Trial]:
        """Ask the sampler for the rest of a batch."""
        import optuna

        solver = self.solver
        complete = sum(trial.state == optuna.trial.TrialState.COMPLETE for trial in trials)
        missing = min(solver.batch - complete % solver.batch, solver.trials - len(trials))
        distributions: dict[str, optuna.distributions.BaseDistribution] = {
            name: optuna.distributions.FloatDistribution(variable.low, variable.high, log=variable.log)
            for name, variable in self.box.free.variables.items()
        }
        batch = []
        for number in range(len(trials), len(trials) + missing):
            self._study.sampler = make_sampler(solver.sampler, number)
            if number < len(solver.starts):
                values = self.box.free.complete(solver.starts[number])
                self._study.enqueue_trial({name: values[name] for name in self.box.names})
            batch.append(self._study.ask(distributions))
        self._study.set_user_attr("proposed", batch[-1].number + 1)
        return batch

    def _key(self, trial: optuna.trial.FrozenTrial | optuna.Trial) -> tuple[float, ...]:
        return tuple(trial.params[name] for name in self.box.names)

    def _tell(self, trial: optuna.trial.FrozenTrial | optuna.Trial, evaluation: Evaluation) -> None:
        import optuna

        known = trial_id(self._storage, self._study, trial.number)
        self._storage.set_trial_user_attr(known, "evaluation", evaluation.to_json())
        if evaluation.feasible:
            objectives = self.config.objectives
            self._study.tell(trial.number, [float(o.cost(evaluation.metrics[o.find().name])) for o in objectives])
        else:
            self._study.tell(trial.number, state=optuna.trial.TrialState.FAIL)

    def result(self) -> tuple[SearchResult, np.ndarray, np.ndarray]:
        """Return the result, the metrics (n, m) [SI] of all feasible designs, and the indices of the front in them."""
        names = [objective.find().name for objective in self.config.objectives]
        evaluations = [_evaluation(trial) for trial in self.trials()]
        feasible = [trial for trial in self.trials() if trial.values is not None]
        if not feasible:
            raise ConvergenceError(
                f"none of {counted(len(evaluations), 'design')} is feasible; the first: {evaluations[0].infeasible}"
            )
        best = [trial for trial in self._study.best_trials if not _evaluation(trial).repeated]
        best.sort(key=lambda trial: (trial.values[0], trial.number))
        if len(names) == 1:
            best = best[:1]
        place = {trial.number: k for k, trial in enumerate(feasible)}
        result = SearchResult(
            front=[
                FrontDesign(
                    trial=trial.number,
                    design={**self.box.reference, **trial.params},
                    metrics=_evaluation(trial).metrics,
                )
                for trial in best
            ],
            feasible=len(feasible),
            infeasible=len(evaluations) - len(feasible),
            repeated=sum(evaluation.repeated for evaluation in evaluations),
            busy_seconds=sum(evaluation.seconds for evaluation in evaluations),
        )
        values = np.array([[_evaluation(trial).metrics[name] for name in names] for trial in feasible])
        return result, values, np.array([place[trial.number] for trial in best])

    def write_table(self, path: Path) -> None:
        """Write a CSV file with one row per trial."""
        names = [objective.find().name for objective in self.config.objectives]
        with atomic_write(path, "w") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(["trial", *self.box.names, *names, "infeasible", "seconds"])
            for trial in self.trials():
                evaluation = _evaluation(trial)
                metrics = [repr(evaluation.metrics[name]) if evaluation.feasible else "" for name in names]
                design = [repr(trial.params[name]) for name in self.box.names]
                writer.writerow(
                    [trial.number, *design, *metrics, evaluation.infeasible or "", f"{evaluation.seconds:.3f}"]
                )


def _evaluation(trial: optuna.trial.FrozenTrial) -> Evaluation:
    return Evaluation.from_json(trial.user_attrs["evaluation"])

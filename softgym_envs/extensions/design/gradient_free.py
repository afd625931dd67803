"""Design search without gradients: Optuna, one objective or several (thesis, sec. 3.2.5)."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.codesign.records import Score
from softgym_envs.codesign.sampling import make_sampler
from softgym_envs.codesign.scheduling.journal import open_journal
from softgym_envs.codesign.scheduling.optuna_study import distributions, name_metrics, tell, trial_id
from softgym_envs.codesign.search import run_search
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.design.bodies import evaluate_each
from softgym_envs.extensions.design.config import OptimiseConfig, SearchConfig
from softgym_envs.extensions.design.plots import draw_front
from softgym_envs.extensions.design.records import FrontDesign, SearchResult
from softgym_envs.runs import RunFolder
from softgym_envs.storage import atomic_write, write_signed
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
    import click

    may_change = ("name", "workers", "solver.trials")
    run = RunFolder(folder, OptimiseConfig, "a search")
    with run.reserve(config, may_change, progress=progress) as place:
        ledger = _Ledger(config, place)
        evaluator = config.bodies.evaluator(config.metrics)
        with click.progressbar(length=ledger.solver.trials, label="designs", hidden=not progress) as bar:

            def evaluate(trials: Sequence[Any]) -> Iterator[tuple[Any, Score]]:
                by_number = {trial.number: trial for trial in trials}
                designs = [(number, ledger.design(trial)) for number, trial in by_number.items()]
                for number, score in evaluate_each(evaluator, designs, config.workers):
                    yield by_number[number], score
                    bar.update(ledger.done - bar.pos)

            run_search(ledger, evaluate)
        result, values, front = ledger.result()
        write_signed(place / "result.json", {**run.stamp(), **result.to_json()})
        ledger.write_table(place / "trials.csv")
        draw_front(place / "front.png", [o.find() for o in config.objectives], values, front)
    return result


class _Ledger:
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
        begun = self._storage.get_all_studies()
        self._study = optuna.create_study(
            study_name=begun[0].study_name if begun else config.name,
            storage=self._storage,
            load_if_exists=True,
            directions=[objective.direction for objective in config.objectives],
            sampler=make_sampler(self.solver.sampler, 0),
        )
        name_metrics(self._study, [objective.title for objective in config.objectives])
        self._discard_unfinished_batch()
        finished = (trial for trial in reversed(self.trials()) if trial.state.is_finished())
        self._known = {self._key(trial): _score(trial) for trial in finished}

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

    @property
    def done(self) -> int:
        """Number of finished trials."""
        return sum(trial.state.is_finished() for trial in self.trials())

    def design(self, trial: optuna.trial.FrozenTrial | optuna.Trial) -> dict[str, float]:
        """Return the complete design of a trial [SI]."""
        return {**self.box.reference, **trial.params}

    def ask(self) -> list[Any]:
        """Return the trials of a batch that have no score yet; a design that is known has its score at once."""
        while True:
            trials = self.trials()
            batch: Sequence[Any] = [trial for trial in trials if not trial.state.is_finished()]
            if not batch:
                if len(trials) >= self.solver.trials:
                    return []
                batch = self._propose(trials)
            new = {self._key(trial): trial for trial in reversed(batch) if self._key(trial) not in self._known}
            for trial in batch:
                if (known := self._known.get(self._key(trial))) is not None:
                    self._finish(trial, replace(known, seconds=0.0, cpu_seconds=0.0), repeated=True)
            if new:
                return sorted(new.values(), key=lambda trial: trial.number)

    def tell(self, trial: optuna.trial.FrozenTrial | optuna.Trial, score: Score) -> None:
        """Record the score of a design."""
        self._known[self._key(trial)] = score
        self._finish(trial, score)

    def _propose(self, trials: Sequence[optuna.trial.FrozenTrial]) -> list[optuna.Trial]:
        """Ask the sampler for the rest of a batch."""
        import optuna

        solver = self.solver
        complete = sum(trial.state == optuna.trial.TrialState.COMPLETE for trial in trials)
        missing = min(solver.batch - complete % solver.batch, solver.trials - len(trials))
        batch = []
        for number in range(len(trials), len(trials) + missing):
            self._study.sampler = make_sampler(solver.sampler, number)
            if number < len(solver.starts):
                values = self.box.free.complete(solver.starts[number])
                self._study.enqueue_trial({name: values[name] for name in self.box.names})
            batch.append(self._study.ask(distributions(self.box.free.variables)))
        self._study.set_user_attr("proposed", batch[-1].number + 1)
        return batch

    def _key(self, trial: optuna.trial.FrozenTrial | optuna.Trial) -> tuple[float, ...]:
        return tuple(trial.params[name] for name in self.box.names)

    def _finish(self, trial: optuna.trial.FrozenTrial | optuna.Trial, score: Score, *, repeated: bool = False) -> None:
        known = trial_id(self._storage, self._study, trial.number)
        self._storage.set_trial_user_attr(known, "repeated", repeated)
        self._storage.set_trial_user_attr(known, "evaluation", score.to_json())
        objectives = self.config.objectives if score.feasible else ()
        tell(self._study, trial.number, [float(o.value(score.values[o.find().name])) for o in objectives])

    def result(self) -> tuple[SearchResult, np.ndarray, np.ndarray]:
        """Return the result, the metrics (n, m) [SI] of all feasible designs, and the indices of the front in them."""
        names = [objective.find().name for objective in self.config.objectives]
        trials = self.trials()
        scores = [_score(trial) for trial in trials]
        feasible = [trial for trial, score in zip(trials, scores, strict=True) if score.feasible]
        if not feasible:
            raise ConvergenceError(
                f"none of {counted(len(trials), 'design')} is feasible; the first: {scores[0].reason}"
            )
        best = [trial for trial in self._study.best_trials if not trial.user_attrs["repeated"]]
        first = self.config.objectives[0]
        best.sort(key=lambda trial: (first.cost(_score(trial).values[names[0]]), trial.number))
        if len(names) == 1:
            best = best[:1]
        place = {trial.number: k for k, trial in enumerate(feasible)}
        result = SearchResult(
            front=[
                FrontDesign(
                    trial=trial.number,
                    design=self.design(trial),
                    metrics=_score(trial).values,
                )
                for trial in best
            ],
            feasible=len(feasible),
            infeasible=len(trials) - len(feasible),
            repeated=sum(trial.user_attrs["repeated"] for trial in trials),
            busy_seconds=sum(score.seconds for score in scores),
        )
        values = np.array([[_score(trial).values[name] for name in names] for trial in feasible])
        return result, values, np.array([place[trial.number] for trial in best])

    def write_table(self, path: Path) -> None:
        """Write a CSV file with one row per trial."""
        names = [objective.find().name for objective in self.config.objectives]
        with atomic_write(path, "w") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(["trial", *self.box.names, *names, "infeasible", "seconds"])
            for trial in self.trials():
                score = _score(trial)
                metrics = [repr(score.values[name]) if score.feasible else "" for name in names]
                design = [repr(trial.params[name]) for name in self.box.names]
                writer.writerow([trial.number, *design, *metrics, score.reason or "", f"{score.seconds:.3f}"])


def _score(trial: optuna.trial.FrozenTrial) -> Score:
    return Score.from_json(trial.user_attrs["evaluation"])

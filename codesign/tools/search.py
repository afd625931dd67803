"""Search over bodies without gradients and without learning (thesis 3.2.5): Optuna, one objective or several."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign.config import SAMPLERS, SamplerConfig, construct
from codesign.scheduling.storage import file_lock
from codesign.tools.bodies import Evaluator
from codesign.tools.config import OptimiseConfig, SearchConfig
from softgym_envs.config import Config, load_config, provenance, save_resolved
from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.executors import run_jobs
from softgym_envs.storage import atomic_write, write_json

if TYPE_CHECKING:
    import optuna

__all__ = ["claimed", "evaluate", "evaluate_numbered", "non_dominated", "search"]


def evaluate(evaluator: Evaluator, design: Mapping[str, float]) -> dict[str, Any]:
    """Return the metrics of a design, or why it has none: ``{"metrics": ...}`` or ``{"infeasible": ...}``."""
    began = time.perf_counter()
    try:
        found: dict[str, Any] = {"metrics": evaluator(design)}
    except (InfeasibleDesign, ConvergenceError) as error:
        found = {"infeasible": f"{type(error).__name__}: {error}"}
    if "metrics" in found and not np.isfinite(list(found["metrics"].values())).all():
        found = {"infeasible": f"metrics are not finite: {found['metrics']}"}
    return {**found, "seconds": time.perf_counter() - began}


def evaluate_numbered(number: int, evaluator: Evaluator, design: Mapping[str, float]) -> tuple[int, dict[str, Any]]:
    """Return a number and what `evaluate` finds: a job of `softgym_envs.executors.run_jobs`."""
    return number, evaluate(evaluator, design)


def non_dominated(costs: np.ndarray) -> np.ndarray:
    """Return the indices of the rows of ``costs`` (n, m) that no other row beats, in increasing order."""
    order = np.lexsort(costs.T[::-1])
    front: list[int] = []
    for k in order:  # none that comes later can dominate one that came before
        if not any((costs[j] <= costs[k]).all() and (costs[j] < costs[k]).any() for j in front):
            front.append(int(k))
    return np.array(sorted(front), dtype=int)


def search(config: OptimiseConfig, folder: str | Path, *, progress: bool = True) -> dict[str, Any]:
    """Evaluate designs that a sampler proposes; goes on where it was stopped.

    Designs are proposed in batches and told to Optuna's journal one by one. A batch is filled up until as many designs
    of it are feasible as it is large. The result is the same however often the search was stopped, and with any number
    of workers; only ``qmc`` skips the points of a batch that it was stopped in the middle of proposing.

    Args:
        config: with solver ``"search"``.
        folder: where the journal, ``result.json``, ``trials.csv`` and a picture go.
        progress: show a bar.

    Returns:
        ``front``: the non-dominated designs with their metrics [SI], sorted by the first objective, or the one best
        design; ``feasible``, ``infeasible`` and ``repeated``: how many designs there were; ``busy_seconds``:
        evaluation time over all processes.

    Raises:
        ConfigError: if the folder holds something else or another process is at it, see `claimed`.
        ConvergenceError: if no design was feasible.
    """
    with claimed(folder, config, "search", free=("name", "workers", "solver.trials")):
        return _search(config, Path(folder), progress)


def _search(config: OptimiseConfig, folder: Path, progress: bool) -> dict[str, Any]:
    import click
    import optuna

    solver = config.solver
    assert isinstance(solver, SearchConfig)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    box = config.bodies.box()
    evaluator = config.bodies.evaluator(config.metrics)
    study = _open(folder, config)
    known: dict[tuple[float, ...], dict[str, Any]] = {}

    def tell(trial: optuna.trial.FrozenTrial | optuna.Trial, found: dict[str, Any]) -> None:
        study._storage.set_trial_user_attr(trial._trial_id, "found", found)
        if "metrics" in found:
            costs = [float(objective.cost(found["metrics"][objective.metric])) for objective in config.objectives]
            study.tell(trial.number, costs)
        else:
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)

    def key(trial: optuna.trial.FrozenTrial | optuna.Trial) -> tuple[float, ...]:
        return tuple(trial.params[name] for name in box.names)

    for trial in _trials(study):
        if trial.state.is_finished():
            known.setdefault(key(trial), trial.user_attrs["found"])
    with click.progressbar(length=solver.trials, label="designs", hidden=not progress) as bar:
        while True:
            trials = _trials(study)
            finished = sum(trial.state.is_finished() for trial in trials)
            bar.update(finished - bar.pos)
            asked: list[Any] = [t for t in trials if t.state == optuna.trial.TrialState.RUNNING]
            if not asked and len(trials) >= solver.trials:
                break
            if not asked:
                complete = sum(trial.state == optuna.trial.TrialState.COMPLETE for trial in trials)
                missing = min(solver.batch - complete % solver.batch, solver.trials - len(trials))
                for number in range(len(trials), len(trials) + missing):
                    study.sampler = _sampler(solver.sampler, number)
                    if number < len(solver.starts):
                        values = box.free.complete(solver.starts[number])
                        study.enqueue_trial({name: values[name] for name in box.names})
                    asked.append(study.ask(_distributions(config)))
                study.set_user_attr("asked", asked[-1].number + 1)
            new = {key(trial): trial for trial in asked if key(trial) not in known}
            for trial in asked:
                if new.get(key(trial)) is not trial and key(trial) in known:
                    tell(trial, {**known[key(trial)], "seconds": 0.0, "repeated": True})
            jobs = [
                (evaluate_numbered, (trial.number, evaluator, {**box.reference, **trial.params}))
                for trial in new.values()
            ]
            by_number = {trial.number: trial for trial in new.values()}
            for number, found in run_jobs(jobs, config.workers):
                known[key(by_number[number])] = found
                tell(by_number[number], found)
                bar.update(1)
    return _result(config, folder, study)


@contextmanager
def claimed(folder: str | Path, config: Config, kind: str, *, free: Sequence[str] = ("name",)) -> Iterator[None]:
    """Keep a folder for one run of a design tool while the block runs, and write its configuration there.

    Args:
        folder: new, or of the same configuration.
        config: of the run.
        kind: what it is, for messages.
        free: dotted keys of the configuration that may differ from that of the folder.

    Raises:
        ConfigError: if the folder holds something else or results of another configuration, or another process is at
            it.
    """
    from filelock import Timeout

    folder = Path(folder)
    _check(folder, config, kind, free)  # before the lock is written to where it may not belong
    lock = file_lock(folder, "run")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"folder '{folder}' is in use by another process; wait for its end, or name another folder"
        ) from None
    try:
        _check(folder, config, kind, free)  # another process may have come first
        save_resolved(folder, config)
        yield
    finally:
        lock.release()


def _check(folder: Path, config: Config, kind: str, free: Sequence[str]) -> None:
    """Raise ConfigError unless a run may go to a folder; see `claimed`."""
    path = folder / "config.yaml"
    results = [name for name in ("journal.log", "evaluations.jsonl", "result.json") if (folder / name).exists()]
    if not path.exists():
        if results:
            raise ConfigError(f"folder '{folder}' holds a {results[0]} but no config.yaml; name another folder")
        return
    try:
        kept = _bound(load_config(path, type(config)), free)
    except ConfigError:
        raise ConfigError(
            f"folder '{folder}' holds something else: its config.yaml is of no {kind}; name another folder"
        ) from None
    asked = _bound(config, free)
    if results and kept != asked:
        changed = next(name for name in asked if asked[name] != kept[name])
        raise ConfigError(f"folder '{folder}' holds another {kind}, with other '{changed}'; name another folder")


def _bound(config: Config, free: Sequence[str]) -> dict[str, Any]:
    """Plain data of a configuration without some dotted keys."""
    data = config.model_dump(mode="json")
    for key in free:
        *path, last = key.split(".")
        part = data
        for name in path:
            part = part[name]
        part.pop(last, None)
    return data


def _open(folder: Path, config: OptimiseConfig) -> optuna.Study:
    """Open the journal of a folder, and mend it if a crash cut off its last line."""
    import optuna
    from optuna.storages.journal import JournalFileBackend

    assert isinstance(config.solver, SearchConfig)
    path = folder / "journal.log"
    if path.exists() and (data := path.read_bytes()) and not data.endswith(b"\n"):
        with path.open("rb+") as stream:
            stream.truncate(data.rfind(b"\n") + 1)
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(path)))
    study = optuna.create_study(
        study_name="search",
        storage=storage,
        load_if_exists=True,
        directions=["minimize"] * len(config.objectives),
        sampler=_sampler(config.solver.sampler, 0),
    )
    _take_back(study)
    return study


def _take_back(study: optuna.Study) -> None:
    """Fail the trials of a batch that was cut off while it was proposed, so that all of it is proposed again.

    The journal has a trial before its parameters, so some may lack theirs.
    """
    import optuna

    asked = study.user_attrs.get("asked", 0)
    for trial in study.get_trials(deepcopy=False)[asked:]:
        if not trial.state.is_finished():
            study._storage.set_trial_state_values(trial._trial_id, optuna.trial.TrialState.FAIL)


def _trials(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """All trials but those that were taken back."""
    trials = study.get_trials(deepcopy=False)
    return [trial for trial in trials if "found" in trial.user_attrs or not trial.state.is_finished()]


def _sampler(sampler: SamplerConfig, number: int) -> Any:
    """Sampler of one trial: its seed follows from the trial's number, so that a search can be stopped anywhere."""
    import optuna

    seed = sampler.seed
    if sampler.name != "qmc":  # which counts its points in the journal
        seed = int(np.random.SeedSequence([sampler.seed, number]).generate_state(1)[0])
    return construct(getattr(optuna.samplers, SAMPLERS[sampler.name]), {"seed": seed, **sampler.options})


def _distributions(config: OptimiseConfig) -> dict[str, optuna.distributions.BaseDistribution]:
    import optuna

    return {
        name: optuna.distributions.FloatDistribution(variable.low, variable.high, log=variable.log)
        for name, variable in config.bodies.box().free.variables.items()
    }


def _result(config: OptimiseConfig, folder: Path, study: optuna.Study) -> dict[str, Any]:
    from codesign.tools.plots import draw_front

    trials = _trials(study)
    feasible = [trial for trial in trials if trial.values is not None]
    if not feasible:
        reason = trials[0].user_attrs["found"]["infeasible"]
        raise ConvergenceError(f"none of {len(trials)} designs is feasible; the first: {reason}")
    box, names = config.bodies.box(), config.metrics
    values = np.array([[trial.user_attrs["found"]["metrics"][name] for name in names] for trial in feasible])
    costs = np.array([trial.values for trial in feasible])
    front = np.array([k for k in non_dominated(costs) if "repeated" not in feasible[k].user_attrs["found"]], dtype=int)
    if len(names) == 1:
        front = front[:1]
    rows = [
        {
            "trial": feasible[k].number,
            "design": {**box.reference, **feasible[k].params},
            "metrics": dict(zip(names, values[k].tolist(), strict=True)),
        }
        for k in front[np.argsort(costs[front, 0], kind="stable")]
    ]
    found = [trial.user_attrs["found"] for trial in trials]
    result: dict[str, Any] = {
        "front": rows,
        "feasible": len(feasible),
        "infeasible": len(trials) - len(feasible),
        "repeated": sum("repeated" in row for row in found),
        "busy_seconds": sum(row["seconds"] for row in found),
    }
    write_json(folder / "result.json", {**provenance(), **result})
    with atomic_write(folder / "trials.csv", "w") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["trial", *box.names, *names, "infeasible", "seconds"])
        for trial, row in zip(trials, found, strict=True):
            measured = [repr(row["metrics"][name]) if "metrics" in row else "" for name in names]
            design = [repr(trial.params[name]) for name in box.names]
            writer.writerow([trial.number, *design, *measured, row.get("infeasible", ""), f"{row['seconds']:.3f}"])
    draw_front(folder / "front.png", names, values, front)
    return result

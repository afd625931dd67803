"""Searches: any optimiser that can ask and tell, within a budget, with a ledger of every body it has tried."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from softgym_envs.codesign.sampling import SamplerConfig, construct, make_sampler
from softgym_envs.codesign.scheduling.optuna_study import distributions, tell
from softgym_envs.codesign.search import run_search
from softgym_envs.errors import SoftGymError, unknown_name
from softgym_envs.extensions.leaderboard.clock import working_seconds
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem
from softgym_envs.extensions.leaderboard.problem import LEVELS, Budget, Judge, JudgedScore

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler


class BudgetSpent(SoftGymError):
    """A search asks for a score although its budget is spent."""


class Optimiser(Protocol):
    """What `solve` needs of an optimiser.

    One that works with several fidelities also has ``share``: the share of the goals and of the training's steps that
    the next body is scored with. One that evaluates the learned model itself has ``steps_left``, which is set before
    each `ask` to the environment steps that it may spend, and ``take_charge()``, which returns the environment steps
    and CPU seconds that it has spent since; they count as those of the body scored next. One that passes policies on
    has ``initial``, the policy that the next training begins with, and ``keep``, the folder for its policy.
    """

    def ask(self) -> Mapping[str, float]:
        """Return the body to score next: a value of every variable [SI]."""

    def tell(self, score: JudgedScore) -> None:
        """Learn the outcome of the body that `ask` returned last."""


@dataclass
class Search:
    """A search on a problem: scores bodies until the budget is spent, and keeps a ledger.

    Args:
        problem: the problem.
        level: name of the budget: small, medium or large.
        judge: who controls the bodies; default that of the problem.
        seed: added to those of trainings.
        limit: largest number of bodies; default none besides the budget. A body scored on a share of the goals counts
            as that share. A search also ends when it has spent the environment steps of so many baselines, for methods
            whose bodies cost more than a score.
    """

    problem: FrozenProblem
    level: str = "small"
    judge: Judge | None = None
    seed: int = 0
    limit: int | None = None
    ledger: list[JudgedScore] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise ValueError(unknown_name("level", self.level, LEVELS))
        self.judge = self.judge or self.problem.definition.judge

    @property
    def limits(self) -> Budget:
        """The budget."""
        return self.problem.definition.budgets[self.level]  # type: ignore[index]

    @property
    def spent(self) -> dict[str, float]:
        """What has been spent, by the names of `Budget`."""
        return {name: sum(getattr(row, name) for row in self.ledger) for name in Budget.model_fields}

    @property
    def open(self) -> bool:
        """Whether budget is left. The score that crosses a limit is the last one, and it counts."""
        if self.limit is not None and sum(row.share for row in self.ledger) >= self.limit:
            return False
        if self.ledger and self.steps_left <= 0:
            return False
        return all(value < max(getattr(self.limits, name), 1) for name, value in self.spent.items())

    @property
    def steps_left(self) -> float:
        """Environment steps that may be spent before the last body begins."""
        allowed = float(self.limits.environment_steps)
        if self.limit is not None and self.ledger and self.ledger[0].environment_steps:
            allowed = min(allowed, self.limit * self.ledger[0].environment_steps)
        return allowed - self.spent["environment_steps"]

    def evaluate(self, design: Mapping[str, float], budget: float = 1.0, **training: Path | None) -> JudgedScore:
        """Score a body and write it into the ledger; see `FrozenProblem.evaluate`, also for options of trainings.

        Raises:
            BudgetSpent: if no budget is left.
        """
        if not self.open:
            spent = ", ".join(f"{name} = {value:g}" for name, value in self.spent.items())
            raise BudgetSpent(f"problem '{self.problem.name}': the budget '{self.level}' is spent ({spent})")
        row = self.problem.evaluate(design, budget, judge=self.judge, seed=self.seed, **training)
        self.ledger.append(row)
        return row

    @property
    def best(self) -> JudgedScore | None:
        """The feasible body with the best score on all goals and steps; None if there is none."""
        whole = [row for row in self.ledger if row.feasible and row.share == 1.0]
        return max(whole, key=lambda row: row.score, default=None)

    @property
    def incumbents(self) -> list[tuple[int, JudgedScore]]:
        """The bodies that were the best when they were scored, each with its place in the ledger."""
        found: list[tuple[int, JudgedScore]] = []
        for index, row in enumerate(self.ledger):
            if row.feasible and row.share == 1.0 and (not found or row.score > found[-1][1].score):
                found.append((index, row))
        return found


@dataclass(frozen=True)
class _Budgeted:
    """The ledger of a search, with an optimiser as its proposer."""

    search: Search
    optimiser: Any

    def ask(self) -> list[Mapping[str, float]]:
        """Return the next body; the first one is the baseline, for every optimiser."""
        search, optimiser = self.search, self.optimiser
        if not search.ledger:
            return [search.problem.definition.baseline_values]
        if not search.open:
            return []
        if hasattr(optimiser, "take_charge"):
            optimiser.steps_left = search.steps_left - search.ledger[0].environment_steps
        return [optimiser.ask()]

    def evaluate(self, designs: Sequence[Mapping[str, float]]) -> Iterator[tuple[Mapping[str, float], JudgedScore]]:
        """Score bodies, and write them into the ledger."""
        search, optimiser = self.search, self.optimiser
        for design in designs:
            if not search.ledger:
                yield design, search.evaluate(design)
                continue
            training = {name: getattr(optimiser, name) for name in ("initial", "keep") if hasattr(optimiser, name)}
            yield design, search.evaluate(design, getattr(optimiser, "share", 1.0), **training)

    def tell(self, design: Mapping[str, float], row: JudgedScore) -> None:
        """Add what the optimiser spent itself to a row, and tell it the score; it did not ask for the baseline."""
        if row is self.search.ledger[0]:
            return
        if hasattr(self.optimiser, "take_charge"):
            steps, seconds = self.optimiser.take_charge()
            row.environment_steps, row.cpu_seconds = row.environment_steps + steps, row.cpu_seconds + seconds
        self.optimiser.tell(row)


def solve(search: Search, optimiser: Optimiser) -> float:
    """Run an optimiser until the budget is spent; return its own CPU time [s]."""
    began = working_seconds()
    ledger = _Budgeted(search, optimiser)
    run_search(ledger, ledger.evaluate)
    return working_seconds() - began - search.spent["cpu_seconds"]


class OptunaOptimiser:
    """A sampler of Optuna, asked and told.

    Args:
        problem: the problem.
        sampler: the sampler.
    """

    def __init__(self, problem: FrozenProblem, sampler: BaseSampler) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        definition = problem.definition
        self._study = optuna.create_study(directions=["maximize"] * definition.score_count, sampler=sampler)
        self._ranges = distributions(definition.optimised)
        self._trial: Any = None

    def ask(self) -> Mapping[str, float]:
        """Return the body to score next."""
        self._trial = self._study.ask(self._ranges)
        return self._trial.params

    def tell(self, score: JudgedScore) -> None:
        """Learn the outcome."""
        tell(self._study, self._trial.number, score.scores)


class HalvingOptimiser:
    """TPE with a pruner of Optuna: bodies are scored on a quarter of the goals, then half, then all.

    Args:
        problem: the problem, with one objective.
        sampler: the sampler and its options.
        pruner: decides after each score whether the body is scored on more goals.
    """

    SHARES = (0.25, 0.5, 1.0)

    def __init__(self, problem: FrozenProblem, sampler: SamplerConfig, pruner: Any) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        # Hyperband draws a trial's bracket from the name of the study, which is random unless it is given.
        self._study = optuna.create_study(
            study_name=f"seed {sampler.seed}", direction="maximize", sampler=make_sampler(sampler, 0), pruner=pruner
        )
        self._ranges = distributions(problem.definition.optimised)
        self._trial: Any = None
        self._rung = 0

    @property
    def share(self) -> float:
        """Share of the goals and of the training's steps for the next score."""
        return self.SHARES[self._rung]

    def ask(self) -> Mapping[str, float]:
        """Return the body to score next: a new one, or the last one on more goals."""
        if self._rung == 0:
            self._trial = self._study.ask(self._ranges)
        return self._trial.params

    def tell(self, score: JudgedScore) -> None:
        """Learn the outcome with the present share."""
        resource, last = round(self.share / self.SHARES[0]), self._rung == len(self.SHARES) - 1
        self._rung = 0 if last or not score.feasible else self._rung + 1
        if not score.feasible:
            tell(self._study, self._trial.number)
            return
        self._trial.report(score.score, resource)
        if last:
            tell(self._study, self._trial.number, score.scores)
        elif self._trial.should_prune():
            self._rung = 0
            tell(self._study, self._trial.number)


def _halving(pruner: str, **options: Any) -> Callable[[FrozenProblem, int], Optimiser]:
    def make(problem: FrozenProblem, seed: int) -> Optimiser:
        import optuna

        sampler = SamplerConfig(name="tpe", seed=seed, options={"n_startup_trials": 8})
        return HalvingOptimiser(problem, sampler, construct(getattr(optuna.pruners, pruner), options))

    return make


def _optuna(name: str, **options: Any) -> Callable[[FrozenProblem, int], Optimiser]:
    def make(problem: FrozenProblem, seed: int) -> Optimiser:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)  # checking the options of qmc warns of a missing seed
        config = SamplerConfig(name=name, seed=seed, options=options)
        return OptunaOptimiser(problem, make_sampler(config, 0))

    return make


def _own(module: str, name: str, **options: Any) -> Callable[[FrozenProblem, int], Optimiser]:
    def make(problem: FrozenProblem, seed: int) -> Optimiser:
        found = import_module(f"softgym_envs.extensions.leaderboard.{module}")  # when needed: its packages are heavy
        return getattr(found, name)(problem, seed, **options)

    return make


METHODS: dict[str, Callable[[FrozenProblem, int], Optimiser]] = {
    "random": _optuna("random"),
    "sobol": _optuna("qmc", scramble=True),
    "tpe": _optuna("tpe", n_startup_trials=8),
    "gp": _optuna("gp", n_startup_trials=8),
    "cmaes": _optuna("cmaes"),
    "nsgaii": _optuna("nsgaii", population_size=8),
    "botorch": _own("packages", "BoTorchOptimiser"),
    "smac": _own("packages", "SmacOptimiser"),
    "map_elites": _own("packages", "QualityDiversityOptimiser", emitter="map_elites"),
    "cma_me": _own("packages", "QualityDiversityOptimiser", emitter="cma_me"),
    "gradient": _own("descents", "GradientOptimiser"),
    "together": _own("together", "TogetherOptimiser", way="ascend"),
    "evolution": _own("together", "TogetherOptimiser", way="evolve"),
    "critic": _own("joint", "JointOptimiser", proposer="critic"),
    "distribution": _own("joint", "JointOptimiser", proposer="distribution"),
    "inheritance": _own("joint", "InheritanceOptimiser"),
    "halving": _halving("SuccessiveHalvingPruner", min_resource=1, reduction_factor=2),
    "hyperband": _halving("HyperbandPruner", min_resource=1, max_resource=4, reduction_factor=2),
}
"""Baselines: name -> function of problem and seed. A new one is one row."""

SINGLE_OBJECTIVE = (
    "cmaes",
    "smac",
    "map_elites",
    "cma_me",
    "gradient",
    "together",
    "evolution",
    "inheritance",
    "halving",
    "hyperband",
)
"""Methods that know a single objective only."""


def make_optimiser(name: str, problem: FrozenProblem, seed: int) -> Optimiser:
    """Return a baseline.

    Raises:
        ValueError: for an unknown name, or a method that does not know several objectives.
    """
    allowed = [each for each in METHODS if problem.definition.score_count == 1 or each not in SINGLE_OBJECTIVE]
    if name not in allowed:
        raise ValueError(f"problem '{problem.name}': {unknown_name('method', name, allowed)}")
    return METHODS[name](problem, seed)

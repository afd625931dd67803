"""A problem of the benchmark: which bodies compete, who controls them, on which goals, and what a search may spend."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.training import train
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.goals import draw_goals
from softgym_envs.codesign.parts import GoalsConfig, TrainingConfig, ZoneConfig
from softgym_envs.codesign.phases.trial import assess, rate
from softgym_envs.codesign.problem import StudyProblem, refuse
from softgym_envs.codesign.records import Score
from softgym_envs.codesign.scoring import scoring
from softgym_envs.config import BesideConfig, Config
from softgym_envs.errors import DesignError, unknown_name
from softgym_envs.extensions.leaderboard.clock import working_seconds

Judge = Literal["qp", "shared", "trained"]
"""Who controls a body while it is scored: the inverse QP, a shared policy, or a policy trained for it."""

JUDGES: tuple[Judge, ...] = ("qp", "shared", "trained")
GOAL_SETS = ("training", "search", "validation", "test")
LEVELS = ("small", "medium", "large")
TRACKS = {
    "A": "design alone, under a fixed controller",
    "B": "design and control",
    "C": "several objectives",
    "D": "transfer: the test goals lie where no search goal does",
    "E": "bodies that move, each with a gait of its own",
}
"""Track of a problem -> what it asks for."""


class GoalSet(Config):
    """One set of goals; see `softgym_envs.codesign.parts.GoalsConfig` for the sources."""

    source: Literal["family", "zone", "task"] = "family"
    zone: ZoneConfig | None = None
    command_low: float = Field(default=0.0, ge=0.0, lt=1.0)
    count: int = Field(ge=1)
    seed: int = Field(ge=0)


class Budget(Config):
    """What a search may spend; it ends at the limit that it reaches first."""

    environment_steps: int = Field(gt=0, description="of trainings and of scores")
    cpu_seconds: float = Field(gt=0.0, description="of trainings and of scores, without the optimiser's own time [s]")
    fem_solves: int = Field(ge=0, description="environment steps on finite elements")


class BenchmarkProblem(StudyProblem):
    """A frozen problem of the benchmark.

    Attributes:
        name: ID with its version: ``finger-zone-v1``. Any change of the problem needs a new version.
        track: key of `TRACKS`.
        judge: who controls the bodies in the search, unless the optimiser chooses another judge, and in the final test.
        policy: shared policy: the judge ``"shared"``, and the start of the trainings of ``"trained"``.
        training: training for one body, for the judge ``"trained"``.
        goals: sets of goals by name, `GOAL_SETS`, each with a seed of its own.
        budgets: by name, `LEVELS`.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9-]*-v[1-9][0-9]*$")
    track: Literal["A", "B", "C", "D", "E"]
    judge: Judge = "qp"
    policy: Annotated[str | None, BesideConfig()] = None
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    goals: dict[Literal["training", "search", "validation", "test"], GoalSet]
    budgets: dict[Literal["small", "medium", "large"], Budget]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        refuse(set(self.goals) != set(GOAL_SETS), f"goals must have the sets {', '.join(GOAL_SETS)}")
        refuse(set(self.budgets) != set(LEVELS), f"budgets must have the levels {', '.join(LEVELS)}")
        seeds = [goals.seed for goals in self.goals.values()]
        refuse(len(set(seeds)) < len(seeds), f"the seeds of the goals must differ, got {seeds}")
        refuse(self.judge not in self.judges, f"judge '{self.judge}' needs a 'policy'")
        refuse(
            bool(self.secondary_objectives) != (self.track == "C"),
            "problems of track C, and only these, have secondary_objectives",
        )
        return self

    @property
    def judges(self) -> tuple[Judge, ...]:
        """The judges that are available for this problem."""
        fast = self.environment.batched and self.environment.backend == "surrogate"
        trains = fast or self.judge == "trained"  # within seconds
        return tuple(
            judge
            for judge in JUDGES
            if judge == "qp" or (judge == "shared" and self.policy) or (judge == "trained" and trains)
        )

    @property
    def score_count(self) -> int:
        """Number of objectives."""
        return 1 + len(self.secondary_objectives)

    def draw_goals(self, name: str) -> np.ndarray:
        """Draw a set of goals [m], shape (count, p, 3), from its seed; the frozen problem keeps them."""
        goals = self.goals[name]  # type: ignore[index]
        config = GoalsConfig(
            source=goals.source,
            zone=goals.zone,
            command_low=goals.command_low,
            count=goals.count,
            unseen_count=2,
            training_count=1,
            seed=goals.seed,
        )
        study = StudyConfig(
            name="goals",
            environment=self.environment,
            variables=self.variables,
            ranges=self.ranges,
            strategy="qp",
            trials=1,
            goals=config,
            finalists={"count": 0},  # type: ignore[arg-type]
        )
        return np.round(np.asarray(draw_goals(study)["selection"], dtype=float), 7)

    def design_from_unit(self, point: Sequence[float]) -> dict[str, float]:
        """Return the values [SI] of the variables at a point of the unit box [-1, 1]^n."""
        return {
            name: float(variable.from_unit(value))
            for (name, variable), value in zip(self.optimised.items(), point, strict=True)
        }

    def checked(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return values of the variables inside the box, in their order.

        Raises:
            DesignError: if a variable is missing, unknown or out of its bounds.
        """
        for name in values:
            if name not in self.optimised:
                raise DesignError(unknown_name("variable", name, self.optimised))
        if missing := [name for name in self.optimised if name not in values]:
            raise DesignError(f"problem '{self.name}': the design lacks {', '.join(missing)}")
        return {name: variable.check(values[name]) for name, variable in self.optimised.items()}


@dataclass(eq=False)
class JudgedScore(Score):
    """Score of one body under one judge."""

    judge: str
    share: float = 1.0  # of the goals and of the training's steps
    environment_steps: int = 0
    fem_solves: int = 0

    @property
    def score(self) -> float:
        """Score of the first objective; minus infinity if infeasible."""
        return self.scores[0] if self.scores else -np.inf


@dataclass(frozen=True)
class JudgedEvaluator:
    """Scores bodies of a problem on given goals, each under the judge that the call names.

    Args:
        problem: the problem.
        training_goals: goals of trainings [m], shape (k, 3).
        goals: goals of the score [m], shape (n, p, 3).
        backend: of the score; default that of the problem. Trainings always run on that of the problem.
    """

    problem: BenchmarkProblem
    training_goals: np.ndarray
    goals: np.ndarray
    backend: str | None = None

    def __call__(
        self,
        values: Mapping[str, float],
        judge: Judge,
        *,
        share: float = 1.0,
        seed: int = 0,
        policy: Path | None = None,
        initial: Path | None = None,
        keep: Path | None = None,
    ) -> JudgedScore:
        """Score one body.

        Args:
            values: values of the variables [SI].
            judge: who controls it.
            share: share of the goals and of the steps of the training, in (0, 1].
            seed: added to that of the training.
            policy: file of a policy that controls the body in place of the judge.
            initial: policy that a training begins with, in place of that of the problem.
            keep: folder for the policy of a training; default it is not kept.

        Raises:
            DesignError: if the body is out of the box.
            ValueError: for a judge that the problem does not have, or a share out of (0, 1].
        """
        problem = self.problem
        if judge not in problem.judges:
            raise ValueError(f"problem '{problem.name}': {unknown_name('judge', judge, problem.judges)}")
        if not 0.0 < share <= 1.0:
            raise ValueError(f"budget = {share} must be a share in (0, 1]")
        values = problem.checked(values)
        design, options = problem.body(values)
        result = JudgedScore(judge, share, design=values)
        goals = self.goals[: max(1, round(share * len(self.goals)))]
        environment = problem.environment_of(options)
        tested = environment if self.backend is None else environment.on(self.backend)
        with scoring(result, working_seconds), tempfile.TemporaryDirectory() as folder:
            agent: str | Path = {"qp": "qp", "shared": problem.policy or ""}.get(judge, "")
            if policy is not None:
                agent = policy
            elif judge == "trained":
                config = self._training(design, options, share, seed)
                start = initial or problem.policy
                agent = train(config, Path(keep or folder) / "policy", initial=start, progress=False)
                result.environment_steps += self.training_steps(share)
                if problem.environment.backend == "fem":
                    result.fem_solves += self.training_steps(share)
            found = assess(agent, problem, tested, goals, design)
            rate(result, problem, found)
            result.environment_steps += found.evaluation.steps
            result.fem_solves += found.evaluation.steps if tested.backend == "fem" else 0
            if broken := problem.violations_text(result.values, problem.constraints):
                result.reason, result.scores = broken, []
        return result

    def training_steps(self, share: float = 1.0) -> int:
        """Return the environment steps of a training for one body, its learning curve included."""
        training = self.problem.training
        steps = self._steps(share)
        reports = -(-steps // min(steps, training.report_every))
        return steps + reports * training.evaluation_episodes * self.problem.episode_steps

    def _steps(self, share: float) -> int:
        return max(self.problem.training.num_envs, round(share * self.problem.training.steps))

    def _training(
        self, design: Mapping[str, float], options: Mapping[str, float], share: float, seed: int
    ) -> TrainConfig:
        problem, training = self.problem, self.problem.training
        steps = self._steps(share)
        shorter: dict[str, Any] = {"steps": steps, "report_every": min(steps, training.report_every)}
        shorter["seed"] = training.seed + seed
        return training.on(problem.environment_of(options), self.training_goals, design, **shorter)


def goal_key(goal: np.ndarray) -> str:
    """Return a hash of one goal or path [m], rounded to a micrometre."""
    return sha256(np.round(1e6 * np.atleast_2d(goal)).astype("<i8").tobytes()).hexdigest()[:16]

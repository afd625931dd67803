"""Typed records of what a study has found; each is one JSON file in the folder of the study."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from softgym_envs.agents.evaluation import Evaluation, none_for_nan
from softgym_envs.codesign.metrics.metric import Measurement
from softgym_envs.errors import DataError
from softgym_envs.storage import RESTORE, read_json, read_signed, write_json, write_signed


def plain(value: Any) -> Any:
    """Return a value of a record as plain data."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value.to_json() if hasattr(value, "to_json") else value


class Record:
    """Base of records: plain data both ways. Fields named in ``EVALUATIONS`` hold an `Evaluation` or None."""

    EVALUATIONS: ClassVar[tuple[str, ...]] = ()

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.to_json() == other.to_json()

    __hash__ = None  # type: ignore[assignment]

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {item.name: plain(getattr(self, item.name)) for item in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the record that `to_json` wrote.

        Raises:
            DataError: if a field is missing, unknown or damaged.
        """
        values = dict(data)
        for name in cls.EVALUATIONS:
            if values.get(name) is not None:
                values[name] = Evaluation.from_json(values[name])
        try:
            return cls(**values)
        except TypeError as error:
            raise DataError(f"stored {cls.__name__} cannot be read: {error}") from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file; see `from_json`."""
        return cls._of(path, read_json(path), "")

    @classmethod
    def _of(cls, path: Path, data: Any, remedy: str) -> Self:
        try:
            return cls.from_json(data)
        except (DataError, TypeError, ValueError) as error:
            raise DataError(f"'{path}': {error}{remedy}") from None

    def write(self, path: Path) -> None:
        """Write a file, whole or not at all."""
        write_json(path, self.to_json())


class StudyRecord(Record):
    """Base of records that a study reads again: their files carry a hash, see `read_signed`."""

    REMEDY: ClassVar[str] = "restore it from a copy, or remove it and run the study again"

    @classmethod
    def read(cls, path: Path) -> Self:
        return cls._of(path, read_signed(path, cls.REMEDY), f"; {cls.REMEDY}")

    def write(self, path: Path) -> None:
        write_signed(path, self.to_json())


@dataclass(eq=False, kw_only=True)
class Score(Record):
    """Metrics of one body and their cost, or the reason why it has none."""

    design: dict[str, float] = field(default_factory=dict)  # values of its variables [SI]
    values: dict[str, float] = field(default_factory=dict)  # of each metric [SI]
    scores: list[float] = field(default_factory=list)  # of the objectives, larger is better; empty if there are none
    reason: str | None = None  # why the body is infeasible
    seconds: float = 0.0  # wall-clock time [s]
    cpu_seconds: float = 0.0

    @property
    def feasible(self) -> bool:
        """Whether the body exists and could be simulated."""
        return self.reason is None


@dataclass(eq=False)
class TrialResult(StudyRecord, Score):
    """Result of one trial; its design is complete, and only complete trials have scores."""

    EVALUATIONS = ("evaluation", "qp", "judge")
    REMEDY = RESTORE

    number: int
    origin: str  # of its body: "baseline", "screen 3" or "sampler 7"
    process: str  # "host:pid" of the worker
    options: dict[str, float] = field(default_factory=dict)  # variables that are options, by their full names [SI]
    sampler_seed: int | None = None  # of the sampler that proposed the body, if one did
    state: Literal["complete", "pruned", "infeasible"] = "complete"  # `reason` says why it is not complete
    violations: dict[str, float] = field(default_factory=dict)  # of each constraint [SI]; positive if it is violated
    controller: str = "qp"  # or the file of the policy, relative to the folder of the study
    evaluation: Evaluation | None = None  # of the controller on the selection goals
    qp: Evaluation | None = None  # of the inverse QP on the same goals
    qp_value: float | None = None  # of the objective with the inverse QP [SI]
    judge: Evaluation | None = None  # of the policy that the training starts from on the same goals
    judge_value: float | None = None  # of the objective with that policy [SI]
    curve: list[list[float]] = field(default_factory=list)  # environment steps and score of each report in training
    training_steps: int = 0
    finished_at: float = 0.0  # time of the end [s since 1970]

    @property
    def score(self) -> float | None:
        """Score of the objective; larger is better."""
        return self.scores[0] if self.scores else None

    @property
    def feasible(self) -> bool:
        """Whether the trial is complete and its body satisfies all constraints."""
        return self.state == "complete" and all(excess <= 0.0 for excess in self.violations.values())

    @property
    def steps_of_scores(self) -> int:
        """Environment steps of the evaluations."""
        evaluations = [self.evaluation] if self.controller == "qp" else [self.qp, self.judge, self.evaluation]
        return sum(evaluation.steps for evaluation in evaluations if evaluation is not None)


@dataclass(eq=False)
class ScreenResult(StudyRecord, Score):
    """Score of one candidate of the screen; its design has the optimised variables."""

    EVALUATIONS = ("evaluation",)

    index: int
    evaluation: Evaluation | None = None  # of the inverse QP; None for an infeasible body


@dataclass(eq=False)
class SharedPolicy(StudyRecord):
    """The policy that scores every body."""

    policy: str  # its file, relative to the folder of the study


@dataclass(eq=False)
class FinalistTraining(StudyRecord):
    """A policy that was trained anew for a finalist."""

    trial: int
    seed: int
    steps: int
    report_steps: int  # environment steps of the points of the learning curve
    cpu_seconds: float
    curve: list[list[float]]  # environment steps and score of each report; empty if they do not measure the objective


REFINED = "refined"
"""Physics of tests on FEM with the finer mesh of ``finalists.refinement``."""


@dataclass(eq=False)
class FinalistTest(StudyRecord):
    """Evaluation of one finalist with one controller on one backend."""

    EVALUATIONS = ("evaluation",)

    trial: int
    agent: str  # "policy" or "qp"
    backend: str  # "fem", "surrogate" or "refined"
    goals: str  # "unseen" or "selection"
    seed: int = 0  # of the training of the policy; 0 for the policy of the trial itself
    evaluation: Evaluation | None = None  # None if the body cannot be simulated
    values: dict[str, float] = field(default_factory=dict)  # of each objective that the study names [SI]
    goal_values: list[float] | None = None  # of the objective for each goal [SI], if it has such values
    error: str | None = None  # why the body cannot be simulated
    unknowns: int | None = None  # of its mesh, on finite elements
    last_motion: float | None = None  # of the effector in the last step [m], if only ends are tested; see `FinalStates`
    numbers: list[int] | None = None  # of the goals among all unseen ones; None: the first ones


@dataclass(eq=False)
class Account(StudyRecord):
    """Time that a study took."""

    command: str = ""  # that last ran it
    wall_seconds: dict[str, float] = field(default_factory=dict)  # of each phase, over all calls [s]


@dataclass(frozen=True, eq=False)
class Finalist(Record):
    """A body in the final test."""

    trial: int
    role: Literal["baseline", "finalist"]
    design: dict[str, float]  # complete [SI]
    options: dict[str, float]  # variables that are options of robot or task [SI]
    score: float  # of its trial; larger is better
    policy: str | None  # of its trial, relative to the folder of the study; None if the strategy has none

    @property
    def agents(self) -> tuple[str, ...]:
        """Controllers to test; that of the trial first."""
        return ("qp",) if self.policy is None else ("policy", "qp")


@dataclass(frozen=True)
class PlannedTest:
    """One test of a finalist: which controller, on which backend and goals; see `FinalistTest`."""

    finalist: Finalist
    agent: str
    backend: str
    goals: str
    seed: int
    numbers: tuple[int, ...] | None = None  # of the goals to test; None: all

    @property
    def key(self) -> tuple[int, str, str, str, int]:
        """Trial, controller, backend, goals and seed."""
        return self.finalist.trial, self.agent, self.backend, self.goals, self.seed

    @property
    def file(self) -> str:
        """Path of the result, relative to the folder of the study."""
        seed = f"-seed{self.seed}" if self.seed else ""
        return f"finalists/trial{self.finalist.trial:04d}-{self.agent}{seed}-{self.backend}-{self.goals}.json"


class TestGroup:
    """Tests that differ in the training seed only.

    Args:
        tests: one test per seed; if one failed, the group has its error and no numbers.
    """

    __test__ = False  # not for pytest

    def __init__(self, tests: Sequence[FinalistTest]) -> None:
        self.tests = tuple(tests)
        first = tests[0]
        self.trial, self.agent, self.backend, self.goals = first.trial, first.agent, first.backend, first.goals
        self.error = next((test.error for test in tests if test.error is not None), None)
        self.evaluations = [test.evaluation for test in tests if test.evaluation is not None]

    @property
    def key(self) -> tuple[int, str, str]:
        """Trial, controller and backend."""
        return self.trial, self.agent, self.backend

    def table(self, name: str) -> np.ndarray:
        """A per-goal field of `Evaluation`, shape (seeds, goals)."""
        return np.array([getattr(evaluation, name) for evaluation in self.evaluations], dtype=float)

    @property
    def objective_table(self) -> np.ndarray | None:
        """Objective of the study [SI], shape (seeds, goals), or None if it has no values per goal."""
        rows = [test.goal_values for test in self.tests]
        return None if any(row is None for row in rows) else np.array(rows, dtype=float)

    def value(self, name: str) -> float:
        """Mean over the seeds of an objective that the study names [SI]."""
        return float(np.mean([test.values[name] for test in self.tests]))

    @property
    def mean(self) -> Evaluation:
        """Evaluation averaged over the seeds, goal by goal; costs add up."""
        return self.evaluations[0] if len(self.evaluations) == 1 else Evaluation.average(self.evaluations)

    @property
    def unknowns(self) -> int | None:
        """Number of unknowns of the mesh, if it is known."""
        return self.tests[0].unknowns

    @property
    def last_motion(self) -> float | None:
        """Largest last motion of any seed [m], if it is known."""
        return max((test.last_motion for test in self.tests if test.last_motion is not None), default=None)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the goals among all of their set."""
        numbers = self.tests[0].numbers
        return list(range(len(self.mean))) if numbers is None else numbers

    @property
    def worst_distance(self) -> float:
        """Largest final distance of any seed [m]."""
        return max(evaluation.worst_distance for evaluation in self.evaluations)

    @property
    def largest_effort(self) -> float:
        """Largest effort of any actuator in any episode of any seed [N, ...]; NaN if it is not known."""
        return float(self.table("largest_efforts").max())

    @property
    def largest_strain(self) -> float:
        """Largest strain of any drive in any episode of any seed; NaN if it is not known."""
        return float(self.table("largest_strains").max())

    @property
    def self_force(self) -> float:
        """Largest force with which surfaces of the body press on each other in any episode [N]; NaN if not known."""
        return float(self.table("self_forces").max())

    def to_json(self) -> dict[str, Any]:
        """Return the average and the values of each seed as plain data."""
        data: dict[str, Any] = {"trial": self.trial, "agent": self.agent, "backend": self.backend, "goals": self.goals}
        if self.error is not None:
            return {**data, "error": self.error}
        data |= {**self.mean.to_json(), "worst_distance": self.worst_distance}
        data["values"] = {name: self.value(name) for name in self.tests[0].values}
        data |= {"unknowns": self.unknowns, "last_motion": self.last_motion}
        if len(self.tests) > 1:
            names = ("distances", "tracking_distances", "returns", "successes", "efforts", "ends")
            data["seeds"] = [test.seed for test in self.tests]
            data["of_seeds"] = {name: none_for_nan(self.table(name)) for name in names}
        return data


@dataclass(frozen=True)
class Job:
    """One JSON file of results, the function that makes its content, and the files that it is made from."""

    path: Path
    make: Callable[[], Record]
    needs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Assessment:
    """An evaluation on one body, and the objectives of a study by name."""

    evaluation: Evaluation
    measurements: dict[str, Measurement]

    @property
    def values(self) -> dict[str, float]:
        """Value of each objective [SI]."""
        return {name: measurement.value for name, measurement in self.measurements.items()}

"""Frozen problems: a definition, the goals drawn from it, and a hash of everything that decides a score."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.policy import policy_path
from softgym_envs.config import load_config
from softgym_envs.errors import ConfigError, DataError, unknown_name
from softgym_envs.extensions.leaderboard.problem import (
    GOAL_SETS,
    BenchmarkProblem,
    Judge,
    JudgedEvaluator,
    JudgedScore,
    goal_key,
)
from softgym_envs.extensions.walkers.robots.mobile import mobile
from softgym_envs.storage import atomic_write, read_json
from softgym_envs.surrogate.pretrained import pretrained_folder


def problem_names() -> list[str]:
    """Return the names of all problems."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def _folder() -> Path:
    """Return the folder of the problems: ``NAME.yaml``, written by hand, and ``NAME.json``, what was frozen."""
    return Path(__file__).parent / "problems"


def load_problem(name: str, *, check: bool = True) -> FrozenProblem:
    """Return a frozen problem.

    Args:
        name: ID such as ``"finger-zone-v1"``.
        check: whether to compare everything that decides a score with the stored hashes.

    Raises:
        ConfigError: for an unknown name or a malformed definition.
        DataError: if something that decides a score differs from what was frozen.
    """
    definition = load_definition(name)
    path = _folder() / f"{name}.json"
    if not path.is_file():
        raise DataError(f"problem '{name}' is not frozen; run: softgym benchmark freeze {name}")
    stored = read_json(path)
    try:
        goals = {key: np.asarray(stored["goals"][key], dtype=float) for key in GOAL_SETS}
        parts = dict(stored["parts"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"'{path}' is damaged: {type(error).__name__} {error}") from None
    problem = FrozenProblem(definition, goals, parts)
    if check:
        changed = [key for key, value in frozen_parts(definition, goals).items() if parts.get(key) != value]
        if changed:
            raise DataError(
                f"problem '{name}' differs from what was frozen in: {', '.join(changed)}; it needs a new "
                "version (softgym benchmark freeze)"
            )
    return problem


def load_definition(name: str) -> BenchmarkProblem:
    """Return the definition of a problem, in its YAML file.

    Raises:
        ConfigError: for an unknown name, or a file whose name is not that of its problem.
    """
    if name not in problem_names():
        raise ConfigError(unknown_name("problem", name, problem_names()))
    path = _folder() / f"{name}.yaml"
    definition = load_config(path, BenchmarkProblem)
    if definition.name != name:
        raise ConfigError(f"'{path}': name = '{definition.name}' must be that of the file")
    return definition


def freeze(name: str) -> Path:
    """Draw the goals of a problem and write them with the hashes of everything that decides a score.

    Raises:
        DataError: if a goal is in two sets.
    """
    definition = load_definition(name)
    goals = {key: definition.draw_goals(key) for key in GOAL_SETS}
    _check_disjoint(definition, goals)
    path = _folder() / f"{name}.json"
    text = json.dumps(
        {
            "parts": frozen_parts(definition, goals),
            "unit": "m",
            "goals": {key: values.tolist() for key, values in goals.items()},
        }
    )
    with atomic_write(path, "w") as stream:
        stream.write(text.replace('], "', '],\n "').replace('}, "', '},\n "') + "\n")
    return path


def frozen_parts(definition: BenchmarkProblem, goals: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Return the hash of each part of a problem that decides a score.

    ``definition`` is the YAML file, ``physics`` the robot's options, mesh, actuators and box of designs, how far ahead
    a moving goal is shown and the plain gait of bodies that move, ``weights`` the learned model, ``policy`` the shared
    policy, and ``goals`` the four sets of goals.
    """
    robot = definition.robot
    physics: dict[str, object] = {
        "robot": robot.name,
        "mechanics": robot.mechanics_key,
        "box": {v.name: [v.low, v.high, v.baseline, v.unit] for v in definition.space},
        "actuators": [[a.name, a.low, a.high, a.rate, a.unit] for a in robot.actuators],
    }
    task = definition.environment.make_task()
    if task.horizon > 1:
        physics["lookahead"] = task.lookahead
    if definition.track == "E":
        physics["gait"] = np.round(mobile(robot).reference_gait() / robot.rates, 6).tolist()
    parts = {
        "definition": _hash(definition.model_dump(mode="json", exclude={"title"}, exclude_unset=True)),
        "physics": _hash(physics),
        "goals": _hash({key: [goal_key(goal) for goal in values] for key, values in goals.items()}),
    }
    if definition.environment.backend == "surrogate":
        parts["weights"] = file_hash(pretrained_folder(robot) / "model.safetensors")
    if definition.policy is not None:
        parts["policy"] = file_hash(policy_path(definition.policy))
    return parts


def file_hash(path: Path) -> str:
    """Return the first half of the SHA-256 of a file."""
    return sha256(path.read_bytes()).hexdigest()[:32]


def _hash(value: object) -> str:
    return sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


def _check_disjoint(definition: BenchmarkProblem, goals: Mapping[str, np.ndarray]) -> None:
    """Raise unless each goal is in one set; tasks that have a single path in all episodes are exempt."""
    if len({goal_key(goal) for values in goals.values() for goal in values}) == 1:
        return
    keys = {key: {goal_key(goal) for goal in values} for key, values in goals.items()}
    for first in GOAL_SETS:
        for second in GOAL_SETS:
            if first < second and keys[first] & keys[second]:
                raise DataError(f"problem '{definition.name}': a goal is in both sets {first} and {second}")


@dataclass(frozen=True)
class FrozenProblem:
    """A problem with its goals, ready to be solved.

    Attributes:
        definition: the definition.
        goals: sets of goals by name [m], shape (count, p, 3).
        parts: hashes of what decides a score, by name.
    """

    definition: BenchmarkProblem
    goals: Mapping[str, np.ndarray]
    parts: Mapping[str, str]

    @property
    def name(self) -> str:
        """ID with its version."""
        return self.definition.name

    @property
    def hash(self) -> str:
        """Hash of everything that decides a score."""
        return _hash(dict(self.parts))

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the design variables."""
        return self.definition.variables

    @property
    def single_path(self) -> bool:
        """Whether the task has the same path in every episode, so that all sets of goals are equal."""
        return len({goal_key(goal) for values in self.goals.values() for goal in values}) == 1

    def design(self, point: Any) -> dict[str, float]:
        """Return the values [SI] of the variables at a point of the unit box [-1, 1]^n."""
        return self.definition.design_from_unit(point)

    def evaluate(
        self,
        design: Mapping[str, float],
        budget: float = 1.0,
        *,
        judge: Judge | None = None,
        seed: int = 0,
        initial: Path | None = None,
        keep: Path | None = None,
    ) -> JudgedScore:
        """Score a body on the search goals.

        Args:
            design: value of every variable [SI].
            budget: share of the goals and of the training's steps, in (0, 1].
            judge: who controls the body; default that of the problem.
            seed: added to that of the training.
            initial: policy that a training begins with, in place of that of the problem.
            keep: folder for the policy of a training.

        Raises:
            DesignError: if the body is out of the box.
            ValueError: for a judge that the problem does not have, or a budget out of (0, 1].
        """
        evaluator, judge = self.evaluator("search"), judge or self.definition.judge
        return evaluator(design, judge, share=budget, seed=seed, initial=initial, keep=keep)

    def evaluator(self, goals: str, backend: str | None = None) -> JudgedEvaluator:
        """Return the evaluator on one set of goals."""
        return JudgedEvaluator(self.definition, self.training_goals, self.goals[goals], backend)

    @property
    def training_goals(self) -> np.ndarray:
        """Goals of trainings [m], shape (k, 3); none for a task with paths, or where the task draws them."""
        training, drawn = self.goals["training"], self.definition.goals["training"].source == "task"
        return training[:, 0] if training.shape[1] == 1 and not drawn else np.zeros((0, 3))

    @cached_property
    def test_keys(self) -> frozenset[str]:
        """A hash of every test goal."""
        return frozenset(goal_key(goal) for goal in self.goals["test"])

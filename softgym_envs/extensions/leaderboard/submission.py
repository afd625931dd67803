"""Submissions to the leaderboard: one JSON file each, and the check that decides whether a score stands."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from math import inf, isfinite
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from softgym_envs.agents.policy import Policy, policy_path
from softgym_envs.codesign.records import Record
from softgym_envs.config import first_problem
from softgym_envs.errors import (
    ConfigError,
    ConvergenceError,
    DataError,
    DesignError,
    InfeasibleDesign,
    WeightsError,
    unknown_name,
)
from softgym_envs.extensions.leaderboard.frozen import FrozenProblem, file_hash, load_problem
from softgym_envs.extensions.leaderboard.problem import JUDGES, LEVELS, Budget, JudgedEvaluator, JudgedScore, goal_key
from softgym_envs.extensions.leaderboard.scoring import (
    DATA,
    Reference,
    front,
    make_reference,
    normalised,
    write_reference,
)
from softgym_envs.extensions.leaderboard.search import Search
from softgym_envs.runs import provenance
from softgym_envs.storage import atomic_write, read_json

TOLERANCE = {"qp": 1e-3, "shared": 1e-3, "trained": 5e-2, "policy": 1e-3}
"""Controller -> largest difference between a claimed score and the verified one, relative to the larger of both.

On one machine both agree to the last digit. Other processors round differently, and a training amplifies that.
"""

FLOOR = 1e-5
"""Difference that is always allowed, relative to the baseline's score on the test goals.

Below the tolerance of the inverse QP, at distances of less than a micrometre, processors differ by more than 0.1 %.
"""


class SubmissionRefused(DataError):
    """A submission whose score does not stand."""


POLICY, CARD = "policy.safetensors", "policy.json"
"""Files of a policy that is submitted, in its folder beside the submission."""


@dataclass(eq=False)
class Submission(Record):
    """One search on one problem, as JSON.

    Attributes:
        problem: ID with its version.
        hash: of the frozen problem.
        method: name of the optimiser.
        author: who submits.
        level: name of the budget.
        judge: who controlled the bodies in the search.
        seed: of the search.
        designs: the winner; with several objectives, at most eight bodies of the front.
        controller: who controls it in the test: a judge, or ``"policy"``.
        policy: for ``"policy"``: ``file``, relative to the folder of the submission, its ``sha256`` (first half), and
            ``goals``, the hashes of the goals that it was trained on.
        claimed: scores of each body on the test goals, on finite elements; empty if they were not computed.
        ledger: all scores of the search.
        optimiser_seconds: CPU time of the optimiser itself [s].
        pretraining_steps: environment steps behind whatever the method knew before it saw the problem; `submit` counts
            those of the problem's own policy.
        provenance: versions, commit, time and machine.
    """

    problem: str
    hash: str
    method: str
    author: str
    level: str
    judge: str
    seed: int
    designs: list[dict[str, float]]
    controller: str
    policy: dict[str, Any] | None = None
    claimed: list[list[float]] = field(default_factory=list)
    ledger: list[dict[str, Any]] = field(default_factory=list)
    optimiser_seconds: float = 0.0
    pretraining_steps: int = 0
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._files: dict[str, bytes] = {}  # policy and card, which `write` puts beside the submission

    def attach(self, policy: str | Path) -> Path:
        """Let a policy control the winner in the test, and return its file; `write` copies it with its card."""
        found = Policy(policy)
        self.controller = "policy"
        self.policy = {"file": POLICY, "sha256": file_hash(found.path), "goals": sorted(_trained_on(found))}
        self._files = {POLICY: found.path.read_bytes(), CARD: found.path.with_suffix(".json").read_bytes()}
        return found.path

    def write(self, path: str | Path) -> None:
        """Write the file, and for ``NAME.json`` an attached policy into the folder ``NAME_policy`` beside it."""
        path = Path(path)
        for name, content in self._files.items():
            folder = path.with_name(f"{path.stem}_policy")
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(folder / name) as stream:
                stream.write(content)
            self.policy = {**(self.policy or {}), "file": f"{folder.name}/{POLICY}"}
        super().write(path)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the submission that `to_json` wrote.

        Raises:
            DataError: if a field is missing, unknown or of another type, also in a row of the ledger.
        """
        found = _typed(cls, data, "the submission")
        _check_numbers(found)
        for number, row in enumerate(found.ledger):
            _check_score(_typed(JudgedScore, row, f"ledger.{number}"), f"ledger.{number}")
        return found


def _check_numbers(found: Submission) -> None:
    """Raise DataError for numbers that no search has."""
    for name, most in (("seed", 2**32 - 1), ("optimiser_seconds", inf), ("pretraining_steps", inf)):
        if not 0 <= getattr(found, name) <= most or not isfinite(getattr(found, name)):
            raise DataError(f"the submission: {name} = {getattr(found, name)!r}; allowed: finite numbers from 0")
    for name, numbers in (
        ("designs", [value for design in found.designs for value in design.values()]),
        ("claimed", [value for scores in found.claimed for value in scores]),
    ):
        if not all(map(isfinite, numbers)):
            raise DataError(f"the submission: {name} holds numbers that are not finite")


def _check_score(row: JudgedScore, where: str) -> None:
    """Raise DataError for a row of a ledger that no search writes."""
    for name, numbers in (("design", row.design.values()), ("values", row.values.values()), ("scores", row.scores)):
        if not all(map(isfinite, numbers)):
            raise DataError(f"{where}.{name} holds numbers that are not finite")
    for name in Budget.model_fields:
        if not (isfinite(value := getattr(row, name)) and value >= 0):
            raise DataError(f"{where}.{name} = {value:g}; allowed: finite numbers from 0")
    if not 0.0 < row.share <= 1.0:
        raise DataError(f"{where}.share = {row.share:g}; allowed: above 0, up to 1")
    if row.feasible != bool(row.scores):
        raise DataError(f"{where} has {'no scores' if row.feasible else 'a reason and scores'}; allowed: one of both")


def _trained_on(policy: Policy) -> set[str]:
    """Return the hashes of the goals that the card of a policy names."""
    goals = policy.environment.task_options.get("goals") or []
    return {goal_key(np.asarray(goal, dtype=float)) for goal in goals}


RecordT = TypeVar("RecordT", bound=Record)

_adapter = cache(TypeAdapter)


def _typed(kind: type[RecordT], data: Any, where: str) -> RecordT:
    """Return a record whose fields have the declared types.

    Raises:
        DataError: one line with the field, its value and what is allowed.
    """
    if not isinstance(data, dict):
        raise DataError(f"{where} must be an object with fields, got a {type(data).__name__}")
    names = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    if unknown := [name for name in data if name not in names]:
        raise DataError(f"{where}: {unknown_name('field', unknown[0], names)}")
    try:
        return _adapter(kind).validate_python(data)  # type: ignore[arg-type]  # records have no hash, classes do
    except ValidationError as error:
        raise DataError(f"{where}: {first_problem(error)}") from None


@dataclass(frozen=True)
class Verdict:
    """What the check of an accepted submission found.

    Attributes:
        scores: of each body on the test goals, on finite elements.
        normalised: 0 for the baseline under the inverse QP, 1 for the best known; None if no better body is known.
        exploitation: search score on the surrogate minus that on finite elements on the same goals [SI]; how much the
            search profited from errors of the surrogate. None with several objectives.
        record: whether it is the best known now.
    """

    scores: list[list[float]]
    normalised: float | None
    exploitation: float | None
    record: bool


def submit(
    search: Search,
    method: str,
    *,
    author: str = "",
    optimiser_seconds: float = 0.0,
    policy: str | Path | None = None,
    test: bool = False,
) -> Submission:
    """Return the submission of a finished search.

    Where the problem trains a policy for each body, the test trains that of the winner again and attaches it: the check
    then runs this policy in place of another training.

    Args:
        search: the search; its best body is submitted, with several objectives the bodies of its front.
        method: name of the optimiser.
        author: who submits.
        optimiser_seconds: CPU time of the optimiser itself [s].
        policy: file of a policy of your own that controls the winner in the test, with its card beside it.
        test: whether to test the bodies on finite elements now, and claim these scores.

    Raises:
        DataError: if the search found no feasible body.
        WeightsError: if the policy cannot be read.
    """
    problem, best = search.problem, search.best
    if best is None:
        raise DataError(f"problem '{problem.name}': the search found no feasible body")
    winners = [best] if problem.definition.score_count == 1 else front(search.ledger)
    submission = Submission(
        problem=problem.name,
        hash=problem.hash,
        method=method,
        author=author,
        level=search.level,
        judge=str(search.judge),
        seed=search.seed,
        designs=[dict(row.design) for row in winners],
        controller=problem.definition.judge,
        ledger=[row.to_json() for row in search.ledger],
        optimiser_seconds=optimiser_seconds,
        pretraining_steps=_pretraining(problem, str(search.judge)),
        provenance=provenance(),
    )
    file = None if policy is None else submission.attach(policy)
    if not test:
        return submission
    with tempfile.TemporaryDirectory() as folder:
        submission.claimed = _tested(problem, submission, file, Path(folder))
        if submission.controller == "trained" and len(winners) == 1:
            submission.attach(Path(folder) / "0" / "policy" / POLICY)
    return submission


def _pretraining(problem: FrozenProblem, judge: str) -> int:
    """Return the environment steps behind the policy that a judge has from the start, its learning curve included."""
    definition = problem.definition
    if judge == "qp" or definition.policy is None:
        return 0
    card = read_json(policy_path(definition.policy).with_suffix(".json"))
    episodes = len(card["curve"]) * int(card["config"]["evaluation_episodes"])
    return int(card["steps"]) + episodes * definition.episode_steps


def verify(path: str | Path, *, data: Path | None = None, record: bool = False) -> Verdict:
    """Check a submission: run its bodies again on finite elements, on the test goals (minutes).

    Args:
        path: the JSON file; a policy lies beside it.
        data: folder of the references; default the shipped one.
        record: whether to store the bodies as the best known if they are.

    Raises:
        SubmissionRefused: one line that says why the score does not stand.
        DataError: if the file cannot be read, or the frozen problem does not fit the installed package.
    """
    path = Path(path)
    submission = Submission.read(path)
    problem = _checked_problem(submission)
    rows = _checked_ledger(problem, submission)
    policy = _checked_policy(problem, submission, path.parent)
    data = data or DATA
    known = make_reference(problem, data)
    _check_search_score(problem, submission, rows, policy, known)
    scores = _tested(problem, submission, policy)
    for claimed, found in zip(submission.claimed, scores, strict=False):
        _compare(submission.controller, "score on the test goals", claimed, found, known)
    exploitation = None
    if problem.definition.score_count == 1 and problem.definition.environment.backend == "surrogate":
        evaluator = problem.evaluator("search", "fem")
        judge = problem.definition.judge if policy is not None else submission.controller
        exact = evaluator(submission.designs[0], judge, seed=submission.seed, policy=policy)  # type: ignore[arg-type]
        learned = problem.evaluator("search")(submission.designs[0], judge, seed=submission.seed, policy=policy)  # type: ignore[arg-type]
        exploitation = learned.score - exact.score
    better = is_better(known, scores)
    if better:
        known.best, known.designs, known.controller = scores, submission.designs, submission.controller
        known.accurate = []
        known.found = {
            "method": submission.method,
            "author": submission.author,
            "judge": submission.judge,
            "seed": submission.seed,
            "level": submission.level,
            **{key: submission.provenance.get(key) for key in ("commit", "time")},
        }
        if record:
            write_reference(known, data)
    return Verdict(scores, normalised(known, scores), exploitation, better)


def is_better(known: Reference, scores: list[list[float]]) -> bool:
    """Return whether bodies beat the best known ones, by more than rounding, and the baseline."""
    level = Reference(known.problem, known.hash, known.baseline, scores)
    if normalised(level, scores) is None:  # not better than the baseline
        return False
    if not known.best:
        return True
    value = normalised(known, scores)
    return value is None or value > 1.0 + FLOOR  # 1 is the gain of the best known ones over the baseline


def _checked_problem(submission: Submission) -> FrozenProblem:
    try:
        problem = load_problem(submission.problem)
    except ConfigError as error:
        raise SubmissionRefused(str(error)) from None
    if submission.hash != problem.hash:
        raise SubmissionRefused(
            f"the submission is for another version of '{problem.name}': its hash is {submission.hash[:12]}, that of "
            f"the installed problem {problem.hash[:12]}"
        )
    if submission.level not in LEVELS:
        raise SubmissionRefused(f"level '{submission.level}' does not exist; allowed: {', '.join(LEVELS)}")
    if submission.judge not in problem.definition.judges:
        raise SubmissionRefused(
            f"problem '{problem.name}' has no judge '{submission.judge}'; allowed: "
            f"{', '.join(problem.definition.judges)}"
        )
    limit = 1 if problem.definition.score_count == 1 else 8
    if not 1 <= len(submission.designs) <= limit:
        raise SubmissionRefused(f"{len(submission.designs)} bodies are submitted; allowed: 1 to {limit}")
    for design in submission.designs:
        try:
            problem.definition.checked(design)
        except DesignError as error:
            raise SubmissionRefused(f"the body is not in the box of '{problem.name}': {error}") from None
    if len(submission.claimed) not in (0, len(submission.designs)):
        raise SubmissionRefused(
            f"scores of {len(submission.claimed)} bodies are claimed; allowed: those of the {len(submission.designs)} "
            "submitted ones, or none"
        )
    return problem


def _checked_ledger(problem: FrozenProblem, submission: Submission) -> list[JudgedScore]:
    """Return the ledger; it must hold each submitted body and keep to the budget."""
    rows = [JudgedScore.from_json(row) for row in submission.ledger]
    limits = problem.definition.budgets[submission.level]  # type: ignore[index]
    for name in Budget.model_fields:
        for number, row in enumerate(rows):
            if not (isfinite(value := getattr(row, name)) and value >= 0):
                raise SubmissionRefused(f"ledger.{number}.{name} = {value:g}; allowed: finite numbers from 0")
        before = sum(getattr(row, name) for row in rows[:-1])  # the score that crosses the limit counts
        if before >= max(getattr(limits, name), 1):
            raise SubmissionRefused(
                f"the ledger exceeds the budget '{submission.level}': {name} = {before:g} before the last body; "
                f"allowed: {getattr(limits, name):g}"
            )
    for design in submission.designs:
        if not any(_same(problem, row.design, design) and row.share == 1.0 for row in rows):
            values = ", ".join(f"{name} = {value:.6g}" for name, value in design.items())
            raise SubmissionRefused(
                f"the submitted body ({values}) is not in the ledger, which has {len(rows)} rows; allowed: a body that "
                "was scored on all goals, with all steps of its training (share = 1)"
            )
    return rows


def _same(problem: FrozenProblem, first: Mapping[str, float], second: Mapping[str, float]) -> bool:
    variables = problem.definition.optimised
    return set(first) == set(second) and all(
        abs(float(variables[name].to_unit(first[name]) - variables[name].to_unit(second[name]))) < 1e-9
        for name in first
    )


def _checked_policy(problem: FrozenProblem, submission: Submission, folder: Path) -> Path | None:
    """Return the file of the submitted policy; None if the controller is a judge."""
    given = submission.policy
    if submission.controller in JUDGES:
        if submission.controller not in problem.definition.judges:
            raise SubmissionRefused(
                f"problem '{problem.name}' has no judge '{submission.controller}' as controller; allowed: "
                f"{', '.join(problem.definition.judges)}, or policy with a file"
            )
        return None
    if submission.controller != "policy" or not given:
        raise SubmissionRefused(
            f"controller '{submission.controller}' does not exist; allowed: {', '.join(JUDGES)}, or policy with a file"
        )
    missing = [name for name in ("file", "sha256", "goals") if name not in given]
    if missing:
        raise SubmissionRefused(f"policy lacks {', '.join(missing)}; needed: file, sha256 and goals")
    if not isinstance(given["goals"], list):
        raise SubmissionRefused(f"policy.goals = {given['goals']!r} must be a list of hashes, which may be empty")
    path = folder / str(given["file"])
    if not path.is_file():
        raise SubmissionRefused(f"the policy '{given['file']}' does not lie beside the submission, in '{folder}'")
    if (found := file_hash(path)) != given["sha256"]:
        raise SubmissionRefused(
            f"the policy '{path.name}' is not the one that was submitted: its SHA-256 begins with {found[:12]}, that "
            f"of the submission with {str(given['sha256'])[:12]}"
        )
    try:
        policy = Policy(path)
    except WeightsError as error:
        raise SubmissionRefused(str(error)) from None
    named = set(map(str, given["goals"])) | _trained_on(policy)
    if not problem.single_path and (leaked := sorted(named & problem.test_keys)):
        raise SubmissionRefused(
            f"the policy '{path.name}' was trained on {len(leaked)} of the {len(problem.test_keys)} test goals of "
            f"'{problem.name}' ({', '.join(leaked[:3])}{', ...' if len(leaked) > 3 else ''}); allowed: any other goals"
        )
    return path


def _check_search_score(
    problem: FrozenProblem, submission: Submission, rows: list[JudgedScore], policy: Path | None, known: Reference
) -> None:
    """Score each submitted body again on the search goals, as the search did."""
    evaluator, judge = problem.evaluator("search"), submission.judge
    for design in submission.designs:
        row = next(row for row in rows if _same(problem, row.design, design) and row.share == 1.0)
        found = _trained_score(evaluator, row, policy, known) if policy is not None and judge == "trained" else None
        found = found or evaluator(design, judge, seed=submission.seed)  # type: ignore[arg-type]
        _compare(judge, "score in the ledger", row.scores, found.scores, known)
        if row.environment_steps < found.environment_steps:
            raise SubmissionRefused(
                f"the ledger counts {row.environment_steps} environment steps for the submitted body, but scoring it "
                f"takes {found.environment_steps}"
            )


def _trained_score(evaluator: JudgedEvaluator, row: JudgedScore, policy: Path, known: Reference) -> JudgedScore | None:
    """Return the score of a body under a submitted policy and the cost of training it; None if the search had another.

    A policy that is trained again differs as soon as a processor rounds differently.
    """
    try:
        found = evaluator(row.design, "trained", policy=policy)
    except ConfigError:  # a policy of another environment, which the test refuses
        return None
    found.environment_steps += evaluator.training_steps()
    return found if _agree(row.scores, found.scores, TOLERANCE["policy"], known.baseline) else None


def _agree(claimed: list[float], found: list[float], tolerance: float, baseline: list[float]) -> bool:
    """Return whether scores are equal, up to a tolerance relative to the larger of both and up to `FLOOR`."""
    return len(claimed) == len(found) and all(
        isfinite(a) and abs(a - b) <= max(tolerance * max(abs(a), abs(b)), FLOOR * abs(scale))
        for a, b, scale in zip(claimed, found, baseline, strict=False)
    )


def _compare(controller: str, what: str, claimed: list[float], found: list[float], known: Reference) -> None:
    tolerance = TOLERANCE[controller]
    for a, b, scale in zip(claimed, found, known.baseline, strict=False):
        if not _agree([a], [b], tolerance, [scale]):
            raise SubmissionRefused(
                f"the {what} is {a:.6g}, but running the body again gives {b:.6g} (tolerance {100 * tolerance:g} %)"
            )
    if len(claimed) != len(found):
        raise SubmissionRefused(f"the {what} has {len(claimed)} values, but running the body again gives {len(found)}")


def _tested(
    problem: FrozenProblem, submission: Submission, policy: Path | None, keep: Path | None = None
) -> list[list[float]]:
    """Return the scores of the bodies on the test goals, on finite elements; trained policies can be kept."""
    evaluator, found = problem.evaluator("test", "fem"), []
    judge: Any = problem.definition.judge if policy is not None else submission.controller
    for number, design in enumerate(submission.designs):
        folder = None if keep is None else keep / str(number)
        try:
            score = evaluator(design, judge, seed=submission.seed, policy=policy, keep=folder)
        except (InfeasibleDesign, ConvergenceError, ConfigError) as error:  # or a policy of another environment
            raise SubmissionRefused(f"the body cannot be tested: {error}") from None
        if not score.feasible:
            raise SubmissionRefused(f"the body is infeasible on finite elements: {score.reason}")
        found.append(score.scores)
    return found

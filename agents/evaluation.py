"""Evaluation of agents on given goals, the same way on every backend."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from softgym_envs.agents.baselines import BASELINES, Agent, make_baseline
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.agents.policy import POLICY_FILE, Policy, shipped_policies
from softgym_envs.agents.residual import BatchQP
from softgym_envs.errors import ConfigError, DataError, unknown_name
from softgym_envs.executors import parallel_map

if TYPE_CHECKING:
    import gymnasium

    from softgym_envs.backends.backend import State

SETTLED = 20
"""Last steps of an episode over which distances are averaged where a body swings about its goal."""

Bodies = Mapping[str, float] | Sequence[Mapping[str, float]] | None
"""The body of all episodes, one for each, or None for that of the environment."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Outcome of one episode per goal, and what it cost.

    Attributes:
        distances: effector to goal at the end of each episode [m], shape (n,).
        tracking_distances: mean of that distance over the steps of each episode [m], shape (n,); on a path, the
            tracking error.
        returns: sum of rewards, shape (n,). Like the means over the steps, NaN if only the ends are known.
        successes: whether each episode ended within the task's success distance, shape (n,); in an average of several
            evaluations, the share that did.
        efforts: mean actuator effort over the episode [N, ...], shape (n,); for actuators of several units, in shares
            of `Robot.effort_scale`.
        ends: first effector at the end of each episode [m], shape (n, 3); in an average of several evaluations, the
            mean of their ends.
        steps: environment steps.
        untrusted: share of the steps of each episode that ended in a state which is not to be trusted (``trusted`` of
            ``info``), shape (n,); NaN if it is not known.
        settled_distances: mean of the distance over the last `SETTLED` steps of each episode [m], shape (n,); NaN if it
            is not known.
        largest_efforts: largest effort of any actuator in any step of each episode [N, ...], shape (n,); NaN if it is
            not known.
        largest_strains: largest strain of a drive in any step of each episode, shape (n,): the displacement over the
            length of its cable or the volume of its chamber at rest; NaN without finite elements, and for servos.
        self_forces: largest sum of the forces with which surfaces of the body press on each other in any step of each
            episode [N], shape (n,); NaN where they are not computed.
        tallies: what the task counts (`Task.tallies`), at the end of each episode [SI], each of shape (n,).
        seconds: wall-clock time [s].
        cpu_seconds: CPU time of this process [s].
    """

    distances: np.ndarray
    tracking_distances: np.ndarray
    returns: np.ndarray
    successes: np.ndarray
    efforts: np.ndarray
    ends: np.ndarray
    steps: int
    untrusted: np.ndarray | None = None
    largest_efforts: np.ndarray | None = None
    settled_distances: np.ndarray | None = None
    largest_strains: np.ndarray | None = None
    self_forces: np.ndarray | None = None
    tallies: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    def __post_init__(self) -> None:
        for name in _LATER:
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self), np.nan))

    def __len__(self) -> int:
        """Number of goals."""
        return len(self.distances)

    @property
    def success_rate(self) -> float:
        """Share of goals reached."""
        return float(self.successes.mean())

    @property
    def mean_distance(self) -> float:
        """Mean final distance [m]."""
        return float(self.distances.mean())

    @property
    def worst_distance(self) -> float:
        """Largest final distance [m]."""
        return float(self.distances.max())

    @property
    def mean_tracking_distance(self) -> float:
        """Mean distance over all steps of an episode [m], averaged over the episodes."""
        return float(self.tracking_distances.mean())

    @property
    def mean_return(self) -> float:
        """Mean sum of rewards."""
        return float(self.returns.mean())

    @property
    def mean_effort(self) -> float:
        """Mean actuator effort [N, ...]."""
        return float(self.efforts.mean())

    @classmethod
    def merge(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """Join evaluations on different goals into one evaluation on all of them; costs add up."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _PER_GOAL}
        tallies = {name: np.concatenate([part.tallies[name] for part in parts]) for name in parts[0].tallies}
        return cls(**columns, tallies=tallies, **_total_cost(parts))

    @classmethod
    def average(cls, repeats: Sequence[Evaluation]) -> Evaluation:
        """Average evaluations on the same goals, such as those of several training seeds, goal by goal; costs add up.

        Raises:
            ValueError: if the numbers of goals differ.
        """
        if len({len(repeat) for repeat in repeats}) != 1:
            raise ValueError(f"numbers of goals must be equal, got {[len(repeat) for repeat in repeats]}")
        columns = {name: np.mean([getattr(repeat, name) for repeat in repeats], axis=0) for name in _PER_GOAL}
        names = repeats[0].tallies
        tallies = {name: np.mean([repeat.tallies[name] for repeat in repeats], axis=0) for name in names}
        return cls(**columns, tallies=tallies, **_total_cost(repeats))

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain data: the summary, the values for each goal and the cost."""
        summary = {name: none_for_nan(getattr(self, name)) for name in _SUMMARY}
        columns = {name: none_for_nan(getattr(self, name)) for name in _PER_GOAL}
        tallies = {name: none_for_nan(values) for name, values in self.tallies.items()}
        cost = {"steps": self.steps, "seconds": self.seconds, "cpu_seconds": self.cpu_seconds}
        return {**summary, **columns, "tallies": tallies, **cost}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Evaluation:
        """Return the evaluation that `to_json` wrote; the summary follows from the values for each goal.

        Raises:
            DataError: if a field is missing or not an array of numbers with a row for each goal.
        """
        try:
            if "mean_distances" in data:  # as older files call it
                data = {"tracking_distances": data["mean_distances"], **data}
            data = {**{name: np.full(np.size(data["distances"]), np.nan) for name in _LATER}, **data}
            columns = {name: _column(data[name]) for name in _PER_GOAL}
            tallies = {name: _column(values) for name, values in data.get("tallies", {}).items()}
            cost = int(data["steps"]), float(data["seconds"]), float(data["cpu_seconds"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"stored evaluation cannot be read: {type(error).__name__} {error}") from None
        found = {**columns, **tallies}
        shapes = {name: column.shape for name, column in found.items()}
        count = np.size(columns["distances"])
        expected = {name: (count, 3) if name == "ends" else (count,) for name in found}
        if shapes != expected or any(column.dtype.kind not in "bif" for column in found.values()):
            raise DataError(f"stored evaluation must hold numbers for each goal, got shapes {shapes}")
        return cls(**columns, tallies=tallies, steps=cost[0], seconds=cost[1], cpu_seconds=cost[2])


def drive_strains(displacement: np.ndarray, sizes: np.ndarray | None) -> np.ndarray:
    """Return the largest strain of a drive, shape (...): NaN without sizes.

    Args:
        displacement: of the actuators [m, ...], shape (..., n_a).
        sizes: `Constraint.rest_size` of the actuators, shape (..., n_a), or None.
    """
    if sizes is None:
        return np.full(displacement.shape[:-1], np.nan)
    strains = np.abs(displacement) / sizes
    return np.where(np.isnan(strains).all(axis=-1), np.nan, np.where(np.isnan(strains), 0.0, strains).max(axis=-1))


def self_force(state: State) -> float:
    """Return the force with which surfaces of a body press on each other [N]; NaN where contact is not computed."""
    return np.nan if state.contacts is None else state.contacts.self_force


def none_for_nan(values: Any) -> Any:
    """Return a number, or numbers as lists, with None for NaN, which JSON lacks."""
    if isinstance(values, np.ndarray):
        return [none_for_nan(value) for value in values] if values.ndim else none_for_nan(values.item())
    value = values.item() if isinstance(values, np.generic) else values
    return None if isinstance(value, float) and np.isnan(value) else value


def _column(values: Any) -> np.ndarray:
    """Return an array of what `none_for_nan` made."""
    found = np.asarray(values)
    return found.astype(float) if found.dtype == object else found


_LATER = ("untrusted", "largest_efforts", "settled_distances", "largest_strains", "self_forces")
"""Columns that older files do not have."""
_PER_GOAL = ("distances", "tracking_distances", "returns", "successes", "efforts", "ends", *_LATER)
_SUMMARY = (
    "success_rate",
    "mean_distance",
    "worst_distance",
    "mean_tracking_distance",
    "mean_return",
    "mean_effort",
)


class _Cost(TypedDict):
    steps: int
    seconds: float
    cpu_seconds: float


def _total_cost(evaluations: Sequence[Evaluation]) -> _Cost:
    return {
        "steps": sum(evaluation.steps for evaluation in evaluations),
        "seconds": sum(evaluation.seconds for evaluation in evaluations),
        "cpu_seconds": sum(evaluation.cpu_seconds for evaluation in evaluations),
    }


def sample_goals(
    environment: EnvironmentConfig, count: int, seed: int, design: Mapping[str, float] | None = None
) -> np.ndarray:
    """Draw goals [m] (count, p, 3) as the task of an environment does, for a body (default the environment's)."""
    return _draw_episodes(environment, count, seed, design)[1]


def evaluation_set(
    environment: EnvironmentConfig, count: int, seed: int
) -> tuple[list[Mapping[str, float]] | None, np.ndarray]:
    """Draw ``count`` bodies and goals [m] (count, p, 3) as an environment does; None if it has a single body."""
    designs, goals = _draw_episodes(environment, count, seed, None)
    return designs if environment.sample_design else None, goals


def _draw_episodes(
    environment: EnvironmentConfig, count: int, seed: int, design: Mapping[str, float] | None
) -> tuple[list[Mapping[str, float]], np.ndarray]:
    """Return the bodies and the goals [m] (count, p, 3) of ``count`` episodes."""
    env = environment.make()
    designs, goals = [], []
    try:
        for i in range(count):
            env.reset(seed=seed if i == 0 else None, options={"design": design})
            designs.append(env.unwrapped.design)  # type: ignore[attr-defined]
            goals.append(env.unwrapped.path.copy())  # type: ignore[attr-defined]
    finally:
        env.close()
    return designs, np.stack(goals)


def check_agent(agent: str | Path) -> None:
    """Check that an agent is a baseline, a shipped policy or a file.

    Raises:
        ConfigError: with the nearest name, and the allowed ones.
    """
    name = str(agent)
    names = [*BASELINES, *shipped_policies()]
    if (
        name in BASELINES
        or name in names
        or name.endswith(".safetensors")
        or (Path(name) / "policy.safetensors").is_file()
    ):
        return
    if name in LEARNERS:
        raise ConfigError(
            f"'{name}' is a learner, not an agent; agents are {', '.join(BASELINES)}, the folder or file of a policy "
            f"('softgym train' makes one), and policies that ship, such as {names[-1]}"
        )
    raise ConfigError(unknown_name("agent", name, names, other=POLICY_FILE))


def make_agent(agent: str | Path, seed: int = 0) -> Agent:
    """Return ``agent(observation, env.unwrapped) -> action``.

    Args:
        agent: one of `BASELINES`, see `make_baseline`; or a policy: its file, the folder of its training, or its name.
        seed: seed of the random agent.

    Raises:
        ConfigError: for an unknown name.
        WeightsError: if the policy cannot be read.
    """
    check_agent(agent)
    if agent in BASELINES:
        return make_baseline(str(agent), seed)
    return _acting(Policy(agent))


def _acting(policy: Policy) -> Agent:
    act = policy.begin()

    def agent(observation: Any, env: Any) -> np.ndarray:
        nonlocal act
        if env.steps == 0:
            act = policy.begin()
        return act(observation)

    return agent


def evaluate(
    agent: str | Path,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    *,
    design: Bodies = None,
    seed: int = 0,
    workers: int = 1,
) -> Evaluation:
    """Run one episode per goal.

    Args:
        agent: one of `BASELINES`, a policy file, or the name of a shipped policy.
        environment: the environment; its ``residual_scale`` applies to policies only.
        goals: goals or paths of goals [m], shape (n, 3) or (n, p, 3).
        design: the body, or one for each goal; default the environment's.
        seed: seed of the random agent and of the environment.
        workers: number of processes, which share the goals and give the same numbers as one. Policies and the QP in
            batched environments run all episodes at once in this process, whatever the number.

    Returns:
        The outcome, whose times include making the environment; the CPU time is that of all processes.

    Raises:
        ValueError: for fewer than one worker, goals of another shape, another number of bodies than goals, or an
            environment that is not an `EnvironmentConfig`.
        ConfigError: for an unknown agent, or if the policy was trained for another environment, see
            `Policy.check_environment`.
        WeightsError: if the policy cannot be read.
    """
    if workers < 1:
        raise ValueError(f"workers = {workers} must be 1 or more")
    if not isinstance(environment, EnvironmentConfig):
        raise ValueError(
            f"environment = {environment!r} must be an EnvironmentConfig, such as EnvironmentConfig(id=ID)"
        )
    check_agent(agent)
    goals = np.asarray(goals, dtype=float)
    goals = goals[:, None, :] if goals.ndim == 2 else goals
    if goals.ndim != 3 or goals.shape[2] != 3 or not goals.size:
        raise ValueError(f"goals must have shape (n, 3) or (n, p, 3), with at least one goal, got {goals.shape}")
    if not (design is None or isinstance(design, Mapping)) and len(design) != len(goals):
        raise ValueError(f"design must be one body or one for each of {len(goals)} goals, got {len(design)}")
    if agent in BASELINES:
        environment = environment.uncorrected
    else:
        Policy(agent).check_environment(environment)
    together = environment.batched and (agent not in BASELINES or (agent == "qp" and len(goals) > 1))
    run = _evaluate_together if together else _evaluate_one_by_one
    shares = np.array_split(np.arange(len(goals)), 1 if together else min(workers, len(goals)))
    began = time.perf_counter()
    calls = [(run, agent, environment, goals, design, seed, share) for share in shares]
    parts = dict(parallel_map(_evaluate_share, calls, len(shares)))
    merged = Evaluation.merge([parts[first] for first in sorted(parts)])
    return replace(merged, seconds=time.perf_counter() - began)


def _evaluate_share(
    run: Callable[..., Evaluation],
    agent: str | Path,
    environment: EnvironmentConfig,
    goals: np.ndarray,
    design: Bodies,
    seed: int,
    share: np.ndarray,
) -> tuple[int, Evaluation]:
    """Evaluate an agent on the goals with the numbers ``share``; return the first of these and the outcome."""
    cpu = time.process_time()
    outcome = run(agent, environment, goals, design, seed, share)
    return int(share[0]), replace(outcome, cpu_seconds=time.process_time() - cpu)


def _evaluate_one_by_one(
    agent: str | Path, environment: EnvironmentConfig, goals: np.ndarray, design: Bodies, seed: int, share: np.ndarray
) -> Evaluation:
    """Run the episodes with the numbers ``share`` one after the other, on any backend."""
    act = make_agent(agent, seed)
    env = environment.make(sample_design=False)
    rows = []
    try:
        for index in share.tolist():
            if agent == "random":  # each episode draws its own numbers, whichever process runs it
                act = make_agent(agent, seed + index)
            body = design if design is None or isinstance(design, Mapping) else design[index]
            # Episodes have touches, plants and noise of their own, whichever process runs them.
            rows.append(_run_episode(env, act, seed + index, {"design": body, "goal": goals[index]}))
    finally:
        env.close()
    columns: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in _PER_GOAL}
    tallies = {name: np.array([row["tallies"][name] for row in rows]) for name in rows[0]["tallies"]}
    return Evaluation(**columns, tallies=tallies, steps=sum(row["steps"] for row in rows))


def _run_episode(env: gymnasium.Env, act: Agent, seed: int, options: dict[str, Any]) -> dict[str, Any]:
    """Return what `Evaluation` says of one episode, by the names of its columns, and its steps."""
    observation, info = env.reset(seed=seed, options=options)
    total, effort, largest, untrusted, ended = 0.0, 0.0, 0.0, 0, False
    distances: list[float] = []
    inner: Any = env.unwrapped
    sizes, strain, pressing = inner.backend.rest_sizes, np.float64(0.0), np.float64(0.0)
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act(observation, inner))
        total += float(reward)
        efforts = env.unwrapped.robot.effort_sizes(info["effort"])  # type: ignore[attr-defined]
        effort, largest = effort + float(efforts.mean()), max(largest, float(efforts.max()))
        distances.append(float(info["distance"]))
        strain = np.maximum(strain, drive_strains(info["displacement"], sizes))
        pressing = np.maximum(pressing, self_force(inner.state))
        untrusted += not info["trusted"]
        ended = terminated or truncated
    steps = len(distances)
    return {
        "distances": info["distance"],
        "tracking_distances": sum(distances) / steps,
        "settled_distances": float(np.mean(distances[-SETTLED:])),
        "returns": total,
        "successes": bool(info["is_success"] and info["converged"]),
        "efforts": effort / steps,
        "ends": info["effector"],
        "untrusted": untrusted / steps,
        "largest_efforts": largest,
        "largest_strains": strain,
        "self_forces": pressing,
        "tallies": {name: info[name] for name in inner.task.tallies},
        "steps": steps,
    }


def _evaluate_together(
    agent: str | Path, environment: EnvironmentConfig, goals: np.ndarray, design: Bodies, seed: int, share: np.ndarray
) -> Evaluation:
    """Run all episodes at once on the batched environment, with a policy or the inverse QP; ``share`` is all goals."""
    count = len(goals)
    env: Any = environment.make_vec(count, sample_design=False)
    if agent in BASELINES:
        control = BatchQP(env.unwrapped)
        act: Callable[[np.ndarray], np.ndarray] = lambda observation: control()  # noqa: E731
    else:
        act = Policy(agent).begin()
    distances, totals, returns, efforts, largest, strains, untrusted, lengths = np.zeros((8, count))
    recent = np.full((SETTLED, count), np.nan)
    successes, running, ends = np.zeros(count, dtype=bool), np.ones(count, dtype=bool), np.zeros((count, 3))
    tallies = {name: np.zeros(count) for name in env.unwrapped.task.tallies}
    try:
        observation, _ = env.reset(seed=seed, options={"design": design, "goal": goals})
        sizes = env.unwrapped.backend.rest_sizes
        while running.any():
            observation, reward, terminated, truncated, info = env.step(act(observation))
            last = info.get("final_info", info)
            distances[running], ends[running] = last["distance"][running], last["effector"][running]
            successes[running] = (last["is_success"] & last["converged"])[running]
            for name, values in tallies.items():
                values[running] = last[name][running]
            totals += running * last["distance"]
            recent[lengths[running].astype(int) % SETTLED, running] = last["distance"][running]
            returns += running * reward
            effort = env.unwrapped.robot.effort_sizes(last["effort"])
            efforts += running * effort.mean(axis=1)
            largest = np.maximum(largest, running * effort.max(axis=1))
            now = drive_strains(last["displacement"], sizes)
            strains = np.where(running, np.maximum(strains, now), strains)
            untrusted += running & ~last["trusted"]
            lengths += running
            running &= ~(terminated | truncated)
    finally:
        env.close()
    return Evaluation(
        distances=distances,
        tracking_distances=totals / lengths,
        returns=returns,
        successes=successes,
        efforts=efforts / lengths,
        ends=ends,
        untrusted=untrusted / lengths,
        largest_efforts=largest,
        settled_distances=np.nanmean(recent, axis=0),
        largest_strains=strains,
        tallies=tallies,
        steps=int(lengths.sum()),
    )

"""Tables and learning curves of stored runs, which `softgym_envs.extensions.sweeps.sweep` writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from softgym_envs import agents
from softgym_envs.agents.baselines import BASELINES
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.learners import LEARNERS
from softgym_envs.config import check_config
from softgym_envs.errors import DataError
from softgym_envs.extensions.sweeps.statistics import Estimate, crossed_estimate, stratified_estimate
from softgym_envs.storage import read_json

if TYPE_CHECKING:
    from softgym_envs.agents.training import CurvePoint

RESULTS = Path(agents.__file__ or "").parent / "results"
"""Stored runs of the configurations in ``configs/agents``."""


def agent_titles() -> dict[str, str]:
    """Return the titles of all agents by name: learners, then agents that need no training."""
    return {name: cls.title for name, cls in LEARNERS.items()} | {name: cls.title for name, cls in BASELINES.items()}


#: Colours of the curves of each learner: single seeds, and their mean.
_COLOURS = (
    ("#99d0ca", "#0f766e"),
    ("#a9bff0", "#1d4ed8"),
    ("#f3c49a", "#c2570c"),
    ("#d3b5ea", "#7e22ce"),
    ("#e3a3b5", "#be123c"),
    ("#b9d59b", "#4d7c0f"),
)


class StoredEvaluation(TypedDict):
    """An evaluation in a file of results: values for each goal, rounded, and the cost."""

    distances: list[float]
    tracking_distances: list[float]
    returns: list[float]
    successes: list[int]
    steps: int
    seconds: float


Evaluations = dict[str, dict[str, StoredEvaluation]]
"""Evaluations by backend and agent."""


@dataclass(frozen=True)
class StoredRun:
    """A training with one seed and the evaluations of its policy."""

    seed: int
    learner: str
    environment: EnvironmentConfig
    curve: list[CurvePoint]
    evaluations: Evaluations

    @classmethod
    def read(cls, path: Path) -> StoredRun:
        """Read ``seed<k>.json``.

        Raises:
            DataError: if it is not the result of a training.
        """
        run = read_json(path)
        expected = {"seed", "config", "curve", "evaluations", "horizon"}
        if not isinstance(run, dict) or not expected <= run.keys():
            raise DataError(f"'{path}' is not the result of a training: it must contain {', '.join(sorted(expected))}")
        environment = check_config(EnvironmentConfig, run["config"]["environment"], f"'{path}'")
        learner = run["config"].get("learner", "sac")  # the only one there was before
        return cls(run["seed"], learner, environment, run["curve"], run["evaluations"])


@dataclass(frozen=True)
class StoredRuns:
    """All trainings in one environment, and the baselines on the same goals.

    Attributes:
        name: name of the first of the configurations that share the environment.
        runs: the trainings, by configuration and seed.
        baselines: evaluations of the baselines, empty if they were not run.
    """

    name: str
    runs: list[StoredRun]
    baselines: Evaluations

    @property
    def environment(self) -> EnvironmentConfig:
        """Environment of the trainings."""
        return self.runs[0].environment

    def scores(self, agent: str, backend: str, column: str) -> np.ndarray | None:
        """Return one column of the final evaluation, shape (seeds, goals), or None if there is no such evaluation.

        Args:
            agent: name of a learner, or of a baseline, which has a single row.
            backend: ``"own"`` for that of the environment, or ``"fem"``.
            column: ``"distances"``, ``"tracking_distances"``, ``"returns"`` or ``"successes"``.
        """
        backend = self.environment.backend if backend == "own" else backend
        own = [run.evaluations for run in self.runs if run.learner == agent]
        sources = own if agent in LEARNERS else [self.baselines]
        rows = [source.get(backend, {}).get(agent) for source in sources]
        found = [row[column] for row in rows if row is not None]  # type: ignore[literal-required]
        return np.array(found, dtype=float) if found else None

    @property
    def follows(self) -> bool:
        """Whether the goal of the task moves along a path."""
        return self.environment.task_class.horizon > 1

    @property
    def horizon(self) -> int:
        """Steps of an episode, the largest possible return."""
        return self.environment.row.max_episode_steps


def load_runs(folder: str | Path = RESULTS) -> list[StoredRuns]:
    """Read ``<config>/seed<k>.json`` and ``<config>/baselines.json`` of a folder.

    Raises:
        DataError: if there are no such files, or one cannot be read.
    """
    folder = Path(folder)
    found: list[StoredRuns] = []
    for place in sorted(path for path in folder.glob("*") if path.is_dir()):
        runs = sorted(map(StoredRun.read, place.glob("seed*.json")), key=lambda run: run.seed)
        if not runs:
            continue
        path = place / "baselines.json"
        baselines = read_json(path)["evaluations"] if path.exists() else {}
        same = next((entry for entry in found if entry.environment == runs[0].environment), None)
        if same is None:
            found.append(StoredRuns(place.name, runs, baselines))
        else:
            same.runs.extend(runs)
            same.baselines.update(baselines)
    if not found:
        raise DataError(f"'{folder}' contains no results (<config>/seed<k>.json); create them with softgym sweep")
    return found


def table(runs: list[StoredRuns]) -> str:
    """Return Markdown tables of distances and success rates on the backend of the training and on FEM, and overall."""
    counts = [Counter(run.learner for run in entry.runs) for entry in runs]
    seeds = sorted({count for each in counts for count in each.values()})
    free, based = ([name for name, cls in LEARNERS.items() if cls.model_based is known] for known in (False, True))
    text = [
        f"Interquartile means over all seeds ({' or '.join(map(str, seeds))}) and goals, with 95 % bootstrap intervals "
        "over both (with three seeds that differ much, they cover only about 80 %). "
        f"{_listed(free)} are model-free; {_listed(based)} learn from the model of the robot that the QP uses. "
        "Distances are in mm, errors of forces in %: to the goal at the end of an episode, or the mean along a path "
        "(track tasks, marked *). Policies were chosen on other goals.\n"
    ]
    for backend, title in (("own", "On the backend of the training"), ("fem", "The same policies on FEM")):
        shown = [entry for entry in runs if backend == "own" or entry.environment.backend != "fem"]
        if any(entry.scores(learner, backend, "distances") is not None for entry in shown for learner in LEARNERS):
            text += [f"\n## {title}\n", _grid(shown, partial(_distance, backend=backend))]
            text += ["\nGoals reached [%]:\n", _grid(shown, partial(_success, backend=backend))]
    text += ["\n## All environments\n", _together(runs)]
    return "\n".join(text) + "\n"


@dataclass(frozen=True)
class Summary:
    """How well one agent does in one environment, over all seeds and goals.

    Attributes:
        configuration: name of the configuration.
        environment: ID of the environment.
        backend: backend of the evaluation.
        agent: name of a learner or a baseline.
        quantity: ``"distance"`` to the goal at the end, ``"tracking_distance"`` along a path, both in metres, or
            ``"relative_error"``, of a force.
        mean: interquartile mean.
        low: lower end of the 95 % bootstrap interval; None if there is nothing to resample.
        high: its upper end.
        success_rate: share of goals reached.
        seeds: number of trainings; 1 for a baseline.
    """

    configuration: str
    environment: str
    backend: str
    agent: str
    quantity: str
    mean: float
    low: float | None
    high: float | None
    success_rate: float
    seeds: int


def summary(runs: list[StoredRuns]) -> list[Summary]:
    """Return the numbers of `table` in SI units: a row for each environment, backend and agent."""
    rows = []
    for entry in runs:
        metres = entry.environment.task_class.distance_scale.goal_unit == "m"
        quantity = ("tracking_distance" if entry.follows else "distance") if metres else "relative_error"
        for backend in sorted({entry.environment.backend, "fem"}):
            for agent in agent_titles():
                scores = entry.scores(agent, backend, "tracking_distances" if entry.follows else "distances")
                successes = entry.scores(agent, backend, "successes")
                if scores is None or successes is None:
                    continue
                estimate = crossed_estimate(scores)
                low, high = (None if np.isnan(end) else end for end in (estimate.low, estimate.high))
                title, rate = entry.environment.title, float(successes.mean())
                rows.append(
                    Summary(entry.name, title, backend, agent, quantity, estimate.value, low, high, rate, len(scores))
                )
    return rows


def _listed(learners: Iterable[str]) -> str:
    *first, last = (LEARNERS[name].title for name in learners)
    return f"{', '.join(first)} and {last}" if first else last


def _grid(runs: Sequence[StoredRuns], cell: Callable[[StoredRuns, str], str]) -> str:
    agents = _evaluated(runs)
    lines = _head("configuration", agents)
    for entry in runs:
        name = f"{entry.name}*" if entry.follows else entry.name
        lines.append(f"| {name} | " + " | ".join(cell(entry, agent) for agent in agents) + " |")
    return "\n".join(lines)


def _evaluated(runs: Sequence[StoredRuns]) -> list[str]:
    """Return the agents of which there are evaluations."""
    return [
        agent
        for agent in agent_titles()
        if any(entry.scores(agent, backend, "returns") is not None for entry in runs for backend in ("own", "fem"))
    ]


def _head(first: str, agents: Sequence[str]) -> list[str]:
    titles = agent_titles()
    return [f"| {first} | " + " | ".join(titles[agent] for agent in agents) + " |", "|---" * (len(agents) + 1) + "|"]


def _distance(entry: StoredRuns, agent: str, backend: str) -> str:
    scores = entry.scores(agent, backend, "tracking_distances" if entry.follows else "distances")
    if scores is None:
        return ""
    scale = entry.environment.task_class.distance_scale
    text = _present(crossed_estimate(scale.factor * scores))
    return text if scale.unit == "mm" else f"{text} {scale.unit}"


def _success(entry: StoredRuns, agent: str, backend: str) -> str:
    scores = entry.scores(agent, backend, "successes")
    return "" if scores is None else f"{100.0 * scores.mean():.0f}"


def _present(estimate: Estimate, digits: int = 3) -> str:
    def number(value: float) -> str:
        return "0" if value == 0.0 else f"{float(f'{value:.{digits}g}'):g}" if abs(value) >= 1e-3 else f"{value:.0e}"

    if np.isnan(estimate.low):
        return number(estimate.value)
    return f"{number(estimate.value)} [{number(estimate.low)}, {number(estimate.high)}]"


def _together(runs: list[StoredRuns]) -> str:
    """Return the table of returns over all environments, with the plain configuration of each task."""
    agents = _evaluated(runs)
    plain = [entry for entry in runs if not entry.environment.residual_scale and not entry.environment.sample_design]
    lines = [
        "Return as a share of the largest possible return; interquartile mean over seeds and the plain configurations "
        "(the intervals resample the seeds of each configuration).\n",
        *_head("backend", agents),
    ]
    for backend, word in (("own", "of the training"), ("fem", "FEM")):
        cells = []
        for agent in agents:
            found = [(entry, entry.scores(agent, backend, "returns")) for entry in plain]
            means = [scores.mean(axis=1) / entry.horizon for entry, scores in found if scores is not None]
            count = max(map(len, means), default=0)
            if not count:
                cells.append("")
                continue
            shares = np.stack([mean for mean in means if len(mean) == count], axis=1)
            cells.append(f"{_present(stratified_estimate(shares))} ({shares.shape[1]})")
        lines.append(f"| {word} | " + " | ".join(cells) + " |")
    return (
        "\n".join(lines)
        + "\n\nIn parentheses: number of environments; those with fewer seeds than the others are left out."
    )


def draw_curves(runs: list[StoredRuns], path: str | Path, columns: int = 4) -> Path:
    """Draw the learning curves of every seed and their mean, in a panel for each configuration.

    The curves are mean returns of the evaluations during training, green for SAC, blue for PPO, orange for the analytic
    gradient, violet for cloning and red for evolution; the dashed line is the inverse QP on the goals of the final
    evaluation.

    Args:
        runs: the runs.
        path: image file; its ending selects the format.
        columns: number of columns of panels.

    Returns:
        The path.
    """
    from matplotlib.figure import Figure

    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(3.0 * columns, 2.1 * rows), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for panel in panels[len(runs) :]:
        panel.remove()
    for panel, entry in zip(panels, runs, strict=False):
        for learner, (light, dark) in zip(LEARNERS, cycle(_COLOURS), strict=False):
            curves = [
                ([row["step"] for row in run.curve], [row["mean_return"] / entry.horizon for row in run.curve])
                for run in entry.runs
                if run.learner == learner
            ]
            if not curves:
                continue
            for steps, returns in curves:
                panel.plot(steps, returns, color=light, linewidth=1.0)
            common = min(len(steps) for steps, _ in curves)
            mean = np.mean([returns[:common] for _, returns in curves], axis=0)
            panel.plot(curves[0][0][:common], mean, color=dark, linewidth=2.0)
        qp = entry.scores("qp", "own", "returns")
        if qp is not None:
            panel.axhline(qp.mean() / entry.horizon, color="#64748b", linestyle="--", linewidth=1.0)
        panel.set_title(entry.name, fontsize=9)
        panel.set_ylim(0.0, 1.0)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1e3:g}")
    figure.supxlabel("environment steps / 1000", fontsize=9)
    figure.supylabel("return, share of the largest", fontsize=9)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path

"""Robots on their accurate meshes: what weights learned there get right, and studies judged on finer meshes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recorded import records, results
from benchmarks.tables import markdown
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.agents.evaluation import make_agent
from softgym_envs.codesign.records import TrialResult
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.control.settling import settle
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot
from softgym_envs.storage import write_json
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model


@dataclass(frozen=True)
class AccurateRobot:
    """A robot whose weights were learned from its accurate mesh.

    Attributes:
        robot: registered name.
        convergence: recorded benchmark with its converged tips and efforts.
        weights: options of the robot for two sets of weights, by name.
        study: configuration of its study; empty for none.
        meshes: sizes of the meshes on which the study's bodies are judged [m], and the number of unseen goals there.
        proportional: all elements shrink with the size of the mesh. Otherwise the outline keeps some of them small, and
            the cube root of volume per unknown is their size.
    """

    robot: str
    convergence: str
    weights: Mapping[str, Mapping[str, Any]]
    study: str
    meshes: Mapping[str, tuple[float, int]]
    proportional: bool = True


ROBOTS = {
    "finger": AccurateRobot(
        "finger",
        "convergence_finger",
        {"accurate": {"mesh": "accurate", "design_box": "wide"}, "published": {}},
        "finger_reach_accurate",
        {"accurate": (10e-3, 20), "refined": (7.5e-3, 6)},
    ),
    "diamond": AccurateRobot(
        "diamond",
        "convergence_diamond",
        {"accurate": {"mesh": "accurate"}, "published": {}},
        "diamond_reach_accurate",
        {"accurate": (17e-3, 12), "refined": (10.2e-3, 3)},
        proportional=False,
    ),
    "cable_trunk": AccurateRobot(
        "cable_trunk", "convergence_cable_trunk", {"accurate": {"mesh": "coarse"}, "published": {}}, "", {}
    ),
}
"""Robots by the last part of the benchmarks' names."""

BODIES = ("baseline", "winner")

LAST_STEPS = 4
"""Control steps of a policy on finite elements, from the command at which it ended on the weights."""


def accurate_weights(name: str) -> dict[str, object]:
    """Tip and tension of weights against values extrapolated from three meshes, on bodies of no training set.

    Bodies, command and converged values are those of the robot's recorded benchmark of convergence.
    """
    robot = ROBOTS[name]
    found = results(robot.convergence)
    rows: list[dict[str, Any]] = []
    for weights, options in robot.weights.items():
        model = pretrained_model(make_robot(robot.robot, **options))
        for body, converged in found["errors"].items():
            tip, tension = _predicted(model, found["designs"][body], np.array(found["command"]))
            truth = np.array(converged["tip [mm]"])
            rows.append(
                {
                    "weights": weights,
                    "body": body,
                    "tip": float(np.linalg.norm(tip - truth) / np.linalg.norm(truth)),
                    "tension": tension / converged["effort"] - 1.0,
                }
            )
    worst = {
        f"{weights}: worst {name} [%]": 100 * max(abs(row[name]) for row in rows if row["weights"] == weights)
        for weights in robot.weights
        for name in ("tip", "tension")
    }
    return {"rows": rows, **worst}


def _predicted(model: SurrogateModel, design: Mapping[str, float], command: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the motion of the tip [mm] and the tension of the first cable [N] under a command."""
    context = model.context(model.robot.design_space.complete(design).array[None])
    ends = np.stack([np.zeros_like(command), command])
    reached = [model.search(context, end[None], end[None], model.robot.unilateral, 1e-6, 50) for end in ends]
    rest, tip = (model.effector(context, displacement)[0][0, :3] for displacement, _, _ in reached)
    return 1e3 * (tip - rest), float(reached[1][1][0, 0])


def accurate_study(name: str, folder: str | Path | None = None) -> dict[str, object]:
    """Baseline and winner of a study on weights of an accurate mesh: where their controllers end, on two meshes of FEM.

    Distances from the first of the study's unseen goals [mm], fewer on the refined mesh. The inverse QP is followed
    until it settles; a policy takes `LAST_STEPS` control steps from the command at which it ended on the weights.

    Args:
        name: one of `ROBOTS`.
        folder: the finished study, by default that of its name in ``results``; finished bodies are kept in it.
    """
    judged = ROBOTS[name]
    folder = Path(folder or f"results/{judged.study}")
    study = load_study(folder)
    assert study.best is not None
    goals = study.folder.goals["unseen"][: max(count for _, count in judged.meshes.values()), 0]
    trials = {"baseline": next(trial for trial in study.trials if trial.origin == "baseline"), "winner": study.best}
    result: dict[str, Any] = {"designs": {body: dict(trial.design) for body, trial in trials.items()}}
    result["goals [mm]"] = (1e3 * goals).tolist()
    environment = study.config.environment
    for body, trial in trials.items():
        agent = trial.controller if trial.controller == "qp" else folder / trial.controller
        commands, distances = _on_weights(environment, trial, agent, goals)
        result[f"{body}: surrogate: distance [mm]"] = (1e3 * distances).tolist()
        for mesh, (size, count) in judged.meshes.items():
            path = folder / f"judged_{body}_{mesh}_{count}.json"
            if not path.exists():
                finer = environment.on("fem")
                finer = finer.model_copy(update={"robot_options": {**environment.robot_options, "mesh_size": size}})
                judge = _settled if agent == "qp" else partial(_followed, agent)
                write_json(path, judge(finer, trial.design, goals[:count], commands))
            result |= {f"{body}: {mesh}: {key}": value for key, value in json.loads(path.read_text()).items()}
    return result


def _on_weights(
    environment: EnvironmentConfig, trial: TrialResult, agent: str | Path, goals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the commands (k, n_a) at which episodes on the weights end, and the distances from goals [m] (k,)."""
    act, env = make_agent(agent), environment.make(sample_design=False)
    commands, distances = [], []
    for goal in goals:
        observation, info = env.reset(seed=0, options={"design": trial.design, "goal": goal})
        ended = False
        while not ended:
            observation, _, lost, over, info = env.step(act(observation, env.unwrapped))
            ended = lost or over
        commands.append(env.unwrapped.command)  # type: ignore[attr-defined]
        distances.append(float(info["distance"]))
    env.close()
    return np.array(commands), np.array(distances)


def _settled(
    environment: EnvironmentConfig, design: Mapping[str, float], goals: np.ndarray, starts: np.ndarray
) -> dict[str, Any]:
    """Return distances from goals [mm] and tensions [N] where the inverse QP ends on one mesh, NaN where it fails."""
    robot, start = environment.make_robot(), time.process_time()
    statics, distances, tensions, count = Statics(robot.build(design)), [], [], 0
    for goal, command in zip(goals, starts, strict=False):
        try:
            found = settle(statics, robot, goal, command)
            count += found.equilibria
            distances.append(1e3 * found.distance)
            tensions.append(float(found.effort.max()))
        except ConvergenceError:
            distances.append(float("nan"))
            tensions.append(float("nan"))
    seconds = time.process_time() - start
    unknowns = statics.model.equations
    shown = {"distance [mm]": distances, "tension [N]": tensions, "equilibria": count}
    return {**shown, "unknowns": unknowns, "CPU [s]": seconds}


def _followed(
    agent: str | Path,
    environment: EnvironmentConfig,
    design: Mapping[str, float],
    goals: np.ndarray,
    starts: np.ndarray,
) -> dict[str, Any]:
    """Return the same where a policy ends in closed loop on one mesh, and how far its last step moved the tip [mm]."""
    start, act, env = time.process_time(), make_agent(agent), environment.make(sample_design=False)
    inside: Any = env.unwrapped
    distances, tensions, moved, count = [], [], [], 0
    for goal, command in zip(goals, starts, strict=False):
        _, info = env.reset(seed=0, options={"design": dict(design), "goal": goal})
        before, converged = info["effector"], True
        try:
            inside.backend.step(command)
        except ConvergenceError:
            converged = False
        observation, info = inside.set_state(inside.get_state())
        for _ in range(LAST_STEPS if converged else 0):
            before = info["effector"]
            observation, _, _, failed, info = env.step(act(observation, inside))
            count, converged = count + 1, converged and bool(info["converged"])
        nan = float("nan")
        distances.append(1e3 * float(info["distance"]) if converged else nan)
        tensions.append(float(info["effort"].max()) if converged else nan)
        moved.append(1e3 * float(np.linalg.norm(info["effector"] - before)) if converged else nan)
    unknowns, seconds = inside.backend.model.equations, time.process_time() - start
    env.close()
    shown = {"distance [mm]": distances, "tension [N]": tensions, "last motion [mm]": moved, "equilibria": count}
    return {**shown, "unknowns": unknowns, "CPU [s]": seconds}


def weights_table(name: str) -> str:
    """Errors of tip and tension of both sets of weights, body by body."""
    found, kinds = results(f"accurate_weights_{name}")["rows"], ROBOTS[name].weights
    of = {(row["weights"], row["body"]): row for row in found}
    rows = []
    for body in dict.fromkeys(row["body"] for row in found):
        title = body if body == "baseline" else f"random body {body}"
        cells = [f"{100 * of[weights, body][what]:.1f}" for weights in kinds for what in ("tip", "tension")]
        rows.append([title, *cells])
    head = ["body", "accurate: tip [%]", "tension [%]", "published: tip [%]", "tension [%]"]
    return markdown(head, rows, "lrrrr")


def study_table(name: str) -> str:
    """Mean distance from the goals of the study's baseline and winner on the weights and on two meshes."""
    found, meshes = results(f"accurate_study_{name}"), ROBOTS[name].meshes

    def change(judge: str, count: int | None) -> np.ndarray:
        before, after = (np.array(found[f"{body}: {judge}: distance [mm]"][:count]) for body in BODIES)
        return after - before

    rows, intervals = [], {}
    for judge in ("surrogate", *meshes):
        values = change(judge, None)
        draws = np.random.default_rng(0).integers(len(values), size=(10_000, len(values)))
        low, high = intervals[judge] = np.quantile(values[draws].mean(axis=1), (0.025, 0.975))
        cells = [f"{np.mean(found[f'{body}: {judge}: distance [mm]']):.2f}" for body in BODIES]
        tensions = [
            f"{np.mean(found[f'{body}: {judge}: tension [N]']):.2f}" if judge in meshes else "" for body in BODIES
        ]
        shown = f"{values.mean():.2f} ({low:.2f} to {high:.2f})"
        rows.append([judge, str(len(values)), *cells, shown, *tensions])
    left = remaining(name, change)
    low, high = intervals["accurate"]
    whole = f"{low + min(left, 0.0):.2f} to {high + max(left, 0.0):.2f}"
    rows.append(["accurate, with its error", "", "", "", f"{whole}", "", ""])
    head = [
        "judge",
        "goals",
        "baseline [mm]",
        "winner [mm]",
        "change (95 %) [mm]",
        "tension, baseline [N]",
        "winner [N]",
    ]
    return markdown(head, rows, "lrrrrrr")


def remaining(name: str, change: Callable[[str, int], np.ndarray]) -> float:
    """Return what is left of the accurate mesh's error in the change from baseline to winner [mm].

    It is the difference of both meshes on the goals that they share, extrapolated linearly to elements of size zero.

    Args:
        name: one of `ROBOTS`.
        change: returns the changes on a mesh at its first goals.
    """
    judged = ROBOTS[name]
    (coarse, _), (fine, count) = judged.meshes["accurate"], judged.meshes["refined"]
    ratio = fine / coarse
    if not judged.proportional:
        found = results(f"accurate_study_{name}")
        ratio = (found["baseline: accurate: unknowns"] / found["baseline: refined: unknowns"]) ** (1.0 / 3.0)
    return float((change("refined", count) - change("accurate", count)).mean() / (1.0 - ratio))


def _named(kind: Callable[..., Any], name: str) -> Callable[[], Any]:
    run = partial(kind, name)
    run.__doc__ = f"{(kind.__doc__ or '').splitlines()[0][:-1]}: {name}."
    return run


TABLES: dict[str, Callable[[], str]] = {
    f"{prefix}_{name}": _named(table, name)
    for name in ROBOTS
    for prefix, table in (("accurate_weights", weights_table), ("accurate_study", study_table))
    if f"{prefix}_{name}" in records()
}
"""Tables of pages by name, of those that have recorded results."""

BENCHMARKS: dict[str, Callable[[], dict[str, object]]] = {
    f"{run.__name__}_{name}": _named(run, name)
    for run in (accurate_weights, accurate_study)
    for name, robot in ROBOTS.items()
    if run is accurate_weights or robot.study
}
"""Benchmarks by name."""

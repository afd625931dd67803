"""Recordings of rollouts for the rerun viewer (``rerun rollout.rrd``), written without a window."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import gymnasium
import numpy as np

from softgym_envs.envs.env import SoftRobotEnv
from softgym_envs.envs.tasks.base import LENGTHS, DistanceScale
from softgym_envs.extras import require
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.units import display, effort_unit
from softgym_envs.viewer.moment import Moment, Watcher
from softgym_envs.viewer.scene import COLORS, STUB, effort_color
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines

Agent = Callable[[np.ndarray, SoftRobotEnv], np.ndarray]
"""Maps an observation and the environment, unwrapped, to an action."""


class RolloutRecorder:
    """Writes the states of one rollout to an ``.rrd`` file on the timeline ``step``.

    Use it as a context manager: the file is complete when the block ends, and does not exist if the block fails.

    The recording contains ``world/body`` (mesh), ``world/cables/<actuator>``, ``world/effectors``, ``world/goal`` and
    ``world/path`` (all in metres), ``plots/distance`` (mm, or the unit of the task), ``plots/reward``, and for each
    actuator ``plots/displacement/<actuator>`` and ``plots/effort/<actuator>`` (mm and N for cables).

    Args:
        robot: the family of bodies.
        path: file to write; missing folders are created.
        name: name of the recording in the viewer.
        roles: names of several rollouts to show side by side. The entities of a rollout lie under its name, and `log`
            writes to the rollout selected by the last `begin`.
        distance_scale: unit of ``plots/distance``.
    """

    def __init__(
        self,
        robot: Robot,
        path: str | Path,
        *,
        name: str | None = None,
        roles: Sequence[str] = ("",),
        distance_scale: DistanceScale = LENGTHS,
    ) -> None:
        self.robot = robot
        self.distance_scale = distance_scale
        self.path = Path(path)
        self.name = name or self.path.stem
        self.roles = tuple(roles)
        self._shapes = ShapeFinder(robot)
        self.begin(self.roles[0])

    def begin(self, role: str) -> None:
        """Select the rollout that `log` writes to."""
        self._root = f"{role}/" if role else ""
        self._model: MechanicalModel | None = None
        self._goals: np.ndarray | None = None

    def __enter__(self) -> RolloutRecorder:
        require("viewer")
        import rerun
        import rerun.blueprint as blueprint

        self._stream = rerun.RecordingStream("softgym_envs")
        # The control steps are the only timeline; wall-clock time is meaningless here.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        roots = [f"{role}/" if role else "" for role in self.roles]
        plots = [
            blueprint.TimeSeriesView(
                origin="/", contents=[f"+ /{root}plots/{kind}/**" for root in roots], name=kind.capitalize()
            )
            for kind in ("distance", "reward", "displacement", "effort")
        ]
        views = [
            blueprint.Spatial3DView(origin=f"{root}world", name=role or self.name, background=COLORS["background"])
            for role, root in zip(self.roles, roots, strict=True)
        ]
        layout = blueprint.Blueprint(
            blueprint.Horizontal(*views, blueprint.Vertical(*plots), column_shares=[3] * len(views) + [2]),
            collapse_panels=True,
        )
        # rerun's own files lack what a full disk does not take, without a word.
        self._memory = self._stream.memory_recording()
        self._stream.send_blueprint(layout, make_active=False)
        self._stream.send_recording_name(self.name)
        for role in self.roles:
            self.begin(role)
            self._log_names()
        self.begin(self.roles[0])
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        content = self._memory.drain_as_bytes()
        self._stream.disconnect()
        if kind is None:
            with atomic_write(self.path) as file:
                file.write(content)

    def log(self, moment: Moment, /) -> None:
        """Log one state."""
        import rerun

        size, design, state, goal, path = self.robot.size, moment.design, moment.state, moment.goal, moment.path
        self._stream.set_time("step", sequence=moment.step)
        model = self._shapes.load(design)
        x = self._shapes.nodes(design, state)
        self._log_body(model, x)
        lines = cable_lines(model, x, state, stub=STUB * size)
        for row, line in lines.items():
            share = state.effort[row] / self.robot.effort_scale[row]
            color = COLORS["cable slack"] if state.slack[row] else effort_color("cable", share)
            strip = rerun.LineStrips3D([line], radii=0.008 * size, colors=color)
            self._stream.log(f"{self._root}world/cables/{self.robot.actuators[row].name}", strip)
        effectors = rerun.Points3D(state.effector, radii=0.026 * size, colors=COLORS["effector"])
        self._stream.log(f"{self._root}world/effectors", effectors)
        self._stream.log(f"{self._root}world/goal", rerun.Points3D(goal, radii=0.034 * size, colors=COLORS["goal"]))
        if path is not None and len(path) > 1 and (self._goals is None or not np.array_equal(path, self._goals)):
            self._goals = np.array(path)
            goals = rerun.LineStrips3D([path], radii=0.005 * size, colors=COLORS["goal"])
            self._stream.log(f"{self._root}world/path", goals)

        distance = moment.distance
        if distance is None:
            distance = float(np.linalg.norm(state.effector[0] - goal))
        self._plot("distance", self.distance_scale.factor * distance)
        if moment.reward is not None:
            self._plot("reward", moment.reward)
        for row, actuator in enumerate(self.robot.actuators):
            self._plot(f"displacement/{actuator.name}", display(actuator.unit).factor * state.displacement[row])
            self._plot(f"effort/{actuator.name}", state.effort[row])

    def _log_names(self) -> None:
        import rerun

        self._stream.log(f"{self._root}world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        scale = self.distance_scale
        names = {"distance": f"{scale.name} [{scale.unit}]", "reward": "reward"}
        for actuator in self.robot.actuators:
            names[f"displacement/{actuator.name}"] = f"{actuator.name} [{display(actuator.unit).unit}]"
            names[f"effort/{actuator.name}"] = f"{actuator.name} [{effort_unit(actuator.unit)}]"
        for entity, name in names.items():
            label = f"{self._root.rstrip('/')} {name}".strip()
            self._stream.log(f"{self._root}plots/{entity}", rerun.SeriesLines(names=label), static=True)

    def _log_body(self, model: MechanicalModel, x: np.ndarray) -> None:
        import rerun

        new = model is not self._model
        if new:
            self._model, self._surface = model, BodySurface(model)
        points = self._surface.points(x)
        normals = self._surface.normals(points)
        if new:
            colors = np.tile(np.array(COLORS["body"], dtype=np.uint8), (len(points), 1))
            colors[self._surface.triangles[self._surface.clamped]] = COLORS["clamp"]
            colors[self._surface.triangles[self._surface.rigid]] = COLORS["object"]
            mesh = rerun.Mesh3D(
                vertex_positions=points,
                vertex_normals=normals,
                vertex_colors=colors,
                triangle_indices=self._surface.triangles,
            )
        else:
            # The viewer keeps the triangles and colours of the step that logged them last.
            mesh = rerun.Mesh3D.from_fields(vertex_positions=points, vertex_normals=normals)
        self._stream.log(f"{self._root}world/body", mesh)

    def _plot(self, entity: str, value: float) -> None:
        import rerun

        self._stream.log(f"{self._root}plots/{entity}", rerun.Scalars(float(value)))


def record_rollout(
    env: gymnasium.Env,
    agent: Agent,
    path: str | Path,
    *,
    seed: int | None = 0,
    options: Mapping[str, Any] | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Run one episode, write it to an ``.rrd`` file and return its result.

    Args:
        env: a `SoftRobotEnv`, wrapped or not. It is reset first and not closed.
        agent: maps an observation and ``env.unwrapped`` to an action.
        path: file to write.
        seed: seed of the reset.
        options: options of the reset.
        steps: largest number of steps; default: the time limit of the environment.

    Returns:
        ``return`` (sum of rewards), ``final_distance`` (as `Task.distance` returns it: [m] for positions), ``success``
        at the last step, ``steps``, and ``distrust_codes``, the ``info["distrust"]`` of each state.

    Raises:
        ValueError: if the environment is not a `SoftRobotEnv`, or has no time limit while ``steps`` is None.
    """
    with recorder_of(env, path) as recorder:
        return watch_rollout(env, agent, [recorder], seed=seed, options=options, steps=steps)


def recorder_of(env: gymnasium.Env, path: str | Path) -> RolloutRecorder:
    """Return a recorder of an environment's rollouts, to be used as a context manager.

    Raises:
        ValueError: if the environment is not a `SoftRobotEnv`.
    """
    name = Path(path).stem if env.spec is None else env.spec.id
    body = _body_of(env)
    return RolloutRecorder(body.robot, path, name=name, distance_scale=body.task.distance_scale)


def _body_of(env: gymnasium.Env) -> SoftRobotEnv:
    body = env.unwrapped
    if not isinstance(body, SoftRobotEnv):
        raise ValueError(f"only rollouts of a SoftRobotEnv can be recorded, got {type(body).__name__}")
    return body


def _limit(env: gymnasium.Env, steps: int | None) -> int:
    limit = env.spec.max_episode_steps if steps is None and env.spec is not None else steps
    if limit is None:
        raise ValueError("the environment has no time limit; pass the largest number of steps as 'steps'")
    return limit


class Filmed:
    """Watcher that keeps a picture of each state.

    Args:
        env: environment with ``render_mode="rgb_array"``.
        frames: list that takes the pictures, shape (height, width, 3).
    """

    def __init__(self, env: gymnasium.Env, frames: list[Any]) -> None:
        self.env, self.frames = env, frames

    def log(self, moment: Moment, /) -> None:
        """Draw the environment as it is now."""
        self.frames.append(self.env.render())


def watch_rollout(
    env: gymnasium.Env,
    agent: Agent,
    watchers: Sequence[Watcher],
    *,
    seed: int | None = 0,
    options: Mapping[str, Any] | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Run one episode, show each of its states to all watchers and return its result; see `record_rollout`."""
    steps = _limit(env, steps)
    body = _body_of(env)
    observation, info = env.reset(seed=seed, options=None if options is None else dict(options))

    def log(step: int, reward: float | None) -> None:
        path, goal = body.task.drawn_goals(body.state, body.path, body.goal)
        moment = Moment(step, body.design, body.state, goal, path, reward, float(info["distance"]))
        for watcher in watchers:
            watcher.log(moment)

    log(0, None)
    total, step, over, distrust_codes = 0.0, 0, False, [int(info["distrust"])]
    while step < steps and not over:
        observation, reward, terminated, truncated, info = env.step(agent(observation, body))
        step, total, over = step + 1, total + float(reward), terminated or truncated
        distrust_codes.append(int(info["distrust"]))
        log(step, float(reward))
    return {
        "return": total,
        "final_distance": float(info["distance"]),
        "success": bool(info["is_success"]),
        "steps": step,
        "distrust_codes": distrust_codes,
    }

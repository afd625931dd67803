"""Recordings of rollouts for the rerun viewer (``rerun rollout.rrd``), written without a window."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.envs.tasks.base import LENGTHS, DistanceScale
from softgym_envs.extras import require
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.units import display, effort_unit
from softgym_envs.viewer.moment import Moment
from softgym_envs.viewer.scene import COLORS, STUB, effort_color
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv


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


def recorder_of(env: SoftRobotEnv, path: str | Path) -> RolloutRecorder:
    """Return a recorder of an environment's rollouts, to be used as a context manager."""
    name = Path(path).stem if env.spec is None else env.spec.id
    return RolloutRecorder(env.robot, path, name=name, distance_scale=env.task.distance_scale)

"""Metrics of designs on the two backends: one design at a time, or a batch with gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.registry import make_backend
from softgym_envs.codesign.tools.grasps import GraspConfig
from softgym_envs.codesign.tools.metrics import Course, Metric, find_metrics
from softgym_envs.codesign.variables import split_values
from softgym_envs.errors import ConfigError
from softgym_envs.estimation.information import touch_slopes
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.mechanics.surfaces import check_cavities
from softgym_envs.robots.base import Robot
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.robots.grasping import Grasp
from softgym_envs.robots.sensorized_finger import SensorizedFinger, SensorReadings
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.potential.torch import TorchModel
from softgym_envs.surrogate.pretrained import pretrained_model

RobotMaker = Callable[[Mapping[str, float]], Robot]
"""Makes a robot with other values of its options, ``{"robot.<option>": value}``."""


def full_command(robot: Robot, actuation: Sequence[float] | None) -> np.ndarray:
    """Return an actuation (n_a,), or a ConfigError if it is out of range; default: half of the upper limits."""
    command = np.array(0.5 * robot.upper if actuation is None else actuation, dtype=float)
    if command.shape != robot.lower.shape or not ((command >= robot.lower) & (command <= robot.upper)).all():
        allowed = ", ".join(f"{a.name} {a.low:g} to {a.high:g} {a.unit}" for a in robot.actuators)
        raise ConfigError(f"actuation {command.tolist()} is out of range; allowed: {allowed}")
    return command


def check_metrics(robot: Robot, metrics: Sequence[str | Metric], backend: str) -> tuple[Metric, ...]:
    """Return metrics by name; a ConfigError for none, or one that is unknown, repeated or not provided."""
    try:
        found = find_metrics(tuple(metrics))
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not found:
        raise ConfigError("name at least one metric")
    for metric in found:
        if metric.needs in ("body", "sensors", "pushes", "touches", "grasps") and backend != "fem":
            raise ConfigError(f"metric '{metric.name}' needs backend 'fem', got '{backend}'")
        if metric.needs == "sensors" and not hasattr(robot, "cavities"):
            raise ConfigError(f"metric '{metric.name}' needs a robot with sensing cavities, got '{robot.name}'")
        if metric.needs in ("pushes", "touches") and not isinstance(robot, SensorizedFinger):
            raise ConfigError(f"metric '{metric.name}' needs robot 'sensorized_finger', got '{robot.name}'")
        if metric.needs == "pushes" and robot.cavities != 4:  # type: ignore[attr-defined]
            raise ConfigError(f"metric '{metric.name}' needs robot 'sensorized_finger' with robot_options cavities: 4")
        if metric.needs == "grasps" and not isinstance(robot, ContactAidedFinger):
            raise ConfigError(f"metric '{metric.name}' needs robot 'contact_aided_finger', got '{robot.name}'")
    return found


def body_axis(robot: Robot) -> int:
    """Return the coordinate along which a robot lies at rest."""
    return int(np.argmax(np.abs(robot.effector_rest)))


class Evaluator:
    """Metrics of one design at a time, on FEM or on a surrogate.

    Args:
        robot: the robot.
        metrics: metrics, or their names or paths, see `softgym_envs.codesign.tools.metrics.find_metric`.
        backend: ``"fem"`` or ``"surrogate"``.
        actuation: full command: displacements of the actuators, shape (n_a,); default: half of their upper limits.
        steps: states beyond rest along the actuation, evenly spaced.
        weights: folder of the surrogate's weights; default: the pretrained ones.
        make_robot: needed for designs that contain robot options.
        grasps: over which metrics of grasps are averaged.

    Raises:
        ConfigError: for an unknown metric, one that the backend or the robot does not provide, or a malformed command.
    """

    def __init__(
        self,
        robot: Robot,
        metrics: Sequence[str | Metric],
        *,
        backend: str = "fem",
        actuation: Sequence[float] | None = None,
        steps: int = 1,
        weights: str | Path | None = None,
        make_robot: RobotMaker | None = None,
        grasps: Sequence[GraspConfig] = (GraspConfig(),),
    ) -> None:
        self.metrics = check_metrics(robot, metrics, backend)
        self.robot = robot
        self.command = full_command(robot, actuation)
        self.steps = steps
        self.backend = backend
        self._backend_options = {"weights": weights} if backend == "surrogate" else {}
        self.grasps = tuple(grasps)
        self._make_robot = make_robot
        self._options: dict[str, float] = {}

    def course(self, design: Mapping[str, float]) -> Course:
        """Return the states of one design; raises `InfeasibleDesign` and `ConvergenceError`.

        With metrics of its sensors, a design is infeasible if the walls of a cavity pass through each other.
        """
        variables = self._choose_robot(design)
        # A backend keeps its body in memory, so every design gets a new one.
        backend = make_backend(self.backend, self.robot, design=variables, **self._backend_options)
        states = [backend.state]
        states += [backend.step(k / self.steps * self.command) for k in range(1, self.steps + 1)]
        sensor, material = None, None
        if isinstance(backend, FEMBackend):
            material = torch.tensor([backend.model.volume], dtype=torch.float64)
            volumes = [c.rest_volume for c in backend.model.constraints["s"] if isinstance(c, Cavity)]
            if volumes and any(metric.needs == "sensors" for metric in self.metrics):
                for state in states:
                    assert state.nodes is not None
                    check_cavities(backend.model.constraints["s"], state.nodes)
            if volumes:
                sensor = _stack([np.array(volumes) + state.condensed.delta.s for state in states])
        return Course(
            displacement=_stack([state.displacement for state in states]),
            effort=_stack([state.effort for state in states]),
            effector=_stack([state.effector.ravel() for state in states]),
            compliance=_stack([_compliance(state) for state in states]),
            axis=body_axis(self.robot),
            sensor=sensor,
            material=material,
        )

    def __call__(self, design: Mapping[str, float]) -> dict[str, float]:
        """Return the metrics of a complete design by name [SI]; raises as `course` and `close`."""
        needs = {metric.needs for metric in self.metrics}
        course = self.course(design) if needs & {"states", "body", "sensors"} else None
        grasps = self.close(design) if "grasps" in needs else []
        values = {}
        for metric in self.metrics:
            if metric.needs == "design":
                values[metric.name] = float(metric(dict(design)))
            elif metric.needs == "grasps":
                values[metric.name] = float(np.mean([metric(each) for each in grasps]))
            elif metric.needs == "pushes":
                values[metric.name] = float(metric(self.push(design)))
            elif metric.needs == "touches":
                values[metric.name] = float(metric(self.touch(design)))
            else:
                values[metric.name] = float(metric(course)[0])
        return values

    def push(self, design: Mapping[str, float]) -> SensorReadings:
        """Return the readings of a complete design under a pull and a lateral force; raises as `course`."""
        variables = self._choose_robot(design)
        assert isinstance(self.robot, SensorizedFinger)
        return self.robot.readings(variables, pull=float(self.command[0]))

    def touch(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the slopes of the volumes under touches of a complete design, see `touch_slopes`; raises as `course`.

        The finger is touched on its back at the centres of ten cells of 20 mm by 7.5 mm, under the full command.
        """
        variables = self._choose_robot(design)
        heights = -0.015 - 0.020 * (np.arange(5) + 0.5)
        places = np.array([[side * 3.75e-3, 0.0, height] for height in heights for side in (-1.0, 1.0)])
        return touch_slopes(self.robot, places, np.array([0.0, 1.0, 0.0]), self.command, variables)

    def close(self, design: Mapping[str, float]) -> list[Grasp]:
        """Return all grasps of a complete design; raises `InfeasibleDesign` and `ConvergenceError`."""
        variables = self._choose_robot(design)
        assert isinstance(self.robot, ContactAidedFinger)
        return [config.evaluate(self.robot, variables) for config in self.grasps]

    def _choose_robot(self, design: Mapping[str, float]) -> dict[str, float]:
        """Make the robot with the options of a design, and return the values of its variables."""
        variables, options = split_values(design)
        if options != self._options:
            assert self._make_robot is not None
            self.robot, self._options = self._make_robot(options), options
        return variables


def _stack(arrays: list[np.ndarray]) -> Tensor:
    """Return states (K, 1, ...) of one body."""
    return torch.as_tensor(np.stack(arrays)[:, None], dtype=torch.float64)


def _compliance(state: State) -> np.ndarray:
    W = state.condensed.W
    return np.block([[W.aa, W.ae], [W.ea, W.ee]])


class LearnedBodies:
    """Metrics of a batch of designs on a surrogate, with gradients.

    Actuators are where they are commanded to be: no cable hangs slack. Rest is zero displacement. The arguments are
    those of `Evaluator`.

    Raises:
        ConfigError: as for `Evaluator`, for metrics without gradients, and for weights of another kind of network.
    """

    def __init__(
        self,
        robot: Robot,
        metrics: Sequence[str | Metric],
        *,
        actuation: Sequence[float] | None = None,
        steps: int = 1,
        weights: str | Path | None = None,
    ) -> None:
        self.metrics = check_metrics(robot, metrics, "surrogate")
        if rigid := [metric.name for metric in self.metrics if metric.needs == "design"]:
            raise ConfigError(f"metric '{rigid[0]}' is a function of the design without gradients; use solver 'search'")
        self.robot = robot
        self.command = torch.as_tensor(full_command(robot, actuation))
        self.steps = steps
        self.net = learned_model(robot, weights)

    def course(self, values: Tensor) -> Course:
        """Return the states of complete designs (B, len(space))."""
        bodies, count = len(values), self.steps + 1
        part = torch.arange(count, dtype=torch.float64) / self.steps
        displacement = (part[:, None, None] * self.command).expand(count, bodies, -1)
        effort, effector, W = self.net(values.repeat(count, 1), displacement.reshape(count * bodies, -1))
        return Course(
            displacement=displacement,
            effort=effort.reshape(count, bodies, -1),
            effector=effector.reshape(count, bodies, -1),
            compliance=W.reshape(count, bodies, *W.shape[1:]),
            axis=body_axis(self.robot),
        )

    def __call__(self, values: Tensor) -> Tensor:
        """Return the metrics of complete designs (B, len(space)), shape (B, m) [SI]."""
        course = self.course(values)
        return torch.stack([metric(course) for metric in self.metrics], dim=1)


def learned_model(robot: Robot, weights: str | Path | None = None) -> TorchModel:
    """Return a robot's surrogate in torch; a ConfigError if its network has no exact gradients."""
    model = pretrained_model(robot, weights)
    if not isinstance(model, Model):
        raise ConfigError(f"gradients need weights of a 'potential' network, got '{model.network}'")
    return TorchModel(model)

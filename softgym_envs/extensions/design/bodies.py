"""Metrics of designs on the two backends: one design at a time, or a batch with gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.backend import Backend, State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.registry import make_backend
from softgym_envs.codesign.metrics.metric import Metric, find_metric
from softgym_envs.codesign.metrics.sources import STATES
from softgym_envs.codesign.records import Score
from softgym_envs.codesign.scoring import Evaluator
from softgym_envs.codesign.variables import split_values
from softgym_envs.errors import ConfigError
from softgym_envs.executors import parallel_map
from softgym_envs.extensions.design.metrics import ActuationPath
from softgym_envs.extensions.fitting.torch_potential import TorchModel
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model

Key = TypeVar("Key")
RobotMaker = Callable[[Mapping[str, float]], Robot]
"""Makes a robot with other values of its options, ``{"robot.<option>": value}``."""


def full_command(robot: Robot, actuation: Sequence[float] | None) -> np.ndarray:
    """Return an actuation (n_a,), or a ConfigError if it is out of range; default: half of the upper limits."""
    command = np.array(0.5 * robot.upper if actuation is None else actuation, dtype=float)
    if command.shape != robot.lower.shape or not ((command >= robot.lower) & (command <= robot.upper)).all():
        allowed = ", ".join(f"{a.name} {a.low:g} to {a.high:g} {a.unit}" for a in robot.actuators)
        raise ConfigError(f"actuation {command.tolist()} is out of range; allowed: {allowed}")
    return command


def check_metrics(
    robot: Robot, metrics: Sequence[str | Metric], backend: str, sources: Mapping[str, Any] | None = None
) -> tuple[Metric, ...]:
    """Return metrics by name; a ConfigError for none, or one that is unknown, repeated or not provided.

    ``sources`` has the settings of sources by name.
    """
    try:
        found = tuple(find_metric(metric, robot) for metric in metrics)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not found:
        raise ConfigError("name at least one metric")
    names = [metric.name for metric in found]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"metric '{repeated[0]}' is named twice")
    for metric in found:
        if lacking := metric.source.refuse(robot, backend):
            raise ConfigError(f"metric '{metric.name}' needs {lacking}")
    read_settings(found, sources or {})
    return found


def read_settings(metrics: Sequence[Metric], sources: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the sources of metrics by name; a ConfigError for those of another source."""
    used = {metric.source.name: metric.source.settings for metric in metrics}
    for name in sources:
        if used.get(name) is None:
            raise ConfigError(f"sources: no metric takes settings of '{name}'; the metrics have: {', '.join(used)}")
    return {name: read(sources.get(name)) for name, read in used.items() if read is not None}


def body_axis(robot: Robot) -> int:
    """Return the coordinate along which a robot lies at rest."""
    return int(np.argmax(np.abs(robot.effector_rest)))


class Body:
    """One design of a robot; what metrics are read from is computed when it is first used.

    Args:
        robot: the robot, with the options of the design.
        design: the complete design [SI], with robot options.
        backend: ``"fem"`` or ``"surrogate"``.
        backend_options: options of the backend.
        command: full command, shape (n_a,).
        steps: states beyond rest along the actuation, evenly spaced.
        settings: settings of sources, by name.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float],
        backend: str,
        backend_options: Mapping[str, Any],
        command: np.ndarray,
        steps: int,
        settings: Mapping[str, Any],
    ) -> None:
        self.robot, self.design, self.command, self.steps, self.settings = robot, design, command, steps, settings
        self.variables, _ = split_values(design)
        self._kind, self._options = backend, backend_options

    @cached_property
    def _backend(self) -> Backend:
        return make_backend(self._kind, self.robot, design=self.variables, **self._options)

    @cached_property
    def model(self) -> MechanicalModel:
        """The mechanical model; raises `InfeasibleDesign`."""
        return self._backend.model if isinstance(self._backend, FEMBackend) else self.robot.build(self.variables)

    @cached_property
    def states(self) -> list[State]:
        """States from rest to the full command; raises `InfeasibleDesign` and `ConvergenceError`."""
        backend = self._backend
        return [backend.state] + [
            backend.step(k / self.steps * self.command, "displacement") for k in range(1, self.steps + 1)
        ]

    @cached_property
    def course(self) -> ActuationPath:
        """The states as tensors; raises as `states`."""
        return ActuationPath(
            displacement=_stack([state.displacement for state in self.states]),
            effort=_stack([state.effort for state in self.states]),
            effector=_stack([state.effector.ravel() for state in self.states]),
            compliance=_stack([_compliance(state) for state in self.states]),
            axis=body_axis(self.robot),
        )


class StateEvaluator(Evaluator):
    """Scores one design at a time by its states along an actuation, on FEM or on a surrogate.

    Args:
        robot: the robot.
        metrics: metrics, or their names or paths, see `softgym_envs.codesign.metrics.metric.find_metric`.
        backend: ``"fem"`` or ``"surrogate"``.
        actuation: full command: displacements of the actuators, shape (n_a,); default: half of their upper limits.
        steps: states beyond rest along the actuation, evenly spaced.
        weights: folder of the surrogate's weights; default: the pretrained ones.
        make_robot: needed for designs that contain robot options.
        sources: settings of sources of metrics by name.

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
        sources: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(check_metrics(robot, metrics, backend, sources))
        self.settings = read_settings(self.metrics, sources or {})
        self.robot = robot
        self.command = full_command(robot, actuation)
        self.steps = steps
        self.backend = backend
        self._backend_options = {"weights": weights} if backend == "surrogate" else {}
        self._make_robot = make_robot
        self._options: dict[str, float] = {}

    def body(self, design: Mapping[str, float]) -> Body:
        """Return the body of a complete design, which metrics are read from."""
        _, options = split_values(design)
        if options != self._options:
            assert self._make_robot is not None
            self.robot, self._options = self._make_robot(options), options
        return Body(self.robot, design, self.backend, self._backend_options, self.command, self.steps, self.settings)

    def measure(self, design: Mapping[str, float]) -> dict[str, float]:
        body = self.body(design)
        read = cache(lambda source: source.read(body))
        return {metric.name: float(metric(read(metric.source))) for metric in self.metrics}


def evaluate_each(
    evaluator: Evaluator, designs: Iterable[tuple[Key, Mapping[str, float]]], workers: int
) -> Iterator[tuple[Key, Score]]:
    """Score designs, each with a key, on several processes; yields each key with its score, in any order."""
    yield from parallel_map(_evaluate_one, [(key, evaluator, design) for key, design in designs], workers)


def _evaluate_one(key: Key, evaluator: Evaluator, design: Mapping[str, float]) -> tuple[Key, Score]:
    return key, evaluator(design)


def _stack(arrays: list[np.ndarray]) -> Tensor:
    """Return states (K, 1, ...) of one body."""
    return torch.as_tensor(np.stack(arrays)[:, None], dtype=torch.float64)


def _compliance(state: State) -> np.ndarray:
    W = state.condensed.W
    return np.block([[W.aa, W.ae], [W.ea, W.ee]])


class LearnedBodies:
    """Metrics of a batch of designs on a surrogate, with gradients.

    Actuators are where they are commanded to be: no cable hangs slack. Rest is zero displacement. The arguments are
    those of `StateEvaluator`.

    Raises:
        ConfigError: as for `StateEvaluator`, for metrics without gradients, and for weights of another kind of network.
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
        check_derivatives(self.metrics)
        self.robot = robot
        self.command = torch.as_tensor(full_command(robot, actuation))
        self.steps = steps
        self.net = learned_model(robot, weights)

    def course(self, values: Tensor) -> ActuationPath:
        """Return the states of complete designs (B, len(space))."""
        bodies, count = len(values), self.steps + 1
        part = torch.arange(count, dtype=torch.float64) / self.steps
        displacement = (part[:, None, None] * self.command).expand(count, bodies, -1)
        effort, effector, W = self.net(values.repeat(count, 1), displacement.reshape(count * bodies, -1))
        return ActuationPath(
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


def check_derivatives(metrics: Sequence[Metric]) -> None:
    """Raise ConfigError for a metric without derivatives."""
    if rigid := [metric.name for metric in metrics if metric.source is not STATES]:
        raise ConfigError(f"metric '{rigid[0]}' has no derivative by the design; use solver 'search'")


def learned_model(robot: Robot, weights: str | Path | None = None) -> TorchModel:
    """Return a robot's surrogate in torch; a ConfigError if its network has no exact gradients."""
    model = pretrained_model(robot, weights)
    if not isinstance(model, Model):
        raise ConfigError(f"gradients need weights of a 'potential' network, got '{model.network}'")
    return TorchModel(model)

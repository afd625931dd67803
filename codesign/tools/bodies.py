"""From a design to the values of its metrics: the free variables, and the two backends that evaluate them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.tools.metrics import METRICS, Course
from softgym_envs.backends import make_backend
from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import DesignSpace
from softgym_envs.errors import ConfigError
from softgym_envs.mechanics.constraints import Cavity
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.potential import model as potential
from softgym_envs.surrogate.potential.torch import TorchModel
from softgym_envs.surrogate.pretrained import pretrained_model

__all__ = ["Box", "Evaluator", "LearnedBodies"]


class Box:
    """The designs under consideration: free variables within bounds, the others fixed.

    Args:
        space: all variables of the robot.
        variables: names of the free ones; default all.
        bounds: narrower bounds of some of them, ``{name: (low, high)}`` [SI].
        design: values of the others, and the reference of the free ones; the rest is the robot's baseline.

    Raises:
        DesignError: for an unknown name, or a value or a bound outside the robot's own bounds.
        ConfigError: for a variable named twice, or bounds of one that is not free.
    """

    def __init__(
        self,
        space: DesignSpace,
        variables: Sequence[str] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        design: Mapping[str, float] | None = None,
    ) -> None:
        self.names = tuple(space.names if variables is None else variables)
        if len(set(self.names)) != len(self.names):
            raise ConfigError(f"variables {list(self.names)} name one twice")
        for name in bounds or {}:
            if name not in self.names:
                raise ConfigError(f"bounds of '{name}', which is not among the variables {', '.join(self.names)}")
        self.space = space
        self.reference = space.complete(design)
        free = []
        for name in self.names:
            variable = space[name]
            low, high = (bounds or {}).get(name, (variable.low, variable.high))
            low, high = variable.check(low), variable.check(high)
            free.append(replace(variable, low=low, high=high, baseline=min(max(self.reference[name], low), high)))
        self.free = DesignSpace(*free)

    def __len__(self) -> int:
        return len(self.names)

    def design(self, unit: np.ndarray) -> dict[str, float]:
        """Return the complete design of a point in [-1, 1]^d."""
        return {**self.reference, **self.free.from_unit(unit)}

    def unit(self, design: Mapping[str, float]) -> np.ndarray:
        """Return the point in [-1, 1]^d of a design, shape (d,)."""
        return self.free.to_unit({name: design[name] for name in self.names})

    def values(self, unit: Tensor) -> Tensor:
        """Return complete designs (B, len(space)) of points (B, d), with gradients."""
        columns = {name: torch.full((len(unit),), value, dtype=torch.float64) for name, value in self.reference.items()}
        for k, (name, variable) in enumerate(self.free.variables.items()):
            ends = np.array([variable.low, variable.high])
            low, high = np.log(ends) if variable.log else ends
            value = low + 0.5 * (unit[:, k] + 1.0) * (high - low)
            columns[name] = torch.exp(value) if variable.log else value
        return torch.stack(list(columns.values()), dim=1)

    def corners(self) -> np.ndarray:
        """All corners, shape (2^d, d)."""
        return np.stack(np.meshgrid(*[[-1.0, 1.0]] * len(self), indexing="ij"), axis=-1).reshape(-1, len(self))

    def grid(self, count: int) -> np.ndarray:
        """A regular grid of about ``count`` points, corners included, shape (m, d) with m >= count."""
        steps = max(2, int(np.ceil(count ** (1.0 / len(self)) - 1e-9)))
        line = np.linspace(-1.0, 1.0, steps)
        return np.stack(np.meshgrid(*[line] * len(self), indexing="ij"), axis=-1).reshape(-1, len(self))


def full_command(robot: Robot, actuation: Sequence[float] | None) -> np.ndarray:
    """Check an actuation (n_a,), by default half of every actuator's upper limit.

    Raises:
        ConfigError: for a wrong length, or a displacement out of range.
    """
    command = np.array(0.5 * robot.upper if actuation is None else actuation, dtype=float)
    if command.shape != robot.lower.shape or not ((command >= robot.lower) & (command <= robot.upper)).all():
        allowed = ", ".join(f"{a.name} {a.low:g} to {a.high:g} {a.unit}" for a in robot.actuators)
        raise ConfigError(f"actuation {command.tolist()} is not allowed; allowed: {allowed}")
    return command


def check_metrics(robot: Robot, metrics: Sequence[str], backend: str) -> None:
    """Raise `ConfigError` for a metric that is unknown, or that a backend or a robot does not have."""
    for name in metrics:
        if name not in METRICS:
            raise ConfigError(f"unknown metric '{name}'; allowed: {', '.join(METRICS)}")
        needs = METRICS[name].needs
        if needs != "states" and backend != "fem":
            raise ConfigError(f"metric '{name}' needs backend 'fem', got '{backend}'")
        if needs == "sensors" and not hasattr(robot, "cavities"):
            raise ConfigError(f"metric '{name}' needs a robot with sensing cavities, got '{robot.name}'")


def body_axis(robot: Robot) -> int:
    """Coordinate along which a robot lies at rest."""
    return int(np.argmax(np.abs(robot.effector_rest)))


class Evaluator:
    """Metrics of one design at a time, on FEM or on a surrogate.

    Args:
        robot: the family of bodies.
        metrics: names in `METRICS`.
        backend: ``"fem"`` or ``"surrogate"``.
        actuation: full command: displacements of the actuators, shape (n_a,); default half of their upper limits.
        steps: states beyond rest along the actuation, evenly spaced.
        weights: folder of the surrogate's weights; default the shipped ones.

    Raises:
        ConfigError: for an unknown metric, or one that the backend or the robot does not have; for a malformed command.
    """

    def __init__(
        self,
        robot: Robot,
        metrics: Sequence[str],
        *,
        backend: str = "fem",
        actuation: Sequence[float] | None = None,
        steps: int = 1,
        weights: str | Path | None = None,
    ) -> None:
        check_metrics(robot, metrics, backend)
        self.robot, self.metrics = robot, tuple(metrics)
        self.command = full_command(robot, actuation)
        self.steps = steps
        self.kind = backend
        self._options = {"weights": weights} if backend == "surrogate" else {}

    def course(self, design: Mapping[str, float]) -> Course:
        """Return the states of one design.

        Raises:
            InfeasibleDesign: if the geometry cannot exist.
            ConvergenceError: if an equilibrium is not found.
        """
        # A backend keeps one body; a new one spares the rest state of another.
        backend = make_backend(self.kind, self.robot, design=design, **self._options)
        states = [backend.state]
        states += [backend.step(k / self.steps * self.command) for k in range(1, self.steps + 1)]
        sensor, material = None, None
        if isinstance(backend, FEMBackend):
            material = torch.tensor([backend.model.volume], dtype=torch.float64)
            volumes = [c.rest_volume for c in backend.model.constraints["s"] if isinstance(c, Cavity)]
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
        """Return the metrics of a design [SI]; raises as `course`."""
        course = self.course(design)
        return {name: float(METRICS[name].formula(course)[0]) for name in self.metrics}


def _stack(arrays: list[np.ndarray]) -> Tensor:
    """States (K, 1, ...) of one body."""
    return torch.as_tensor(np.stack(arrays)[:, None], dtype=torch.float64)


def _compliance(state: State) -> np.ndarray:
    W = state.condensed.W
    return np.block([[W.aa, W.ae], [W.ea, W.ee]])


class LearnedBodies:
    """Metrics of a batch of designs on a surrogate, with gradients.

    Actuators are where they are commanded to be: no cable hangs slack. Rest is zero displacement.

    Args:
        robot: the family of bodies.
        metrics: names in `METRICS`.
        actuation: full command: displacements of the actuators, shape (n_a,); default half of their upper limits.
        steps: states beyond rest along the actuation, evenly spaced.
        weights: folder of the surrogate's weights; default the shipped ones.

    Raises:
        ConfigError: as for `Evaluator`, and for weights that are not of a potential network.
    """

    def __init__(
        self,
        robot: Robot,
        metrics: Sequence[str],
        *,
        actuation: Sequence[float] | None = None,
        steps: int = 1,
        weights: str | Path | None = None,
    ) -> None:
        check_metrics(robot, metrics, "surrogate")
        self.robot, self.metrics = robot, tuple(metrics)
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
        return torch.stack([METRICS[name].formula(course) for name in self.metrics], dim=1)


def learned_model(robot: Robot, weights: str | Path | None = None) -> TorchModel:
    """Return a robot's surrogate in torch.

    Raises:
        ConfigError: if its network has no exact gradients.
        WeightsError: if there are no weights.
    """
    model = pretrained_model(robot, weights)
    if not isinstance(model, potential.Model):
        raise ConfigError(f"gradients need weights of a 'potential' network, got '{model.network}'")
    return TorchModel(model)

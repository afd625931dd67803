"""The surrogate backend: a learned condensed model in place of the finite elements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model

__all__ = ["Settled", "SurrogateBackend", "at_rest", "released", "settle"]

#: Largest step left when a search ends [quarter of the actuator range]: 3e-7 m for a cable of 20 mm. Single precision
#: does not carry much farther.
TOLERANCE = 5e-5


@dataclass(frozen=True)
class Settled:
    """Batched states.

    Attributes:
        displacement: reached actuator displacements, shape (B, n_a).
        effort: actuator efforts, shape (B, n_a).
        effector: effector coordinates [m], shape (B, n_e).
        slack: slack actuators, shape (B, n_a).
        converged: whether the state was found, shape (B,); the other rows are not to be used.
        uncertainty: of the effector [m], shape (B,).
        trusted: whether the model knows the state, shape (B,).
    """

    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    slack: np.ndarray
    converged: np.ndarray
    uncertainty: np.ndarray
    trusted: np.ndarray


def released(model: SurrogateModel, context: Context, effort: np.ndarray, start: np.ndarray) -> Settled:
    """Find the states under efforts (B, n_a), by Newton's method from displacements ``start`` (B, n_a)."""
    displacement = start.copy()
    limit = model.span
    for _ in range(50):
        found, effector, spread = model.state(context, displacement)
        step = np.linalg.solve(model.stiffness(context, displacement), (effort - found)[:, :, None])[:, :, 0]
        moving = ~(np.abs(step) <= TOLERANCE * limit).all(axis=1)
        if not moving.any():
            break
        displacement = displacement + np.clip(step, -limit, limit) * moving[:, None]
    return Settled(
        displacement, found, effector, np.zeros(found.shape, bool), ~moving, *model.trust(context, displacement, spread)
    )


def at_rest(model: SurrogateModel, context: Context, unilateral: np.ndarray) -> Settled:
    """Bodies without effort; where loads would drag the actuators along, with actuators held at zero."""
    zero = np.zeros((len(context.slot), model.count))
    if model.card.get("loaded", False):
        return settle(model, context, zero, zero, unilateral)
    return released(model, context, zero, zero)


def settle(
    model: SurrogateModel,
    context: Context,
    target: np.ndarray,
    start: np.ndarray,
    unilateral: np.ndarray,
    slack: np.ndarray | None = None,
    *,
    max_iterations: int = 25,
) -> Settled:
    """Find the states under commanded displacements, with cables that cannot push.

    A taut state is one evaluation of the model. Where a cable would have to push, the displacement it reaches is
    found by Newton's method on the complementarity problem, with the model's own W.

    Args:
        model: the learned condensed model.
        context: prepared bodies.
        target: commanded displacements, shape (B, n_a).
        start: displacements reached before, shape (B, n_a): where the search begins for slack cables.
        unilateral: actuators that cannot push, shape (n_a,).
        slack: actuators slack before, shape (B, n_a).
        max_iterations: bound on the search; it mostly ends after two or three.
    """
    guess = target if slack is None else np.where(slack, np.maximum(start, target), target)
    displacement, effort, converged = model.search(context, target, guess, unilateral, TOLERANCE, max_iterations)
    effector, spread = model.effector(context, displacement)
    loose = unilateral & (displacement > target + (10.0 * TOLERANCE) * model.span)
    if loose.any():
        effort = np.where(loose, 0.0, np.where(unilateral, np.maximum(effort, 0.0), effort))
    return Settled(displacement, effort, effector, loose, converged, *model.trust(context, displacement, spread))


class SurrogateBackend(Backend):
    """States from a learned condensed model.

    Args:
        robot: the family of bodies.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.
        members: how many members of the ensemble to use, fewer for speed; default all.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        members: int | None = None,
    ) -> None:
        if not robot.convex:
            raise ValueError(
                f"robot '{robot.name}' alone has no state that a search finds by its commands; its learned model is a "
                "part of grippers (softgym_envs.control.CoupledFingers), or use backend='fem'"
            )
        self.robot = robot
        self.model = pretrained_model(robot, weights, members)
        self._unilateral = robot.unilateral
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            self._context = self.model.context(complete.array[None])
            self.design = complete
            rest = at_rest(self.model, self._context, self._unilateral)
            if not rest.converged[0]:
                raise ConvergenceError(f"the surrogate finds no rest of design {complete}")
            self._rest = self._state(np.zeros(self.model.count), rest)
        self.state = self._rest
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        if force is not None and np.any(force):
            raise ValueError("the surrogate knows no forces on effectors; use backend='fem'")
        command = np.asarray(command, dtype=float)
        if command.shape != (self.model.count,) or not np.isfinite(command).all():
            raise ValueError(f"command must be {self.model.count} finite numbers, got {command.tolist()}")
        if mode == "displacement":
            settled = settle(
                self.model,
                self._context,
                command[None],
                self.state.displacement[None],
                self._unilateral,
                self.state.slack[None],
            )
            if not settled.converged[0]:
                raise ConvergenceError(f"the surrogate finds no state for commands {command.tolist()}")
        elif mode == "effort":
            if (command[self._unilateral] < 0.0).any():
                raise ValueError(f"efforts {command.tolist()} must not be negative: the actuators cannot push")
            settled = released(self.model, self._context, command[None], self.state.displacement[None])
            if not settled.converged[0]:
                raise ConvergenceError(f"the surrogate finds no displacement for efforts {command.tolist()}")
        else:
            raise ValueError(f"mode = {mode!r} is unknown; allowed: 'displacement', 'effort'")
        self.state = self._state(command, settled)
        return self.state

    def restore(self, state: State) -> None:
        self.state = state

    def _state(self, command: np.ndarray, settled: Settled) -> State:
        return _SurrogateState(
            model=self.model,
            context=self._context,
            command=command.copy(),
            displacement=settled.displacement[0],
            effort=settled.effort[0],
            effector=settled.effector[0].reshape(-1, 3),
            slack=settled.slack[0],
            uncertainty=float(settled.uncertainty[0]),
            trusted=bool(settled.trusted[0]),
        )


class _SurrogateState(State):
    """A state whose condensed model is evaluated when it is asked for: agents that do not look at W do not pay."""

    def __init__(self, model: SurrogateModel, context: Context, **fields: np.ndarray | float) -> None:
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "velocity", np.zeros_like(self.effector))
        object.__setattr__(self, "bonds", np.zeros(0))
        object.__setattr__(self, "_source", (model, context))

    def __reduce__(self) -> tuple[type[State], tuple]:
        # A copy is a plain state: the model is not carried along.
        return State, tuple(getattr(self, field.name) for field in fields(State))

    @cached_property
    def condensed(self) -> CondensedModel:
        model, context = self.__dict__["_source"]
        batch = model.condensed(context, self.displacement[None])
        # Slack cables carry no effort, whatever the network's last digits say.
        effort = batch.effort[0].copy()
        effort[: model.count] = self.effort
        delta = np.concatenate([self.displacement, self.effector.ravel()])
        W = batch.compliance[0]
        return CondensedModel(W, delta - W @ effort, effort, batch.roles, batch.rows)

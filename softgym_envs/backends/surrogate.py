"""The surrogate backend: a learned condensed model in place of the finite elements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from softgym_envs.backends.backend import (
    Backend,
    PointForce,
    Snapshot,
    State,
    check_command,
    check_touch,
    refuse_force,
)
from softgym_envs.backends.batch import BatchBackend, BatchState
from softgym_envs.backends.surrogate_motion import MotionState, SurrogateMotion
from softgym_envs.backends.time_steps import TimeSteps, check_still
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.inertia import read_inertia
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_folder, standalone_model

#: A search ends when its next step is below this [quarter of the actuator range]: 3e-7 m for a cable of 20 mm. Single
#: precision does not allow much less.
TOLERANCE = 5e-5


def solve_efforts(model: SurrogateModel, context: Context, effort: np.ndarray, start: np.ndarray) -> BatchState:
    """Return the states under efforts (B, n_a), by Newton's method from displacements ``start`` (B, n_a)."""
    displacement = start.copy()
    limit = model.span
    for _ in range(50):
        found, effector, spread = model.state(context, displacement)
        step = np.linalg.solve(model.stiffness(context, displacement), (effort - found)[:, :, None])[:, :, 0]
        moving = ~(np.abs(step) <= TOLERANCE * limit).all(axis=1)
        if not moving.any():
            break
        displacement = displacement + np.clip(step, -limit, limit) * moving[:, None]
    return BatchState(
        displacement,
        found,
        effector,
        np.zeros(found.shape, bool),
        ~moving,
        *model.distrust(context, displacement, spread),
    )


def rest_state(model: SurrogateModel, context: Context, unilateral: np.ndarray) -> BatchState:
    """Return the states at rest: without effort, or with actuators held at zero if loads would move them."""
    zero = np.zeros((len(context.slot), model.count))
    if model.card.get("loaded", False):
        return solve_displacements(model, context, zero, zero, unilateral)
    return solve_efforts(model, context, zero, zero)


def solve_displacements(
    model: SurrogateModel,
    context: Context,
    target: np.ndarray,
    start: np.ndarray,
    unilateral: np.ndarray,
    slack: np.ndarray | None = None,
    *,
    max_iterations: int = 25,
) -> BatchState:
    """Return the states under commanded displacements, with cables that cannot push.

    If all cables are taut, one evaluation of the model is enough. Where a cable would have to push, Newton's method on
    the complementarity problem finds the displacement that it reaches, with the model's own W.

    Args:
        model: the learned condensed model.
        context: prepared bodies.
        target: commanded displacements, shape (B, n_a).
        start: displacements reached before, shape (B, n_a); the search for slack cables starts there.
        unilateral: actuators that cannot push, shape (n_a,).
        slack: which actuators were slack before, shape (B, n_a).
        max_iterations: largest number of steps of the search, which usually takes two or three.
    """
    guess = target if slack is None else np.where(slack, np.maximum(start, target), target)
    displacement, effort, converged = model.search(context, target, guess, unilateral, TOLERANCE, max_iterations)
    effector, spread = model.effector(context, displacement)
    loose = unilateral & (displacement > target + (10.0 * TOLERANCE) * model.span)
    if loose.any():
        effort = np.where(loose, 0.0, np.where(unilateral, np.maximum(effort, 0.0), effort))
    judged = model.distrust(context, displacement, spread, target)
    return BatchState(displacement, effort, effector, loose, converged, *judged)


def displacement_gradient(
    model: SurrogateModel,
    context: Context,
    state: BatchState,
    effector: np.ndarray,
    effort: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of a function of the state in its displacements, and in the commands that led to it.

    A command moves its own actuator as long as that is taut, and through the equilibrium the slack ones, whose efforts
    stay zero: with the stiffness ``K`` and sets ``T`` and ``S`` of taut and slack actuators,
    ``d displacement_S = -K_SS^-1 K_ST d command_T``.

    Args:
        model: the learned condensed model.
        context: prepared bodies.
        state: the states, from `solve_displacements`.
        effector: derivative of the function in the effector coordinates, shape (B, n_e).
        effort: derivative in the efforts, shape (B, n_a).

    Returns:
        Two gradients, each (B, n_a): with all displacements held, as if no actuator were slack; and in the commands,
        zero for slack actuators.
    """
    held = model.effector_gradient(context, state.displacement, effector)
    slack = state.slack
    effort = np.where(slack, 0.0, effort)
    needed = np.flatnonzero(slack.any(axis=1) | (effort != 0.0).any(axis=1))
    if not len(needed):
        return held, held
    commanded = held.copy()
    K, free = model.stiffness(context.rows(needed), state.displacement[needed]), slack[needed]
    # The efforts depend on all displacements, those of slack actuators included.
    total = held[needed] + np.matmul(K, effort[needed, :, None])[:, :, 0]
    held = held.copy()
    held[needed] = total
    both = free[:, :, None] & free[:, None, :]
    follow = np.linalg.solve(np.where(both, K, np.eye(model.count)), np.where(free, total, 0.0)[:, :, None])
    through = total - np.matmul(K, follow)[:, :, 0]
    commanded[needed] = np.where(free, 0.0, through)
    return held, commanded


class SurrogateBody:
    """One body on a learned model: its states at rest and under commands.

    Args:
        model: the learned model.
        design: the body.
        motion: what steps it in time; None in statics.
        effectors: coordinates of effectors that states have, the first ones of the model; default all.
        touch: values of the model's load variables; default none act.
    """

    def __init__(
        self,
        model: SurrogateModel,
        design: Design,
        motion: SurrogateMotion | None = None,
        *,
        effectors: int | None = None,
        touch: Mapping[str, float] | None = None,
    ) -> None:
        self.model, self.design, self._motion = model, design, motion
        space = model.robot.design_space
        # Loads beyond those that were learned are judged as outside the box, not refused.
        values = np.array([{**space.baseline, **design, **(touch or {})}[name] for name in space.names])
        self._context, self._unilateral = model.context(values[None]), model.robot.unilateral
        self._effectors = model.effectors if effectors is None else effectors
        self._inertia = np.zeros((1, 0)) if motion is None else motion.inertia.body(design.array[None])

    def rest(self) -> State:
        """Return the state at rest.

        Raises:
            ConvergenceError: if the search does not find it.
        """
        found = rest_state(self.model, self._context, self._unilateral)
        if not found.converged[0]:
            raise ConvergenceError(f"the surrogate finds no equilibrium at rest of design {self.design}")
        return self._state(np.zeros(self.model.count), found)

    def solve(self, command: np.ndarray, mode: str, start: State) -> State:
        """Return the state under a command; the search begins at ``start``.

        Raises:
            ConvergenceError: if the search does not find it.
            ValueError: for a malformed command.
        """
        command = check_command(self.model.robot, command, mode)
        place = start.displacement[None]
        if mode == "displacement":
            found = solve_displacements(
                self.model, self._context, command[None], place, self._unilateral, start.slack[None]
            )
        elif mode == "effort":
            if (command[self._unilateral] < 0.0).any():
                raise ValueError(f"efforts {command.tolist()} must not be negative: the actuators cannot push")
            found = solve_efforts(self.model, self._context, command[None], place)
        else:
            raise ValueError(f"mode = {mode!r} is unknown; allowed: 'displacement', 'effort'")
        if not found.converged[0]:
            raise ConvergenceError(f"the surrogate finds no equilibrium under {mode}s {command.tolist()}")
        return self._state(command, found)

    def advance(self, command: np.ndarray, mode: str, start: State) -> State:
        """Return the state a control step after ``start``, in motion.

        Raises:
            ConvergenceError: if a time step is not solved.
            ValueError: for a malformed command, or for commanded efforts.
        """
        assert self._motion is not None
        command = check_command(self.model.robot, command, mode)
        if mode != "displacement":
            raise ValueError(f"mode = {mode!r} is not available in motion on the surrogate; allowed: 'displacement'")
        moved, found = self._motion.advance(
            self._context, self._inertia, start.memory, start.command[None], command[None]
        )
        if not found[0]:
            raise ConvergenceError(f"the surrogate cannot move to displacements {command.tolist()}")
        state = self._state(command, self._motion.batch_state(self._context, moved, command[None], found))
        return replace(
            state,
            condensed=partial(_condensed_in_motion, self._motion, moved),
            velocity=self._motion.effector_velocity(moved).reshape(-1, 3),
            memory=moved,
        )

    def _state(self, command: np.ndarray, found: BatchState) -> State:
        displacement, effort, effector = found.displacement[0], found.effort[0], found.effector[0]
        motion = self._motion
        return State(
            command=command.copy(),
            displacement=displacement,
            effort=effort,
            effector=effector[: self._effectors].reshape(-1, 3),
            slack=found.slack[0],
            # W is evaluated on demand, because many agents never read it.
            condensed=partial(_condensed, self.model, self._context, displacement, effort, effector, self._effectors),
            velocity=np.zeros((self._effectors // 3, 3)),
            memory=None if motion is None else motion.at_rest(self._context, found.displacement, found.effort),
            uncertainty=float(found.uncertainty[0]),
            distrust=int(found.distrust[0]),
        )


def _condensed(
    model: SurrogateModel,
    context: Context,
    displacement: np.ndarray,
    effort: np.ndarray,
    effector: np.ndarray,
    effectors: int,
) -> CondensedModel:
    """Condensed model of a state: W of the network, and the state itself, in which slack cables have no effort.

    Of the coordinates of the effectors, it has the first ``effectors``.
    """
    W = model.compliance(context, displacement[None])[0]
    delta = np.concatenate([displacement, effector, model.sensed(context, displacement[None])[0]])
    n = model.count
    kept = np.delete(np.arange(len(delta)), np.arange(n + effectors, n + model.effectors))
    W, delta = W[np.ix_(kept, kept)], delta[kept]
    full = np.concatenate([effort, np.zeros(len(delta) - n)])
    roles = tuple((role, effectors if role == "e" else size) for role, size in model.roles)
    return CondensedModel(W, delta - W @ full, full, roles, tuple(model.rows[k] for k in kept))


def _condensed_in_motion(motion: SurrogateMotion, state: MotionState) -> CondensedModel:
    """Condensed model of the last time step of one body."""
    many = motion.condensed(state)
    return CondensedModel(many.compliance[0], many.free[0], many.effort[0], many.roles, many.rows)


def _motion_of(
    model: SurrogateModel, weights: str | Path | None, dynamics: bool, steps: TimeSteps
) -> SurrogateMotion | None:
    """Return what steps bodies of a model in time; None without dynamics.

    Raises:
        WeightsError: if there is no inertia beside the weights.
    """
    if not isinstance(dynamics, bool):
        raise ValueError(f"dynamics = {dynamics!r} is unknown; allowed: True, False")
    if not dynamics:
        check_still(steps)
        return None
    folder = pretrained_folder(model.robot) if weights is None else Path(weights)
    return SurrogateMotion(model, read_inertia(folder, model.robot), steps)


class SurrogateBackend(Backend):
    """States from a learned condensed model: static equilibria, or motion in time with a learned inertia.

    Args:
        robot: the robot.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.
        members: how many members of the ensemble to use, fewer for speed; default all.
        dynamics: step in time, starting from the static equilibrium; for the robots whose weights have an inertia.
        control_step: duration of one `step` [s].
        time_step: largest physical time step [s]; commands are ramped over those of a control step.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].

    Attributes:
        model: the learned model.
        steps: time steps of a control step, and damping.

    Raises:
        WeightsError: if there are no weights for the robot, they are damaged, or its actuators have a largest effort.
        ValueError: for a robot whose energy is not convex.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        members: int | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
    ) -> None:
        if not robot.learning.convex:
            raise ValueError(
                f"robot '{robot.name}' has a non-convex energy and cannot run on the surrogate alone; use "
                "backend='fem', or its learned model as part of a gripper"
            )
        self.robot = robot
        touch = robot.learning.touch
        learned = robot if touch is None else touch.variant()
        self.takes_touch = touch is not None
        self.model = standalone_model(learned, weights, members)
        self._touch: PointForce | None = None
        self.steps = TimeSteps(control_step, time_step, mass_damping, stiffness_damping)
        self._motion = _motion_of(self.model, weights, dynamics, self.steps)
        self.moving = dynamics
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> type[BatchBackend]:
        return SurrogateBatch

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            body = SurrogateBody(self.model, complete, self._motion, effectors=3 * len(self.robot.effectors))
            self._rest = body.rest()
            self._untouched, self.design = body, complete
        self._touch, self._body = None, self._untouched
        self.state = self._rest
        return self.state

    def touch(self, load: PointForce | None) -> None:
        if load is self._touch:
            return
        load = check_touch(self.robot, self._rest, load)
        if load is None:
            self._body = self._untouched
        else:
            learned = self.robot.learning.touch
            if learned is None:
                raise ValueError(f"no touch of robot '{self.robot.name}' is learned; use backend='fem'")
            touch = learned.design(self.design, load.point, load.force)
            effectors = 3 * len(self.robot.effectors)
            self._body = SurrogateBody(self.model, self.design, self._motion, effectors=effectors, touch=touch)
        self._touch = load

    def _extra_state(self) -> PointForce | None:
        return self._touch

    def _resume(self, snapshot: Snapshot) -> None:
        self.reset(snapshot.design)
        self.touch(snapshot.extra)
        self.restore(snapshot.state)

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        if self.moving:
            self.state = self._body.advance(command, mode, self.state)
        else:
            self.state = self._body.solve(command, mode, self.state)
        return self.state

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the static equilibrium under a command without going there."""
        return self._body.solve(command, mode, self.state)

    def restore(self, state: State) -> None:
        self.state = state


class SurrogateBatch(BatchBackend):
    """States of many bodies from a learned condensed model, evaluated together.

    Args:
        robot: the robot.
        designs: bodies, shape (B, number of design variables).
        weights: as for `SurrogateBackend`.
        members: as for `SurrogateBackend`.
        dynamics: as for `SurrogateBackend`.
        **steps: attributes of `TimeSteps`.

    Attributes:
        model: the learned model.

    Raises:
        WeightsError: if there are no weights for the robot, they are damaged, or its actuators have a largest effort.
    """

    def __init__(
        self,
        robot: Robot,
        designs: np.ndarray,
        weights: str | Path | None = None,
        members: int | None = None,
        *,
        dynamics: bool = False,
        **steps: float,
    ) -> None:
        self.robot = robot
        self.model = standalone_model(robot, weights, members)
        self._motion = _motion_of(self.model, weights, dynamics, TimeSteps(**steps))
        self.moving = dynamics
        self._unilateral = robot.unilateral
        count = len(designs)
        # One body for all rows, until they differ.
        self._context = Context.shared(self.model.context(designs[:1]), count)
        self.command = np.zeros((count, len(robot.actuators)))
        rest = self._rest_states(self._context.rows(np.zeros(1, dtype=np.int64)), designs[:1])
        self._rest, self.state = rest.repeat(count), rest.repeat(count)
        if self._motion is not None:
            self._inertia = self._motion.inertia.body(designs)
            self._moving = self._motion.at_rest(self._context, self._rest.displacement, self._rest.effort)
            self._settled = rest.repeat(count)
        other = np.flatnonzero((designs != designs[:1]).any(axis=1))
        if len(other):
            self.begin(other, designs[other])

    def _rest_states(self, context: Context, designs: np.ndarray) -> BatchState:
        rest = rest_state(self.model, context, self._unilateral)
        if not rest.converged.all():
            lost = designs[np.flatnonzero(~rest.converged)[0]].tolist()
            design = dict(zip(self.robot.design_space.names, lost, strict=True))
            raise ConvergenceError(f"the surrogate finds no equilibrium at rest of design {design}")
        return rest

    def begin(self, index: np.ndarray, designs: np.ndarray) -> Mapping[int, InfeasibleDesign]:
        context = self.model.context(designs)
        rest = self._rest_states(context, designs)
        self._context.put(index, context)
        self._rest.put(index, rest)
        if self._motion is not None:
            self._inertia[index] = self._motion.inertia.body(designs)
        self.rest(index)
        return {}

    def rest(self, index: np.ndarray) -> None:
        self.command[index] = 0.0
        rest = self._rest.rows(index)
        self.state.put(index, rest)
        self.state.slack[index] = False
        if self._motion is not None:
            still = self._motion.at_rest(self._context.rows(index), rest.displacement, rest.effort)
            self._moving.put(index, still)
            self._settled.put(index, rest)

    def step(self, command: np.ndarray) -> None:
        present = self.state
        if self._motion is None:
            state = solve_displacements(
                self.model, self._context, command, present.displacement, self._unilateral, present.slack
            )
        else:
            moved, solved = self._motion.advance(self._context, self._inertia, self._moving, self.command, command)
            self._moving = moved.where(solved, self._moving)
            state = self._motion.batch_state(self._context, self._moving, command, solved)
        found = state.converged.copy()
        if found.all():
            self.command, self.state = command, replace(state, converged=found)
        else:
            self.command = np.where(found[:, None], command, self.command)
            self.state = replace(state.where(found, present), converged=found)

    def effectors(self, index: np.ndarray, commands: np.ndarray) -> np.ndarray:
        context = self._context.rows(index)
        found = solve_displacements(self.model, context, commands, np.zeros_like(commands), self._unilateral)
        return np.where(found.converged[:, None], found.effector[:, :3], np.nan)

    @property
    def velocity(self) -> np.ndarray | None:
        return None if self._motion is None else self._motion.effector_velocity(self._moving)[:, :3]

    @property
    def stable(self) -> np.ndarray:
        return np.ones(len(self.command), dtype=bool)

    @property
    def condensed(self) -> CondensedModel:
        if self._motion is not None:
            return self._motion.condensed(self._moving)
        batch = self.model.condensed(self._context, self.state.displacement)
        effort, delta = batch.effort.copy(), batch.delta.array
        # Slack cables carry no effort; the network's may differ from zero by rounding.
        effort[:, : self.model.count] = self.state.effort
        free = delta - np.einsum("bij,bj->bi", batch.compliance, effort)
        return CondensedModel(batch.compliance, free, effort, batch.roles, batch.rows)

    def settled(self) -> BatchState:
        if self._motion is None:
            return self.state
        # The search for slack cables starts where they were last.
        last = self._settled
        found = solve_displacements(
            self.model, self._context, self.command, last.displacement, self._unilateral, last.slack
        )
        self._settled = replace(found.where(found.converged, last), converged=found.converged)
        return self._settled

    def gradient(self, effector: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = self.state if self._motion is None else self._settled
        return displacement_gradient(self.model, self._context, state, effector, effort)

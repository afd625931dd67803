"""The surrogate backend: a learned condensed model in place of the finite elements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.backends.backend import (
    COMMANDED,
    Backend,
    PointForce,
    Snapshot,
    State,
    check_command,
    check_touch,
    drive_sizes,
    refuse_force,
)
from softgym_envs.backends.batch import BatchBackend, BatchState
from softgym_envs.backends.time_steps import TimeSteps, check_still
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.registry import Table
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_folder, standalone_model

#: A search ends when its next step is below this [quarter of the actuator range]: 3e-7 m for a cable of 20 mm. Single
#: precision does not allow much less.
TOLERANCE = 5e-5

_ONLY = np.zeros(1, dtype=np.int64)


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


def effort_gradient(
    model: SurrogateModel, context: Context, state: BatchState, effector: np.ndarray, effort: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `displacement_gradient` does where efforts are commanded, whose displacements follow all of them."""
    held = model.effector_gradient(context, state.displacement, effector)
    K = model.stiffness(context, state.displacement)
    held = held + np.matmul(K, effort[:, :, None])[:, :, 0]
    return held, np.linalg.solve(K, held[:, :, None])[:, :, 0]


def rest_state(model: SurrogateModel, context: Context, unilateral: np.ndarray, by_effort: bool = False) -> BatchState:
    """Return the states at rest: without effort, or with actuators held at zero if loads would move them."""
    zero = np.zeros((len(context.slot), model.count))
    if model.card.get("loaded", False) and not by_effort:
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


def _condensed(model: SurrogateModel, context: Context, state: BatchState) -> CondensedModel:
    """Return the condensed models of states; of the coordinates of the effectors, they have those of the states."""
    found = model.condensed(context, state.displacement)
    W, effort, delta = found.compliance, found.effort.copy(), found.delta.array
    # Slack cables carry no effort; the network's may differ from zero by rounding.
    effort[:, : model.count] = state.effort
    free, roles, rows = delta - np.einsum("bij,bj->bi", W, effort), found.roles, found.rows
    if (effectors := state.effector.shape[1]) != model.effectors:
        kept = np.delete(np.arange(len(rows)), np.arange(model.count + effectors, model.count + model.effectors))
        W, free, effort, rows = W[:, kept[:, None], kept], free[:, kept], effort[:, kept], tuple(rows[k] for k in kept)
        roles = tuple((role, effectors if role == "e" else size) for role, size in roles)
    return CondensedModel(W, free, effort, roles, rows)


def _only(condensed: Callable[..., CondensedModel], *of: object) -> CondensedModel:
    """Return the condensed model of a batch of one."""
    many = condensed(*of)
    return replace(many, compliance=many.compliance[0], free=many.free[0], effort=many.effort[0])


MOTIONS = Table("motion of surrogates", {}, group="softgym_envs.motions")
"""Classes that step bodies of learned models in time, made of the model, the folder of its weights and `TimeSteps`."""


def _motion_of(model: SurrogateModel, weights: str | Path | None, dynamics: bool, steps: TimeSteps) -> Any:
    """Return what steps bodies of a model in time; None without dynamics.

    Raises:
        WeightsError: if there is no inertia beside the weights.
    """
    if not isinstance(dynamics, bool):
        raise ValueError(f"dynamics = {dynamics!r} is unknown; allowed: True, False")
    if not dynamics:
        check_still(steps)
        return None
    return MOTIONS["inertia"](model, pretrained_folder(model.robot) if weights is None else Path(weights), steps)


def _all_by_effort(robot: Robot, dynamics: bool) -> bool:
    """Return whether a robot commands efforts, in place of displacements.

    Raises:
        ValueError: for a robot that commands both, or efforts in motion.
    """
    if not (by_effort := robot.by_effort).any():
        return False
    if dynamics:
        robot.needs_displacements("a surrogate in motion")
    if not by_effort.all():
        held = next(each.name for each in robot.actuators if not each.by_effort)
        raise ValueError(
            f"a surrogate takes actuators that are all commanded in effort or all in displacement, but robot "
            f"'{robot.name}' commands the displacement of '{held}': use backend='fem'"
        )
    return True


class SurrogateBatch(BatchBackend):
    """States of many bodies from a learned condensed model, evaluated together.

    Args:
        robot: the robot.
        designs: bodies, shape (B, number of design variables).
        weights: folder of weights, or a model; default the shipped ones.
        members: how many members of the ensemble to use, fewer for speed; default all.
        dynamics: step in time, starting from the static equilibrium; for the robots whose weights have an inertia.
        **steps: attributes of `TimeSteps`.

    Attributes:
        model: the learned model. If a touch is learned, it is that of `LearnedTouch.variant`.
        steps: time steps of a control step, and damping.

    Raises:
        WeightsError: if there are no weights for the robot, they are damaged, or its actuators have a largest effort.
        ValueError: for a robot whose energy is not convex.
    """

    def __init__(
        self,
        robot: Robot,
        designs: np.ndarray,
        weights: SurrogateModel | str | Path | None = None,
        members: int | None = None,
        *,
        dynamics: bool = False,
        **steps: float,
    ) -> None:
        self.robot, self._touch = robot, robot.learning.touch
        self._by_effort = _all_by_effort(robot, dynamics)
        self.takes_touch = self._touch is not None
        self.steps = TimeSteps(**steps)
        if isinstance(weights, SurrogateModel):
            self.model, self._motion = weights, None
        elif not robot.learning.convex:
            raise ValueError(
                f"robot '{robot.name}' has a non-convex energy and cannot run on the surrogate alone; use "
                "backend='fem', or its learned model as part of a gripper"
            )
        else:
            self.model = standalone_model(robot if self._touch is None else self._touch.variant(), weights, members)
            self._motion = _motion_of(self.model, weights, dynamics, self.steps)
        self.moving = dynamics
        self._unilateral, self._effectors = robot.unilateral, 3 * len(robot.effectors)
        count = len(designs)
        self._designs, self._touched = designs.copy(), np.zeros(count, dtype=bool)
        self.command = np.zeros((count, len(robot.actuators)))
        # One body for all rows, until they differ.
        one = self.model.context(self._values(designs[:1]))
        rest = self._rest_states(one, designs[:1])
        self._context = Context.shared(one, count)
        self._rest, self.state = rest.repeat(count), rest.repeat(count)
        if self._motion is not None:
            self._inertia = self._motion.body(designs)
            self._moving = self._motion.at_rest(self._context, self._rest.displacement, self._rest.effort)
            self._settled = rest.repeat(count)
        other = np.flatnonzero((designs != designs[:1]).any(axis=1))
        if len(other):
            self.begin(other, designs[other])

    @property
    def rest_sizes(self) -> np.ndarray | None:
        """Those of bodies of beams, which are built in milliseconds; None for others, whose meshes take seconds."""
        if not self.robot.made_of_beams:
            return None
        different, where = np.unique(self._designs, axis=0, return_inverse=True)
        sizes = []
        for values in different:
            design = dict(zip(self.robot.design_space.names, values.tolist(), strict=True))
            sizes.append(drive_sizes(self.robot.build(design)))
        return np.array(sizes)[where.ravel()]

    def _values(self, designs: np.ndarray, touch: Mapping[str, float] | None = None) -> np.ndarray:
        """Return designs of the model, whose variables also say what touches a body; by default nothing does."""
        if self._touch is None:
            return designs
        # Loads beyond those that were learned are judged as outside the box, not refused.
        space, names = self.model.robot.design_space, self.robot.design_space.names
        loads = {**space.baseline, **(touch or {})}
        return np.array([[{**loads, **dict(zip(names, row, strict=True))}[k] for k in space.names] for row in designs])

    def _rest_states(self, context: Context, designs: np.ndarray) -> BatchState:
        rest = rest_state(self.model, context, self._unilateral, self._by_effort)
        if not rest.converged.all():
            lost = designs[np.flatnonzero(~rest.converged)[0]].tolist()
            design = dict(zip(self.robot.design_space.names, lost, strict=True))
            raise ConvergenceError(f"the surrogate finds no equilibrium at rest of design {design}")
        return self._own(rest)

    def _own(self, state: BatchState) -> BatchState:
        """Return states with the effectors of the robot only; the model may have more."""
        if self._effectors == self.model.effectors:
            return state
        return replace(state, effector=state.effector[:, : self._effectors])

    def _put(self, index: np.ndarray, context: Context) -> None:
        """Give rows other contexts. That of a single body is replaced: its earlier states still read theirs."""
        if len(index) == len(self.command) == 1:
            self._context = context
        else:
            self._context.put(index, context)

    def begin(self, index: np.ndarray, designs: np.ndarray) -> Mapping[int, InfeasibleDesign]:
        context = self.model.context(self._values(designs))
        rest = self._rest_states(context, designs)
        self._put(index, context)
        self._touched[index], self._designs[index] = False, designs
        self._rest = self._rest.replaced(index, rest)
        if self._motion is not None:
            self._inertia[index] = self._motion.body(designs)
        self.rest(index)
        return {}

    def rest(self, index: np.ndarray) -> None:
        self._touch_rows([(i, None) for i in index[self._touched[index]].tolist()])
        rest = self._rest.rows(index)
        self.command = self.command.copy()
        self.command[index] = 0.0
        self.state = self.state.replaced(index, rest)
        if self._motion is not None:
            still = self._motion.at_rest(self._context.rows(index), rest.displacement, rest.effort)
            self._moving = self._moving.replaced(index, still)
            self._settled = self._settled.replaced(index, rest)

    def touch(self, loads: Sequence[PointForce | None]) -> None:
        changes = []
        for i, load in enumerate(loads):
            if load is not None or self._touched[i]:
                still = np.array([i])
                rest = self.row(np.zeros_like(self.command[i]), self._rest.rows(still), self._context.rows(still))
                changes.append((i, check_touch(self.robot, rest, load)))
        self._touch_rows(changes)

    def _touch_rows(self, loads: Sequence[tuple[int, PointForce | None]]) -> None:
        for i, load in loads:
            design, touch = self._designs[i], None
            if load is not None:
                if self._touch is None:
                    raise ValueError(f"no touch of robot '{self.robot.name}' is learned; use backend='fem'")
                named = dict(zip(self.robot.design_space.names, design.tolist(), strict=True))
                touch = self._touch.design(named, load.point, load.force)
            self._put(np.array([i]), self.model.context(self._values(design[None], touch)))
            self._touched[i] = load is not None

    def equilibria(self, command: np.ndarray, mode: str = COMMANDED) -> BatchState:
        """Return the equilibria under commands (B, n_a), displacements or efforts; the search begins at the present."""
        present = self.state
        if mode == "effort" or (mode == COMMANDED and self._by_effort):
            return self._own(solve_efforts(self.model, self._context, command, present.displacement))
        return self._own(
            solve_displacements(
                self.model, self._context, command, present.displacement, self._unilateral, present.slack
            )
        )

    def step(self, command: np.ndarray, mode: str = COMMANDED) -> None:
        present = self.state
        if self._motion is None:
            state = self.equilibria(command, mode)
        else:
            moved, solved = self._motion.advance(self._context, self._inertia, self._moving, self.command, command)
            self._moving = moved.where(solved, self._moving)
            state = self._own(self._motion.batch_state(self._context, self._moving, command, solved))
        found = state.converged
        if found[0] if len(found) == 1 else found.all():
            self.command, self.state = command, state
        else:
            self.command = np.where(found[:, None], command, self.command)
            self.state = replace(state.where(found, present), converged=found)

    def effectors(self, index: np.ndarray, commands: np.ndarray) -> np.ndarray:
        context, zero = self._context.rows(index), np.zeros_like(commands)
        if self._by_effort:
            found = solve_efforts(self.model, context, commands, zero)
        else:
            found = solve_displacements(self.model, context, commands, zero, self._unilateral)
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
        return _condensed(self.model, self._context, self.state)

    def settled(self) -> BatchState:
        if self._motion is None:
            return self.state
        # The search for slack cables starts where they were last.
        last = self._settled
        found = solve_displacements(
            self.model, self._context, self.command, last.displacement, self._unilateral, last.slack
        )
        self._settled = replace(self._own(found).where(found.converged, last), converged=found.converged)
        return self._settled

    def gradient(self, effector: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = self.state if self._motion is None else self._settled
        unused = self.model.effectors - self._effectors
        gradient = effort_gradient if self._by_effort else displacement_gradient
        return gradient(self.model, self._context, state, np.pad(effector, ((0, 0), (0, unused))), effort)

    # -- a batch of one -----------------------------------------------------------------------------------------------

    def row(self, command: np.ndarray, state: BatchState, context: Context | None = None) -> State:
        """Return an equilibrium of one body under a command (n_a,); by default the body is that of a batch of one."""
        context, motion = context or self._context, self._motion
        return State(
            command=command,
            displacement=state.displacement[0],
            effort=state.effort[0],
            effector=state.effector[0].reshape(-1, 3),
            slack=state.slack[0],
            # W is evaluated on demand, because many agents never read it.
            condensed=partial(_only, _condensed, self.model, context, state),
            velocity=np.zeros((self._effectors // 3, 3)),
            memory=None if motion is None else motion.at_rest(context, state.displacement, state.effort),
            uncertainty=float(state.uncertainty[0]),
            distrust=int(state.distrust[0]),
        )

    def present(self, command: np.ndarray) -> State:
        """Return the present state of a batch of one that moves, which a command (n_a,) has led to."""
        assert self._motion is not None
        return replace(
            self.row(command, self.state),
            condensed=partial(_only, self._motion.condensed, self._moving),
            velocity=self._motion.effector_velocity(self._moving)[:, : self._effectors].reshape(-1, 3),
            memory=self._moving,
        )

    def restore(self, state: State) -> None:
        """Put a batch of one into a state of its body."""
        self.command = state.command[None]
        self.state = BatchState(
            state.displacement[None], state.effort[None], state.effector.reshape(1, -1), state.slack[None],
            np.ones(1, dtype=bool), np.array([state.uncertainty]), np.array([state.distrust]),
        )  # fmt: skip
        if self._motion is not None:
            self._moving = state.memory


class SurrogateBackend(Backend):
    """One body on a learned condensed model, in static equilibria or in motion in time: a `SurrogateBatch` of one.

    Models are learned over displacements; those under commanded efforts are found by Newton's method on the model.

    Args:
        robot: the robot.
        design: first design; missing variables take their baseline.
        weights: folder of weights, or a model; default the shipped ones.
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
        weights: SurrogateModel | str | Path | None = None,
        members: int | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
    ) -> None:
        self.robot, self.design = robot, robot.design_space.complete(design)
        self._by_effort = bool(robot.by_effort.any())
        self._batch = SurrogateBatch(
            robot, self.design.array[None], weights, members, dynamics=dynamics, control_step=control_step,
            time_step=time_step, mass_damping=mass_damping, stiffness_damping=stiffness_damping,
        )  # fmt: skip
        self.model, self.steps, self.moving = self._batch.model, self._batch.steps, dynamics
        self.takes_touch = self._batch.takes_touch
        self._touch: PointForce | None = None
        self.state = self._rest = self._batch.row(np.zeros(len(robot.actuators)), self._batch.state)

    commands_efforts = True

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> type[BatchBackend]:
        return SurrogateBatch

    @property
    def rest_sizes(self) -> np.ndarray | None:
        sizes = self._batch.rest_sizes
        return None if sizes is None else sizes[0]

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            self._batch.begin(_ONLY, complete.array[None])
            self.design = complete
            self._rest = self._batch.row(np.zeros(len(self.robot.actuators)), self._batch.state)
        else:
            self._batch.rest(_ONLY)
        self._touch, self.state = None, self._rest
        return self.state

    def touch(self, load: PointForce | None) -> None:
        if load is not self._touch:
            self._batch.touch([load])
            self._touch = load

    def _extra_state(self) -> PointForce | None:
        return self._touch

    def _resume(self, snapshot: Snapshot) -> None:
        self.reset(snapshot.design)
        self.touch(snapshot.extra)
        self.restore(snapshot.state)

    def step(self, command: np.ndarray, mode: str = COMMANDED, *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        command, mode = self._checked(command, mode)
        if self.moving and mode != "displacement":
            raise ValueError(f"mode = {mode!r} is not available in motion on the surrogate; allowed: 'displacement'")
        batch = self._batch
        batch.step(command[None], mode)
        if not batch.state.converged[0]:
            self.restore(self.state)
            raise ConvergenceError(f"the surrogate finds no equilibrium under {mode}s {command.tolist()}")
        self.state = batch.present(command) if self.moving else batch.row(command, batch.state)
        return self.state

    def probe(self, command: np.ndarray, mode: str = COMMANDED) -> State:
        """Return the static equilibrium under a command without going there."""
        command, mode = self._checked(command, mode)
        found = self._batch.equilibria(command[None], mode)
        if not found.converged[0]:
            raise ConvergenceError(f"the surrogate finds no equilibrium under {mode}s {command.tolist()}")
        return self._batch.row(command, found)

    def _checked(self, command: np.ndarray, mode: str) -> tuple[np.ndarray, str]:
        """Return a command (n_a,) and what it commands, ``"displacement"`` or ``"effort"``."""
        command = check_command(self.robot, command, mode)
        if mode == COMMANDED:
            mode = "effort" if self._by_effort else "displacement"
        if mode == "effort" and (command[self.robot.unilateral] < 0.0).any():
            raise ValueError(f"efforts {command.tolist()} must not be negative: the actuators cannot push")
        return command.copy(), mode

    def restore(self, state: State) -> None:
        self.state = state
        self._batch.restore(state)

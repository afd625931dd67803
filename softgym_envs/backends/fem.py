"""The finite-element backend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.backends.backend import (
    COMMANDED,
    Backend,
    Ground,
    PointForce,
    Snapshot,
    State,
    check_command,
    check_force,
    check_touch,
    command_modes,
    drive_sizes,
)
from softgym_envs.backends.time_steps import TimeSteps, check_still
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import ContactModel
from softgym_envs.mechanics.constraints.cable import Cable
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import SATURATED, Equilibrium
from softgym_envs.mechanics.solvers.exact_compliance import exact_at
from softgym_envs.mechanics.solvers.learned_errors import possible_errors
from softgym_envs.mechanics.solvers.schemes import SCHEMES
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.quantities import check_quantity
from softgym_envs.robots.base import TOUCH_RADIUS, Robot
from softgym_envs.surrogate.domain import FOLDED, LOADED, SOFT, SPREAD
from softgym_envs.wording import brief, counted

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import Contact, ContactMemory
    from softgym_envs.mechanics.solvers.compiled import CompiledSolver
    from softgym_envs.mechanics.solvers.dynamics import Dynamics, Motion


SHIFT = 1e-3
"""Motion by which it is found out whether something holds a body, in its sizes or as an angle [rad]."""


def _drifts(model: MechanicalModel) -> bool:
    """Whether nothing holds a body: shifted or turned, it stores no energy, and neither actuators nor bonds notice."""
    from scipy.spatial.transform import Rotation

    places = np.ones((len(model.nodes), 1))
    places[(model.frames.rows[:, None] + np.arange(1, 4)).ravel()] = 0.0  # directors turn but do not shift
    places[model.frames.carried[model.frames.moves != 1.0]] = 0.0
    held = [constraint for group in "ab" for constraint in model.constraints[group]]
    size = float(np.ptp(model.nodes, axis=0).max()) or 1.0
    shifted = [model.nodes + SHIFT * size * axis * places for axis in np.eye(3)]
    turned = [model.nodes @ Rotation.from_rotvec(SHIFT * axis).as_matrix().T for axis in np.eye(3)]
    return not any(
        abs(model.elastic_energy(x) - model.elastic_energy(model.nodes)) > 1e-12
        or any(np.abs(each.value(x) - each.value(model.nodes)).max() > 1e-6 * size for each in held)
        for x in (*shifted, *turned)
    )


def _relax_dynamically(
    model: MechanicalModel, statics: Statics, command: np.ndarray, modes: Sequence[str]
) -> Equilibrium:
    """Find an equilibrium that Newton's method misses, by a slow, heavily damped motion towards it."""
    from softgym_envs.mechanics.solvers.dynamics import Dynamics

    motion_solver = Dynamics(model, step=0.02, stiffness_damping=0.02, tolerance=1e-8)
    for _ in range(200):
        motion = motion_solver.advance(command, modes)
        if np.abs(motion.velocity).max() * model.kinematics.dof_scale.max() < 1e-3:
            break
    statics.restore(motion_solver.x, motion_solver.effort)
    return statics.solve(command, modes)


class FEMBackend(Backend):
    """States from finite elements: static equilibria with exact ``W``, or motion in time.

    An actuator that is commanded in displacement and would exceed its ``max_effort`` is driven by that effort instead,
    until its command asks for less.

    Args:
        robot: the robot.
        design: first design; missing variables take their baseline.
        dynamics: step in time, starting from the static equilibrium.
        control_step: duration of one `step` [s].
        time_step: largest physical time step [s]; commands are ramped over those of a control step.
        scheme: time integration, see `Dynamics`.
        mass_damping: Rayleigh's alpha [1/s].
        stiffness_damping: Rayleigh's beta [s].
        cable_friction: coefficient of friction of cables on their guides; in statics only.
        cable_compliance: how far cables stretch per tension [m/N], one number or one for each actuator; in statics
            without contact only.

    Attributes:
        model: the present body.
        steps: time steps of a control step, and damping.
        step_options: options of `Dynamics`.
        largest_efforts: of the actuators, shape (n_a,).
    """

    model: MechanicalModel
    takes_force = True
    takes_touch = True
    commands_efforts = True

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        *,
        dynamics: bool = False,
        control_step: float = 0.05,
        time_step: float = 0.01,
        scheme: str = "euler",
        mass_damping: float = 0.0,
        stiffness_damping: float = 0.01,
        cable_friction: float = 0.0,
        cable_compliance: float | Sequence[float] = 0.0,
    ) -> None:
        if not isinstance(dynamics, bool):
            raise ValueError(f"dynamics = {dynamics!r} is unknown; allowed: True, False")
        if scheme not in SCHEMES:
            raise ValueError(f"scheme = {scheme!r} is unknown; allowed: {', '.join(SCHEMES)}")
        self.robot = robot
        self.moving = dynamics
        self.steps = TimeSteps(control_step, time_step, mass_damping, stiffness_damping)
        if not dynamics:
            check_still(self.steps, scheme=(scheme, "euler"))
        self.step_options: dict[str, Any] = {
            "step": self.steps.step,
            "scheme": scheme,
            "mass_damping": mass_damping,
            "stiffness_damping": stiffness_damping,
            "tolerance": 1e-9,
        }
        self.largest_efforts = np.array([actuator.max_effort for actuator in robot.actuators])
        self._friction = self._checked_friction(cable_friction)
        self._compliance = self._checked_compliance(cable_compliance)
        self._ground, self._carries = Ground(), False
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> str | None:
        if not robot.made_of_beams:
            return None
        from softgym_envs.mechanics.solvers.compiled import SOLVERS

        found = (solver.batch_class(robot, options) for solver in SOLVERS.values())
        return next((path for path in found if path is not None), None)

    @property
    def rest(self) -> State:
        """State of the present body at rest."""
        return self._rest

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            model = self._build(complete)
            self._set_friction(model)
            own, loads = (model.contact, model.gravity.tolist()), model.nodal_loads.copy()
            self._stand(self._ground, model, own)
            self._settle(model)
            self.design, self._own, self._own_loads = complete, own, loads
        self.touch(None)
        self.restore(self._rest)
        self._modes = self.robot.command_modes  # those of the current state's command
        return self.state

    def _settle(self, model: MechanicalModel) -> None:
        """Find the state at rest of a model, and take over the model and its solvers."""
        statics, zero = self._solver(model), np.zeros(len(self.robot.actuators))
        if model.floating and model.contact is None and _drifts(model):
            rest = self._afloat(model, zero)
        else:
            try:
                rest = statics.solve(zero, self.robot.command_modes)
            except ConvergenceError:
                rest = _relax_dynamically(model, statics, zero, self.robot.command_modes)
        self._dynamics = self._mover(model) if self.moving else None
        self.model, self._statics = model, statics
        self._rest = self._state(rest, zero, still=True)

    def stand_on(self, ground: Ground) -> State:
        if not self.robot.may_touch and (ground.friction, ground.gravity) != (None, None):
            raise ValueError(f"robot '{self.robot.name}' touches nothing, so it has no ground")
        if ground != self._ground:
            self.touch(None)
            try:
                self._stand(ground, self.model, self._own)
                self._settle(self.model)
            except BaseException:
                self._stand(self._ground, self.model, self._own)
                raise
            self._ground = ground
        return self.reset()

    def _stand(self, ground: Ground, model: MechanicalModel, own: tuple[Contact | None, Sequence[float]]) -> None:
        """Change payload, gravity and friction of a model, whose own contact and gravity are given."""
        contact, gravity = own
        if ground.payload is not None or self._carries:
            from softgym_envs.mechanics.elements.rigid import carry

            carry(model, ground.payload)
            self._carries = True
        model.set_gravity(gravity if ground.gravity is None else ground.gravity)
        model.contact = contact
        if contact is not None and ground.friction is not None:
            model.contact = contact.with_friction(ground.friction)

    def _mover(self, model: MechanicalModel) -> Dynamics:
        from softgym_envs.mechanics.solvers.dynamics import Dynamics

        return Dynamics(model, **self.step_options)

    def _build(self, design: Design) -> MechanicalModel:
        return self.robot.build(design)

    def _afloat(self, model: MechanicalModel, command: np.ndarray) -> Equilibrium:
        """Return the undeformed shape of a body that nothing holds, with the condensed model of a time step from it."""
        if not self.moving:
            raise ValueError(f"nothing holds robot '{self.robot.name}', so it has no equilibrium; pass dynamics=True")
        moved = self._mover(model).advance(command, self.robot.command_modes).equilibrium
        values = np.concatenate([constraint.value(model.nodes) for constraint, _ in model.rows])
        return replace(moved, x=model.nodes.copy(), delta=values, effort=np.zeros_like(moved.effort))

    def touch(self, load: PointForce | None) -> None:
        load = check_touch(self.robot, self._rest, load)
        loads = self._own_loads.copy()
        if load is not None:
            at = self.model.embed(load.point, radius=TOUCH_RADIUS)
            np.add.at(loads, at.node_ids[0], at.weights[0][:, None] * load.force)
        self.model.nodal_loads[:] = loads
        self._touch = load

    @property
    def cable_friction(self) -> float:
        """Coefficient of friction of cables on their guides; a new one applies from the state at rest."""
        return self._friction

    @cable_friction.setter
    def cable_friction(self, friction: float) -> None:
        friction, kept = self._checked_friction(friction), self._friction
        if friction == kept:
            return
        try:
            self._friction = friction
            self._set_friction(self.model)
            self._statics = self._solver(self.model)
        except ValueError:
            self._friction = kept
            self._set_friction(self.model)
            raise
        self._rest = replace(self._rest, memory=self._statics.memory)
        self.restore(self._rest)

    @property
    def rest_sizes(self) -> np.ndarray:
        return drive_sizes(self.model)

    @property
    def cable_compliance(self) -> np.ndarray:
        """How far each cable stretches per tension [m/N], shape (n_a,); another one applies from the next step."""
        return self._compliance

    @cable_compliance.setter
    def cable_compliance(self, compliance: float | Sequence[float] | np.ndarray) -> None:
        compliance = self._checked_compliance(compliance)
        if np.array_equal(compliance, self._compliance):
            return
        self._compliance = compliance
        self._stretch(self._statics)

    def _checked_compliance(self, compliance: float | Sequence[float] | np.ndarray) -> np.ndarray:
        try:
            values = np.broadcast_to(np.asarray(compliance, dtype=float), (len(self.robot.actuators),)).copy()
        except ValueError:
            raise ValueError(
                f"cable_compliance = {brief(compliance)} must be one number or one for each of "
                f"{counted(len(self.robot.actuators), 'actuator')} [m/N]"
            ) from None
        if not (np.isfinite(values) & (values >= 0.0)).all():
            raise ValueError(f"cable_compliance = {compliance!r} must be finite and not negative")
        check_quantity("compliance", values, "cable_compliance")
        if values.any() and (self.moving or self.robot.touches):
            raise ValueError("cable_compliance is computed in statics without contact only; allowed here: 0")
        return values

    def _stretch(self, statics: Statics) -> None:
        """Set how far cables stretch: what is part of the robot, and what only the plant has and no model knows."""
        for row, (constraint, value) in enumerate(zip(statics.model.constraints["a"], self._compliance, strict=True)):
            if value and not isinstance(constraint, Cable):
                raise ValueError(f"cable_compliance: actuator '{constraint.name}' of '{self.robot.name}' is no cable")
            statics.compliance[row] = constraint.compliance + value

    def _solver(self, model: MechanicalModel) -> Statics:
        """Return the static solver of a body."""
        statics = Statics(model)
        if self._compliance.any():
            self._stretch(statics)
        linear, learned = statics.linearisation, any(block.learned for block in model.blocks)
        # In contact, only W needs the last factorisation of a step: it is made when W is read.
        statics.exact_compliance = linear.contact is None or linear.has_friction or learned
        return statics

    def _checked_friction(self, friction: float) -> float:
        if not (np.isfinite(friction) and friction >= 0.0):
            raise ValueError(f"cable_friction = {friction} must be finite and not negative")
        check_quantity("friction", friction, "cable_friction")
        if friction and self.moving:
            raise ValueError(f"cable_friction = {friction} is computed in statics only; allowed in dynamics: 0")
        return float(friction)

    def _set_friction(self, model: MechanicalModel) -> None:
        """Set the friction of the model's cables."""
        cables = [constraint for constraint in model.constraints["a"] if isinstance(constraint, Cable)]
        if self._friction and not cables:
            raise ValueError(f"cable_friction = {self._friction}: robot '{self.robot.name}' has no cables")
        for cable in cables:
            cable.friction = self._friction

    def step(self, command: np.ndarray, mode: str = COMMANDED, *, force: np.ndarray | None = None) -> State:
        command, modes = check_command(self.robot, command, mode), command_modes(self.robot, mode)
        load = None
        if force is not None:
            load = np.zeros(self.state.effector.size)
            load[:3] = check_force(self.robot, self._rest, force)
        kept = self._motion
        try:
            if self._dynamics is None:
                found = self._drive(self._statics, command, modes, load)
                self.state = self._state(found, command)
            else:
                self.state = self._advance(command, modes, load)
            self._modes = modes
        except BaseException:
            # Keep the current state, whatever stopped the step.
            self._go_back(kept)
            raise
        return self.state

    def probe(self, command: np.ndarray, mode: str = COMMANDED) -> State:
        """Return the static equilibrium under a command, found from the present shape, without going there."""
        kept = self._motion
        command, modes = check_command(self.robot, command, mode), command_modes(self.robot, mode)
        try:
            if self._dynamics is not None:
                self.restore(self.state)  # statics are where they were left before the last steps of the motion
            return self._state(self._drive(self._statics, command, modes, None), command, still=True)
        finally:
            self._go_back(kept)

    def contact_model(self, *, friction: bool = False) -> ContactModel:
        if self.moving:
            raise ValueError("contact_model() is that of an equilibrium; make the backend with dynamics=False")
        return self._statics.contact_model(friction=friction)

    def restore(self, state: State) -> None:
        """Go back to a state; in dynamics with its velocities, but with time, work and the scheme's history reset.

        Raises:
            ValueError: for a state of another backend, which has no deformed nodes.
        """
        if not isinstance(state, State) or state.nodes is None:
            raise ValueError("the state has no deformed nodes; finite elements can only restore their own states")
        effort = state.row_effort
        self._statics.restore(state.nodes, effort, memory=state.memory)
        if self._dynamics is not None:
            velocity = None if state.motion is None else state.motion.velocity
            self._dynamics.restore(state.nodes, effort, velocity, memory=state.memory)
        self.state = state

    @property
    def tolerance(self) -> float:
        """Largest remaining correction of any node of a solution [m]."""
        return (self._dynamics or self._statics).tolerance

    @property
    def cuts(self) -> int:
        """How often a time step that cannot be solved is halved; 0 in statics."""
        return 0 if self._dynamics is None else self._dynamics.max_cuts

    @property
    def dynamics(self) -> Dynamics | None:
        """Time stepping of the present body, for those who know what they change; None in statics."""
        return self._dynamics

    @property
    def compiled(self) -> CompiledSolver | None:
        """Compiled solver of the present body; None for a body that needs the general one."""
        return (self._dynamics or self._statics).compiled_solver()

    @property
    def not_compiled(self) -> str | None:
        """Why the general solver computes the present body; None for a body of beams that compiled code can solve."""
        return (self._dynamics or self._statics).not_compiled

    def go_to(
        self,
        x: np.ndarray,
        effort: np.ndarray,
        delta: np.ndarray,
        velocity: np.ndarray,
        command: np.ndarray,
        memory: ContactMemory | None = None,
    ) -> None:
        """Go on from a state that another solver has found for the present body under commands.

        Args:
            x: nodes [m], shape (n, 3).
            effort: of all constraint rows, shape (size,).
            delta: their values, shape (size,).
            velocity: of the nodes [m/s], shape (n, 3).
            command: commands that led there, shape (n_a,).
            memory: what friction remembers there; None for a body that touches nothing.
        """
        count, e = len(command), self.state.condensed.slices["e"]
        self._statics.restore(x, effort, memory=memory)
        if self._dynamics is not None:
            self._dynamics.restore(x, effort, velocity, memory=memory)
        self._modes = self.robot.command_modes
        self.state = replace(
            self._rest,
            command=command.copy(),
            displacement=delta[:count].copy(),
            effort=effort[:count].copy(),
            row_effort=effort.copy(),
            effector=delta[e].reshape(-1, 3).copy(),
            nodes=x.copy(),
            memory=memory,
        )

    def _extra_state(self) -> tuple[tuple[str, ...], tuple | None, PointForce | None, Ground]:
        return self._modes, self._motion, self._touch, self._ground

    def _resume(self, snapshot: Snapshot) -> None:
        self._modes, motion, touch, ground = snapshot.extra
        if ground != self._ground:
            self.stand_on(ground)
        self.reset(snapshot.design)
        self.state = snapshot.state
        self._modes = snapshot.extra[0]  # a reset has changed it
        self.touch(touch)
        self._go_back(motion)

    @property
    def _motion(self) -> tuple | None:
        """The part of a motion that a state does not hold."""
        return None if self._dynamics is None else self._dynamics.snapshot

    def _go_back(self, motion: tuple | None) -> None:
        """Undo everything since the current state."""
        self.restore(self.state)
        if self._dynamics is not None and motion is not None:
            self._dynamics.snapshot = motion

    def _advance(self, command: np.ndarray, modes: Sequence[str], load: np.ndarray | None) -> State:
        assert self._dynamics is not None
        # Ramps start at the last command, which a saturated actuator has not reached.
        by_effort = np.array([mode == "effort" for mode in modes], dtype=bool)
        start = self.state.command if self._modes == modes else self.state.displacement
        parts = self.steps.ramp(np.where(by_effort, self.state.effort, start), command)
        aims = np.where(by_effort, np.clip(parts, -self.largest_efforts, self.largest_efforts), parts)
        done, motion = self._dynamics.advance_compiled(
            aims, modes, largest_effort=self.largest_efforts, effector_force=load
        )
        for part in parts[done:]:
            motion = self._drive(self._dynamics, part, modes, load)
        assert motion is not None
        return self._state(motion.equilibrium, command, motion)

    def _drive(self, solver: Statics, command: np.ndarray, kinds: Sequence[str], load: np.ndarray | None) -> Any:
        """Solve once, with actuators saturated at their largest effort."""
        moving = self._dynamics if solver is self._dynamics else None
        solve: Any = solver.solve if moving is None else moving.advance
        limit, count = self.largest_efforts, len(command)
        held = np.array([kind == "displacement" for kind in kinds], dtype=bool)
        command = np.where(held, command, np.clip(command, -limit, limit))
        if not np.isfinite(limit[held]).any():
            return solve(command, kinds, effector_force=load)
        start, present = solver.snapshot, solver.effort[:count]
        saturated, sign = held & (np.abs(present) >= limit * SATURATED), np.sign(present)
        for attempt in range(2 * count + 2):
            target = np.where(saturated, sign * limit, command)
            modes = ["effort" if s else kind for s, kind in zip(saturated, kinds, strict=True)]
            found = solve(target, modes, effector_force=load)
            equilibrium = found if moving is None else found.equilibrium
            effort, reached = equilibrium.effort[:count], equilibrium.delta[:count]
            over = held & ~saturated & (np.abs(effort) > limit)
            # A saturated actuator is released when its command asks for less than it has reached; none after a while,
            # so that the loop terminates.
            back = saturated & (sign * (command - reached) < 0.0) & (attempt <= count)
            if not (over.any() or back.any()):
                break
            sign = np.where(over, np.sign(effort), sign)
            saturated = (saturated | over) & ~back
            solver.snapshot = start
        return found

    def _uncertainty(self, equilibrium: Equilibrium, command: np.ndarray) -> float:
        """Return how far learned energies may put the first effector off at an equilibrium under a command [m]."""
        effort = equilibrium.effort[equilibrium.condensed.slices["a"]]
        held = ~equilibrium.slack & ~self.robot.by_effort & (np.abs(effort) < self.largest_efforts * SATURATED)
        return float(np.linalg.norm(possible_errors(self._statics, held)[:3]))

    def _state(
        self, equilibrium: Equilibrium, command: np.ndarray, motion: Motion | None = None, *, still: bool = False
    ) -> State:
        condensed, slices, statics = equilibrium.condensed, equilibrium.condensed.slices, self._statics
        exact = equilibrium.conditions is None
        effector = equilibrium.delta[slices["e"]].reshape(-1, 3)
        velocity = np.zeros_like(effector)
        if motion is not None and not still:
            assert self._dynamics is not None
            velocity = self._dynamics.effector_velocity().reshape(-1, 3)
        distrust = 0 if all(block.knows(equilibrium.x) for block in self.model.blocks) else LOADED
        if any(block.is_folded(equilibrium.x) for block in self.model.blocks):
            distrust |= FOLDED
        uncertainty = 0.0
        learned = any(block.learned for block in self.model.blocks)
        if learned and not equilibrium.stable:
            distrust |= SOFT
        if motion is None and learned:
            uncertainty = self._uncertainty(equilibrium, command)
            distrust |= SPREAD if uncertainty > self.robot.goal_tolerance else 0
        return State(
            command=np.array(command, dtype=float),
            displacement=equilibrium.delta[slices["a"]],
            effort=equilibrium.effort[slices["a"]],
            effector=effector,
            slack=equilibrium.slack,
            condensed=condensed if exact else (lambda: exact_at(statics, equilibrium).condensed),
            nodes=equilibrium.x,
            velocity=velocity,
            motion=motion,
            row_effort=equilibrium.effort,
            stable=equilibrium.stable,
            uncertainty=uncertainty,
            distrust=distrust,
            contacts=equilibrium.contacts,
            memory=equilibrium.memory,
        )

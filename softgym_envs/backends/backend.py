"""The interface between physics and everything above it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.arguments import choice
from softgym_envs.designs import Design
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.quantities import check_quantity
from softgym_envs.robots.base import Robot
from softgym_envs.robots.checks import plausible_force
from softgym_envs.wording import brief

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.contact import Contacts
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.mechanics.solvers.dynamics import Motion

#: A displacement this many times as large as the bounds of its actuator is taken for a mistake in its unit.
FAR_BEYOND = 10.0

#: An effort of this many times the typical one of its actuator is taken for a mistake in its unit.
STRONG = 100.0

#: Mode of `Backend.step`: every actuator in the quantity that its robot commands.
COMMANDED = "commanded"

#: A force that would move the effector by this many sizes of its robot is taken for a mistake in its unit.
FAR_MOVED = 10.0


class _Evaluated:
    """Field of `State` that also takes a function, which is called when the field is first read."""

    def __get__(self, state: State | None, owner: type[State]) -> CondensedModel:
        if state is None:
            raise AttributeError("condensed")  # tells `dataclass` that the field has no default
        value = state.__dict__["condensed"]
        if not isinstance(value, CondensedModel):
            value = state.__dict__["condensed"] = value()
        return value

    def __set__(self, state: State, value: CondensedModel | Callable[[], CondensedModel]) -> None:
        state.__dict__["condensed"] = value


@dataclass(frozen=True)
class State:
    """A robot at an equilibrium, or at an instant of its motion.

    Attributes:
        command: commanded displacements or efforts, shape (n_a,).
        displacement: reached actuator displacements [m, ...], shape (n_a,); larger than commanded for slack cables.
        effort: actuator efforts [N, ...], shape (n_a,).
        effector: effector positions [m], shape (k, 3).
        slack: which actuators are slack, shape (n_a,).
        condensed: condensed model at the state; learned models, and FEM in contact, evaluate it when it is first read.
        row_effort: efforts of all rows of the body's model, bonds last, shape (size,); empty on the surrogate.
        velocity: effector velocities [m/s], shape (k, 3); zero without dynamics.
        motion: time, velocities and energies of the body; None without dynamics, and on the surrogate.
        stable: the equilibrium is stable whether displacements or efforts are commanded (always True on the
            surrogate); on FEM in contact it may be that of the last iterate. In dynamics: the tangent of the time step,
            including inertia, is positive definite.
        uncertainty: bound on 95 % of the effector errors of a learned model [m]; 0 for FEM without
            learned superelements.
        distrust: why the model is not trusted at the state, 0 if it is: a sum of numbers in
            `softgym_envs.surrogate.domain.DISTRUST_REASONS`. FEM is trusted unless a beam folds or a
            superelement is loaded beyond what it has learned.
        nodes: deformed nodes [m], shape (n, 3); None on the surrogate.
        contacts: where the body touches, with forces and gaps; None if it cannot touch anything.
        memory: what else the backend needs to continue from the state: the past of friction, or the motion of a
            learned model; None where the other attributes are enough.
    """

    command: np.ndarray
    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    slack: np.ndarray
    condensed: _Evaluated = _Evaluated()
    nodes: np.ndarray | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    motion: Motion | None = None
    row_effort: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stable: bool = True
    uncertainty: float = 0.0
    distrust: int = 0
    contacts: Contacts | None = None
    memory: Any = None

    @property
    def trusted(self) -> bool:
        """Whether the model may be trusted at the state."""
        return self.distrust == 0

    def __getstate__(self) -> dict[str, Any]:
        # A copy holds the condensed model itself, not the model that evaluates it.
        return {**self.__dict__, "condensed": self.condensed}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


@dataclass(frozen=True)
class PointForce:
    """A force at a point of a body, whose direction stays fixed in space.

    Attributes:
        point: of the undeformed body [m], shape (3,).
        force: [N], shape (3,).

    Raises:
        ValueError: unless both are three finite numbers.
    """

    point: np.ndarray
    force: np.ndarray

    def __post_init__(self) -> None:
        for name in ("point", "force"):
            object.__setattr__(self, name, check_numbers(f"{name} of a touch", getattr(self, name), 3))


@dataclass(frozen=True)
class Ground:
    """Where a body stands and what it carries, if not as its robot says: what an episode can draw without another body.

    On a slope that rises by an angle ``a`` along x, gravity is ``9.81 (-sin a, 0, -cos a)``: the axes are those of the
    slope, and obstacles keep their places.

    Attributes:
        friction: coefficient of friction of all obstacles; None: their own.
        gravity: acceleration [m/s2], shape (3,); None: that of the robot.
        payload: mass that the rigid part of the first effector carries [kg]; None: that of the robot.

    Raises:
        ValueError: for a negative coefficient or mass, or values that are not finite or in another unit.
    """

    friction: float | None = None
    gravity: Sequence[float] | None = None
    payload: float | None = None

    def __post_init__(self) -> None:
        if self.friction is not None:
            friction = float(check_numbers("friction of the ground", [self.friction], 1)[0])
            if friction < 0.0:
                raise ValueError(f"friction of the ground = {friction} must not be negative")
            check_quantity("friction", friction, "friction of the ground")
            object.__setattr__(self, "friction", friction)
        if self.gravity is not None:
            gravity = check_numbers("gravity", self.gravity, 3)
            check_quantity("gravity", np.linalg.norm(gravity), "length of gravity")
            object.__setattr__(self, "gravity", tuple(gravity.tolist()))
        if self.payload is not None:
            payload = float(check_numbers("payload", [self.payload], 1)[0])
            if payload < 0.0:
                raise ValueError(f"payload = {payload} kg must not be negative")
            check_quantity("mass", payload, "payload")
            object.__setattr__(self, "payload", payload)


@dataclass(frozen=True)
class Snapshot:
    """What another backend of the same class needs to continue from a state.

    Attributes:
        backend: name of the class.
        design: the body.
        state: the present state.
        extra: whatever else the next steps depend on.
    """

    backend: str
    design: Design
    state: State
    extra: Any = None


def check_numbers(name: str, values: object, count: int) -> np.ndarray:
    """Return values as an array (count,).

    Raises:
        ValueError: unless they are ``count`` finite numbers.
    """
    wanted = f"{name} must be {count} finite number{'s' * (count > 1)}"
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{wanted}, got {values!r}") from None
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"{wanted}, got {array.tolist()}")
    return array


def command_modes(robot: Robot, mode: str) -> tuple[str, ...]:
    """Return what a command drives of each actuator, ``"displacement"`` or ``"effort"``, see `Backend.step`.

    Raises:
        ValueError: for an unknown mode.
    """
    choice("mode", mode, ("displacement", "effort", COMMANDED))
    return robot.command_modes if mode == COMMANDED else (mode,) * len(robot.actuators)


def check_command(robot: Robot, command: object, mode: str) -> np.ndarray:
    """Return a command as an array (n_a,); for the mode see `Backend.step`.

    Raises:
        ValueError: for an unknown mode, or unless it is one finite number for each actuator; also for a displacement
            so far beyond the range of its actuator, or an effort so far beyond what is typical of it, that its unit is
            probably wrong.
    """
    modes = command_modes(robot, mode)
    array = check_numbers("command", command, len(robot.actuators))
    values, scales = array.tolist(), robot.effort_scale.tolist()
    for actuator, kind, value, typical in zip(robot.actuators, modes, values, scales, strict=True):
        if kind == "effort":
            if abs(value) > STRONG * typical:
                check_quantity(
                    "pressure" if actuator.unit == "m3" else "force",
                    value,
                    f"effort of actuator '{actuator.name}'",
                    high=STRONG * typical,
                    example=f"{STRONG:g} times effort_scale of robot '{robot.name}'",
                )
        elif abs(value) > FAR_BEYOND * max(abs(actuator.low), abs(actuator.high)):
            raise ValueError(
                f"command = {value:g} {actuator.unit} of actuator '{actuator.name}' is far beyond its range of "
                f"{actuator.low:g} to {actuator.high:g} {actuator.unit}; check its unit"
            )
    return array


def check_force(robot: Robot, rest: State, force: object, name: str = "force") -> np.ndarray:
    """Return a force on a body as an array (3,).

    Args:
        robot: the robot.
        rest: of the body; its compliance says what force is plausible.
        force: [N].
        name: of the force, for messages.

    Raises:
        ValueError: unless it is three finite numbers; also for a force so large that its unit is probably wrong.
    """
    array = check_numbers(name, force, 3)
    largest = float(np.abs(array).max())
    if not largest:
        return array
    high, why = plausible_force(robot), "ten times what its actuators can do"
    if rest.contacts is None:  # what contact holds at rest may be free
        condensed = rest.condensed
        a, e, W = condensed.slices["a"], condensed.slices["e"], condensed.compliance
        held = W[e, e] - W[e, a] @ np.linalg.lstsq(W[a, a], W[a, e], rcond=None)[0]
        compliance = float(np.linalg.norm(held[:3, :3], 2))
        if compliance * high > FAR_MOVED * robot.size:
            high, why = FAR_MOVED * robot.size / compliance, f"which moves its effector by {FAR_MOVED:g} sizes"
    check_quantity("force", array, name, high=high, example=f"for robot '{robot.name}', {why}")
    return array


def check_touch(robot: Robot, rest: State, load: object) -> PointForce | None:
    """Return what touches a body at rest, after checking it as `check_force` does.

    Raises:
        ValueError: unless it is a `PointForce` or None, and the force is plausible.
    """
    if load is None:
        return None
    if not isinstance(load, PointForce):
        raise ValueError(f"touch = {brief(load)} must be a PointForce(point=..., force=...) or None")
    check_force(robot, rest, load.force, "force of a touch")
    return load


def drive_sizes(model: MechanicalModel) -> np.ndarray:
    """Return `Constraint.rest_size` of each actuator of a model, shape (n_a,): NaN for servos."""
    return np.array([drive.rest_size() for drive in model.constraints["a"] for _ in range(drive.size)])


def refuse_force(force: np.ndarray | None) -> None:
    """Raise ValueError for a force on the effector, which only finite elements take."""
    if force is not None and np.any(force):
        raise ValueError(f"force = {np.asarray(force).tolist()} N is taken by backend='fem' only; allowed: None")


class Backend(ABC):
    """Physics of one robot: ``reset(design)`` and ``step(command)`` return a `State`.

    Attributes:
        robot: the robot, a family of bodies.
        design: the current design.
        state: the current state.
        moving: states have velocities.
        takes_force: `step` takes a force on the effector.
        takes_touch: `touch` takes a force on a point of the body.
        commands_efforts: `step` takes actuators that their robot commands in effort.
        cable_friction: coefficient of friction of cables on their guides, 0 where they are not computed.
        cable_compliance: how far cables stretch per tension [m/N], 0 where that is not computed.
    """

    moving: bool = False
    takes_force: bool = False
    takes_touch: bool = False
    commands_efforts: bool = False
    cable_friction: float = 0.0
    cable_compliance: Any = 0.0
    robot: Robot
    design: Design
    state: State

    @property
    def rest_sizes(self) -> np.ndarray | None:
        """Return `Constraint.rest_size` of each actuator, shape (n_a,); None where no mechanical model is at hand."""
        return None

    @classmethod
    def batch_class(cls, robot: Robot, options: Mapping[str, object]) -> type | str | None:
        """Return what steps many bodies of a robot in one call, as this backend with these options; None for nothing.

        It is a `BatchBackend`, or the path of one, and takes the robot, designs (B, number of design variables) and
        the same options.
        """
        return None

    @abstractmethod
    def reset(self, design: Mapping[str, float] | None = None) -> State:
        """Go to the rest equilibrium of a design (default: the current one). An unchanged design is not rebuilt.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if its geometry cannot exist.
        """

    @abstractmethod
    def step(self, command: np.ndarray, mode: str = COMMANDED, *, force: np.ndarray | None = None) -> State:
        """Go from the current equilibrium to that under a command, shape (n_a,).

        Args:
            command: actuator displacements, or efforts.
            mode: ``"displacement"``, ``"effort"``, or ``"commanded"``: the quantity in which the robot commands each
                actuator. Efforts of actuators that cannot push must not be negative.
            force: force on the first effector [N], shape (3,), or None.

        Raises:
            ConvergenceError: if no equilibrium is found; the current state is kept.
            ValueError: for a malformed command.
        """

    def probe(self, command: np.ndarray, mode: str = COMMANDED) -> State:
        """Return the state under a command without going there."""
        kept = self.state
        try:
            # A backend that takes one quantity alone has that as its default.
            return self.step(command) if mode == COMMANDED else self.step(command, mode)
        finally:
            self.restore(kept)

    def touch(self, load: PointForce | None) -> None:
        """Touch the body at a point from the next `step` on, or no longer; `reset` ends a touch.

        Raises:
            ValueError: for a point outside the body, a force that is probably in another unit, or if the backend takes
                no forces.
        """
        if load is not None:
            raise ValueError(f"{type(self).__name__} takes no forces")

    def stand_on(self, ground: Ground) -> State:
        """Go to the rest equilibrium on another ground, which stays that of all bodies until the next call.

        Raises:
            ConvergenceError: if the body does not stand there; ground and state are kept.
            ValueError: if the backend computes no contacts, or for what the robot cannot stand on or carry.
        """
        raise ValueError(f"{type(self).__name__} has no ground")

    def contact_model(self, *, friction: bool = False) -> CondensedModel:
        """Return the condensed model at the current state, with openings of contacts as further rows ``c``.

        The openings and the normal forces on them are complementary, see `Statics.contact_model`.

        Args:
            friction: with slips and friction forces as rows ``t``; otherwise friction forces stay as they are.

        Raises:
            ConvergenceError: if the body has no equilibrium without its contacts.
            ValueError: if the body cannot touch anything, or the backend does not compute its contacts.
        """
        raise ValueError(f"{type(self).__name__} does not compute contacts")

    @abstractmethod
    def restore(self, state: State) -> None:
        """Go back to a state of the current design."""

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Free what the backend holds outside of this program, such as a robot; nothing by default."""

    def snapshot(self) -> Snapshot:
        """Return all that the next steps depend on."""
        return Snapshot(type(self).__name__, self.design, self.state, self._extra_state())

    def resume(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot, also of another backend of the same class and with the same robot.

        Raises:
            ValueError: for a snapshot of another class.
        """
        if snapshot.backend != type(self).__name__:
            raise ValueError(f"a state of {snapshot.backend} cannot continue in {type(self).__name__}")
        self._resume(snapshot)

    def _extra_state(self) -> Any:
        """Return what the next steps depend on besides body and state."""
        return None

    def _resume(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of the same class."""
        self.reset(snapshot.design)
        self.restore(snapshot.state)

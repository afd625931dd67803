"""The Robot base class: a family of bodies spanned by a design space."""

from __future__ import annotations

import copy
import functools
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from softgym_envs.designs import DesignSpace
from softgym_envs.errors import InfeasibleDesign, SoftGymError
from softgym_envs.robots.actuator import Actuator as Actuator
from softgym_envs.robots.capabilities import Learning, Sensing, View
from softgym_envs.robots.checks import (
    CONTACT_DEFAULTS,
    WatchedDesign,
    check_built,
    check_defined,
    check_robot,
    warn_unknown,
    warn_unread,
)
from softgym_envs.robots.mesh_tiers import FOLLOWING, UNIFORM
from softgym_envs.wording import brief

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.obstacles import Obstacle
    from softgym_envs.mechanics.model import MechanicalModel

F = TypeVar("F", bound=Callable[..., None])

Drawing = tuple[Callable[..., None], dict]
"""A module-level function that draws one volume with gmsh in millimetres, and its parameters (JSON-serialisable)."""

DEFAULTS_NOT_IN_KEY: dict[str, object] = CONTACT_DEFAULTS | UNIFORM | {"sealed": False, "touch": False}
"""Values of options that are not part of a robot's key."""

BASES = (__name__, "softgym_envs.robots.gmsh_robot")
"""Modules of base classes, whose constructors set none of the attributes that a robot defines."""

TOUCH_RADIUS = 2.5e-3
"""Radius of the part of a body on which a touch acts [m]. At a single point, the compliance depends on the mesh."""


def _recording_options(init: F) -> F:
    """Return a robot's constructor that also records its arguments as options, and checks the finished robot."""
    signature = inspect.signature(init)
    extra = next((p.name for p in signature.parameters.values() if p.kind is p.VAR_KEYWORD), None)

    @functools.wraps(init)
    def wrapper(self: Robot, *args: object, **kwargs: object) -> None:
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        options = dict(list(bound.arguments.items())[1:])
        options |= options.pop(extra, {}) if extra else {}
        outermost = "_options" not in vars(self)
        recorded = vars(self).setdefault("_options", {})
        # This wrapper runs before those of the base classes: an option keeps the value given to the class itself.
        for name, value in options.items():
            recorded.setdefault(name, value)
        init(self, *args, **kwargs)
        if outermost:
            check_robot(self)
            warn_unknown(self, Robot)

    return wrapper  # type: ignore[return-value]


class Robot(ABC):
    """A family of bodies; one file per robot.

    A subclass defines the attributes without a default below, as class attributes or in its ``__init__``, and the
    method `assemble`. All arguments of its ``__init__`` are options; they become part of `mechanics_key`. A constructor
    that takes ``**options`` and passes them on gives its robot the options of this class.

    Args:
        gravity: acceleration [m/s2].
        obstacles: what the robot's surface touches: obstacles, or their records
            ``{"kind": "plane", "point": [0, 0, 0], "normal": [0, 0, 1], "friction": 0.5}``. Points within a triangle
            of a clamped node touch nothing.
        self_contact: whether surfaces of the robot touch each other.
        self_friction: coefficient of friction between them.
        contact_distance: gap below which there are forces [m]. It must be smaller than the thinnest wall.
        contact_stiffness: of the barrier [Pa]; default a tenth of the largest Young's modulus of the body.
        design_box: bounds of the design variables: ``"published"``, those of ``design_space`` as the class defines it,
            or a name in ``design_boxes``.

    Attributes:
        name: registry name, also used to look up weights and meshes.
        design_space: variables of the body with bounds and baseline.
        design_boxes: other boxes of designs by name, each with the bounds of the variables that it changes.
        actuators: in the order of the commands.
        effectors: names, in the order of the effector rows of the condensed model.
        size: a characteristic length [m], for scaling.
        effector_rest: nominal effector of the baseline body at rest [m], before loads, shape (3,).
        effort_scale: typical effort of each actuator of the baseline body [N, ...], shape (n_a,).
        antagonists: groups of actuators, by name, that pull against each other, such as the tendons around a rod: what
            some pull, the others let out. Commands of fits, goals and random agents are balanced in each group.
        goal_axes: which coordinates of the first effector count towards a goal, 1 or 0, shape (3,).
        goal_tolerance: distance at which a goal counts as reached [m].
        workspace_scale: distance over which the effector typically moves [m], by default a quarter of the size; scales
            rewards and errors.
        learning: what surrogates know of the robot before they learn it.
        sensing: sensors inside the body; none by default.
        view: from where pictures show it.
        made_of_beams: bodies are quadratic beams and rigid parts, moved by servos or chambers; finite elements step
            many of them at once.
        backends: backends of its own, ``"module:class"``, by the name that they replace or add.
        parts: the parts that `learning` names, where `assemble` shall use them: functions of a design and of gravity
            that return the options of the element; see `of_parts`.
        reproduces_scene: whether the mesh is that of a published scene, whose elements may lock; others warn once.
        non_mechanical_options: options that do not change the condensed model.
    """

    name: str
    design_space: DesignSpace
    actuators: tuple[Actuator, ...]
    effectors: tuple[str, ...]
    size: float
    effector_rest: np.ndarray
    effort_scale: np.ndarray
    antagonists: tuple[tuple[str, ...], ...] = ()
    goal_axes: np.ndarray = np.ones(3)
    goal_tolerance: float = 0.002
    workspace_scale: float
    learning: Learning = Learning()
    sensing: Sensing = Sensing()
    view: View = View()
    made_of_beams: bool = False
    backends: Mapping[str, str] = {}
    parts: Mapping[str, Callable[[Mapping[str, float], np.ndarray], dict[str, Any]]] = {}
    design_boxes: Mapping[str, Mapping[str, tuple[float, float]]] = {}
    non_mechanical_options: tuple[str, ...] = ("unilateral", "design_box")
    reproduces_scene: bool = False
    _has_built = False
    _options: dict[str, object]

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            cls.__init__ = _recording_options(cls.__init__)  # type: ignore[method-assign]
        # Attributes that a constructor may set are checked after it; those of classes without one are checked now.
        own = (base for base in cls.__mro__[:-1] if not base.__module__.startswith(BASES))
        own_constructor = any("__init__" in vars(base) for base in own)
        abstract = any(getattr(getattr(cls, name, None), "__isabstractmethod__", False) for name in dir(cls))
        if not (own_constructor or abstract or cls.__module__ in BASES):
            check_defined(cls, cls)

    @_recording_options
    def __init__(
        self,
        *,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        obstacles: Sequence[Any] = (),
        self_contact: bool = False,
        self_friction: float = 0.0,
        contact_distance: float = 5e-4,
        contact_stiffness: float | None = None,
        design_box: str = "published",
    ) -> None:
        if len(gravity) != 3 or not np.isfinite(gravity).all():
            raise ValueError(f"gravity must be three finite numbers [m/s2], got {gravity!r}")
        self.gravity = gravity
        self.obstacles = self._checked_obstacles(obstacles)
        self.self_contact = self_contact
        self.self_friction = self_friction
        self.contact_distance = contact_distance
        self.contact_stiffness = contact_stiffness
        self.design_box = design_box

    # -- what a robot defines ---------------------------------------------------------------------------------------

    @abstractmethod
    def assemble(self, design: Mapping[str, float]) -> MechanicalModel:
        """Return the model of a complete design: bodies, boundary conditions, actuators, effectors, contacts.

        Raises:
            InfeasibleDesign: if the geometry cannot exist. All other exceptions count as errors in the robot's code.
        """

    def own_obstacles(self, model: MechanicalModel, design: Mapping[str, float]) -> Sequence[Obstacle]:
        """Return the rigid objects that are part of an assembled robot, as obstacles that the rest of it touches."""
        return ()

    def drawing(self, design: Mapping[str, float]) -> Drawing:
        """Return the function that draws the exact shape of a complete design, and its parameters.

        Raises:
            InfeasibleDesign: if the shape cannot exist.
            ValueError: if no single gmsh drawing describes the body.
        """
        raise ValueError(f"robot '{self.name}' has no exact shape for STEP; write its triangles as .stl")

    def reference_path(self, count: int = 30) -> np.ndarray:
        """Return the published trajectory of the first effector [m], shape (count, 3), on which tracking is compared.

        Raises:
            ValueError: if the robot has none.
        """
        raise ValueError(
            f"robot '{self.name}' has no reference path: define reference_path, or pass task_options={{'path': points}}"
        )

    def displacements(self, fractions: np.ndarray) -> np.ndarray:
        """Return the commands, shape (N, n_a), at which states are sampled, for points of the unit cube (N, n_a).

        Robots whose actuators never move independently override this to sample only commands that occur.
        """
        return self.balanced(self.lower + fractions * (self.upper - self.lower))

    # -- what follows from it ---------------------------------------------------------------------------------------

    def build(self, design: Mapping[str, float] | None = None) -> MechanicalModel:
        """Return the mechanical model of a design; missing variables take their baseline.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the geometry cannot exist, or the body at rest crosses an obstacle or itself.

        Any other exception is an error in the robot's code, such as a ValueError for a model without the actuators and
        effectors that the class declares; a note is added that names the robot and the design.
        """
        from softgym_envs.mechanics.locking import locking_accepted

        complete = self.design_space.complete(design)
        try:
            watched = WatchedDesign(complete)
            with locking_accepted(self._has_built or self.reproduces_scene):
                model = self.assemble(watched)
            self._has_built = True
            check_built(self, model, complete)
            self._add_contact(model, watched)
            with locking_accepted():
                warn_unread(self, model, watched)
            return model
        except SoftGymError:
            raise
        except Exception as error:
            error.add_note(f"while assembling robot '{self.name}' for {complete}")
            raise

    def balanced(self, commands: Any) -> Any:
        """Return commands (..., n_a), an array or a tensor, in which `antagonists` do not pull against each other.

        Their mean is taken off each group, which is then scaled into its range if it left that.
        """
        names = [actuator.name for actuator in self.actuators]
        columns = [commands[..., k] for k in range(len(names))]
        for group in self.antagonists:
            chosen = [names.index(name) for name in group]
            mean = sum(columns[k] for k in chosen) / len(chosen)
            beyond = mean * 0.0 + 1.0
            for k in chosen:
                columns[k] = columns[k] - mean
                share = abs(columns[k]) / self.actuators[k].high
                beyond = 0.5 * (beyond + share + abs(beyond - share))  # the larger one, in numpy and torch
            for k in chosen:
                columns[k] = columns[k] / beyond
        if not self.antagonists:
            return commands
        if isinstance(commands, np.ndarray):
            return np.stack(columns, axis=-1)
        import torch

        return torch.stack(columns, dim=-1)

    def of_parts(self, parts: Mapping[str, Callable[[Mapping[str, float], np.ndarray], dict[str, Any]]]) -> Robot:
        """Return the robot whose bodies have learned parts in place of finite elements; see `Learning`."""
        made = copy.copy(self)
        made.parts = parts
        return made

    def learned_mesh(self) -> Robot:
        """Return the robot on the mesh from which its parts were learned."""
        return self

    def printable(self) -> Robot:
        """Return the robot whose solid parts are this one's body; it takes the same designs."""
        return self

    def _checked_obstacles(self, obstacles: Any) -> tuple[Any, ...]:
        if isinstance(obstacles, tuple | list) and not obstacles:
            return ()  # without loading contact
        from softgym_envs.mechanics.contact.obstacles import Obstacle, obstacle_from

        if isinstance(obstacles, Mapping | Obstacle):
            raise ValueError(f"robot '{self.name}': obstacles must be a list, got one obstacle: {brief(obstacles)}")
        if not isinstance(obstacles, Iterable) or isinstance(obstacles, str | bytes):
            raise ValueError(f"robot '{self.name}': obstacles must be a list, got {brief(obstacles)}")
        return tuple(obstacle_from(obstacle) for obstacle in obstacles)

    def _add_contact(self, model: MechanicalModel, design: Mapping[str, float]) -> None:
        obstacles = (*self.own_obstacles(model, design), *self.obstacles)
        if not obstacles and not self.self_contact:
            return
        from softgym_envs.mechanics.contact.contact import ContactSettings

        if model.contact is not None:
            raise ValueError(f"robot '{self.name}' adds its own contact and does not take obstacles or self_contact")
        model.set_contact(
            obstacles=obstacles,
            excluded=np.flatnonzero(model.fixed),
            settings=ContactSettings(
                self_contact=self.self_contact,
                self_friction=self.self_friction,
                distance=self.contact_distance,
                stiffness=self.contact_stiffness,
            ),
        )
        assert model.contact is not None
        if (crossing := model.contact.intersections(model.nodes)) is not None:
            raise InfeasibleDesign(f"robot '{self.name}' at rest: {crossing}")

    @property
    def touches(self) -> bool:
        """Whether options give the robot something to touch: obstacles, or itself."""
        return bool(self.obstacles) or self.self_contact

    @property
    def may_touch(self) -> bool:
        """Whether options of contact matter."""
        return self.touches or self.has_own_obstacles

    @property
    def has_own_obstacles(self) -> bool:
        """Whether rigid objects are part of the robot."""
        return type(self).own_obstacles is not Robot.own_obstacles

    @property
    def options(self) -> dict[str, object]:
        """The arguments of the constructor by name, defaults included.

        If the robot has an attribute of the same name, for example because a default depends on other options, this is
        the attribute's value.
        """
        return {name: vars(self).get(name, value) for name, value in self._options.items()}

    @property
    def mechanics_key(self) -> dict[str, Any]:
        """All options that change the mechanics, JSON-serialisable. Weights are valid for exactly one key.

        Of the `options`, those of contact, of meshes and of single robots are left out at their simplest values
        (`DEFAULTS_NOT_IN_KEY`).
        """
        values = self.options | {name: vars(self)[name] for name in FOLLOWING if vars(self).get(name)}
        return {
            name: _json_value(value, f"option '{name}' of robot '{self.name}'")
            for name, value in values.items()
            if name not in self.non_mechanical_options
            and not (name in DEFAULTS_NOT_IN_KEY and DEFAULTS_NOT_IN_KEY[name] == value)
        }

    @property
    def by_effort(self) -> np.ndarray:
        """Which actuators are commanded in effort, the others in displacement, shape (n_a,)."""
        return np.array([actuator.by_effort for actuator in self.actuators], dtype=bool)

    @property
    def command_modes(self) -> tuple[str, ...]:
        """What each actuator is commanded in, as solvers name it: ``"displacement"`` or ``"effort"``."""
        return tuple("effort" if actuator.by_effort else "displacement" for actuator in self.actuators)

    @property
    def command_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest commands, displacements or efforts, each of shape (n_a,)."""
        ends = np.array([actuator.command_range for actuator in self.actuators]).reshape(-1, 2)
        return ends[:, 0], ends[:, 1]

    @property
    def command_rates(self) -> np.ndarray:
        """Largest change of the commands per control step, shape (n_a,)."""
        return np.array([actuator.command_rate for actuator in self.actuators])

    @property
    def effort_limited(self) -> list[str]:
        """Names of actuators that do not reach a commanded displacement beyond their largest effort."""
        return [each.name for each in self.actuators if np.isfinite(each.max_effort) and not each.by_effort]

    def needs_displacements(self, what: str) -> None:
        """Raise ValueError, in the name of what takes displacements only, if an actuator is commanded in effort."""
        if names := [actuator.name for actuator in self.actuators if actuator.by_effort]:
            raise ValueError(
                f"{what} takes actuators that are commanded in displacement, but robot '{self.name}' commands the "
                f"effort of {', '.join(names)}: leave effort_rate out"
            )

    @property
    def lower(self) -> np.ndarray:
        """Smallest displacements that are commanded or occur, shape (n_a,)."""
        return np.array([actuator.low for actuator in self.actuators])

    @property
    def upper(self) -> np.ndarray:
        """Largest displacements that are commanded or occur, shape (n_a,)."""
        return np.array([actuator.high for actuator in self.actuators])

    def effort_sizes(self, efforts: np.ndarray) -> np.ndarray:
        """Return the sizes of efforts (..., n_a) in one unit: their own, or shares of `effort_scale` if they differ."""
        mixed = len({actuator.unit for actuator in self.actuators}) > 1
        sizes: np.ndarray = np.abs(efforts)
        return sizes / self.effort_scale if mixed else sizes

    @property
    def rates(self) -> np.ndarray:
        """Largest change of displacements per control step, shape (n_a,)."""
        return np.array([actuator.rate for actuator in self.actuators])

    @property
    def unilateral(self) -> np.ndarray:
        """Actuators that cannot push, shape (n_a,)."""
        return np.array([actuator.unilateral for actuator in self.actuators], dtype=bool)

    def check_point(self, name: str, point: Any) -> np.ndarray:
        """Return points [m] as an array (..., 3) after checking that they are near the robot.

        Args:
            name: what the point is, for messages: ``"goal"``.
            point: one or more points [m], shape (..., 3).

        Raises:
            ValueError: for a point farther from the effector at rest than three times the robot's size.
        """
        array = np.asarray(point, dtype=float)
        distance = np.linalg.norm(array - self.effector_rest, axis=-1)
        if (distance > 3.0 * self.size).any():
            worst = array.reshape(-1, 3)[int(np.nanargmax(distance))]
            raise ValueError(
                f"{name} = {worst.tolist()} m is {np.nanmax(distance):.4g} m away from the effector of robot "
                f"'{self.name}', whose size is {self.size:g} m; did you mean metres?"
            )
        return array


def _json_value(value: Any, label: str) -> Any:
    """Return an option as plain JSON data.

    Raises:
        TypeError: for an option that cannot be represented as JSON.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_json_value(item, label) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _json_value(item, label) for key, item in value.items()}
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "as_dict"):  # an obstacle
        return _json_value(value.as_dict(), label)
    if isinstance(value, Robot):
        return {"robot": value.name, **value.mechanics_key}
    if callable(value) and hasattr(value, "__qualname__"):
        return f"{value.__module__}:{value.__qualname__}"
    raise TypeError(
        f"{label} = {value!r} cannot be stored as the key of trained weights: use numbers, strings, lists or mappings, "
        "or list it in 'non_mechanical_options'"
    )

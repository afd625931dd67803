"""Checks of robots: what a class defines, the numbers of a new robot, and whether a built body follows from them."""

from __future__ import annotations

import inspect
import warnings
from collections import deque
from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from dataclasses import replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import numpy as np

from softgym_envs.designs import Design
from softgym_envs.errors import unknown_name
from softgym_envs.quantities import check_by_unit, check_quantity

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel

Robot = Any
"""`softgym_envs.robots.base.Robot`, which imports this module."""

PUBLISHED = "published"
"""Name of the design box that every robot has: the bounds with which its class defines its design space."""

CONTACT_DEFAULTS: dict[str, object] = {
    "obstacles": (),
    "self_contact": False,
    "self_friction": 0.0,
    "contact_distance": 5e-4,
    "contact_stiffness": None,
}
"""Options of a robot that touches nothing. They are not part of its key."""

STROKES = 2.0
"""Largest stroke of an actuator, in sizes of the robot."""

DIMENSIONS = 10.0
"""Largest dimension of a design, in sizes of the robot; a radius of curvature may well be larger than the body."""

CARRIED = 2000.0
"""Largest mass that a robot is believed to carry, over the cube of its size [kg/m3]."""

OPTIONS = {
    "gravity": "gravity",
    "density": "density",
    "payload": "mass",
    "object_mass": "mass",
    "friction": "friction",
    "stand_friction": "friction",
    "self_friction": "friction",
    "young_modulus": "modulus",
    "stroke": "length",
    "strokes": "length",
    "mesh_size": "length",
    "fillet": "length",
    "guide_radius": "length",
    "servo_range": "angle",
    "max_pressure": "pressure",
    "largest_volume": "volume",
    "button_force": "force",
    "contact_distance": "contact_distance",
    "contact_stiffness": "contact_stiffness",
}
"""Quantity of each option of a robot that has a unit, by name; robots of other packages share these names."""

_EFFORTS = {"m": "force", "rad": "force", "m3": "pressure"}
"""Quantity of an actuator's effort, by its unit."""

LARGEST_RATIO = 8.0
"""Ratio of a robot's size and the extent of its baseline body, either way, beyond which one has a wrong unit."""

_REQUIRED = ("name", "effectors", "size", "design_space", "actuators", "effector_rest", "effort_scale")

_WRITTEN_OTHERWISE = {
    **{name: f"learning = Learning({name}=...)" for name in ("stiffness_variable", "convex", "symmetries")},
    "learned_parts": "learning = Learning(parts=...)",
    "weights_name": "learning = Learning(weights=...)",
    "load_variables": "learning = Learning(loads=...)",
    **{name: "learning = Learning(touch=...)" for name in ("touch_variant", "touch_design")},
    "sealed": "sensing = Sensing(sealed=...)",
    "sensor_scale": "sensing = Sensing(scale=...)",
    "sensor_unit": "sensing = Sensing(unit=...)",
    "picture_axes": "view = View(axes=...)",
    "free_object": "view = View(at_rest=...)",
}
"""How the attributes of a robot are written that stand in one of its objects, or have another name."""

UNREAD_COORDINATES = 100_000
"""Size of all bodies together by which variables that are passed on together are watched: two to ten seconds, once."""


def check_defined(holder: object, cls: type) -> None:
    """Raise TypeError if an attribute that every robot needs is missing in a class, or in a new robot of it."""
    missing = [name for name in _REQUIRED if not hasattr(holder, name)]
    if missing:
        raise TypeError(f"robot class '{cls.__name__}' does not define: {', '.join(missing)} (see Robot)")


def check_robot(robot: Robot) -> None:
    """Complete and check a new robot.

    Raises:
        TypeError: naming the attributes that the class does not define.
        ValueError: for an unknown design box, arrays of a wrong shape, numbers that are probably in another unit, or an
            option without effect.
    """
    check_defined(robot, type(robot))
    boxes = {PUBLISHED: {}, **robot.design_boxes}
    if robot.design_box not in boxes:
        raise ValueError(f"robot '{robot.name}': {unknown_name('design_box', robot.design_box, boxes)}")
    if bounds := boxes[robot.design_box]:
        robot.design_space = robot.design_space.within(bounds)
    if isinstance(robot.effectors, str):
        raise TypeError(f"robot '{robot.name}': effectors must be a tuple of names, got {robot.effectors!r}")
    if not hasattr(robot, "workspace_scale"):
        robot.workspace_scale = 0.25 * robot.size
    _complete_learning(robot)
    for name, count in (("effector_rest", 3), ("effort_scale", len(robot.actuators))):
        value = np.asarray(getattr(robot, name), dtype=float)
        if value.shape != (count,):
            raise ValueError(f"robot '{robot.name}': {name} must have shape ({count},), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"robot '{robot.name}': {name} must be finite, got {value.tolist()}")
        setattr(robot, name, value)
    _check_antagonists(robot)
    # Rewards and observations are divided by these.
    scales = {name: getattr(robot, name) for name in ("size", "effort_scale", "goal_tolerance", "workspace_scale")}
    for name, given in {**scales, "sensing.scale": robot.sensing.scale}.items():
        value = np.asarray(given, dtype=float)
        if not (np.isfinite(value) & (value > 0.0)).all():
            raise ValueError(f"robot '{robot.name}': {name} must be positive and finite, got {value.tolist()}")
    _check_quantities(robot)
    _check_touching(robot)


def _complete_learning(robot: Robot) -> None:
    """Name the weights, and forget a stiffness that not all forces are proportional to."""
    learning, name = robot.learning, robot.learning.stiffness_variable
    if name is not None and name not in robot.design_space.names:
        names = robot.design_space.names
        raise ValueError(f"robot '{robot.name}': {unknown_name('learning.stiffness_variable', name, names)}")
    others = any(robot.gravity) or robot.sensing.sealed or (robot.touches and robot.contact_stiffness is not None)
    robot.learning = replace(
        learning, weights=learning.weights or robot.name, stiffness_variable=None if others else name
    )


def _check_antagonists(robot: Robot) -> None:
    """Raise ValueError for groups of antagonists that are no groups of actuators, or cannot be let out."""
    actuators = {actuator.name: actuator for actuator in robot.actuators}
    owner, seen = f"robot '{robot.name}': antagonists", set()
    for group in robot.antagonists:
        if isinstance(group, str) or len(group) < 2:
            raise ValueError(f"{owner} must be groups of two or more names, got {group!r}")
        for name in group:
            if name not in actuators:
                raise ValueError(f"{owner}: {unknown_name('actuator', name, actuators)}")
            if name in seen:
                raise ValueError(f"{owner}: '{name}' is in two groups")
            if actuators[name].by_effort:
                raise ValueError(f"{owner}: '{name}' is commanded in effort, which no other actuator pulls against")
            seen.add(name)
            high, low = actuators[name].high, actuators[name].low
            if low != -high or high != actuators[group[0]].high:
                raise ValueError(
                    f"{owner}: '{name}' has the range {low:g} to {high:g}; a group needs one range, from -high to high"
                )


def _check_quantities(robot: Robot) -> None:
    """Raise ValueError for numbers that are probably in another unit."""
    owner, size = f"robot '{robot.name}': ", robot.size
    check_quantity("size", size, f"{owner}size")
    for name in ("effector_rest", "goal_tolerance", "workspace_scale"):
        check_quantity("length", getattr(robot, name), f"{owner}{name}", high=100.0 * size, example="near the robot")
    strokes = {"m": STROKES * size, "m3": size**3}
    for actuator in robot.actuators:
        furthest, label = max(actuator.low, actuator.high, key=abs), f"{owner}stroke of actuator '{actuator.name}'"
        if actuator.unit in strokes:
            example = f"for a robot of size {size:g} m"
            check_by_unit(actuator.unit, furthest, label, high=strokes[actuator.unit], example=example)
    for actuator, effort in zip(robot.actuators, robot.effort_scale.tolist(), strict=True):
        if actuator.unit in _EFFORTS:
            check_quantity(_EFFORTS[actuator.unit], effort, f"{owner}effort_scale of actuator '{actuator.name}'")
    for variable in robot.design_space:
        if variable.unit == "m":
            furthest, label = max(variable.low, variable.high, key=abs), f"{owner}design variable '{variable.name}'"
            check_quantity("length", furthest, label, high=DIMENSIONS * size, example=f"{DIMENSIONS:g} sizes")
    narrower = {
        "mass": plausible_mass(robot),
        "contact_distance": (0.1 * size, "a tenth of the robot"),
        "length": (STROKES * size, f"{STROKES:g} sizes of the robot"),
        "force": (plausible_force(robot), "for its actuators"),
    }
    for name, value in robot.options.items():
        if name in OPTIONS and _is_number(value) and not (name in CONTACT_DEFAULTS and value == CONTACT_DEFAULTS[name]):
            high, example = narrower.get(OPTIONS[name], (None, ""))
            check_quantity(OPTIONS[name], value, f"{owner}{name}", high=high, example=example)


def plausible_mass(robot: Robot) -> tuple[float, str]:
    """Return the largest plausible mass that a robot carries [kg], and why, for messages."""
    lifted, carried = plausible_force(robot) / 9.81, CARRIED * robot.size**3
    if lifted < carried:
        return lifted, "ten times what its actuators can lift"
    return carried, "what a robot of its size may carry"


def plausible_force(robot: Robot) -> float:
    """Return the largest plausible force on a robot [N]: ten times what its actuators can do together.

    A pressure acts on the face of a cube as large as the volume that its actuator can push.
    """
    forces = []
    for each, scale in zip(robot.actuators, robot.effort_scale.tolist(), strict=True):
        per_unit = {"m": 1.0, "rad": 1.0 / robot.size, "m3": (each.high - each.low) ** (2.0 / 3.0)}
        forces.append(scale * per_unit.get(each.unit, np.inf))
    return 10.0 * sum(forces)


def _is_number(value: object) -> bool:
    if isinstance(value, list | tuple):
        return bool(value) and all(map(_is_number, value))
    return isinstance(value, int | float | np.number | np.ndarray) and not isinstance(value, bool)


def _check_touching(robot: Robot) -> None:
    """Raise ValueError for options of contact on a robot that touches nothing."""
    if robot.self_friction and not robot.self_contact:
        raise ValueError(
            f"robot '{robot.name}': self_friction = {robot.self_friction} has no effect without self_contact=True"
        )
    if robot.may_touch:
        return
    for name in ("contact_distance", "contact_stiffness"):
        given = robot._options.get(name)
        if given is not None and given != CONTACT_DEFAULTS[name]:
            raise ValueError(
                f"robot '{robot.name}': {name} = {given} has no effect: it touches neither obstacles nor itself "
                "(self_contact=True)"
            )


class WatchedDesign(Design):
    """A design that notes which of its variables are read.

    Attributes:
        read: names of the variables read one by one so far.
        passed_on: names of those read all together, as by ``**design``, which says nothing about their use.
    """

    __slots__ = ("_array", "_copying", "passed_on", "read")

    def __init__(self, design: Design) -> None:
        self.read: set[str] = set()
        self.passed_on: set[str] = set()
        self._copying: deque[str] = deque()
        self.space, self._values, self._array = design.space, dict(design), design.array

    @property
    def array(self) -> np.ndarray:  # type: ignore[override]
        """All values, which are read thereby."""
        self.passed_on.update(self.space.names)
        return self._array

    def __getitem__(self, name: str) -> float:
        if self._copying and name == self._copying[0]:
            self._copying.popleft()
            self.passed_on.add(name)
        else:
            self._copying.clear()
            self.read.add(name)
        return self._values[name]

    def keys(self) -> KeysView[str]:
        """Return the names; ``dict(design)`` and ``**design`` then read each of them in turn."""
        self._copying = deque(self._values)
        return self._values.keys()

    def items(self) -> ItemsView[str, float]:
        """Return names and values, which are read thereby."""
        self.passed_on.update(self._values)
        return self._values.items()

    def values(self) -> ValuesView[float]:
        """Return all values, which are read thereby."""
        self.passed_on.update(self._values)
        return self._values.values()

    def __hash__(self) -> int:  # as a key of a cache, which may know the answer to all that would be read
        self.passed_on.update(self.space.names)
        return super().__hash__()

    def __iter__(self) -> Iterator[str]:
        return super().__iter__()

    def __reduce__(self) -> tuple[type[Design], tuple[Any, dict[str, float]]]:
        return Design, (self.space, self._values)


def check_built(robot: Robot, model: Any, design: Mapping[str, float]) -> None:
    """Check that an assembled model is what its robot says of it.

    Args:
        robot: the robot.
        model: what its `assemble` returned.
        design: the complete design of the model.

    Raises:
        ValueError: for another object than a model, actuators or effectors in another order or unit than declared, an
            effector far from `Robot.effector_rest`, another gravity than the robot's, or a number that is probably in
            another unit.
    """
    from softgym_envs.mechanics.elements.rigid import RigidBody
    from softgym_envs.mechanics.model import MechanicalModel
    from softgym_envs.mechanics.solids import check_modulus, check_size

    owner = f"robot '{robot.name}'"
    if not isinstance(model, MechanicalModel):
        raise ValueError(f"{owner}: assemble must return a MechanicalModel, got {model!r}")
    declared = {"a": tuple(actuator.name for actuator in robot.actuators), "e": tuple(robot.effectors)}
    for role, kind in (("a", "actuators"), ("e", "effectors")):
        added = tuple(constraint.name for constraint in model.constraints[role])
        if added != declared[role]:
            wanted, got = (", ".join(names) or "none" for names in (declared[role], added))
            raise ValueError(f"{owner}: assemble must add the {kind} {wanted} in this order, got {got}")
    for actuator, constraint in zip(robot.actuators, model.constraints["a"], strict=True):
        if constraint.unit[0] != actuator.unit:
            raise ValueError(
                f"{owner}: actuator '{actuator.name}' is declared in {actuator.unit}, but assemble adds one in "
                f"{constraint.unit[0]}"
            )
    check_modulus([block.largest_young_modulus for block in model.blocks])
    check_size(model.places, f"scale what {owner} assembles to metres")
    extent = float(np.linalg.norm(np.ptp(model.places, axis=0)))
    if not robot.size / LARGEST_RATIO < extent < LARGEST_RATIO * robot.size and design == robot.design_space.baseline:
        raise ValueError(
            f"{owner}: size = {robot.size:g} m does not fit the body that assemble returns, which extends over "
            f"{extent:.3g} m; allowed: {extent / LARGEST_RATIO:.3g} to {LARGEST_RATIO * extent:.3g} m"
        )
    for block in model.blocks:
        if isinstance(block, RigidBody):
            high, example = CARRIED * robot.size**3, f"what a robot of size {robot.size:g} m may carry"
            check_quantity("mass", block.mass, f"{owner}: mass of a rigid part", high=high, example=example)
    if not np.array_equal(model.gravity, robot.gravity):
        raise ValueError(
            f"{owner}: option gravity = {tuple(robot.gravity)} m/s2 has no effect: assemble builds a model with "
            f"{tuple(model.gravity.tolist())}; pass gravity=self.gravity to it"
        )
    _check_effector(robot, model, design)


def _check_effector(robot: Robot, model: MechanicalModel, design: Mapping[str, float]) -> None:
    """Raise ValueError for an effector that is not near `Robot.effector_rest`, from which goals are measured."""
    if not model.constraints["e"]:
        return
    place = model.constraints["e"][0].value(model.nodes)
    if place.shape != (3,):
        return
    baseline = design == robot.design_space.baseline
    allowed = (0.1 if baseline else 1.0) * robot.size
    away = float(np.linalg.norm(place - robot.effector_rest))
    if away > allowed:
        raise ValueError(
            f"robot '{robot.name}': effector '{robot.effectors[0]}' of {'the baseline' if baseline else 'this'} body "
            f"is at {np.round(place, 6).tolist()} m, {away:.3g} m away from effector_rest = "
            f"{robot.effector_rest.tolist()} m; allowed: {allowed:g} m"
        )


_WATCHED: WeakSet[type] = WeakSet()
"""Classes of robots whose reading of designs has been watched."""


def warn_unread(robot: Robot, model: MechanicalModel, design: WatchedDesign) -> None:
    """Warn of design variables that change nothing, once for each class: those that `assemble` never reads.

    Where variables are passed on together, the body with another value of each is compared, unless these bodies are
    large (`UNREAD_COORDINATES`). What chooses among parts may leave others unread.

    Args:
        robot: the robot.
        model: what its `assemble` returned.
        design: the watched design from which it did.
    """
    if type(robot) in _WATCHED or any(variable.choices for variable in robot.design_space):
        return
    _WATCHED.add(type(robot))
    known = [name for name in robot.design_space.names if name not in design.read]
    unread = [name for name in known if name not in design.passed_on]
    passed_on = [name for name in known if name in design.passed_on]
    if passed_on and model.nodes.size * len(passed_on) <= UNREAD_COORDINATES and not robot.has_own_obstacles:
        numbers = _numbers_of(model)
        unread += [name for name in passed_on if _same(numbers, robot, _moved(design, name))]
    if unread:
        warnings.warn(
            f"robot '{robot.name}': assemble never reads the design variable{'s' if len(unread) > 1 else ''} "
            f"{', '.join(unread)}: {'they change' if len(unread) > 1 else 'it changes'} nothing",
            stacklevel=4,
        )


def _moved(design: Design, name: str) -> Design:
    """Return a design with another value of one variable."""
    variable = design.space[name]
    low, high = (abs(end - design._values[name]) for end in (variable.low, variable.high))
    end = variable.high if high > low else variable.low
    return Design(design.space, {**design._values, name: 0.7 * design._values[name] + 0.3 * end})


def _same(numbers: list[np.ndarray], robot: Robot, design: Design) -> bool:
    """Whether `assemble` makes a body of the same numbers from another design."""
    try:
        other = _numbers_of(robot.assemble(design))
    except Exception:  # of this other body, which nobody asked for
        return False
    return len(other) == len(numbers) and all(map(np.array_equal, numbers, other))


def _numbers_of(model: MechanicalModel) -> list[np.ndarray]:
    """Return what a body is: its shape, loads, masses, rows of `W`, and its energy in a strained shape."""
    constraints = [constraint for group in model.constraints.values() for constraint in group]
    strained = model.nodes * (1.0 + 1e-3 * np.sin(np.arange(1.0, 4.0) + 1e3 * model.nodes))
    blocks = [np.array([block.mass, block.volume]) for block in model.blocks]
    rows = [np.append(constraint.value(strained), constraint.compliance) for constraint in constraints]
    extra = [np.array([model.elastic_energy(strained)]), model.fixed, model.loads, model.nodes]
    return [*extra, *blocks, *rows]


_TOLD: WeakSet[type] = WeakSet()
"""Classes of robots whose attributes have been looked at."""


def warn_unknown(robot: Robot, base: type) -> None:
    """Warn once for each class of attributes that nothing reads, which are nearly those of ``base``."""
    cls = type(robot)
    if cls in _TOLD:
        return
    _TOLD.add(cls)
    known = {name for name in (*dir(base), *inspect.get_annotations(base)) if not name.startswith("_")}
    defined = {name for each in cls.__mro__ if not issubclass(base, each) for name in vars(each)}
    own = {name for name in defined | set(vars(robot)) if not name.startswith("_")}
    for name in sorted(own - known - set(robot.options)):
        if name in _WRITTEN_OTHERWISE:
            meant = _WRITTEN_OTHERWISE[name]
        elif name in defined and len(name) > 5 and (near := get_close_matches(name, known, n=1, cutoff=0.9)):
            meant = near[0]
        else:
            continue
        warnings.warn(
            f"robot '{robot.name}': nothing reads its attribute '{name}'; did you mean '{meant}'?", stacklevel=4
        )

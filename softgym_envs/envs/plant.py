"""A plant that differs from the model: options of every environment, fixed or drawn at each reset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from softgym_envs.backends.backend import PointForce, State
from softgym_envs.envs.random import RowRandom
from softgym_envs.errors import unknown_name
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.quantities import QUANTITIES
from softgym_envs.robots.base import Robot
from softgym_envs.wording import brief


@dataclass(frozen=True)
class Plant:
    """How a robot differs from its model.

    Attributes:
        stiffness: factor of the elastic stiffness of the whole body. It multiplies all efforts and divides ``W``; a
            given force deforms the body as a smaller one deforms the model, see `equivalent_model_force`.
        cable_friction: coefficient of friction of cables on their guides, by the capstan law; finite elements only.
        delay: control steps between sending a command and its arrival at the drives.
        noise: standard deviation of all sensors: of displacements over their range, of efforts and of sensor rows over
            their scale, of effectors over the robot's size, of measured forces over the largest wanted one.
        gain: what each drive does over what it is commanded to, one number or one for each actuator, as all below.
        offset: what it adds to that [m, ...].
        backlash: width of its play [m, ...]: it stays where it is while the command is within half of it.
        cable_compliance: how far each cable stretches per tension [m/N]; finite elements without contact only.
    """

    stiffness: float = 1.0
    cable_friction: float = 0.0
    delay: int = 0
    noise: float = 0.0
    gain: float | tuple[float, ...] = 1.0
    offset: float | tuple[float, ...] = 0.0
    backlash: float | tuple[float, ...] = 0.0
    cable_compliance: float | tuple[float, ...] = 0.0

    @property
    def drives_exactly(self) -> bool:
        """Whether drives do what they are commanded to."""
        return not (np.any(np.asarray(self.gain) != 1.0) or np.any(self.offset) or np.any(self.backlash))

    def equivalent_model_force(self, load: PointForce | None) -> PointForce | None:
        """Return the force that deforms the model as a force on the plant deforms the plant.

        Both have the same shape if all forces on the stiffer body are larger by the same factor.
        """
        if load is None or self.stiffness == 1.0:
            return load
        return replace(load, force=load.force / self.stiffness)


def play(command: np.ndarray, last: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return where drives with play end up that were at ``last``: nowhere else if the command is within half of it."""
    return np.clip(last, command - 0.5 * width, command + 0.5 * width)


LIMITS: dict[str, tuple[float, float]] = {
    "stiffness": (0.1, 10.0),
    "cable_friction": (0.0, QUANTITIES["friction"].high),
    "delay": (0, 100),
    "noise": (0.0, 1.0),
    "gain": (0.1, 10.0),
    "offset": (-10.0, 10.0),
    "backlash": (0.0, 10.0),
    "cable_compliance": (0.0, 1.0),
}
"""Smallest and largest value of each attribute of a plant."""

OF_DRIVES = ("gain", "offset", "backlash", "cable_compliance")
"""Attributes that may have one value for each actuator."""


@dataclass(frozen=True)
class Plants:
    """A range of plants, from which each reset draws one.

    Attributes:
        low: smallest value of each attribute.
        high: largest value of each attribute.
    """

    low: Plant
    high: Plant

    @classmethod
    def check(
        cls, option: Mapping[str, Any] | None, robot: Robot, backend: str, *, moving: bool = False
    ) -> Plants | None:
        """Return the plants of the option ``plant``: a number or a range for each attribute. None without the option.

        What the drives do may differ: ``{"offset": {"cable_1": 0.001, "cable_2": [0.0, 0.002]}}`` by actuator.

        Args:
            option: the option.
            robot: the robot.
            backend: name of its backend.
            moving: whether that computes motion in time.

        Raises:
            ValueError: for an unknown name, a value out of bounds, or a plant that the robot or its backend cannot be.
        """
        if option is None:
            return None
        names = [attribute.name for attribute in fields(Plant)]
        low: dict[str, Any] = {}
        high: dict[str, Any] = {}
        for name, given in option.items():
            if name not in names:
                raise ValueError(unknown_name("plant option", name, names))
            if name in OF_DRIVES and isinstance(given, Mapping):
                low[name], high[name] = _ends_by_actuator(name, given, robot)
            else:
                low[name], high[name] = _ends(name, given)
        found = cls(replace(Plant(), **low), replace(Plant(), **high))
        if found.high.cable_friction and backend != "fem":
            raise ValueError(f"plant cable_friction needs backend 'fem': '{backend}' has no friction of cables")
        if np.any(found.high.cable_compliance) and (backend != "fem" or robot.touches or moving):
            raise ValueError("plant cable_compliance needs backend 'fem' without contact and dynamics; allowed: 0")
        stiff = found.low.stiffness == found.high.stiffness == 1.0
        limited = any(np.isfinite(actuator.max_effort) for actuator in robot.actuators)
        if not stiff and (any(robot.gravity) or robot.touches or robot.sensing.sealed or limited):
            raise ValueError(
                f"plant stiffness: robot '{robot.name}' has weight, contacts, sealed air or limited efforts, which do "
                "not scale with its stiffness; change its design instead"
            )
        if not stiff and moving:
            raise ValueError(
                "plant stiffness changes frequencies, which dynamics=True would not show; change the design"
            )
        return found

    @property
    def drive_exactly(self) -> bool:
        """Whether the drives of all plants do what they are commanded to."""
        return self.low.drives_exactly and self.high.drives_exactly

    @property
    def change_cables(self) -> bool:
        """Whether cables have friction or stretch."""
        return bool(self.high.cable_friction or np.any(self.high.cable_compliance))

    @property
    def longest_delay(self) -> int:
        """Largest number of control steps that a command may take."""
        return self.high.delay

    def sample(self, rng: np.random.Generator) -> Plant:
        """Draw a plant: every attribute uniformly, and no random number for one that is fixed."""
        values: dict[str, Any] = {}
        for name, low in asdict(self.low).items():
            high = getattr(self.high, name)
            if low == high:
                values[name] = low
            elif isinstance(low, tuple):
                values[name] = tuple(float(value) for value in rng.uniform(low, high))
            else:
                values[name] = int(rng.integers(low, high + 1)) if name == "delay" else float(rng.uniform(low, high))
        return Plant(**values)


@dataclass(slots=True)
class Sensed:
    """What the sensors of a robot show.

    Attributes:
        displacement: of the actuators [m, ...], shape (..., n_a).
        effort: of the actuators [N, ...], shape (..., n_a).
        effector: the first effector, or what the task measures in its place, shape (..., 3).
        sensors: readings of sensor rows over their scale, shape (..., s).
    """

    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    sensors: np.ndarray = field(default_factory=lambda: np.zeros(0))


def _ends_by_actuator(
    name: str, given: Mapping[str, object], robot: Robot
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the smallest and largest values of an attribute given by actuator; the others have its default.

    Raises:
        ValueError: as `_ends`, and for an unknown actuator.
    """
    names = [actuator.name for actuator in robot.actuators]
    for actuator in given:
        if actuator not in names:
            raise ValueError(f"plant {name}: {unknown_name('actuator', actuator, names)}")
    ends = [_ends(name, given.get(actuator, getattr(Plant, name))) for actuator in names]
    return tuple(low for low, _ in ends), tuple(high for _, high in ends)


def _ends(name: str, given: object) -> tuple[float, float]:
    """Return the smallest and largest value of an attribute of a plant, integers for a delay.

    Raises:
        ValueError: unless the given value is one number or two, in order and within `LIMITS`.
    """
    typed: type = int if name == "delay" else float
    least, most = LIMITS[name]
    try:
        ends = np.atleast_1d(np.asarray(given, dtype=float))
        valid = ends.shape in ((1,), (2,)) and least <= ends[0] <= ends[-1] <= most
    except (TypeError, ValueError):
        valid = False
    if not valid or any(end != typed(end) for end in ends):
        word = "integers" if typed is int else "numbers"
        raise ValueError(f"plant {name} = {brief(given)}; allowed: one or two {word} from {least} to {most}, rising")
    return typed(ends[0]), typed(ends[-1])


def sensed(robot: Robot, true: Sensed, noise: np.ndarray, random: RowRandom, measured_scale: float) -> Sensed:
    """Return true values of B bodies with Gaussian noise, see `Plant`.

    Args:
        robot: the robot.
        true: the true values.
        noise: relative standard deviation, shape (B,).
        random: random numbers of the bodies.
        measured_scale: that of the task, see `Task`.
    """
    if not np.any(noise):
        return true
    level = noise[:, None]
    return Sensed(
        true.displacement + level * (robot.upper - robot.lower) * random.normal(true.displacement.shape),
        true.effort + level * robot.effort_scale * random.normal(true.effort.shape),
        true.effector + level * measured_scale * random.normal(true.effector.shape),
        true.sensors + level * random.normal(true.sensors.shape) if true.sensors.size else true.sensors,
    )


def stiffened(state: State, factor: float) -> State:
    """Return the state of a body whose elastic stiffness is larger by a factor, under the same displacements."""
    if factor == 1.0:
        return state

    def condensed() -> CondensedModel:
        model = state.condensed
        return replace(model, compliance=model.compliance / factor, effort=factor * model.effort)

    return replace(state, effort=factor * state.effort, row_effort=factor * state.row_effort, condensed=condensed)

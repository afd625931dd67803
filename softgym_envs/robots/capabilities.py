"""What only some robots have, or have differently: each is one object of a robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from softgym_envs.robots.geometry.symmetry import Symmetry


class LearnedTouch(ABC):
    """How surrogates know what touches a body: as design variables of another robot."""

    @abstractmethod
    def variant(self) -> Any:
        """Return the `Robot` that is learned: its design also says what touches it (`Learning.loads`)."""

    @abstractmethod
    def design(self, design: Mapping[str, float], point: np.ndarray, force: np.ndarray) -> dict[str, float]:
        """Return the variables that stand for a force [N] (3,) at a point [m] (3,) of a complete design.

        Raises:
            ValueError: for a touch that is not learned.
        """


@dataclass(frozen=True)
class Learning:
    """What surrogates know of a robot before they learn it.

    Attributes:
        weights: name of its weights; default the robot's name. Variants with other mechanics have other names.
        stiffness_variable: design variable that scales all efforts and nothing else (Young's modulus), or None.
            Surrogates use it exactly instead of learning it. A robot with gravity, sealed air or a contact stiffness
            in pascals has none, whatever its class says: these forces do not scale with it.
        convex: the elastic energy is convex in the actuator displacements, so that the body is also stable when its
            actuators are driven by efforts. Surrogates rely on it; without it, they learn unstable states too.
        symmetries: reflections and rotations, besides the identity, that map every body and its mesh to itself.
            Surrogates also learn from the images of their states.
        loads: design variables that say what acts on the body, not what the body is.
        touch: how a touch is learned; None if it is not.
        parts: names of the parts of bodies that are learned instead of whole bodies; see `Robot.of_parts`.
    """

    weights: str = ""
    stiffness_variable: str | None = None
    convex: bool = True
    symmetries: tuple[Symmetry, ...] = ()
    loads: tuple[str, ...] = ()
    touch: LearnedTouch | None = None
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Sensing:
    """Sensors inside a body, the rows ``s`` of its condensed model; by default there are none.

    Attributes:
        scale: typical reading of each [unit], shape (n_s,).
        unit: of the readings.
        sealed: the sensors enclose air, which resists changes of its volume.
    """

    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    unit: str = "m3"
    sealed: bool = False

    def __len__(self) -> int:
        return len(self.scale)


@dataclass(frozen=True)
class View:
    """From where pictures show a robot.

    Attributes:
        axes: coordinates towards the viewer, to the right and up: (0, 1, 2), (1, 2, 0) or (2, 0, 1).
        turned: by a quarter about the vertical, so that the first of the axes points to the right instead.
        at_rest: pictures are framed by the robot at rest, since many commands have no static equilibrium, as with an
            object that can fall; otherwise also by where its actuators can take it.
        follows: row of the model that the camera goes with, of robots that move about.
        way: how far it goes along x in an episode, which pictures are to show too [sizes of the robot].
    """

    axes: tuple[int, int, int] = (0, 1, 2)
    turned: bool = False
    at_rest: bool = False
    follows: int | None = None
    way: float = 0.0

    @property
    def directions(self) -> np.ndarray:
        """Directions towards the viewer, to the right and up, as rows, shape (3, 3)."""
        towards, right, up = np.eye(3)[list(self.axes)]
        return np.stack([-right, towards, up] if self.turned else [towards, right, up])

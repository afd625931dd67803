"""The interface between the physics of many bodies at once and the batched environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from softgym_envs.backends.backend import Ground, PointForce, State
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot


class Rows:
    """A dataclass of arrays, whose first axis counts the rows."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def _each(self, function: Callable[..., np.ndarray], *others: Self) -> Self:
        """Return what a function makes of each array, and of the same one of others."""
        return type(self)(*(function(*(getattr(one, n) for one in (self, *others))) for n in self.__dataclass_fields__))

    def repeat(self, count: int) -> Self:
        """Return ``count`` copies of the only row."""
        return self._each(lambda a: np.repeat(a, count, axis=0))

    def rows(self, index: np.ndarray) -> Self:
        """Return copies of some rows."""
        return self._each(lambda a: a[index])

    def replaced(self, index: np.ndarray, new: Self) -> Self:
        """Return a copy in which some rows are new."""

        def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            copy = old.copy()
            copy[index] = new
            return copy

        return self._each(put, new)

    def where(self, found: np.ndarray, old: Self) -> Self:
        """Return the rows that are found (B,), and those of ``old`` in place of the others."""

        def choose(new: np.ndarray, old: np.ndarray) -> np.ndarray:
            return np.where(found.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

        return self._each(choose, old)


@dataclass(slots=True)  # not frozen: that would triple the time to make one
class BatchState(Rows):
    """States of a batch of B bodies.

    Attributes:
        displacement: reached actuator displacements, shape (B, n_a).
        effort: actuator efforts, shape (B, n_a).
        effector: effector coordinates [m], shape (B, n_e).
        slack: which actuators are slack, shape (B, n_a).
        converged: whether the state was found, shape (B,); rows without a state must not be used.
        uncertainty: uncertainty of the effector [m], shape (B,).
        distrust: why the model is not trusted, 0 where it is (`surrogate.domain.DISTRUST_REASONS`), shape (B,).
    """

    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    slack: np.ndarray
    converged: np.ndarray
    uncertainty: np.ndarray
    distrust: np.ndarray

    @property
    def trusted(self) -> np.ndarray:
        """Whether the model may be trusted, shape (B,)."""
        return self.distrust == 0


class BatchBackend(ABC):
    """Physics of B bodies of one robot, which go from state to state under the commands of its actuators.

    Attributes:
        robot: the robot.
        state: the present states.
        command: the commands that led to them, shape (B, n_a).
        moving: states have velocities.
        takes_force: `push` takes forces on the effectors.
        takes_touch: `touch` takes forces on points of the bodies.
    """

    moving: bool = False
    takes_force: bool = False
    takes_touch: bool = False
    robot: Robot
    state: BatchState
    command: np.ndarray

    @property
    def rest_sizes(self) -> np.ndarray | None:
        """Return `Constraint.rest_size` of each actuator, shape (B, n_a); None where no mechanical model is at hand."""
        return None

    @abstractmethod
    def begin(self, index: np.ndarray, designs: np.ndarray) -> Mapping[int, InfeasibleDesign]:
        """Give rows other bodies, at rest.

        Args:
            index: the rows.
            designs: their bodies, shape (len(index), number of design variables).

        Returns:
            Why the bodies of rows cannot exist; these rows keep the bodies that they had.

        Raises:
            ConvergenceError: if a body has no state at rest.
        """

    @abstractmethod
    def rest(self, index: np.ndarray) -> None:
        """Put rows at rest, without a command."""

    @abstractmethod
    def step(self, command: np.ndarray) -> None:
        """Go to the states under commands (B, n_a). Rows whose state is not found keep theirs and are not converged."""

    def push(self, forces: Sequence[np.ndarray | None]) -> None:
        """Push the first effectors from the next `step` on, with a force [N] (3,) or None for each row."""
        raise ValueError(f"{type(self).__name__} takes no forces")

    def touch(self, loads: Sequence[PointForce | None]) -> None:
        """Touch the bodies from the next `step` on, one load or None for each; `rest` ends a touch."""
        raise ValueError(f"{type(self).__name__} takes no forces")

    def stand_on(self, index: np.ndarray, grounds: Sequence[Ground]) -> None:
        """Put rows at rest on other grounds, as `Backend.stand_on`."""
        raise ValueError(f"{type(self).__name__} has no ground")

    def set_cables(self, index: np.ndarray, friction: Sequence[float], compliance: Sequence[Any]) -> None:
        """Set `Backend.cable_friction` and `Backend.cable_compliance` of rows at rest.

        Raises:
            ValueError: for what is not computed.
        """
        if any(friction) or any(np.any(value) for value in compliance):
            raise ValueError(f"{type(self).__name__} has neither friction nor compliance of cables; allowed: 0")

    @property
    def states(self) -> list[State]:
        """The present mechanical states of the rows; empty where they are stepped together."""
        return []

    @abstractmethod
    def effectors(self, index: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Return the first effectors [m] (len(index), 3) of equilibria under commands; NaN where there is none."""

    @property
    def velocity(self) -> np.ndarray | None:
        """Velocities of the first effector [m/s], shape (B, 3); None without dynamics."""
        return None

    @property
    @abstractmethod
    def stable(self) -> np.ndarray:
        """Whether each state is stable, as in `State`, shape (B,)."""

    @property
    @abstractmethod
    def condensed(self) -> CondensedModel:
        """Condensed models of the present states, evaluated at each access; leading shape (B,)."""

    @abstractmethod
    def settled(self) -> BatchState:
        """Return the equilibria under the present commands, whose derivatives `gradient` takes.

        Without dynamics they are the present states. In dynamics a body goes there if its command is held.
        """

    @abstractmethod
    def gradient(self, effector: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient of a function of the last `settled` states in displacements, and in commands.

        Args:
            effector: derivative of the function in the effector coordinates, shape (B, n_e).
            effort: derivative in the efforts, shape (B, n_a).

        Returns:
            Two gradients, each (B, n_a): with all displacements held, as if no actuator were slack; and in the
            commands, zero for actuators that do not follow theirs.
        """


def condensed_gradient(
    compliance: np.ndarray,
    a: slice,
    e: slice,
    follows: np.ndarray,
    effector: np.ndarray,
    effort: np.ndarray,
    by_effort: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `BatchBackend.gradient` does, from ``W``.

    A commanded effort adds to the pull of its own row, and moves what is held in displacement: with ``g`` the gradient
    in the displacements of the held actuators ``T``, that in an effort of ``E`` is ``pull_E - W_ET g``.

    Args:
        compliance: of the states, shape (B, n, n).
        a: rows of the actuators.
        e: rows of the effectors.
        follows: actuators that follow their commands, neither slack nor saturated: the efforts of the others stay what
            they are. Shape (B, n_a).
        effector: derivative of the function in the effector coordinates, shape (B, n_e).
        effort: derivative in the efforts, shape (B, n_a).
        by_effort: actuators that are commanded in effort, shape (n_a,).
    """
    W, follows = compliance[:, a, a], follows & ~by_effort
    pulled = np.einsum("bea,be->ba", compliance[:, e, a], effector) + effort
    held = np.linalg.solve(W, pulled[:, :, None])[:, :, 0]
    both, unit = follows[:, :, None] & follows[:, None, :], np.eye(W.shape[1])
    driven = np.linalg.solve(np.where(both, W, unit), np.where(follows, pulled, 0.0)[:, :, None])[:, :, 0]
    driven = np.where(follows, driven, 0.0)
    return held, np.where(by_effort, pulled - np.einsum("bij,bj->bi", W, driven), driven)

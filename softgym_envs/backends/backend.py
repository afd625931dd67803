"""The interface between physics and everything above it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.designs import Design
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.dynamics import Motion
from softgym_envs.robots.base import Robot

__all__ = ["Backend", "State"]


@dataclass(frozen=True)
class State:
    """What is known of a robot at an equilibrium.

    Attributes:
        command: commanded displacements or efforts, shape (n_a,).
        displacement: reached actuator displacements [m, ...], shape (n_a,); larger than commanded where slack.
        effort: actuator efforts [N, ...], shape (n_a,).
        effector: effector positions [m], shape (k, 3).
        slack: actuators that hang slack, shape (n_a,).
        condensed: condensed model at the state.
        bonds: forces in the bonds of the body, in the order of its model [N], empty where it has none.
        velocity: of the effectors [m/s], shape (k, 3); zero without dynamics.
        motion: time, velocities and energies of the body, where the backend knows dynamics.
        stable: the state is stable whatever drives the actuators (always True on the surrogate, which knows no other);
            in dynamics it is the tangent of the time step, with its inertia, that is positive definite.
        uncertainty: of the effector [m]: 95 % of errors are smaller, where a learned model knows; 0 for FEM.
        trusted: the state lies where the backend knows what it says; always True for FEM.
        nodes: deformed nodes [m], shape (n, 3), where the backend has them.
    """

    command: np.ndarray
    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    slack: np.ndarray
    condensed: CondensedModel
    nodes: np.ndarray | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    motion: Motion | None = None
    bonds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stable: bool = True
    uncertainty: float = 0.0
    trusted: bool = True


class Backend(ABC):
    """Physics of one robot: ``reset(design) -> State``, ``step(command) -> State``.

    Attributes:
        robot: the family of bodies.
        design: the present complete design.
        state: the present state.
        moving: states have velocities that matter.
        takes_force: `step` can push the effector.
    """

    moving: bool = False
    takes_force: bool = False
    robot: Robot
    design: Design
    state: State

    @abstractmethod
    def reset(self, design: Mapping[str, float] | None = None) -> State:
        """Go to the rest equilibrium of a design (default: the present one). Nothing is rebuilt if it is the same.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if its geometry cannot exist.
        """

    @abstractmethod
    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        """Go to the equilibrium under a command, shape (n_a,), from the present one.

        Args:
            command: actuator displacements, or efforts.
            mode: ``"displacement"`` or ``"effort"``; an effort on an actuator that cannot push is not negative.
            force: on the first effector [N], shape (3,), or None.

        Raises:
            ConvergenceError: if no equilibrium is found; the present state is kept.
            ValueError: for a malformed command.
        """

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the state under a command without going there."""
        kept = self.state
        try:
            return self.step(command, mode)
        finally:
            self.restore(kept)

    @abstractmethod
    def restore(self, state: State) -> None:
        """Go back to a state of the present design."""

"""An effector that a rigid, frictionless plane stops, on finite elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError

MAX_CONTACT_STEPS = 50
GAP_TOLERANCE = 1e-9  # [m]


@dataclass(frozen=True)
class Plane:
    """A rigid, frictionless plane in the way of the first effector."""

    distance: float  # from the effector at rest, along the normal [m]
    normal: Sequence[float] | np.ndarray  # direction towards the plane, of any length, shape (3,)


def step_towards_plane(backend: FEMBackend, command: np.ndarray, driven: str, plane: Plane, rest: np.ndarray) -> State:
    """Return the state under a command (n_a,), with a plane in the way of the first effector.

    The contact force f and the gap g satisfy ``f >= 0, g >= 0, f g = 0``. Newton's method with the condensed compliance
    of the effector finds them. ``rest`` is the position of the effector at rest [m], shape (3,).

    Raises:
        ConvergenceError: if an equilibrium is not found.
    """
    normal = np.asarray(plane.normal, dtype=float) / np.linalg.norm(plane.normal)
    force = 0.0
    state = backend.step(command, driven)
    for _ in range(MAX_CONTACT_STEPS):
        gap = plane.distance - float((state.effector[0] - rest) @ normal)
        if abs(gap) < GAP_TOLERANCE or (force == 0.0 and gap > 0.0):
            return state
        W = state.condensed.W
        held = np.zeros(len(command), dtype=bool) if driven == "effort" else ~state.slack
        compliance = normal @ W.ee[:3, :3] @ normal
        if held.any():
            coupling = W.ae[:, :3][held] @ normal
            compliance -= coupling @ np.linalg.solve(W.aa[np.ix_(held, held)], coupling)
        force = max(0.0, force - gap / compliance)
        state = backend.step(command, driven, force=-force * normal)
    raise ConvergenceError(f"no equilibrium with the effector at a plane {plane.distance:g} m away, command {command}")

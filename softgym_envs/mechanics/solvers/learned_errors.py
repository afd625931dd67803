"""How far learned energies may put the effectors of a body off."""

from __future__ import annotations

import numpy as np

from softgym_envs.mechanics.solvers.statics import Statics


def possible_errors(statics: Statics, held: np.ndarray) -> np.ndarray:
    """Return how far learned energies may put the effectors off at the present equilibrium of a solver.

    An error of the forces moves an effector by its work along the motion that a unit force on the effector causes
    (Maxwell and Betti), with the displacements of some actuators held.

    Args:
        statics: the solver.
        held: actuators whose displacement is held, not their effort, shape (n_a,).

    Returns:
        Root of the sum of squares over all independent errors, shape (n_e,) [m].
    """
    model, linear, x, rows = statics.model, statics.linearisation, statics.x, np.flatnonzero(held)
    sizes = dict(model.roles)
    effectors = sizes.get("a", 0) + np.arange(sizes.get("e", 0))
    efforts = np.zeros((len(effectors), len(statics.effort)))
    efforts[np.arange(len(effectors)), effectors] = 1.0
    if len(rows):
        efforts[:, rows] = -np.linalg.solve(linear.W[np.ix_(rows, rows)], linear.W[np.ix_(rows, effectors)]).T
    fields = np.stack([model.kinematics.row_velocity(x, linear.response(effort)) for effort in efforts])
    total = np.zeros(len(effectors))
    for block in model.blocks:
        if block.learned:
            total += (block.possible_errors(x, fields) ** 2).sum(axis=0)
    return np.sqrt(total)

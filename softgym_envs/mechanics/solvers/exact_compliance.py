"""Condensed models and stability of equilibria that were found without a factorisation there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium, RowLayout
from softgym_envs.mechanics.solvers.linearisation import Linearisation
from softgym_envs.mechanics.solvers.statics import Statics


def exact_at(statics: Statics, found: Equilibrium) -> Equilibrium:
    """Return an equilibrium that a solver has found, with ``W`` and ``stable`` of the tangent there.

    The solver stays where it is. If that is the equilibrium, its next step starts with this factorisation.

    Raises:
        ConvergenceError: if the tangent is singular.
        ValueError: if there is friction, whose tangent depends on what happened before the equilibrium.
    """
    linear = statics.linearisation
    if linear.rubs:
        raise ValueError("a body with friction needs a solver with exact_compliance=True")
    if not (np.array_equal(found.x, statics.x) and np.array_equal(found.effort, statics.effort)):
        linear = Linearisation(statics.model)
    if not linear.update(found.x, found.effort, exact=True):
        raise ConvergenceError("the tangent of the equilibrium is singular", fraction=1.0)
    values = found.x, found.effort, linear.delta, linear.W, found.slack
    layout = RowLayout.of(statics.model)
    stable = linear.positive_definite
    return replace(found, condensed=layout.equilibrium(*values, stable=stable, iterations=0).condensed, stable=stable)

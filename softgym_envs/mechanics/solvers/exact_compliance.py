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
        ValueError: if there is friction, whose tangent depends on what happened before the equilibrium, or if the body
            has changed since.
    """
    if found.conditions is None:
        return found
    model, linear, (loads, elasticity_version) = statics.model, statics.linearisation, found.conditions
    if linear.has_friction:
        raise ValueError("a body with friction needs a solver with exact_compliance=True")
    contact = None if linear.contact is None else linear.contact.contact
    same = model.assembly is linear.assembly and model.contact is contact
    if not same or elasticity_version != model.elasticity_version:
        raise ValueError(
            "the constraints, contact or elasticity of the body have changed since this equilibrium was found; "
            "solve for it again"
        )
    pairs = (found.x, statics.x), (found.effort, statics.effort), (loads, linear.loads)
    if all(np.array_equal(*pair) for pair in pairs):
        linear.current = False  # until the update has succeeded
    else:
        linear = Linearisation(model)
        linear.loads, linear.cable_friction = loads, None  # the body may have been given friction since
    if not linear.update(found.x, found.effort, exact=True):
        raise ConvergenceError("the tangent of the equilibrium is singular", fraction=1.0)
    values = found.x, found.effort, linear.delta, linear.W, found.slack
    layout = RowLayout.of(model)
    stable = linear.positive_definite
    condensed = layout.equilibrium(*values, stable=stable, iterations=0).condensed
    return replace(found, condensed=condensed, stable=stable, conditions=None)

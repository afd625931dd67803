"""How much too stiff coarse elements make a body: the share of its compliance that they miss."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from softgym_envs.mechanics.elements.quadratic import EDGES, QuadraticTetrahedra, add_midside_nodes
from softgym_envs.mechanics.solvers.tangent import Tangent

Body = Any
"""A `MechanicalModel`, whose module imports this one."""

TOLERATED = 0.05
"""Share of the compliance that an element may miss without a warning."""

MOST_NODES = 40_000
"""Nodes of quadratic elements beyond which nothing is estimated: it would take longer than a minute."""


class LockingWarning(UserWarning):
    """The elements that were asked for make a body much stiffer than it is."""


def missing_compliance(model: Body) -> float | None:
    """Return the share of the compliance at rest that a body's solid lacks against quadratic elements on its mesh.

    The compliance is the work of a uniform load, as of weight, on the displacement that it causes; the worst of the
    axes of space counts. Quadratic elements miss some of it too, so this is a lower bound of the error.

    Args:
        model: of one solid of elements with four nodes.

    Returns:
        The share, or None for bodies that are too large to compare.
    """
    solid = model.solids[0]
    nodes, tetrahedra = add_midside_nodes(model.nodes, solid.connectivity)
    if len(nodes) > MOST_NODES:
        return None
    held = np.zeros((len(nodes), 3), dtype=bool)
    held[: len(model.nodes)] = model.kinematics.held
    for slot, edge in enumerate(EDGES):
        held[tetrahedra[:, 4 + slot]] = held[tetrahedra[:, edge]].all(axis=1)
    young = solid.mu * (3.0 * solid.lame + 2.0 * solid.mu) / (solid.lame + solid.mu)
    poisson = 0.5 * solid.lame / (solid.lame + solid.mu)
    fine = QuadraticTetrahedra(nodes, tetrahedra, material=solid.material, young_modulus=young, poisson_ratio=poisson)
    exact = _compliances(type(model)(nodes, [fine], fixed=held, solver=model.solver))
    free = exact > 0.0  # axes along which something can move
    return float((1.0 - _compliances(model)[free] / exact[free]).max(initial=0.0))


def _compliances(model: Body) -> np.ndarray:
    """Work of a uniform load of 1 N/m3 along each axis of space on the displacements at rest [J], shape (3,)."""
    solid, assembly = model.solids[0], model.assembly
    volumes = solid.nodal_masses(len(model.nodes)) / solid.density
    assembled = assembly.evaluate(model.nodes, np.zeros(assembly.size), np.zeros_like(model.nodes), None)
    assert assembled is not None and assembled.tangent is not None  # at rest no element is inverted
    tangent = Tangent(assembly.indptr, assembly.indices, model.solver)
    tangent.factorise(assembled.tangent, None)
    out = np.empty(3)
    for axis in range(3):
        load = np.zeros_like(model.nodes)
        load[:, axis] = volumes
        force = model.kinematics.equation_force(model.nodes, load)
        out[axis] = force @ tangent.solver.solve(force[:, None])[:, 0]
    return out


def warn_of_locking(model: Body, element: str) -> None:
    """Warn if elements that were asked for miss much of a body's compliance; see `missing_compliance`."""
    missing = None if element == "quadratic" or not model.solids[0].density else missing_compliance(model)
    if missing is None or missing <= TOLERATED:
        return
    warnings.warn(
        f"{element} elements lock on this mesh: under a uniform load the body gives way by {100 * missing:.0f} % less "
        "than with element='quadratic', the default",
        LockingWarning,
        stacklevel=3,
    )

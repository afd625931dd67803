"""How much too stiff coarse elements make a body: the share of its compliance that they miss."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from softgym_envs.mechanics.elements.quadratic import EDGES, QuadraticTetrahedra, add_midside_nodes
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock
from softgym_envs.mechanics.solvers.tangent import Tangent

Body = Any
"""A `MechanicalModel`, whose module imports this one."""

TOLERATED = 0.05
"""Share of the compliance that an element may miss without a warning."""

MOST_NODES = 40_000
"""Nodes of quadratic elements beyond which nothing is computed: it would take longer than a minute."""

NEARLY_INCOMPRESSIBLE = 0.4
"""Poisson's ratio from which elements of large meshes, of which nothing is computed, are said to lock."""

_accepted: ContextVar[bool] = ContextVar("accepted", default=False)


class LockingWarning(UserWarning):
    """The elements that were asked for make a body much stiffer than it is."""


@contextmanager
def locking_accepted(accepted: bool = True) -> Iterator[None]:
    """Neither estimate nor warn of locking while a block runs: the scene is a published one, or it is known."""
    token = _accepted.set(accepted or _accepted.get())
    try:
        yield
    finally:
        _accepted.reset(token)


def missing_compliance(model: Body, number: int = 0) -> float | None:
    """Return the share of the compliance at rest that a solid lacks against quadratic elements on its mesh.

    The compliance is the work of a uniform load, as of weight, on the displacement that it causes; the worst of the
    axes of space counts. Quadratic elements miss some of it too, so this is a lower bound of the error. The solid is
    held where it is clamped and where frames carry it; one that nothing holds, at the first tenth of its length.

    Args:
        model: with a solid of elements with four nodes.
        number: of the solid among ``model.solids``.

    Returns:
        The share, or None for solids that are too large to compare.
    """
    solid = model.solids[number]
    nodes, tetrahedra = add_midside_nodes(model.nodes, solid.connectivity)
    if len(np.unique(tetrahedra)) > MOST_NODES:
        return None
    held = model.kinematics.held.copy()
    held[model.frames.carried] = True
    used = np.unique(solid.connectivity)
    if not held[used].any():
        places = model.nodes[used]
        along = places[:, int(np.argmax(np.ptp(places, axis=0)))]
        held[used[along <= along.min() + 0.1 * np.ptp(along)]] = True
    fine_held = np.zeros((len(nodes), 3), dtype=bool)
    fine_held[: len(held)] = held
    for slot, edge in enumerate(EDGES):
        fine_held[tetrahedra[:, 4 + slot]] = fine_held[tetrahedra[:, edge]].all(axis=1)
    young = solid.mu * (3.0 * solid.lame + 2.0 * solid.mu) / (solid.lame + solid.mu)
    elasticity = {"material": solid.material, "young_modulus": young, "poisson_ratio": _poisson_ratio(solid)}
    fine = QuadraticTetrahedra(nodes, tetrahedra, **elasticity)
    exact = _compliances(type(model)(nodes, [fine], fixed=fine_held, solver=model.solver))
    coarse = type(solid)(model.nodes, solid.connectivity, **elasticity)
    free = exact > 0.0  # axes along which something can move
    found = _compliances(type(model)(model.nodes, [coarse], fixed=held, solver=model.solver))
    return float((1.0 - found[free] / exact[free]).max(initial=0.0))


def _poisson_ratio(solid: SolidBlock) -> np.ndarray:
    return 0.5 * solid.lame / (solid.lame + solid.mu)


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


def warn_of_locking(model: Body, *, stacklevel: int = 4) -> None:
    """Warn if elements that were asked for miss much of a body's compliance; see `missing_compliance`."""
    if _accepted.get():
        return
    for number, solid in enumerate(model.solids):
        if solid.element in ("", "quadratic"):
            continue
        where = f" of solid {number}" if len(model.solids) > 1 else ""
        missing = missing_compliance(model, number)
        if missing is None and np.max(_poisson_ratio(solid)) > NEARLY_INCOMPRESSIBLE:
            said = f"near a Poisson's ratio of 0.5, here {np.max(_poisson_ratio(solid)):g}, and in thin walls"
        elif missing is not None and missing > TOLERATED:
            said = f"on this mesh{where}: under a uniform load the body gives way by {100 * missing:.0f} % less"
            said += " than with element='quadratic', the default"
        else:
            continue
        warnings.warn(f"{solid.element} elements lock {said}", LockingWarning, stacklevel=stacklevel)
        return

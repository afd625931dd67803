"""Compiled solvers of bodies of one kind, which installed packages add; the general solver needs none."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from softgym_envs.registry import Registry

if TYPE_CHECKING:
    from softgym_envs.mechanics.assembly import MassMatrix
    from softgym_envs.mechanics.contact.contact import ContactMemory, Contacts
    from softgym_envs.mechanics.model import MechanicalModel


class MarchedSteps(NamedTuple):
    """Time steps, or increments towards an equilibrium, that were taken in one call.

    Attributes:
        taken: how many of them were taken.
        solved: whether all were.
        x: rows at the end [m], shape (n, 3).
        velocity: of the rows [m/s], shape (n, 3).
        effort: of all constraint rows, shape (size,).
        delta: their values, shape (size,).
        compliance: ``W`` at the end, shape (size, size).
        kinetic: kinetic energy at the end [J].
        elastic: energy stored in elements and contacts at the end [J].
        work: done by efforts on these steps [J].
        dissipated: by damping and friction on these steps [J].
        iterations: Newton iterations of the last time step.
        stable: whether the tangent at the end is positive definite.
        parts: of the last time step.
        slides: whether points slide at the end, so that ``W`` is not symmetric.
        contacts: where the body touches at the end; None for a body that touches nothing.
        memory: what friction remembers; None likewise.
    """

    taken: int
    solved: bool
    x: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    delta: np.ndarray
    compliance: np.ndarray
    kinetic: float
    elastic: float
    work: float
    dissipated: float
    iterations: int
    stable: bool
    parts: int
    slides: bool
    contacts: Contacts | None
    memory: ContactMemory | None


class CompiledSolver(ABC):
    """Time steps and equilibria of one body, the same as those of the general solver.

    Args:
        model: a body against which there is no reason.
        mass: its mass matrix.

    Attributes:
        elasticity_version: of the model when this was made.
    """

    elasticity_version: int

    @abstractmethod
    def __init__(self, model: MechanicalModel, mass: MassMatrix) -> None: ...

    @classmethod
    @abstractmethod
    def reason_against(cls, model: MechanicalModel, *, moving: bool) -> str | None:
        """Return why a body, that moves in time or not, needs the general solver; None for one solved here."""

    @classmethod
    def batch_class(cls, robot: Any, options: Mapping[str, object]) -> str | None:
        """Return the path of a `BatchBackend` for bodies of a robot on finite elements; None for nothing."""
        return None

    @abstractmethod
    def march(self, *arguments: Any, **options: Any) -> MarchedSteps:
        """Take time steps until one cannot be solved."""

    @abstractmethod
    def balance(self, *arguments: Any, **options: Any) -> MarchedSteps:
        """Find the equilibrium near a state; no step is taken where none is found."""


SOLVERS = Registry(
    "compiled solver",
    {},
    base="softgym_envs.mechanics.solvers.compiled:CompiledSolver",
    group="softgym_envs.solvers",
)
"""Compiled solvers of installed packages by name."""


def compiled_solver(model: MechanicalModel, *, moving: bool) -> type[CompiledSolver] | str:
    """Return the compiled solver of a body, or why it needs the general one.

    Args:
        model: the body.
        moving: whether it moves in time.
    """
    if len(model.solids) == len(model.blocks):
        return "it has no beams"
    reason = "no compiled solver is installed"
    for solver in SOLVERS.values():
        found = solver.reason_against(model, moving=moving)
        if found is None:
            made: type[CompiledSolver] = solver
            return made
        reason = found
    return reason

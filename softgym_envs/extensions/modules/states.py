"""States of modules under load, from finite elements: what superelements learn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.modules.base import Module
from softgym_envs.extensions.modules.superelement import QuadraticEnergy, Superelement
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.frames import frame_rows
from softgym_envs.mechanics.solvers.statics import Statics

MODULUS = 1.0e7
"""Young's modulus of the learned states [Pa]; the energy of a module is proportional to it."""

LARGEST_SINE = 0.8
"""Largest sine of the rotation of the far port; the strains are unique up to 90 degrees."""


@dataclass(frozen=True)
class ModuleStates:
    """Equilibria of bodies of one module. Energies are divided by Young's modulus and the cube of the length.

    Attributes:
        designs: dimensions of the body of each state, without its material, shape (n, v).
        strain: those of a superelement, the first three over the length, shape (n, 6).
        gradient: of the energy in the strains, shape (n, 6).
        hessian: of the energy in the strains, shape (n, 6, 6).
        swelling: derivative of the volume of the cavity by the strains over the cube of the length, shape (n, 6); zero
            for modules that are not closed.
        bulge: growth of that volume under a pressure with the ports held, times Young's modulus over the cube of the
            length, shape (n,).
    """

    designs: np.ndarray
    strain: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    swelling: np.ndarray
    bulge: np.ndarray

    def __len__(self) -> int:
        return len(self.strain)

    def rows(self, index: np.ndarray) -> ModuleStates:
        """Return some of the states."""
        return ModuleStates(*(getattr(self, f.name)[index] for f in fields(self)))

    def joined(self, other: ModuleStates) -> ModuleStates:
        """Return these states and others of the same module."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return ModuleStates(*(np.concatenate(pair) for pair in pairs))


def solve_states(
    module: Module,
    designs: np.ndarray,
    names: tuple[str, ...],
    *,
    rotation: float,
    rays: int,
    rng: np.random.Generator,
    more: Mapping[str, float] | None = None,
    refine: float = 1.0,
) -> ModuleStates:
    """Return the states of bodies at rest, and under half and full loads in random directions.

    The largest moment of a body is the one that would turn its softest rotation by ``rotation``, by its compliance at
    rest; the largest force is that moment over half the length. Such loads occur in structures of modules that are
    about as soft: soft motions become large and stiff ones stay small. Loads at which the body is unstable, turns by
    more than 53 degrees or is not found are left out.

    Args:
        module: the module.
        designs: dimensions of the bodies, shape (b, v).
        names: of the dimensions.
        rotation: [rad].
        rays: number of random directions for each body.
        rng: draws the directions.
        more: other variables of all designs.
        refine: see `Module.body`.
    """
    kept: list[tuple[Any, ...]] = []
    for row in designs:
        design = dict(zip(names, row, strict=True)) | dict(more or {}) | {"young_modulus": MODULUS}
        length = module.length(module.design_space.complete(design))
        solver = Statics(module.model(design, refine=refine))
        # A closed module has no pressure, which would be its seventh effort.
        rest = solver.solve(np.zeros(6 + module.closed), "effort").condensed
        kept.append((row, *in_strains(rest, length)))
        moment = rotation / np.diag(rest.W.aa)[3:6].max()
        scale = np.array([2.0 * moment / length] * 3 + [moment] * 3)
        for _ in range(rays):
            direction = rng.normal(size=6)
            load = scale * (direction / np.linalg.norm(direction))
            # At the middle of the module, where forces do not bend: the moments are those of the far port there.
            load[3:5] += 0.5 * length * np.array([load[1], -load[0]])
            for share in (0.5, 1.0):
                try:
                    found = solver.solve(np.append(share * load, np.zeros(int(module.closed))), "effort")
                except ConvergenceError:
                    break
                if not found.stable:
                    break
                if np.linalg.norm(found.condensed.delta.a[3:6]) > LARGEST_SINE:
                    break
                kept.append((row, *in_strains(found.condensed, length)))
    return ModuleStates(*(np.array(column) for column in zip(*kept, strict=True)))


def pose_rows(pose: np.ndarray, length: float) -> np.ndarray:
    """Return the rows (8, 3) of two frames: the near one at rest, and the far one in a pose (6,); see `Pose`."""
    axial = pose[3:]
    cosine = np.sqrt(max(1.0 - axial @ axial, 0.0))
    skew = np.array([[0.0, -axial[2], axial[1]], [axial[2], 0.0, -axial[0]], [-axial[1], axial[0], 0.0]])
    rotation = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return np.vstack([frame_rows(np.zeros(3)), frame_rows(pose[:3] + [0.0, 0.0, length], rotation)])


def in_strains(state: CondensedModel, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Turn a state over a far port's pose into one over strains: the fields of `ModuleStates`."""
    effort, W = state.lambda_.a[:6], state.W.aa
    pose = state.delta.a[:6] if effort.any() else np.zeros(6)  # at rest without round-off
    tangent = np.linalg.inv(W[:6, :6])
    scale = np.array([length] * 3 + [1.0] * 3)
    rest = pose_rows(np.zeros(6), length)
    element = Superelement(rest, np.array([0, 4]), energy=QuadraticEnergy(np.eye(6)), length=length)

    def strain(p: np.ndarray) -> np.ndarray:
        return element.strains(pose_rows(p, length)) / scale

    # Central differences of an exact function: errors of about 1e-9 (first) and 1e-6 (second derivatives).
    step = 1e-4
    units = step * np.diag(scale)
    jacobian = np.stack([(strain(pose + u) - strain(pose - u)) / (2.0 * step) for u in units], axis=1)
    bend = np.empty((6, 6, 6))
    for j, u in enumerate(units):
        for k, v in enumerate(units):
            corners = strain(pose + u + v) - strain(pose + u - v) - strain(pose - u + v) + strain(pose - u - v)
            bend[:, j, k] = corners / (4.0 * step**2)
    unit = MODULUS * length**3
    inverse = np.linalg.inv(jacobian)
    gradient = inverse.T @ (scale * effort) / unit
    hessian = scale[:, None] * tangent * scale / unit - np.einsum("i,ijk->jk", gradient, bend)
    swelling, bulge = np.zeros(6), 0.0
    if len(W) > 6:
        by_pose = W[6, :6] @ tangent
        swelling = inverse.T @ (scale * by_pose) / length**3
        bulge = float(W[6, 6] - by_pose @ W[:6, 6]) * MODULUS / length**3
    return strain(pose), gradient, inverse.T @ hessian @ inverse, swelling, bulge

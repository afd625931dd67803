"""The modular arm on superelements whose energies are exact, condensed from finite elements of each module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgym_envs.extensions.modules.modular_arm import ModularArm
from softgym_envs.extensions.modules.superelement import Superelement
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium


@dataclass(frozen=True)
class Expanded:
    """Energy of a module to second order about one state, where its force and its stiffness are exact.

    Attributes:
        strains: of the state [m, 1], shape (6,).
        gradient: of the energy at the state, shape (6,) [N, N m].
        hessian: of the energy at the state, shape (6, 6).
    """

    strains: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def evaluate(self, strains: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        off = strains - self.strains
        force = self.gradient + self.hessian @ off
        return 0.5 * float((self.gradient + force) @ off), force, self.hessian

    def knows(self, strains: np.ndarray) -> bool:
        return True


CHANGE = 1e-8
"""Largest change of the frames of an exact arm [m, 1] by its last step."""


def superelements(model: MechanicalModel) -> list[Superelement]:
    """Return the superelements of an arm from the base to the tip."""
    return [block for block in model.blocks if isinstance(block, Superelement)]


class ExactArm:
    """An arm of superelements whose energies are exact where it is: condensed from finite elements of each module.

    Its equilibria and condensed models are those of the finite elements of the whole body, because the ports are rigid.

    Args:
        cells: from the base to the tip.
        design: complete.

    Attributes:
        model: the arm.
        names: of its modules.
        designs: of its modules.
    """

    def __init__(self, cells: Sequence[str], design: Mapping[str, float]) -> None:
        from softgym_envs.extensions.modules import MODULES, learned_module
        from softgym_envs.extensions.modules.modular_arm import CELLS
        from softgym_envs.mechanics.solvers.statics import Statics

        self.model = ModularArm(cells=cells).build(design)
        self.names = [CELLS[cell][0] for cell in cells]
        self.designs = [
            {dimension: design[f"{dimension}_{number}"] for dimension in learned_module(name).box}
            | {"young_modulus": design["young_modulus"]}
            for number, name in enumerate(self.names, start=1)
        ]
        self._axes = [CELLS[cell][1] for cell in cells]
        self._parts = [Statics(MODULES[n]().model(own)) for n, own in zip(self.names, self.designs, strict=True)]

    def energies(self, x: np.ndarray) -> list[Expanded]:
        """Return the energy of each module about a state with frames ``x`` (n, 3), its ports held where they are."""
        from softgym_envs.extensions.modules.states import MODULUS, in_strains

        found = []
        for part, block, axes in zip(self._parts, superelements(self.model), self._axes, strict=True):
            near, far = np.split(x[block.rows], 2)
            turned = near[1:].T @ axes
            rows = part.model.nodes.copy()
            rows[-4] = (far[0] - near[0]) @ turned
            rows[-3:] = axes.T @ far[1:] @ turned
            pose = np.concatenate([constraint.value(rows) for constraint in part.model.constraints["a"]])
            strain, gradient, hessian, *_ = in_strains(part.solve(pose).condensed, block.length)
            scale, unit = np.array([block.length] * 3 + [1.0] * 3), MODULUS * block.length**3
            found.append(Expanded(scale * strain, unit * gradient / scale, unit * hessian / np.outer(scale, scale)))
        return found

    def solve(self, command: np.ndarray, start: Equilibrium) -> tuple[Equilibrium, list[Expanded]]:
        """Return the equilibrium under a command, and the energies about it, by Newton's method from a state."""
        from softgym_envs.mechanics.solvers.statics import Statics

        state = start
        while True:
            energies = self.energies(state.x)
            for block, energy in zip(superelements(self.model), energies, strict=True):
                block.energy = energy
            solver, last = Statics(self.model), state.x
            solver.restore(state.x, state.effort)
            state = solver.solve(command)
            if np.abs(state.x - last).max() < CHANGE:
                return state, energies

"""Superelements of modules: their energy as a function of the motion between their ports and of their dimensions.

The energy has the form of `ModuleEnergy`. Its numbers are polynomials of the logarithms of the dimensions, which are
learned from finite elements (`learning`); Young's modulus scales the energy exactly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.robots.modules.base import Module
from softgym_envs.robots.modules.energy import TERMS, ModuleEnergy
from softgym_envs.robots.modules.registry import MODULES

FORMAT = 1
MEMBER_DEGREES = (2, 1)
"""Degrees of the polynomials of members: a cubic of too few bodies says nothing about the others."""
FOLDER = Path(__file__).parent / "energies"


def polynomials(unit: np.ndarray, degree: int) -> np.ndarray:
    """Return all products of up to ``degree`` of the coordinates (n, v), and one, as columns (n, p)."""
    columns = [np.ones(len(unit))]
    for k in range(1, degree + 1):
        columns += [unit[:, list(f)].prod(axis=1) for f in combinations_with_replacement(range(unit.shape[1]), k)]
    return np.column_stack(columns)


@dataclass(frozen=True)
class LearnedModule:
    """The energy of all bodies of a module.

    Attributes:
        module: name in `MODULES`.
        box: bounds of each dimension [m] within which it was learned.
        others: the only value of each variable that was not varied, except Young's modulus.
        rotation: angle [rad] that defines the largest load; see `softgym_envs.robots.modules.states.solve_states`.
        stiffness: weights of the logarithm of ``k``, shape (p, 6).
        corrections: weights of ``c``, shape (q, len(TERMS)).
        errors: those on bodies that were not used, as `learning.errors` returns them.
        degrees: of the polynomials of ``stiffness`` and ``corrections``.
        members: ``(stiffness, corrections)`` of fits to parts of the bodies, whose differences tell where the energy is
            not known; none in files of older modules. Their polynomials have `MEMBER_DEGREES`.
    """

    module: str
    box: Mapping[str, tuple[float, float]]
    others: Mapping[str, float]
    rotation: float
    stiffness: np.ndarray
    corrections: np.ndarray
    errors: Mapping[str, Mapping[str, float]]
    degrees: tuple[int, int]
    members: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def unit(self, designs: np.ndarray) -> np.ndarray:
        """Map dimensions (n, v) to [-1, 1] on a logarithmic scale."""
        low, high = np.log(np.array(list(self.box.values()))).T
        return (2.0 * np.log(designs) - low - high) / (high - low)

    def energy(self, design: Mapping[str, float] | None = None, *, beyond: bool = False) -> ModuleEnergy:
        """Return the energy of a body; missing variables take their baseline.

        Args:
            design: the body.
            beyond: allow dimensions outside the box; the spread of the members says what the energy is worth there.

        Raises:
            DesignError: for a malformed design, or one outside the box; with ``beyond``, if there are no members.
        """
        module: Module = MODULES[self.module]()
        complete = module.design_space.complete(design)
        for name, (low, high) in self.box.items():
            inside = low * (1.0 - 1e-6) <= complete[name] <= high * (1.0 + 1e-6)
            if not inside and not (beyond and self.members):
                raise DesignError(
                    f"superelement '{self.module}' was learned for {name} from {low:g} to {high:g} m, "
                    f"got {complete[name]:g} m"
                )
        for name, value in self.others.items():
            if not np.isclose(complete[name], value, rtol=1e-6):
                raise DesignError(
                    f"superelement '{self.module}' was learned for {name} = {value:g} only, got {complete[name]:g}"
                )
        unit = self.unit(np.array([[complete[name] for name in self.box]]))
        length = module.length(complete)

        def numbers(
            stiffness: np.ndarray, corrections: np.ndarray, degrees: tuple[int, int]
        ) -> tuple[np.ndarray, np.ndarray]:
            k = complete["young_modulus"] * length**3 * np.exp(polynomials(unit, degrees[0]) @ stiffness)[0]
            return k, (polynomials(unit, degrees[1]) @ corrections)[0]

        members = [numbers(*member, MEMBER_DEGREES) for member in self.members]
        return ModuleEnergy(
            length, *numbers(self.stiffness, self.corrections, self.degrees), self.rotation, members=members
        )

    def save(self, path: str | Path) -> None:
        """Write the superelement as JSON, for `load_module`."""
        record = {"format": FORMAT, **asdict(self)}
        record |= {name: np.round(getattr(self, name), 8).tolist() for name in ("stiffness", "corrections")}
        record["members"] = [[np.round(part, 5).tolist() for part in member] for member in self.members]
        Path(path).write_text(json.dumps(record) + "\n")


def load_module(path: str | Path) -> LearnedModule:
    """Return the superelement in a JSON file.

    Raises:
        WeightsError: if the file is missing, or is not one.
    """
    path = Path(path)
    try:
        record = json.loads(path.read_text())
        if record.pop("format") != FORMAT:
            raise ValueError(f"it does not have format {FORMAT}")
        record["box"] = {name: (float(low), float(high)) for name, (low, high) in record["box"].items()}
        record["degrees"] = tuple(record["degrees"])
        for name in ("stiffness", "corrections"):
            record[name] = np.array(record[name], dtype=float)
        record["members"] = tuple((np.array(k), np.array(c)) for k, c in record.get("members", ()))
        for corrections in (record["corrections"], *(c for _, c in record["members"])):
            if corrections.shape[-1] != len(TERMS):
                raise ValueError(f"it has {corrections.shape[-1]} corrections, needed {len(TERMS)}")
        return LearnedModule(**record)
    except FileNotFoundError:
        raise WeightsError(f"superelement '{path}' does not exist; learn it with `learn_module`") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise WeightsError(f"superelement '{path}' is damaged: {error}") from None


@cache
def learned_module(name: str) -> LearnedModule:
    """Return the learned superelement of a module that comes with the package.

    Raises:
        WeightsError: if none has been learned for the module.
    """
    return load_module(FOLDER / f"{name}.json")

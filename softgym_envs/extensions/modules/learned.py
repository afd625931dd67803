"""Superelements of modules: their energy as a function of the motion between their ports and of their dimensions.

The energy has the form of `ModuleEnergy`. Its numbers are polynomials of the logarithms of the dimensions, which are
learned from finite elements (`learning`); Young's modulus scales the energy exactly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.extensions.modules.base import Module
from softgym_envs.extensions.modules.energy import CavityVolume, ModuleEnergy, terms
from softgym_envs.extensions.modules.registry import MODULES

EDGE = 0.5
"""A dimension counts as being at its bound within this part of half its range, linearly from 0 to 1."""

FORMAT = 1
_ARRAYS = ("stiffness", "corrections", "largest_strains", "swelling", "bulge")
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
        rotation: angle [rad] that defines the largest load; see `softgym_envs.extensions.modules.states.solve_states`.
        stiffness: weights of the logarithm of ``k``, shape (p, 6).
        corrections: weights of ``c``, shape (q, len(terms)).
        largest_strains: size of each strain of the states, the first three over the length, shape (6,).
        errors: those on bodies that were not used, as `learning.errors` returns them.
        bounds: on the error of each strain relative to the size of all, ``"inside"`` the box and at its ``"corners"``,
            shape (6,), as `learning.calibrated` finds them; without them, the errors count as zero.
        degrees: of the polynomials of ``stiffness`` and ``corrections``.
        swelling: weights of the coefficients of `energy.CavityVolume`, shape (p, m); none if the module is not closed.
        bulge: weights of the logarithm of its ``bulge``, shape (p,); likewise.
        order: of the corrections; see `energy.terms`.
    """

    module: str
    box: Mapping[str, tuple[float, float]]
    others: Mapping[str, float]
    rotation: float
    stiffness: np.ndarray
    corrections: np.ndarray
    largest_strains: np.ndarray
    errors: Mapping[str, Mapping[str, float]]
    bounds: Mapping[str, np.ndarray]
    degrees: tuple[int, int]
    swelling: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    bulge: np.ndarray = field(default_factory=lambda: np.empty(0))
    order: int = 3

    @property
    def symmetry(self) -> tuple[str, ...]:
        """That of the module; see `Module`."""
        module: type[Module] = MODULES[self.module]
        return module.symmetry

    @property
    def terms(self) -> np.ndarray:
        """The corrections that the symmetry of the module allows, shape (m, order + 1); see `energy.terms`."""
        return terms(self.symmetry, self.order)

    def unit(self, designs: np.ndarray) -> np.ndarray:
        """Map dimensions (n, v) to [-1, 1] on a logarithmic scale."""
        low, high = np.log(np.array(list(self.box.values()))).T
        return (2.0 * np.log(designs) - low - high) / (high - low)

    def energy(self, design: Mapping[str, float] | None = None) -> ModuleEnergy:
        """Return the energy of a body; missing variables take their baseline.

        Raises:
            DesignError: for a malformed design, or one outside the box.
        """
        length, modulus, unit = self._body(design)
        modulus *= length**3
        P, Q = (polynomials(unit, degree)[0] for degree in self.degrees)
        return ModuleEnergy(
            length,
            modulus * np.exp(P @ self.stiffness),
            Q @ self.corrections,
            self.symmetry,
            self.order,
            self.rotation,
            self.largest_strains,
            self.error_bounds(unit[0]),
        )

    def edge_share(self, unit: np.ndarray) -> np.ndarray:
        """Return the share of dimensions at the bounds of the box, of bodies (..., v) in [-1, 1]; see `EDGE`."""
        return np.clip((np.abs(unit) - 1.0) / EDGE + 1.0, 0.0, 1.0).mean(axis=-1)

    def error_bounds(self, unit: np.ndarray) -> np.ndarray:
        """Return the bounds (..., 6) on the error of each strain over the size of all, of bodies (..., v) in [-1, 1].

        Their logarithms are linear in the share of dimensions at their bounds, as in `softgym_envs.surrogate.domain`.
        """
        if not self.bounds:
            return np.zeros((*unit.shape[:-1], 6))
        share = self.edge_share(unit)[..., None]
        return self.bounds["inside"] ** (1.0 - share) * self.bounds["corners"] ** share

    def cavity(self, design: Mapping[str, float] | None = None) -> CavityVolume:
        """Return how the volume of the cavity of a body grows; see `energy`.

        Raises:
            ValueError: if the module has no closed cavity.
        """
        if not len(self.swelling):
            raise ValueError(f"module '{self.module}' has no closed cavity")
        length, modulus, unit = self._body(design)
        P = polynomials(unit, self.degrees[0])[0]
        bulge = length**3 / modulus * float(np.exp(P @ self.bulge))
        return CavityVolume(length, length**3 * (P @ self.swelling), bulge, self.symmetry)

    def _body(self, design: Mapping[str, float] | None) -> tuple[float, float, np.ndarray]:
        """Return the length [m] and Young's modulus [Pa] of a body, and its dimensions in [-1, 1], shape (1, v)."""
        module: Module = MODULES[self.module]()
        complete = module.design_space.complete(design)
        for name, (low, high) in self.box.items():
            if not low * (1.0 - 1e-6) <= complete[name] <= high * (1.0 + 1e-6):
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
        return module.length(complete), complete["young_modulus"], unit

    def save(self, path: str | Path) -> None:
        """Write the superelement as JSON, for `load_module`."""
        record = {"format": FORMAT, **asdict(self)}
        record |= {name: np.round(getattr(self, name), 8).tolist() for name in _ARRAYS}
        record["bounds"] = {place: np.round(bound, 8).tolist() for place, bound in self.bounds.items()}
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
        # Files of earlier versions do not limit strains, and have no calibrated bounds.
        record.setdefault("largest_strains", [np.inf] * 6)
        record["bounds"] = {place: np.array(bound) for place, bound in record.get("bounds", {}).items()}
        for name in _ARRAYS:
            if name in record:
                record[name] = np.array(record[name], dtype=float)
        found = LearnedModule(**record)
        if found.corrections.shape[-1] != len(found.terms):
            raise ValueError(f"it has {found.corrections.shape[-1]} corrections, needed {len(found.terms)}")
        return found
    except FileNotFoundError:
        raise WeightsError(f"superelement '{path}' does not exist; learn it with `learn_module`") from None
    except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError) as error:
        raise WeightsError(f"superelement '{path}' is damaged: {error}") from None


@cache
def learned_module(name: str) -> LearnedModule:
    """Return the learned superelement of a module that comes with the package.

    Raises:
        WeightsError: if none has been learned for the module.
    """
    return load_module(FOLDER / f"{name}.json")

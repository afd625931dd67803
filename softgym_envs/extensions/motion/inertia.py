"""Learned inertia: how slowly a body moves in the coordinates of its condensed model.

Static reduction of a body gives the mass ``M`` about an equilibrium in its constraint values and its inner modes. The
mass follows from the compliance ``W`` of a learned model and from the matrix of squared periods, ``P = K^-1/2 M
K^-1/2`` with ``K = diag(W^-1, 1)`` and the roots of `half_stiffness`: its eigenvalues are ``1 / omega^2`` of the free
body [s2]. They change far less from body to body than masses do, and they are all that is learned here: the logarithm
of the diagonal of the Cholesky factor of ``P`` and its other entries, relative to that diagonal, are polynomials of the
design and of the reached displacements, so ``P`` is positive definite everywhere.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import WeightsError
from softgym_envs.robots.base import Robot
from softgym_envs.runs import provenance
from softgym_envs.storage import atomic_write
from softgym_envs.surrogate.features import Features
from softgym_envs.surrogate.weight_files import card_of, check_box

FILE = "inertia.safetensors"
BEYOND = 1.1
"""Where polynomials are held constant beyond the learned ranges, which end at -1 and 1: slack cables reach there."""


class Polynomials:
    """All monomials of some inputs up to a degree.

    Args:
        inputs: number of inputs.
        degree: largest degree, at least 1.
    """

    def __init__(self, inputs: int, degree: int) -> None:
        self.inputs, self.degree = inputs, degree
        # Each monomial of a degree is one of the degree below times an input.
        self._factors: list[tuple[np.ndarray, np.ndarray]] = []
        below: dict[tuple[int, ...], int] = {(i,): i for i in range(inputs)}
        for order in range(2, degree + 1):
            present = list(combinations_with_replacement(range(inputs), order))
            self._factors.append((np.array([below[m[:-1]] for m in present]), np.array([m[-1] for m in present])))
            below = {m: k for k, m in enumerate(present)}

    @property
    def count(self) -> int:
        """Number of monomials."""
        return 1 + self.inputs + sum(len(first) for first, _ in self._factors)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the monomials (B, count) of inputs (B, inputs)."""
        parts = [np.ones((len(x), 1)), x]
        for first, second in self._factors:
            parts.append(parts[-1][:, first] * x[:, second])
        return np.concatenate(parts, axis=1)


def to_entries(matrices: np.ndarray) -> np.ndarray:
    """Return unbounded entries (B, k (k + 1) / 2) that stand for positive definite matrices (B, k, k)."""
    lower = np.linalg.cholesky(matrices)
    own = np.diagonal(lower, axis1=1, axis2=2)
    relative = lower / np.sqrt(own[:, :, None] * own[:, None, :])
    rows, columns = np.tril_indices(matrices.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rows == columns, np.log(lower[:, rows, columns]), relative[:, rows, columns])


def from_entries(entries: np.ndarray) -> np.ndarray:
    """Return the positive definite matrices (B, k, k) of entries; the inverse of `to_entries`."""
    k = int((np.sqrt(8 * entries.shape[1] + 1) - 1) / 2)
    rows, columns = np.tril_indices(k)
    lower = np.zeros((len(entries), k, k))
    own = np.exp(entries[:, rows == columns])
    lower[:, rows, columns] = np.where(rows == columns, 1.0, entries) * np.sqrt(own[:, rows] * own[:, columns])
    return lower @ lower.swapaxes(1, 2)


def typical_sizes(robot: Robot) -> np.ndarray:
    """Return the unit in which each constraint value is seen: ranges of actuators, the robot's size for effectors."""
    return np.concatenate([robot.upper - robot.lower, np.full(3 * len(robot.effectors), robot.size)])


def root(matrix: np.ndarray, power: float = 0.5) -> np.ndarray:
    """Return the symmetric power of symmetric positive definite matrices (..., n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values[..., None, :] ** power) @ np.swapaxes(vectors, -1, -2)


def half_stiffness(W: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return ``H`` (..., n, n) with ``H H^T = W^-1``, symmetric over constraint values in units of ``sizes`` (n,)."""
    return root(W / np.outer(sizes, sizes), -0.5) / sizes[:, None]


class LearnedInertia:
    """Squared periods of the bodies of a robot, for NumPy arrays with a leading batch dimension.

    Args:
        robot: the robot.
        coefficients: of the monomials, shape (terms, entries).
        degree: of the polynomials.
        card: what else the file says.

    Attributes:
        order: number of coordinates: constraint values and as many inner modes.
        sizes: see `typical_sizes`, shape (order / 2,).

    Raises:
        ValueError: if the coefficients do not fit the robot.
    """

    def __init__(self, robot: Robot, coefficients: np.ndarray, degree: int, card: Mapping[str, Any]) -> None:
        box = {name: (low, high) for name, (low, high, _) in card.get("design_variables", {}).items()}
        self.robot, self.card, self.degree = robot, dict(card), degree
        self.features = Features(robot, bounds=box)
        self.monomials = Polynomials(self.features.design_size + len(robot.actuators), degree)
        self.coefficients = np.asarray(coefficients, dtype=float)
        self.sizes = typical_sizes(robot)
        self.order = 2 * (len(robot.actuators) + 3 * len(robot.effectors))
        needed = (self.monomials.count, self.order * (self.order + 1) // 2)
        if self.coefficients.shape != needed:
            raise ValueError(f"coefficients of the inertia have shape {self.coefficients.shape}, needed {needed}")

    def body(self, designs: np.ndarray) -> np.ndarray:
        """Return what `periods` needs to know of bodies (B, number of design variables), shape (B, design_size + 1).

        These are their scaled designs, and their stiffness relative to the baseline.
        """
        return np.concatenate([self.features.design(designs), self.features.stiffness(designs)], axis=1)

    def inputs(self, body: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return the inputs of the polynomials for bodies, from `body`, at displacements (B, n_a)."""
        x = np.concatenate([body[:, :-1], self.features.actuation(displacement)], axis=1)
        return np.clip(x, -BEYOND, BEYOND)

    def periods(self, body: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return the squared periods ``P`` [s2] (B, order, order) of bodies at displacements (B, n_a)."""
        entries = self.monomials(self.inputs(body, displacement)) @ self.coefficients
        return from_entries(entries) / body[:, -1, None, None]


def write_inertia(inertia: LearnedInertia, folder: str | Path) -> None:
    """Write a learned inertia beside the weights of a model, with the provenance of this run."""
    from safetensors.numpy import save

    values = inertia.coefficients.astype(np.float32)
    card = {**inertia.card, "degree": inertia.degree, "sha256": _hash(values), "provenance": provenance()}
    with atomic_write(Path(folder) / FILE) as stream:
        stream.write(save({"coefficients": values}, {"card": json.dumps(card)}))


def _hash(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def read_inertia(folder: str | Path, robot: Robot) -> LearnedInertia:
    """Read the learned inertia in a folder of weights.

    Raises:
        WeightsError: if there is none, or it is damaged, for another robot or for a design box that does not contain
            that of the robot.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(folder) / FILE
    if not path.is_file():
        raise WeightsError(
            f"robot '{robot.learning.weights}' has no learned inertia '{path}', which motion on the surrogate needs: "
            "use backend='fem' or dynamics=False, or learn it with 'softgym fit-inertia'"
        )
    try:
        with safe_open(path, "numpy") as file:
            card = json.loads(file.metadata()["card"])
            coefficients = file.get_tensor("coefficients")
        if not np.isfinite(coefficients).all():
            raise ValueError("values are not finite")
        if card.get("sha256") != _hash(coefficients):
            raise ValueError("values are not those of its card (SHA-256)")
        if card["robot"] != robot.name or card["mechanics_key"] != robot.mechanics_key:
            raise WeightsError(
                f"inertia '{path}' was learned for another robot: {card['robot']} {card['mechanics_key']}, needed "
                f"{robot.name} {robot.mechanics_key}"
            )
        check_box(path.name, card["design_variables"], card_of(robot, "inertia")["design_variables"])
        return LearnedInertia(robot, coefficients, int(card["degree"]), card)
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise WeightsError(f"inertia '{path}' is damaged: {error}") from None

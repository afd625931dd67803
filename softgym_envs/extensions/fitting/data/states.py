"""Datasets as the matrices on which networks are trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from softgym_envs.errors import DataError
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.features import Features

#: States whose actuators are more than this many times softer than at rest are not learned.
GROWTH = 10.0


@dataclass(frozen=True)
class States:
    """Condensed models of N equilibria; efforts and compliances are those at the baseline stiffness.

    Sensor rows are divided by `Features.units`, so that all rows are of similar size.

    Attributes:
        design: features of the design, shape (N, d).
        actuation: scaled displacements, shape (N, n_a).
        displacement: reached actuator displacements, shape (N, n_a).
        effort: shape (N, n_a).
        effector: and sensor rows, shape (N, n_e).
        W: compliance, shape (N, n, n).
        rest_of: row of the state at rest of the same body, shape (N,).
    """

    design: np.ndarray
    actuation: np.ndarray
    displacement: np.ndarray
    effort: np.ndarray
    effector: np.ndarray
    W: np.ndarray
    rest_of: np.ndarray

    def __len__(self) -> int:
        return len(self.effort)

    @property
    def rest_rows(self) -> np.ndarray:
        """Rows of the states at rest, one per body."""
        return np.unique(self.rest_of)

    @property
    def unloaded(self) -> bool:
        """Whether every body is at rest without effort and at zero displacement."""
        rows = self.rest_rows
        return bool(np.abs(self.displacement[rows]).max() < 1e-9 and np.abs(self.effort[rows]).max() < 1e-9)

    @property
    def entries(self) -> np.ndarray:
        """Outputs of the thesis' networks: the upper triangle of W, row by row, then delta_free, shape (N, k)."""
        effort = np.concatenate([self.effort, np.zeros_like(self.effector)], axis=1)
        delta = np.concatenate([self.displacement, self.effector], axis=1)
        free = delta - np.einsum("bij,bj->bi", self.W, effort)
        return np.concatenate([self.W[:, *np.triu_indices(self.W.shape[1])], free], axis=1)

    def rows(self, index: np.ndarray) -> States:
        """Return some of the states, for networks that ignore rest states: each is listed as its own state at rest."""
        parts = {f.name: getattr(self, f.name)[index] for f in fields(self)}
        parts["rest_of"] = np.arange(len(parts["effort"]))
        return States(**parts)


def full_compliance(upper: np.ndarray, size: int) -> np.ndarray:
    """Return symmetric matrices (N, size, size) from upper triangles, row by row (N, size (size + 1) / 2)."""
    W = np.empty((len(upper), size, size))
    rows, columns = np.triu_indices(size)
    W[:, rows, columns] = upper
    W[:, columns, rows] = upper
    return W


def with_images(robot: Robot, data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a dataset, followed by the images of its states under each of the robot's `Learning.symmetries`."""
    data = dict(data)
    if not robot.learning.symmetries:
        return data
    count, coordinates = data["effort"].shape[1], data["effector"].shape[1]
    size = count + coordinates
    W, upper, parts = full_compliance(data["compliance"], size), np.triu_indices(size), [data]
    for symmetry in robot.learning.symmetries:
        turn = np.zeros((size, size))
        turn[np.arange(count), symmetry.order] = 1.0
        turn[count:, count:] = symmetry.rows(coordinates // 3)
        parts.append(
            {
                **data,
                "displacement": data["displacement"][:, symmetry.order],
                "effort": data["effort"][:, symmetry.order],
                "effector": symmetry.positions(data["effector"]),
                "compliance": (turn @ W @ turn.T)[:, *upper],
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in data}


def stable_rows(robot: Robot, data: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which equilibria of a dataset are stable enough to be learned, shape (N,).

    States whose W is not positive definite are unstable even with their actuators held (volume-driven chambers can
    buckle). States whose compliance between actuators is more than `GROWTH` times that at rest, in any direction, are
    about to buckle: W is nearly singular there, and a smooth model cannot represent that. All states of a body that is
    unstable at rest are left out. For robots whose energy is not convex (`Learning.convex`), states that are stable
    only while their actuators are held are included.

    Raises:
        DataError: if the dataset does not begin with a state at rest.
    """
    rest = data["rest"].astype(bool)
    if len(rest) == 0 or not rest[0]:
        raise DataError("the dataset does not begin with a rest state")
    count = data["effort"].shape[1]
    W = (
        full_compliance(data["compliance"], count + data["effector"].shape[1])
        * Features(robot).stiffness(data["design"])[:, :, None]
    )
    a, e = slice(0, count), slice(count, None)
    scale = np.sqrt(np.abs(np.einsum("bii->bi", W)).mean(axis=0))
    rest_of = np.flatnonzero(rest)[np.cumsum(rest) - 1]
    convex = np.linalg.eigvalsh((W / scale[:, None] / scale)[:, a, a])[:, 0] > 1e-9
    stable = convex if robot.learning.convex else convex[rest_of]
    # The compliance with held actuators may be zero (in rigid directions) but not negative.
    held = W[:, e, e] - W[:, e, a] @ np.linalg.solve(W[:, a, a], W[:, a, e])
    least = np.linalg.eigvalsh(0.5 * (held + held.swapaxes(1, 2)))[:, 0]
    stable &= least > -1e-6 * np.einsum("bii->b", W[:, e, e])
    stable &= stable[rest_of]
    if not robot.learning.convex:
        return stable
    C = np.linalg.cholesky(W[rest_of][stable][:, a, a])
    half = np.linalg.solve(C, W[stable][:, a, a])
    growth = np.linalg.eigvalsh(np.linalg.solve(C, half.swapaxes(1, 2)))[:, -1]
    stable[np.flatnonzero(stable)[growth > GROWTH]] = False
    return stable


def training_states(robot: Robot, data: Mapping[str, np.ndarray], features: Features) -> States:
    """Return the stable states of a dataset as matrices.

    Raises:
        DataError: if the dataset does not begin with a rest state.
    """
    stable = stable_rows(robot, data)
    data = {name: column[stable] for name, column in data.items()}
    factor = features.stiffness(data["design"])
    rest = np.flatnonzero(data["rest"])
    return States(
        design=features.design(data["design"]),
        actuation=features.actuation(data["displacement"]),
        displacement=data["displacement"],
        effort=data["effort"] / factor,
        effector=data["effector"] / features.units[data["effort"].shape[1] :],
        W=full_compliance(data["compliance"], len(features.units))
        * factor[:, :, None]
        / (features.units[:, None] * features.units),
        rest_of=rest[np.cumsum(data["rest"]) - 1],
    )

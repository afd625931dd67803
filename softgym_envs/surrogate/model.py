"""The interface of trained condensed models; they are evaluated by compiled kernels or NumPy, without torch.

Every model maps the reached actuator displacements and the design to efforts, effector positions and the compliance.
Everything that depends on the design alone is computed once per body (`SurrogateModel.context`). All arrays have a
leading batch dimension. The kinds of networks are listed in `softgym_envs.surrogate.networks`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softgym_envs.mechanics.compilation import njit
from softgym_envs.mechanics.condensation import CondensedModel, Roles, Row, point_rows
from softgym_envs.mechanics.solvers.complementarity import solve_rows
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.correction import EffortCorrection
from softgym_envs.surrogate.domain import SOFT, Domain, assess_trust
from softgym_envs.surrogate.features import Features
from softgym_envs.units import effort_unit


@njit(cache=True, error_model="numpy")
def _positive_pivots(a):
    """Return whether a symmetric matrix (n, n), which is overwritten, is positive definite."""
    n = len(a)
    for k in range(n):
        if not a[k, k] > 0.0:
            return False
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, n):
                a[i, j] -= factor * a[k, j]
    return True


@njit(cache=True, error_model="numpy")
def definite(matrices):
    """Return whether symmetric matrices (B, n, n) are positive definite, shape (B,): all pivots are positive."""
    found = np.empty(len(matrices), dtype=np.bool_)
    for row in range(len(matrices)):
        found[row] = _positive_pivots(matrices[row].copy())
    return found


@njit(cache=True, error_model="numpy")
def exceeds_softening(factor, stiffness, unmoved, slot):
    """Return which stiffnesses (B, n, n) are more than ``factor`` times softer than those of their bodies, shape (B,).

    Those of the bodies, ``unmoved`` (S, n, n), are at displacement zero; ``slot`` (B,) is the body of each row. A body
    is softer if it is so in any direction: ``factor * stiffness - unmoved`` is then not positive definite.
    """
    found = np.empty(len(stiffness), dtype=np.bool_)
    for row in range(len(stiffness)):
        found[row] = not _positive_pivots(factor * stiffness[row] - unmoved[slot[row]])
    return found


@dataclass
class Context:
    """Bodies, prepared for a model: everything that does not depend on the actuation.

    Attributes:
        stiffness: what scales all efforts: stiffness relative to the baseline, and the correction, shape (S, 1).
        arrays: arrays of the model with leading dimension S, the number of different bodies.
        slot: index of the body of each of B rows, shape (B,).
    """

    stiffness: np.ndarray
    arrays: dict[str, np.ndarray]
    slot: np.ndarray

    @classmethod
    def shared(cls, one: Context, count: int) -> Context:
        """Return ``count`` rows of one body, which is stored once."""
        return cls(one.stiffness, one.arrays, np.zeros(count, dtype=np.int64))

    def rows(self, index: np.ndarray) -> Context:
        """Return the context of some of the rows, without copying arrays."""
        return Context(self.stiffness, self.arrays, self.slot[index])

    def put(self, index: np.ndarray, other: Context) -> None:
        """Overwrite the bodies of some rows. Afterwards every row has a body of its own."""
        if not self._own:
            self.stiffness = self.stiffness[self.slot]
            self.arrays = {name: array[self.slot] for name, array in self.arrays.items()}
            self.slot = np.arange(len(self.slot))
        target = self.slot[index]
        self.stiffness[target] = other.stiffness[other.slot]
        for name, array in self.arrays.items():
            array[target] = other.arrays[name][other.slot]

    @property
    def _own(self) -> bool:
        """Whether every row has a body of its own, in order."""
        return len(self.stiffness) == len(self.slot) and bool((self.slot == np.arange(len(self.slot))).all())

    def gather(self) -> dict[str, np.ndarray]:
        """Return the arrays of every row, with leading dimension B."""
        if self._own:
            return self.arrays
        return {name: array[self.slot] for name, array in self.arrays.items()}


class SurrogateModel(ABC):
    """A learned condensed model of one robot.

    Args:
        robot: the robot the weights are for.
        tensors: weights by name.
        card: the JSON file that describes the weights, see `weight_files.card_of`.
        members: how many members of the ensemble to use; default all.

    Attributes:
        features: scaling of inputs.
        correction: of the efforts, for the error of the mesh that was learned.
        count: number of actuators n_a.
        effectors: number of effector coordinates n_e.
        sensors: number of sensor rows n_s.
        size: order of W, n_a + n_e + n_s.
        span: a quarter of the actuators' ranges, the unit of steps and tolerances of searches, shape (n_a,).
        domain: where the model may be trusted.
        members: how many members of the ensemble are used; 1 without an ensemble.

    Raises:
        ValueError: if the card or ``members`` does not fit.
    """

    network: ClassVar[str]
    ensemble: ClassVar[bool] = False
    members: int = 1
    senses: ClassVar[bool] = False

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        if members not in (None, 1) and not self.ensemble:
            raise ValueError(f"members = {members} is out of bounds; these weights have one")
        self.robot = robot
        self.tensors = tensors
        self.card = dict(card)
        # Weights of a wide design box also serve a robot with a narrow one.
        learned_box = {name: (low, high) for name, (low, high, _) in self.card.get("design_variables", {}).items()}
        self.features = Features(robot, bounds=learned_box)
        self.correction = EffortCorrection.of_card(self.card, self.features.design_size)
        self.count = len(robot.actuators)
        self.effectors = 3 * len(robot.effectors)
        self.sensors = len(robot.sensing.scale)
        if self.sensors and not self.senses:
            raise ValueError(f"a network of kind '{self.network}' does not learn the sensors of '{robot.name}'")
        self.size = self.count + self.effectors + self.sensors
        self.roles: Roles = (("a", self.count), ("e", self.effectors))
        commanded = [Row(a.name, a.unit, effort_unit(a.unit)) for a in robot.actuators]
        self.rows = (*commanded, *(row for name in robot.effectors for row in point_rows(name)))
        if self.sensors:
            self.roles += (("s", self.sensors),)
            self.rows += tuple(Row(f"sensor {k + 1}", "m3", effort_unit("m3")) for k in range(self.sensors))
        self.span = 0.25 * (robot.upper - robot.lower)
        self.domain = Domain.of_card(self.card, robot)

    def context(self, designs: np.ndarray) -> Context:
        """Prepare bodies, given as designs (B, len(space)) in the order of the design space."""
        features = self.features.design(designs)
        arrays = self._prepare(features)
        low, high = self.domain.design_low, self.domain.design_high
        arrays["known"] = np.all((designs >= low) & (designs <= high), axis=1)
        calibration, share = self.domain.calibration, self.domain.at_bounds(designs)
        arrays["factor"], arrays["corner"] = calibration.body_factors(share, len(self.domain.columns))
        stiffness = self.features.stiffness(designs) * self.correction.factor(features)
        context = Context(stiffness, arrays, np.arange(len(designs)))
        if self.domain.limits_growth:
            arrays["unmoved"] = self._curvature(context, np.zeros((len(designs), self.count)))
            arrays["known"] &= definite(arrays["unmoved"])
        return context

    def state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the predicted states at displacements (B, n_a).

        Returns:
            Efforts [N, ...] (B, n_a), effector positions [m] (B, n_e), and the spread of the ensemble [m] (B,), see
            `softgym_envs.surrogate.domain.Calibration`; infinite for a model without an ensemble.
        """
        effort, effector, spread = self._state(context, displacement)
        return effort * context.stiffness[context.slot], effector, spread

    def effort(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return only the efforts (B, n_a) at displacements (B, n_a)."""
        return self._effort(context, displacement) * context.stiffness[context.slot]

    def effector(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return only the effectors [m] (B, n_e) and their spread [m] (B,), at displacements (B, n_a)."""
        return self._state(context, displacement)[1:]

    def member_efforts(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return the efforts of each member of an ensemble (M, B, n_a) at displacements (B, n_a)."""
        return self.effort(context, displacement)[None]

    def force_spread(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return how far an effector would move [m] (B,) by what the members' efforts differ at displacements (B, n_a).

        It moves by the compliance of the body at displacement zero; zero for a model without an ensemble.
        """
        return np.zeros(len(displacement))

    def sensed(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return the sensor rows [m3] (B, n_s) at displacements (B, n_a)."""
        return np.zeros((len(displacement), 0))

    def effector_gradient(self, context: Context, displacement: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the gradient (B, n_a) of ``weights . effector`` in the displacements (B, n_a).

        This is one product with the transposed Jacobian of the effector, which costs about as much as the effector.

        Args:
            context: prepared bodies.
            displacement: shape (B, n_a).
            weights: of the effector coordinates, shape (B, n_e).
        """
        n = self.count
        W = self._compliance(context, displacement)
        pulled = np.matmul(W[:, :n, n : n + self.effectors], weights[:, :, None])
        return np.linalg.solve(W[:, :n, :n], pulled)[:, :, 0]

    def search(
        self,
        context: Context,
        target: np.ndarray,
        guess: np.ndarray,
        unilateral: np.ndarray,
        tolerance: float,
        iterations: int,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the displacements that real cables reach: Newton's method on the complementarity problem, with W.

        Args:
            context: prepared bodies.
            target: commanded displacements, shape (B, n_a).
            guess: where the search begins, shape (B, n_a).
            unilateral: actuators that cannot push, shape (n_a,).
            tolerance: the search ends when its next step is below this [`span`].
            iterations: largest number of steps; two or three are usually enough.

        Returns:
            Displacements (B, n_a), efforts (B, n_a), and whether they were found (B,).
        """
        displacement, effort = guess.copy(), self.effort(context, guess)
        converged = np.isfinite(effort).all(axis=1)
        rows = np.flatnonzero((unilateral & ((effort < 0.0) | (guess > target))).any(axis=1))
        d, e, wanted, part = guess[rows], effort[rows], target[rows], context.rows(rows)
        for iteration in range(iterations):
            if len(rows) == 0:
                break
            if iteration % 4 == 0:
                # W changes slowly along the search; a simplified Newton step is cheaper than a new one.
                K = self.stiffness(part, d)
                K[np.linalg.det(K) == 0.0] = np.nan
                W = np.linalg.inv(K)
            taut, solved = solve_rows(W, d - np.matmul(W, e[:, :, None])[:, :, 0] - wanted, unilateral)
            if not solved.all():  # W is not positive definite in these rows
                converged[rows[~solved]] = False
                rows, d, e, wanted, W, taut = (x[solved] for x in (rows, d, e, wanted, W, taut))
                part = part.rows(solved)
            step = np.matmul(W, (taut - e)[:, :, None])[:, :, 0]
            longest = np.max(np.abs(step) / self.span, axis=1)
            # A long step is shortened as a whole, so that the network is evaluated near known states only. Cut one by
            # one, cables that pull against each other would leave the direction of the solution.
            d = d + step / np.maximum(longest, 1.0)[:, None]
            moving = longest > tolerance
            # A last step below the tolerance is taken without evaluating the model again.
            displacement[rows[~moving]], effort[rows[~moving]] = d[~moving], taut[~moving]
            rows, d, wanted, W, part = rows[moving], d[moving], wanted[moving], W[moving], part.rows(moving)
            e = self.effort(part, d)
        converged[rows] = False
        return displacement, effort, converged

    def stiffness(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return the inverse of W between actuators alone, (B, n_a, n_a), at displacements (B, n_a)."""
        return self._stiffness(context, displacement) * context.stiffness[context.slot][:, :, None]

    def trust(
        self, context: Context, displacement: np.ndarray, spread: np.ndarray, command: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Judge predictions: return their uncertainty [m] and whether they are trusted, both (B,); see `distrust`."""
        uncertainty, distrust = self.distrust(context, displacement, spread, command)
        return uncertainty, distrust == 0

    def distrust(
        self, context: Context, displacement: np.ndarray, spread: np.ndarray, command: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Judge predictions at displacements (B, n_a) by their spread (B,).

        Args:
            context: prepared bodies.
            displacement: reached displacements, shape (B, n_a).
            spread: of the ensemble [m], shape (B,).
            command: commanded displacements, shape (B, n_a); default the reached ones.

        Returns:
            The uncertainty of the effector [m] (B,), a bound on 95 % of the errors (see
            `softgym_envs.surrogate.domain.Calibration`); and why predictions are not trusted (B,), sums of the numbers
            in `softgym_envs.surrogate.domain.DISTRUST_REASONS`, 0 for a trusted one. A model without an
            ensemble is judged by its domain alone.
        """
        domain, calibration = self.domain, self.domain.calibration
        scale, floor, power = domain.inflation, calibration.floor, calibration.power
        scale *= floor ** (1.0 - power)
        scales, soft, arrays = np.array([scale]), None, context.arrays
        if domain.limits_growth:
            bodies, K = (arrays["unmoved"], context.slot), self._curvature(context, displacement)
            soft = exceeds_softening(domain.growth, K, *bodies)
            # What is not softer than the smaller factor is not softer than the larger one either.
            if calibration.buckling != 1.0 and (soft.any() or calibration.soft < domain.growth):
                near = exceeds_softening(calibration.soft, K, *bodies)
                scales = np.where(near, scale * calibration.buckling, scale)
        uncertainty, distrust = np.empty(len(displacement)), np.empty(len(displacement), dtype=np.int8)
        assess_trust(
            displacement, displacement if command is None else command, spread, context.slot, domain.low, domain.high,
            domain.command_low, domain.command_high, domain.unilateral, arrays["factor"], arrays["corner"],
            arrays["known"], scales, floor, power, domain.limit, uncertainty, distrust,
        )  # fmt: skip
        if soft is not None:
            distrust[soft] |= SOFT
        return uncertainty, distrust

    def softening_ratio(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return how many times softer the actuators are at displacements (B, n_a) than at zero, shape (B,).

        This is the largest ratio, over all directions, of the two predicted compliances between actuators; near
        buckling it becomes large. It is infinite if one of the two is not positive definite.
        """
        unmoved, stiffness = (self._curvature(context, d) for d in (np.zeros_like(displacement), displacement))
        found = np.full(len(displacement), np.inf)
        both = definite(unmoved) & definite(stiffness)
        root = np.linalg.cholesky(unmoved[both])
        ratio = root.swapaxes(1, 2) @ np.linalg.inv(stiffness[both]) @ root
        found[both] = np.linalg.eigvalsh(ratio)[:, -1]
        return found

    def compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return W, shape (B, n, n), at displacements (B, n_a)."""
        return self._compliance(context, displacement) / context.stiffness[context.slot][:, :, None]

    def condensed(self, context: Context, displacement: np.ndarray) -> CondensedModel:
        """Return the condensed models at displacements (B, n_a)."""
        effort, effector, _ = self.state(context, displacement)
        W = self.compliance(context, displacement)
        passive = np.concatenate([effector, self.sensed(context, displacement)], axis=-1)
        full = np.concatenate([effort, np.zeros_like(passive)], axis=-1)
        delta = np.concatenate([displacement, passive], axis=-1)
        return CondensedModel(W, delta - np.einsum("bij,bj->bi", W, full), full, self.roles, self.rows)

    @abstractmethod
    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays of the context, from design features (B, design_size)."""

    @abstractmethod
    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return efforts at the baseline stiffness, effector positions and their spread."""

    def _effort(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._state(context, displacement)[0]

    def _stiffness(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return np.linalg.inv(self._compliance(context, displacement)[:, : self.count, : self.count])

    def _curvature(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return the stiffness that `softening_ratio` uses in every step; it may be a cheaper estimate."""
        return self._stiffness(context, displacement)

    @abstractmethod
    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return W at the baseline stiffness."""

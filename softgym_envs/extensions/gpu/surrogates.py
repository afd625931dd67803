"""The potential model for a hundred thousand bodies at once, entirely in torch: nothing leaves the device.

A search takes a fixed sequence of batched matrix products over all rows and all members of the ensemble: every row
takes the same few Newton steps, whether it needs them or not, without waiting for the host. It can therefore be
captured as a CUDA graph or compiled.

Displacements are scaled to [-1, 1] over the actuators' ranges.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.surrogate import TOLERANCE
from softgym_envs.extensions.fitting.torch_potential import PotentialEnsemble
from softgym_envs.surrogate.domain import EDGE, SLACK
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model

#: A quarter of an actuator's range, the unit of steps and tolerances of searches, in scaled displacements.
SPAN = 0.5
#: Newton steps of every row, with one Hessian. With random actions 7 % of the rows of GripperPinch and 2 % of the rows
#: of the cable trunk need more; those of the other robots do not.
NEWTON_STEPS = 4
#: Bound on the Newton steps of a row that takes more than the fixed few.
MAX_NEWTON_STEPS = 25
#: Pivoting passes of a complementarity problem: the first restores the last known slack set, the others correct it.
PIVOT_PASSES = 3

Bodies = dict[str, Tensor]
"""Arrays of S bodies by name, or of one body for all rows."""

State = dict[str, Tensor]
"""Arrays of B states by name."""

#: Arrays that differ between the members of the ensemble, (M, S, ...); the others are (S, ...).
_PER_MEMBER = frozenset({"c", "a", "b", "quadratics", "linears", "d1", "d2", "x0", "slope", "held"})


class TorchBatch:
    """States of many bodies under commanded displacements, as `solve_displacements` finds them.

    Args:
        model: a trained ensemble of potential networks.
        device: device of all tensors.
        dtype: type of the networks and all results.

    Raises:
        ValueError: for a model of an unsupported network.
    """

    def __init__(self, model: SurrogateModel, device: torch.device, dtype: torch.dtype) -> None:
        if not isinstance(model, Model):
            raise ValueError(f"network '{model.network}' is not supported; allowed: potential")

        def put(values: np.ndarray, kind: torch.dtype = dtype) -> Tensor:
            return torch.as_tensor(np.array(values, dtype=float), dtype=kind, device=device)

        self.moving = False
        self.dtype, self.count, self._effectors = dtype, model.count, model.effectors
        self.middle, self.half_range = put(model.middle), put(model.half_range)
        self.unilateral = tuple(model.robot.unilateral.tolist())
        self._pulls = torch.tensor(self.unilateral, device=device)
        self._ensemble = PotentialEnsemble.of_model(model, device, dtype)
        self._features, self._correction = model.features, model.correction
        self._loaded = bool(model.card.get("loaded", False))
        self._calibrated = model.members >= model.trained
        self._effort_scale = put(model.energy_scale / model.half_range)
        self._effector_scale, self._effector_mean = model.effector_scale, put(model.effector_mean)
        domain = model.domain
        self._domain, self._calibration = domain, domain.calibration
        floor, power = domain.calibration.floor, domain.calibration.power
        self._scale, self._limit = domain.inflation * floor ** (1.0 - power), domain.limit
        self._growth = domain.growth if domain.limits_growth else None
        self._low, self._high = (put((bound - model.middle) / model.half_range) for bound in (domain.low, domain.high))
        self._design_low, self._design_high = (put(b, torch.float64) for b in (domain.design_low, domain.design_high))

    def prepare(self, designs: Tensor) -> Bodies:
        """Return what does not depend on the actuation, and the states at rest; waits for the device.

        Args:
            designs: values in the order of the design space, in double precision (near 0.5 a Poisson's ratio needs its
                digits), shape (S, len(space)).

        Returns:
            Arrays of the bodies, among them ``rest`` (S, n_a), ``rest_effort`` (S, n_a), ``rest_effector`` [m] (S, 3),
            ``rest_uncertainty`` [m] (S,) and ``rest_trusted`` (S,).
        """
        features = self._features.design(designs)
        bodies = self._ensemble.coefficients(features.to(self.dtype))
        stiffness = self._features.stiffness(designs) * self._correction.factor(features)
        bodies["effort"] = stiffness.to(self.dtype) * self._effort_scale
        share = self._domain.at_bounds(designs.cpu().numpy())
        for name, values in zip(
            ("factor", "corner"), self._calibration.body_factors(share, len(self._domain.columns)), strict=True
        ):
            bodies[name] = torch.as_tensor(values, dtype=self.dtype, device=designs.device)
        bodies["known"] = ((designs >= self._design_low) & (designs <= self._design_high)).all(dim=1)
        zero = (-self.middle / self.half_range).expand(len(designs), -1)
        if self._growth is not None:
            bodies["unmoved"] = self._ensemble.curvature(bodies, zero)
            bodies["known"] &= _definite(bodies["unmoved"])
        if self._calibration.forces:
            bodies["lever"] = self._ensemble.lever(bodies, zero)[:, : self._effectors]
        if self._loaded:
            u, gradient, _ = self.search(bodies, zero, zero, MAX_NEWTON_STEPS, stop=True)
        else:
            u = self._without_effort(bodies, zero)
            gradient = self._ensemble.gradient(bodies, u)
        bodies["rest"], bodies["rest_effort"] = u, gradient * bodies["effort"]
        judged = self.measure(bodies, u, zero if self._loaded else u)
        bodies["rest_effector"], bodies["rest_uncertainty"], bodies["rest_trusted"] = judged
        return bodies

    def measure(self, bodies: Bodies, u: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First effector [m] (B, 3), its uncertainty [m] (B,), and whether it is trusted (B,).

        As `SurrogateModel.trust`, at displacements ``u`` under commands ``target``, both scaled, shape (B, n).
        """
        x = self._ensemble.effectors(bodies, u)[..., : self._effectors]
        mean = x.mean(dim=0)
        effector = (mean * self._effector_scale + self._effector_mean[: self._effectors])[:, :3]
        if self._calibrated:
            calibration, variance = self._calibration, _variance(x - mean)
            if calibration.forces:
                efforts = self._ensemble.gradients(bodies, u)
                moved = (bodies["lever"] @ (efforts - efforts.mean(dim=0))[..., None])[..., 0]
                variance = variance + calibration.forces**2 * _variance(moved)
            variance = variance * self._effector_scale**2
            uncertainty = (
                self._scale * bodies["factor"] * (variance + calibration.floor**2) ** (0.5 * calibration.power)
            )
            if calibration.slack_corners != calibration.corners:
                slack = (self._pulls & (u > target + SLACK)).any(dim=1)
                ends = ((target.abs() - 1.0) / EDGE + 1.0).clamp(0.0, 1.0).mean(dim=1)
                uncertainty = torch.where(slack, uncertainty * bodies["corner"] ** ends, uncertainty)
        else:
            uncertainty = torch.full_like(mean[:, 0], torch.inf)
        soft = None
        if self._growth is not None:
            K = self._ensemble.curvature(bodies, u)
            soft = ~_definite(self._growth * K - bodies["unmoved"])
            if self._calibration.buckling != 1.0:
                near = ~_definite(self._calibration.soft * K - bodies["unmoved"])
                uncertainty = torch.where(near, uncertainty * self._calibration.buckling, uncertainty)
        inside = ((u >= self._low) & (u <= self._high)).all(dim=1)
        trusted = inside & bodies["known"] & ((uncertainty <= self._limit) | torch.isinf(uncertainty))
        if soft is not None:
            trusted &= ~soft
        return effector, uncertainty, trusted

    def at_rest(self, bodies: Bodies) -> State:
        """Return the states of bodies at rest, by name."""
        names = ("effort", "effector", "uncertainty", "trusted")
        slack = torch.zeros_like(bodies["rest"], dtype=torch.bool)
        return {"u": bodies["rest"], "slack": slack, **{name: bodies[f"rest_{name}"] for name in names}}

    def advance(self, bodies: Bodies, state: State, command: Tensor) -> tuple[State, Tensor]:
        """Return the states under commands (B, n_a), and whether `NEWTON_STEPS` Newton steps found them (B,)."""
        return self._reach(bodies, state, command, NEWTON_STEPS)

    def finish(self, bodies: Bodies, state: State, command: Tensor) -> tuple[State, Tensor]:
        """As `advance`, for rows that need more Newton steps; waits for the device."""
        return self._reach(bodies, state, command, MAX_NEWTON_STEPS, stop=True)

    def kinematics(self, bodies: Bodies, command: Tensor) -> Tensor:
        """Return the effectors [m] (B, 3) under commands (B, n_a); NaN where no equilibrium is found."""
        target = self._scaled(command)
        u, _, found = self.search(bodies, target, target, MAX_NEWTON_STEPS, stop=True)
        return torch.where(found[:, None], self.measure(bodies, u, u)[0], torch.nan)

    def _scaled(self, command: Tensor) -> Tensor:
        return (command - self.middle) / self.half_range

    def _reach(
        self, bodies: Bodies, state: State, command: Tensor, iterations: int, *, stop: bool = False
    ) -> tuple[State, Tensor]:
        target = self._scaled(command)
        # A search begins with slack cables at their displacement, the others at their command.
        guess = torch.where(state["slack"], torch.maximum(state["u"], target), target)
        u, gradient, found = self.search(bodies, target, guess, iterations, stop=stop)
        effector, uncertainty, trusted = self.measure(bodies, u, target)
        effort, slack = self.efforts(bodies, target, u, gradient)
        new = {
            "u": u,
            "effort": effort,
            "effector": effector,
            "slack": slack,
            "uncertainty": uncertainty,
            "trusted": trusted,
        }
        return new, found

    def efforts(self, bodies: Bodies, target: Tensor, u: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Efforts [N, ...] (B, n_a) and slack actuators (B, n_a) of the results of `search`."""
        slack = self._pulls & (u > target + (10.0 * TOLERANCE) * SPAN)
        gradient = torch.where(self._pulls, gradient.clamp(min=0.0), gradient).masked_fill(slack, 0.0)
        return gradient * bodies["effort"], slack

    def search(
        self, bodies: Bodies, target: Tensor, guess: Tensor, iterations: int, *, stop: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Find the displacements that real cables reach: `SurrogateModel.search`, on scaled displacements (B, n).

        Args:
            bodies: from `prepare`.
            target: commanded displacements.
            guess: where the search begins.
            iterations: number of Newton steps of every row.
            stop: stop when no row moves any more; the host checks this before every step.

        Returns:
            Displacements (B, n), gradients (B, n), and whether they were found (B,).
        """
        if not any(self.unilateral):
            gradient = self._ensemble.gradient(bodies, guess)
            return guess, gradient, torch.isfinite(gradient).all(dim=1)
        u = guess
        for iteration in range(iterations):
            # The Hessian changes slowly along the search; a simplified Newton step is cheaper than a new one.
            if iteration % 4 == 0:
                gradient, hessian = self._ensemble.derivatives(bodies, u)
            else:
                gradient = self._ensemble.gradient(bodies, u)
            if iteration == 0:
                wrong = ((gradient < 0.0) | (guess > target)) & self._pulls
                found = torch.isfinite(gradient).all(dim=1) & ~wrong.any(dim=1)
                effort, slack = gradient, guess > target
            if stop and bool(found.all()):
                break
            # In the displacement beyond the command, z >= 0, the effort is K z + q >= 0.
            ahead = target - u
            q = gradient + (hessian * ahead[:, None, :]).sum(dim=2)
            z, taut, slack, solved = complementarity(hessian, q, slack, self.unilateral)
            step, still = _shortened(ahead + z)
            # A last step below the tolerance is taken without evaluating the model again.
            u = torch.where(found[:, None], u, u + step)
            effort = torch.where(found[:, None], effort, taut)
            found = found | (still & solved)
        return u, effort, found

    def _without_effort(self, bodies: Bodies, start: Tensor) -> Tensor:
        """Find displacements (B, n) without effort by Newton's method; waits for the device."""
        u = start
        for _ in range(50):
            gradient, hessian = self._ensemble.derivatives(bodies, u)
            step, still = _shortened(-torch.linalg.solve_ex(hessian, gradient)[0])
            if bool(still.all()):
                break
            u = torch.where(still[:, None], u, u + step)
        return u


def _shortened(step: Tensor) -> tuple[Tensor, Tensor]:
    """Shorten long steps (B, n) as a whole, as `SurrogateModel.search` does; return also which are below tolerance."""
    longest = step.abs().amax(dim=1) / SPAN
    return step / longest.clamp(min=1.0)[:, None], longest <= TOLERANCE


def complementarity(
    K: Tensor, q: Tensor, slack: Tensor, unilateral: tuple[bool, ...]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve ``0 <= z _|_ K z + q >= 0`` (z = 0 in bilateral rows) by principal pivots, in a fixed number of passes.

    A pivot exchanges an actuator's z with its effort: a rank-one update of the tableau, masked by row of the batch.
    The first pass exchanges the actuators that were slack before. In the others, each actuator in turn is exchanged if
    its sign is wrong.

    Args:
        K: symmetric positive definite, shape (B, n, n).
        q: shape (B, n).
        slack: guess of where z > 0, shape (B, n).
        unilateral: n flags.

    Returns:
        z (B, n), K z + q (B, n), the slack set (B, n), and whether its signs are right (B,).
    """
    n = q.shape[1]
    # With a unit diagonal the pivots are of order one, so the sums of the rank-one updates lose no digits.
    scale = torch.rsqrt(torch.diagonal(K, dim1=1, dim2=2))
    q = scale * q
    tableau = torch.cat([K * scale[:, :, None] * scale[:, None, :], q[:, :, None]], dim=2).permute(1, 2, 0).contiguous()
    slightly = -4.0 * torch.finfo(q.dtype).eps * q.abs().amax(dim=1)
    unit = torch.eye(n, n + 1, dtype=q.dtype, device=q.device)[:, :, None]
    free = list(slack.unbind(dim=1))
    pull = [p for p in range(n) if unilateral[p]]
    for sweep in range(PIVOT_PASSES):
        for p in pull:
            if sweep == 0:
                exchanged = free[p]
            else:
                exchanged = tableau[p, n] < slightly
                free[p] = free[p] ^ exchanged
            inverse = torch.where(exchanged, 1.0 / tableau[p, p], 0.0)
            column = (tableau[:, p] + unit[p, :n]) * inverse
            tableau = torch.addcmul(tableau, column[:, None], tableau[p] - unit[p], value=-1.0)
    value, slack = tableau[:, n].mT, torch.stack(free, dim=1)
    right = torch.stack([value[:, p] >= slightly for p in pull]).all(dim=0)
    return torch.where(slack, value, 0.0) * scale, torch.where(slack, 0.0, value) / scale, slack, right


def _variance(differences: Tensor) -> Tensor:
    """Mean square distance (B,) of points from their means, from those of members (M, B, e); the largest counts."""
    square = (differences**2).mean(dim=0)
    return square.reshape(len(square), -1, 3).sum(dim=2).amax(dim=1)


def _definite(a: Tensor) -> Tensor:
    """Whether symmetric matrices (B, n, n) are positive definite, shape (B,): all pivots are positive."""
    found = torch.ones(len(a), dtype=torch.bool, device=a.device)
    while a.shape[1]:
        pivot = a[:, :1, :1]
        found &= pivot[:, 0, 0] > 0.0
        a = a[:, 1:, 1:] - a[:, 1:, :1] * a[:, :1, 1:] / pivot
    return found


def take_rows(bodies: Bodies, index: Tensor) -> Bodies:
    """Return the bodies of some rows; one body for all rows stays one."""
    if len(bodies["rest"]) == 1:
        return bodies
    return {name: value[_rows(name, index)] for name, value in bodies.items()}


def put_rows(bodies: Bodies, index: Tensor, new: Bodies) -> None:
    """Overwrite the bodies of some rows."""
    for name, value in new.items():
        bodies[name][_rows(name, index)] = value


def repeat_body(bodies: Bodies, count: int) -> Bodies:
    """Return ``count`` copies of a single body."""
    return {name: value.repeat_interleave(count, dim=1 if name in _PER_MEMBER else 0) for name, value in bodies.items()}


def _rows(name: str, index: Tensor) -> Any:
    return (slice(None), index) if name in _PER_MEMBER else index

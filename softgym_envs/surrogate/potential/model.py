"""Potential networks: one scalar, the elastic energy of a body as a function of its actuator displacements.

Let ``Phi(delta_a, f)`` be the energy of a body whose actuators are held at ``delta_a`` while a force ``f`` acts on its
effector. Its first derivatives are the actuator efforts and, with a minus sign, the effector position; its second
derivatives hold the whole condensed model. To second order in ``f``

    Phi = U(delta_a) - f . x(delta_a) - f^T C(delta_a) f / 2

so with ``K = hess U`` and ``J = dx / d delta_a``

    effort = grad U,   effector = x,   W_aa = K^-1,   W_ea = J W_aa,   W_ee = C + J W_aa J^T.

The network consists of these three parts: ``U`` is convex in ``delta_a`` by construction (an input-convex network, Amos
et al. 2017, arXiv:1609.07152), ``x`` is a plain network, and ``C = L L^T``. Therefore, for any weights:

* W is symmetric positive definite;
* d delta / d effort of the surrogate is its own W: control and design work with exact derivatives;
* cables that cannot push have one solution: the minimum of ``U`` over the displacements beyond their commands.

For a robot whose energy is not convex (`Learning.convex`) the quadratic part of ``U`` may have any sign: a convex
function plus such a quadratic can represent every smooth function on the box of displacements. ``W`` is then still the
exact derivative, but positive definite only where the body is stable.

Every FEM state teaches values and first derivatives of efforts and effectors (through W_aa and W_ea), so few states are
needed. The layers of the design are separate from those of the actuation and are evaluated once per body. An ensemble
is the mean of its members' ``Phi``, which is a potential as well; the spread of the members is its uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.potential import kernels

SHIFT = 4.0
"""Subtracted from the factors of the energy's ramps before they are made positive, so that untrained ones are small."""


def coefficient_sizes(n: int, e: int, w: int) -> dict[str, int]:
    """Names and sizes of the coefficients of a body, in the order in which the design layers return them.

    Args:
        n: actuators.
        e: effector coordinates.
        w: hidden units of the actuation layers.
    """
    entries_a, entries_e = n * (n + 1) // 2, e * (e + 1) // 2
    sizes = (w, w, w, w, entries_a, n, e, e * n, entries_e, w, w)
    names = ("c1", "c2", "a", "b", "quadratic", "linear", "x0", "slope", "held", "d1", "d2")
    return dict(zip(names, sizes, strict=True))


class Model(SurrogateModel):
    """An ensemble of potential networks (see the module).

    Attributes:
        members: how many members are used.
        trained: how many members the spread was calibrated for, at least 2; if fewer are used, the spread is infinite.
        middle: middle of the actuators' ranges, shape (n_a,).
        half_range: half of the ranges, shape (n_a,); networks see displacements scaled by both to [-1, 1].
        energy_scale: unit of the networks' energy [J].
        effector_mean: origin of the networks' effectors and sensors [m], shape (n_e + n_s,).
        effector_scale: unit of the networks' effectors [m].
        held_scale: unit of the networks' held compliance [m/N].
    """

    network = "potential"
    ensemble = True
    senses = True

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        super().__init__(robot, tensors, card)
        available = len(tensors["energy1"])
        if members is not None and not 1 <= members <= available:
            raise ValueError(f"members = {members} is out of bounds; these weights have 1 to {available}")
        self.trained = max(available, 2)
        tensors = {
            k: v[:members] if v.shape and not k.startswith("scale.") and k != "rest" else v for k, v in tensors.items()
        }
        self.tensors = tensors
        self.members, self.width = tensors["energy1"].shape[:2]

        def kernel(name: str, *axes: int) -> np.ndarray:
            return np.ascontiguousarray(np.transpose(tensors[name], axes), dtype=np.float32)

        self.passive = self.effectors + self.sensors
        self.half_range = 0.5 * (robot.upper - robot.lower)
        self.middle = robot.lower + self.half_range
        self.energy_scale = float(tensors["scale.energy"].item())
        self.effector_mean = tensors["scale.effector_mean"].astype(float)
        self.effector_scale = float(tensors["scale.effector"].item())
        self.held_scale = float(tensors["scale.held"].item())
        self._effort_scale = self.energy_scale / self.half_range
        A1, A2 = kernel("energy1", 0, 2, 1), kernel("energy2", 0, 2, 1)
        P = np.logaddexp(0.0, tensors["pass_on"].astype(float)).astype(np.float32)
        PT = np.ascontiguousarray(P.transpose(0, 2, 1))
        B1, B2 = kernel("shape1", 0, 2, 1), kernel("shape2", 0, 2, 1)
        self._energy, self._shape = (A1, A2, P, PT), (B1, B2, kernel("effector", 0, 1, 2))
        self._shape_transposed = kernel("shape1", 0, 1, 2), kernel("shape2", 0, 1, 2)
        self._held = kernel("held", 0, 2, 1)
        layers = [(tensors[f"body.{k}.weight"], tensors[f"body.{k}.bias"]) for k in range(3)]
        self._layers = [(w.astype(np.float32), v.astype(np.float32)[:, None]) for w, v in layers]
        self._rest = tensors["rest"].astype(np.float32) if "rest" in tensors else None
        if self._rest is not None and self._rest.shape != (self.count,):
            raise ValueError(f"'rest' has shape {self._rest.shape}; the robot has {self.count} actuators")

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        rows, n, e, w, M = len(design), self.count, self.passive, self.width, self.members
        x = design if design.shape[1] else np.zeros((rows, 1))
        h = np.repeat(x[None].astype(np.float32), M, axis=0)
        for k, (weight, bias) in enumerate(self._layers):
            h = h @ weight.transpose(0, 2, 1) + bias
            if k < 2:
                h = h / np.sqrt(1.0 + h * h)
        sizes = coefficient_sizes(n, e, w)
        parts = np.split(h.transpose(1, 0, 2), np.cumsum(list(sizes.values()))[:-1], axis=2)
        body = {k: np.ascontiguousarray(v) for k, v in zip(sizes, parts, strict=True)}
        for name in ("a", "b"):
            body[name] = np.logaddexp(np.float32(0.0), body[name] - np.float32(SHIFT))
        lower = np.tril_indices(n)
        factor, entries = np.zeros((rows, M, n, n), dtype=np.float32), body["quadratic"]
        if self.robot.learning.convex:
            factor[:, :, lower[0], lower[1]] = np.where(lower[0] == lower[1], np.exp(entries), entries)
            quadratic = factor @ factor.swapaxes(2, 3)
        else:
            factor[:, :, lower[0], lower[1]] = entries
            quadratic = factor + factor.swapaxes(2, 3)
        body["quadratic"], body["first"] = quadratic.mean(axis=1), np.ascontiguousarray(quadratic[:, 0])
        body["quadratics"], body["linears"] = quadratic, np.ascontiguousarray(body["linear"])
        body["slope"] = body["slope"].reshape(rows, M, e, n)
        body["linear"] = np.ascontiguousarray(body["linear"].mean(axis=1))
        if self._rest is not None:
            u, body["linears"] = np.repeat(self._rest[None], rows, axis=0), np.zeros_like(body["linears"])
            body["linears"] = -self._member_efforts(body, u, np.arange(rows))
            body["linear"] = body["linears"].mean(axis=1)
        if self.domain.calibration.forces:
            body["lever"] = self._lever(body)
        return body

    def _lever(self, body: dict[str, np.ndarray]) -> np.ndarray:
        """Return how efforts move the effectors of bodies at displacement zero, in scaled units, shape (S, n_e, n)."""
        rows, n = len(body["c1"]), self.count
        u, slot = np.repeat(self._scaled(np.zeros((1, n))), rows, axis=0), np.arange(rows)
        hessian = np.empty((rows, n, n), dtype=np.float32)
        coefficients = (body[k] for k in ("c1", "c2", "a", "b", "quadratic", "linear"))
        kernels.hessians(u, slot, *self._energy, *coefficients, hessian)
        jacobian, _ = self._jacobian(body, u, slot)
        # K is symmetric: J K^-1 is the transpose of K^-1 J^T.
        moved = np.linalg.solve(hessian.astype(float), jacobian[:, : self.effectors].swapaxes(1, 2).astype(float))
        return np.ascontiguousarray(moved.swapaxes(1, 2), dtype=np.float32)

    def _jacobian(self, body: dict[str, np.ndarray], u: np.ndarray, slot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Jacobian (B, n_e + n_s, n) and the held compliance of rows nothing drives, in scaled units."""
        rows, e = len(u), self.passive
        jacobian = np.empty((rows, e, self.count), dtype=np.float32)
        held = np.empty((rows, e, e), dtype=np.float32)
        coefficients = (body["d1"], body["d2"], body["slope"], body["held"])
        kernels.jacobians(u, slot, *self._shape, self._held, *coefficients, jacobian, held)
        return jacobian, held

    def _member_efforts(self, body: dict[str, np.ndarray], u: np.ndarray, slot: np.ndarray) -> np.ndarray:
        efforts = np.empty((len(u), self.members, self.count), dtype=np.float32)
        coefficients = (body[k] for k in ("c1", "c2", "a", "b", "quadratics", "linears"))
        kernels.member_efforts(u, slot, *self._energy, *coefficients, efforts)
        return efforts

    def member_efforts(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Return the efforts of each member [N, ...] (M, B, n_a) at displacements (B, n_a)."""
        found = self._member_efforts(context.arrays, self._scaled(displacement), context.slot)
        return found.swapaxes(0, 1) * self._effort_scale * context.stiffness[context.slot]

    def force_spread(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        body, spread = context.arrays, np.empty(len(displacement), dtype=np.float32)
        efforts = self._member_efforts(body, self._scaled(displacement), context.slot)
        lever = body["lever"] if "lever" in body else self._lever(body)
        kernels.moved_spreads(efforts, context.slot, lever, spread)
        return spread * self.effector_scale

    def _scaled(self, displacement: np.ndarray) -> np.ndarray:
        return ((displacement - self.middle) / self.half_range).astype(np.float32)

    def _effort(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        members = self._member_efforts(context.arrays, self._scaled(displacement), context.slot)
        return members.mean(axis=1) * self._effort_scale

    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._effort(context, displacement), *self.effector(context, displacement)

    def effector(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, spread = self._passive(context, displacement)
        return rows[:, : self.effectors], spread

    def sensed(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        if not self.sensors:
            return super().sensed(context, displacement)
        rows, units = self._passive(context, displacement)[0], self.features.units
        return rows[:, self.effectors :] * units[self.count + self.effectors :]

    def _passive(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return effectors and sensors in the network's units [m] (B, n_e + n_s) and the spread of effectors [m]."""
        u, body = self._scaled(displacement), context.arrays
        effector = np.empty((len(u), self.passive), dtype=np.float32)
        spread = np.empty(len(u), dtype=np.float32)
        coefficients = (body["d1"], body["d2"], body["x0"], body["slope"])
        kernels.effectors(u, context.slot, *self._shape, *coefficients, self.effectors, effector, spread)
        spread = spread * self.effector_scale
        if self.members < self.trained:
            spread = np.full(len(u), np.inf)
        elif weight := self.domain.calibration.forces:
            spread = np.hypot(spread, weight * self.force_spread(context, displacement))
        return effector * self.effector_scale + self.effector_mean, spread

    def effector_gradient(self, context: Context, displacement: np.ndarray, weights: np.ndarray) -> np.ndarray:
        u, body = self._scaled(displacement), context.arrays
        gradient = np.empty((len(u), self.count), dtype=np.float32)
        (B1, B2, V), (B1T, B2T) = self._shape, self._shape_transposed
        scaled = np.zeros((len(u), self.passive), dtype=np.float32)
        scaled[:, : self.effectors] = self.effector_scale * weights
        coefficients = (body["d1"], body["d2"], body["slope"])
        kernels.effector_gradients(u, context.slot, B1, B1T, B2, B2T, V, *coefficients, scaled, gradient)
        return gradient / self.half_range

    def search(
        self,
        context: Context,
        target: np.ndarray,
        guess: np.ndarray,
        unilateral: np.ndarray,
        tolerance: float,
        iterations: int,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        body = context.arrays
        displacement, effort = np.empty(guess.shape), np.empty(guess.shape)
        converged = np.empty(len(guess), dtype=bool)
        kernels.search(
            target, guess, unilateral, self.span, tolerance * self.span, iterations, self.middle, self.half_range,
            self._effort_scale, context.stiffness, context.slot, *self._energy,
            *(body[k] for k in ("c1", "c2", "a", "b", "quadratic", "linear", "first")), displacement, effort, converged,
        )  # fmt: skip
        return displacement, effort, converged

    def _stiffness(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._hessian(context, displacement, self._energy, "quadratic")

    def _curvature(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Stiffness of the first member alone, in a fifth of the time: members agree where actuators become soft."""
        return self._hessian(context, displacement, [part[:1] for part in self._energy], "first")

    def _hessian(
        self, context: Context, displacement: np.ndarray, energy: Iterable[np.ndarray], quadratic: str
    ) -> np.ndarray:
        """Stiffness of the members whose weights are given; ``quadratic`` names their quadratic part."""
        u, body = self._scaled(displacement), context.arrays
        hessian = np.empty((len(u), self.count, self.count), dtype=np.float32)
        coefficients = (body["c1"], body["c2"], body["a"], body["b"], body[quadratic], body["linear"])
        kernels.hessians(u, context.slot, *energy, *coefficients, hessian)
        return hessian.astype(float) * (self._effort_scale[:, None] / self.half_range)

    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        rows, n = len(displacement), self.count
        jacobian, held = self._jacobian(context.arrays, self._scaled(displacement), context.slot)
        K = self._stiffness(context, displacement)
        J = jacobian.astype(float) * (self.effector_scale / self.half_range)
        W = np.empty((rows, self.size, self.size))
        a, c = slice(0, n), slice(n, None)
        W_aa = np.linalg.inv(K)
        W[:, a, a] = 0.5 * (W_aa + W_aa.swapaxes(1, 2))
        W[:, c, a] = J @ W[:, a, a]
        W[:, a, c] = W[:, c, a].swapaxes(1, 2)
        moved = W[:, c, a] @ J.swapaxes(1, 2)
        W[:, c, c] = 0.5 * (moved + moved.swapaxes(1, 2)) + held.astype(float) * self.held_scale
        if self.sensors:
            W *= self.features.units[:, None] * self.features.units
        return W

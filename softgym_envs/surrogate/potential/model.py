"""One scalar for everything: the elastic energy of a body, as a function of its actuator displacements.

Let ``Phi(delta_a, f)`` be the energy left in a body whose actuators are held at ``delta_a`` while a force ``f`` acts
on its effector. Its first derivatives are the actuator efforts and (minus) the effector; its second derivatives hold
the whole condensed model. To second order in ``f``

    Phi = U(delta_a) - f . x(delta_a) - f^T C(delta_a) f / 2

so with ``K = hess U`` and ``J = dx / d delta_a``

    effort = grad U,   effector = x,   W_aa = K^-1,   W_ea = J W_aa,   W_ee = C + J W_aa J^T.

The network is these three: ``U`` is convex in ``delta_a`` by construction (an input-convex network, Amos et al. 2017,
arXiv:1609.07152), ``x`` a plain one, ``C = L L^T``. Hence, whatever the weights:

* W is symmetric positive definite;
* d delta / d effort of the surrogate is its own W: control and design work with exact derivatives;
* cables that cannot push have one solution, ``min U`` over the displacements beyond their commands.

A robot whose energy is not convex (`Robot.convex`) has a quadratic part of any sign instead of a convex one: what a
convex function and a quadratic one of the body can be together is every smooth function on its box. ``W`` is then the
exact derivative still, but positive definite only where the body is stable.

Every FEM state teaches values and first derivatives of both (efforts, W_aa, W_ea), which is why few are needed.
Layers of the design are apart from those of the actuation and evaluated once per body. An ensemble is the mean of its
members' ``Phi``, and so a potential again; their spread is the uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from numba import njit
from pydantic import Field

from softgym_envs.config import Config
from softgym_envs.executors import parallel_map
from softgym_envs.mechanics.solvers.complementarity import _solve_row
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.data.states import States
from softgym_envs.surrogate.model import Context, SurrogateModel

__all__ = ["Model", "Options", "train"]


class Options(Config):
    """Hyper-parameters."""

    kind: Literal["potential"] = "potential"
    width: int = Field(default=64, gt=0)
    body_width: int = Field(default=64, gt=0)
    members: int = Field(default=5, gt=0)
    optimiser: Literal["soap", "adam"] = "soap"
    steps: int = Field(default=4000, gt=0)
    batch_size: int = Field(default=128, gt=0)
    learning_rate: float = Field(default=1e-2, gt=0)


def coefficient_sizes(n: int, e: int, w: int) -> dict[str, int]:
    """Names and sizes of the coefficients that the design layers give to a body, in their order."""
    entries_a, entries_e = n * (n + 1) // 2, e * (e + 1) // 2
    sizes = (w, w, w, w, entries_a, n, e, e * n, entries_e, w, w)
    names = ("c1", "c2", "a", "b", "quadratic", "linear", "x0", "slope", "held", "d1", "d2")
    return dict(zip(names, sizes, strict=True))


_FAST: Any = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}
#: SHA-256 of the file of `_solve_row`. Numba keeps compiled kernels by the text of their own file: so this file changes
#: with that one, and `_search` is compiled anew (a test compares).
_INLINED = "8338c32da064cf58"
#: Rows evaluated together: each weight is then fetched once for all of them, and what belongs to one member stays
#: in the fast caches.
_ROWS = 48


@njit(**_FAST)
def _multiply(h, weights, z, rows):
    """``z += h @ weights`` for the first ``rows`` rows, four at a time with four inputs at a time.

    Sixteen products for each load and store of z keep the arithmetic busy, not the memory.
    """
    inputs, width = weights.shape
    whole = inputs - inputs % 4
    first = 0
    while first + 4 <= rows:
        second, third, fourth = first + 1, first + 2, first + 3
        for k in range(0, whole, 4):
            a0, a1, a2, a3 = h[first, k], h[first, k + 1], h[first, k + 2], h[first, k + 3]
            b0, b1, b2, b3 = h[second, k], h[second, k + 1], h[second, k + 2], h[second, k + 3]
            c0, c1, c2, c3 = h[third, k], h[third, k + 1], h[third, k + 2], h[third, k + 3]
            d0, d1, d2, d3 = h[fourth, k], h[fourth, k + 1], h[fourth, k + 2], h[fourth, k + 3]
            for j in range(width):
                w0, w1, w2, w3 = weights[k, j], weights[k + 1, j], weights[k + 2, j], weights[k + 3, j]
                z[first, j] += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
                z[second, j] += b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
                z[third, j] += c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
                z[fourth, j] += d0 * w0 + d1 * w1 + d2 * w2 + d3 * w3
        for k in range(whole, inputs):
            a0, b0, c0, d0 = h[first, k], h[second, k], h[third, k], h[fourth, k]
            for j in range(width):
                w0 = weights[k, j]
                z[first, j] += a0 * w0
                z[second, j] += b0 * w0
                z[third, j] += c0 * w0
                z[fourth, j] += d0 * w0
        first += 4
    for row in range(first, rows):
        for k in range(0, whole, 4):
            a0, a1, a2, a3 = h[row, k], h[row, k + 1], h[row, k + 2], h[row, k + 3]
            for j in range(width):
                w0, w1, w2, w3 = weights[k, j], weights[k + 1, j], weights[k + 2, j], weights[k + 3, j]
                z[row, j] += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
        for k in range(whole, inputs):
            a0 = h[row, k]
            for j in range(width):
                z[row, j] += a0 * weights[k, j]


@njit(**_FAST)
def _gradients(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, effort):
    """Gradient of the energy (rows, n) at scaled actuation u (rows, n) of bodies ``slot`` (rows,), for a block.

    ``kept`` (members, 3, rows, w) takes what `_curvatures` needs from here: the slope of the first activation, and
    what the curvature of each layer weighs in the Hessian.
    """
    rows = len(u)
    members, n, w = A1.shape
    one, half, share = np.float32(1.0), np.float32(0.5), np.float32(1.0 / members)
    h, z, lower = np.empty((rows, w), np.float32), np.empty((rows, w), np.float32), np.empty((rows, w), np.float32)
    for r in range(rows):
        s = slot[r]
        for i in range(n):
            value = linear[s, i]
            for j in range(n):
                value += quadratic[s, i, j] * u[r, j]
            effort[r, i] = value
    for m in range(members):
        hp, first, second = kept[m, 0], kept[m, 1], kept[m, 2]
        for r in range(rows):
            s = slot[r]
            for j in range(w):
                z[r, j] = c1[s, m, j]
        _multiply(u, A1[m], z, rows)
        for r in range(rows):
            for j in range(w):
                square = one + z[r, j] * z[r, j]
                inverse = one / np.sqrt(square)
                h[r, j] = half * (z[r, j] + square * inverse)
                hp[r, j] = half * (one + z[r, j] * inverse)
                first[r, j] = half * inverse * inverse * inverse
            s = slot[r]
            for j in range(w):
                z[r, j] = c2[s, m, j]
                lower[r, j] = b[s, m, j]
        _multiply(u, A2[m], z, rows)
        _multiply(h, PT[m], z, rows)
        for r in range(rows):
            s = slot[r]
            for j in range(w):
                inverse = one / np.sqrt(one + z[r, j] * z[r, j])
                weight = half * a[s, m, j]
                z[r, j] = weight * (one + z[r, j] * inverse)
                second[r, j] = weight * inverse * inverse * inverse
        _multiply(z, P[m], lower, rows)
        for r in range(rows):
            for j in range(w):
                first[r, j] *= lower[r, j]
                lower[r, j] *= hp[r, j]
            for i in range(n):
                value = np.float32(0.0)
                for j in range(w):
                    value += lower[r, j] * A1[m, i, j] + z[r, j] * A2[m, i, j]
                effort[r, i] += share * value


@njit(**_FAST)
def _curvatures(index, slot, A1, A2, PT, quadratic, kept, hessian):
    """Hessian of the energy (rows, n, n) of the rows ``index`` of a block, from what `_gradients` ``kept`` of it."""
    members, n, w = A1.shape
    share = np.float32(1.0 / members)
    tangents = len(index) * n
    slopes, through = np.empty((tangents, w), np.float32), np.empty((tangents, w), np.float32)
    for row in index:
        for i in range(n):
            for j in range(n):
                hessian[row, i, j] = quadratic[slot[row], i, j]
    for m in range(members):
        for r in range(len(index)):
            hp = kept[m, 0, index[r]]
            for i in range(n):
                for j in range(w):
                    slopes[r * n + i, j] = hp[j] * A1[m, i, j]
                    through[r * n + i, j] = A2[m, i, j]
        _multiply(slopes, PT[m], through, tangents)
        for r in range(len(index)):
            row = index[r]
            first, second = kept[m, 1, row], kept[m, 2, row]
            for i in range(n):
                left = through[r * n + i]
                for k in range(i + 1):
                    right = through[r * n + k]
                    value = np.float32(0.0)
                    for j in range(w):
                        value += A1[m, i, j] * first[j] * A1[m, k, j] + left[j] * second[j] * right[j]
                    hessian[row, i, k] += share * value
    for row in index:
        for i in range(n):
            for k in range(i):
                hessian[row, k, i] = hessian[row, i, k]


@njit(**_FAST)
def _efforts(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, effort):
    """Gradient of the energy (rows, n) at scaled actuation u (rows, n) of bodies ``slot`` (rows,)."""
    kept = np.empty((len(A1), 3, min(_ROWS, len(u)), A1.shape[2]), np.float32)
    for start in range(0, len(u), _ROWS):
        rows = slice(start, start + _ROWS)
        _gradients(u[rows], slot[rows], A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, effort[rows])


@njit(**_FAST)
def _hessians(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, hessian):
    """Hessian of the energy (rows, n, n) at scaled actuation u (rows, n) of bodies ``slot`` (rows,)."""
    size = min(_ROWS, len(u))
    kept = np.empty((len(A1), 3, size, A1.shape[2]), np.float32)
    effort, index = np.empty((size, u.shape[1]), np.float32), np.arange(size)
    for start in range(0, len(u), _ROWS):
        rows = slice(start, start + _ROWS)
        part, bodies = u[rows], slot[rows]
        _gradients(part, bodies, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, effort)
        _curvatures(index[: len(part)], bodies, A1, A2, PT, quadratic, kept, hessian[rows])


@njit(**_FAST)
def _effectors(u, slot, B1, B2, V, d1, d2, x0, slope, effector, spread):
    """Effector (rows, e) and its spread (rows,) at scaled actuation u (rows, n) of bodies ``slot`` (rows,)."""
    members, n, w = B1.shape
    e = V.shape[1]
    one, share = np.float32(1.0), np.float32(1.0 / members)
    most = min(_ROWS, len(u))
    h, z = np.empty((most, w), np.float32), np.empty((most, w), np.float32)
    x = np.empty((most, members, e), np.float32)
    for start in range(0, len(u), _ROWS):
        rows = min(_ROWS, len(u) - start)
        part = u[start : start + rows]
        for m in range(members):
            for r in range(rows):
                s = slot[start + r]
                for j in range(w):
                    z[r, j] = d1[s, m, j]
            _multiply(part, B1[m], z, rows)
            for r in range(rows):
                for j in range(w):
                    h[r, j] = z[r, j] / np.sqrt(one + z[r, j] * z[r, j])
                s = slot[start + r]
                for j in range(w):
                    z[r, j] = d2[s, m, j]
            _multiply(h, B2[m], z, rows)
            for r in range(rows):
                s = slot[start + r]
                for j in range(w):
                    z[r, j] = z[r, j] / np.sqrt(one + z[r, j] * z[r, j])
                for k in range(e):
                    value = x0[s, m, k]
                    for i in range(n):
                        value += slope[s, m, k, i] * part[r, i]
                    for j in range(w):
                        value += z[r, j] * V[m, k, j]
                    x[r, m, k] = value
        # mean, and the largest standard deviation of a point
        for r in range(rows):
            for k in range(e):
                value = np.float32(0.0)
                for m in range(members):
                    value += x[r, m, k]
                effector[start + r, k] = share * value
            largest = np.float32(0.0)
            for first in range(0, e, 3):
                value = np.float32(0.0)
                for k in range(first, first + 3):
                    for m in range(members):
                        value += (x[r, m, k] - effector[start + r, k]) ** 2
                largest = max(largest, value)
            spread[start + r] = np.sqrt(share * largest)


@njit(**_FAST)
def _jacobians(u, slot, B1, B2, V, H, d1, d2, slope, held0, jacobian, held):
    """Jacobian of the effector (rows, e, n) and held compliance (rows, e, e) of bodies ``slot`` (rows,)."""
    members, n, w = B1.shape
    e = V.shape[1]
    entries = H.shape[2]
    one, share = np.float32(1.0), np.float32(1.0 / members)
    h, z, hp = np.empty((1, w), np.float32), np.empty((1, w), np.float32), np.empty(w, np.float32)
    through, first = np.empty((n, w), np.float32), np.empty((n, w), np.float32)
    y = np.empty(entries, np.float32)
    L = np.zeros((e, e), np.float32)
    for row in range(len(u)):
        s = slot[row]
        part = u[row : row + 1]
        for k in range(e):
            for i in range(n):
                jacobian[row, k, i] = 0.0
            for j in range(e):
                held[row, k, j] = 0.0
        for m in range(members):
            for j in range(w):
                z[0, j] = d1[s, m, j]
            _multiply(part, B1[m], z, 1)
            for j in range(w):
                r = one / np.sqrt(one + z[0, j] * z[0, j])
                h[0, j] = z[0, j] * r
                hp[j] = r * r * r
                z[0, j] = d2[s, m, j]
            for i in range(n):
                for j in range(w):
                    first[i, j] = hp[j] * B1[m, i, j]
                    through[i, j] = 0.0
            _multiply(h, B2[m], z, 1)
            _multiply(first, B2[m], through, n)
            for k in range(entries):
                y[k] = held0[s, m, k]
            for j in range(w):
                r = one / np.sqrt(one + z[0, j] * z[0, j])
                hp[j] = r * r * r
                for k in range(entries):
                    y[k] += z[0, j] * r * H[m, j, k]
            for k in range(e):
                for i in range(n):
                    value = slope[s, m, k, i]
                    for j in range(w):
                        value += V[m, k, j] * hp[j] * through[i, j]
                    jacobian[row, k, i] += share * value
            k = 0
            for i in range(e):
                for j in range(i + 1):
                    L[i, j] = np.exp(y[k]) if i == j else y[k]
                    k += 1
            for i in range(e):
                for j in range(i + 1):
                    value = np.float32(0.0)
                    for k in range(j + 1):
                        value += L[i, k] * L[j, k]
                    held[row, i, j] += share * value
        for i in range(e):
            for k in range(i):
                held[row, k, i] = held[row, i, k]


@njit(cache=True, error_model="numpy")
def _invert(a):
    """Invert a positive definite matrix in place (Gauss and Jordan; no pivoting needed); False if it is not one."""
    n = len(a)
    for p in range(n):
        if not a[p, p] > 0.0:
            return False
        inverse = 1.0 / a[p, p]
        a[p, p] = 1.0
        for j in range(n):
            a[p, j] *= inverse
        for i in range(n):
            if i != p:
                factor = a[i, p]
                a[i, p] = 0.0
                for j in range(n):
                    a[i, j] -= factor * a[p, j]
    return True


@njit(**_FAST)
def _search(
    target, guess, unilateral, limit, tolerance, iterations, middle, half, scale, stiffness, slot,
    A1, A2, P, PT, c1, c2, a, b, quadratic, linear, first, displacement, effort, converged,
):  # fmt: skip
    """Newton's method on the complementarity problem of each row; see `SurrogateModel.search`.

    The steps are those of one member's curvature, whose quadratic part is ``first``. A step more for one row in five
    (cable trunk; none to one in four elsewhere) costs less than the curvature of all members, which took half the time.

    The rows of a block take their steps together, so that the network is asked for all that still move at once.
    """
    n = target.shape[1]
    size = min(_ROWS, len(target))
    kept = np.empty((len(A1), 3, size, A1.shape[2]), np.float32)
    u, g, K = np.empty((size, n), np.float32), np.empty((size, n), np.float32), np.empty((size, n, n), np.float32)
    moving, asked, part = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    W, gap, taut = np.empty((size, n, n)), np.empty(n), np.empty(n)
    work, index = np.empty((n, n + 1)), np.empty(n, np.int64)
    for start in range(0, len(target), _ROWS):
        # of this block: displacements, efforts, and the rows that still move
        d, e = displacement[start : start + _ROWS], effort[start : start + _ROWS]
        count = len(d)
        for row in range(count):
            moving[row] = row
            converged[start + row] = False
            for i in range(n):
                d[row, i] = guess[start + row, i]
        for iteration in range(iterations + 1):
            for k in range(count):
                row = moving[k]
                part[k] = slot[start + row]
                for i in range(n):
                    u[k, i] = (d[row, i] - middle[i]) / half[i]
            _gradients(u[:count], part, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, g)
            left = 0
            for k in range(count):
                row = moving[k]
                finite, right = True, iteration == 0
                for i in range(n):
                    e[row, i] = g[k, i] * scale[i] * stiffness[part[k], 0]
                    finite = finite and np.isfinite(e[row, i])
                    if unilateral[i] and (e[row, i] < 0.0 or d[row, i] > target[start + row, i]):
                        right = False
                if not finite or right:
                    converged[start + row] = finite
                else:
                    moving[left], asked[left] = row, k
                    left += 1
            count = left
            renew = iteration % 4 == 0
            if renew:
                # W changes slowly along the search; a simplified Newton step is cheaper than a new one.
                _curvatures(asked[:count], part, A1[:1], A2[:1], PT[:1], first, kept, K)
            left = 0
            for k in range(count):
                row = moving[k]
                if renew:
                    for i in range(n):
                        for j in range(n):
                            W[row, i, j] = K[asked[k], i, j] * scale[i] / half[j] * stiffness[slot[start + row], 0]
                    if not _invert(W[row]):
                        continue
                for i in range(n):
                    gap[i] = d[row, i] - target[start + row, i]
                    for j in range(n):
                        gap[i] -= W[row, i, j] * e[row, j]
                if not _solve_row(W[row], gap, unilateral, taut, work, index):
                    continue
                far = False
                for i in range(n):
                    step = 0.0
                    for j in range(n):
                        step += W[row, i, j] * (taut[j] - e[row, j])
                    # Far steps are cut: the network is only asked where its neighbourhood of known states reaches.
                    step = min(max(step, -limit[i]), limit[i])
                    d[row, i] += step
                    far = far or abs(step) > tolerance[i]
                if far:
                    moving[left] = row
                    left += 1
                    continue
                # A last step below the tolerance is taken without asking the model again.
                converged[start + row] = True
                for i in range(n):
                    e[row, i] = taut[i]
            count = left
            if count == 0:
                break


class Model(SurrogateModel):
    """An ensemble of potential networks (see the module)."""

    network = "potential"
    ensemble = True

    def __init__(
        self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any], members: int | None = None
    ) -> None:
        super().__init__(robot, tensors, card)
        available = len(tensors["energy1"])
        if members is not None and not 1 <= members <= available:
            raise ValueError(f"members = {members} is out of bounds; these weights have 1 to {available}")
        #: Their spread is calibrated for all of an ensemble; that of fewer is smaller, and one has none.
        self.trained = max(available, 2)
        tensors = {
            k: v[:members] if v.shape and not k.startswith("scale.") and k != "rest" else v for k, v in tensors.items()
        }
        self.tensors = tensors
        self.members, self.width = tensors["energy1"].shape[:2]

        def kernel(name, *axes):
            return np.ascontiguousarray(np.transpose(tensors[name], axes), dtype=np.float32)

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
        self._held = kernel("held", 0, 2, 1)
        layers = [(tensors[f"body.{k}.weight"], tensors[f"body.{k}.bias"]) for k in range(3)]
        self._layers = [(w.astype(np.float32), v.astype(np.float32)[:, None]) for w, v in layers]
        rest = tensors["rest"].astype(np.float32) if "rest" in tensors else None
        self._rest = rest
        if rest is not None and rest.shape != (self.count,):
            raise ValueError(f"the rest has shape {rest.shape}, the robot {self.count} actuators")

    def _prepare(self, design: np.ndarray) -> dict[str, np.ndarray]:
        rows, n, e, w, M = len(design), self.count, self.effectors, self.width, self.members
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
            body[name] = np.logaddexp(np.float32(0.0), body[name] - np.float32(4.0))
        lower = np.tril_indices(n)
        factor, entries = np.zeros((rows, M, n, n), dtype=np.float32), body["quadratic"]
        if self.robot.convex:
            factor[:, :, lower[0], lower[1]] = np.where(lower[0] == lower[1], np.exp(entries), entries)
            quadratic = factor @ factor.swapaxes(2, 3)
        else:
            factor[:, :, lower[0], lower[1]] = entries
            quadratic = factor + factor.swapaxes(2, 3)
        body["quadratic"], body["first"] = quadratic.mean(axis=1), np.ascontiguousarray(quadratic[:, 0])
        body["slope"] = body["slope"].reshape(rows, M, e, n)
        body["linear"] = np.ascontiguousarray(body["linear"].mean(axis=1))
        if self._rest is not None:
            body["linear"] = np.zeros_like(body["linear"])
            body["linear"] = -self._gradient(body, np.repeat(self._rest[None], rows, axis=0), np.arange(rows))
        return body

    def _gradient(self, body: dict[str, np.ndarray], u: np.ndarray, slot: np.ndarray) -> np.ndarray:
        effort = np.empty((len(u), self.count), dtype=np.float32)
        coefficients = (body["c1"], body["c2"], body["a"], body["b"], body["quadratic"], body["linear"])
        _efforts(u, slot, *self._energy, *coefficients, effort)
        return effort

    def _scaled(self, displacement: np.ndarray) -> np.ndarray:
        return ((displacement - self.middle) / self.half_range).astype(np.float32)

    def _effort(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._gradient(context.arrays, self._scaled(displacement), context.slot) * self._effort_scale

    def _state(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._effort(context, displacement), *self.effector(context, displacement)

    def effector(self, context: Context, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, body = self._scaled(displacement), context.arrays
        effector = np.empty((len(u), self.effectors), dtype=np.float32)
        spread = np.empty(len(u), dtype=np.float32)
        coefficients = (body["d1"], body["d2"], body["x0"], body["slope"])
        _effectors(u, context.slot, *self._shape, *coefficients, effector, spread)
        if self.members < self.trained:
            spread = np.full(len(u), np.inf)
        return effector * self.effector_scale + self.effector_mean, spread * self.effector_scale

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
        _search(
            target, guess, unilateral, self.span, tolerance * self.span, iterations, self.middle, self.half_range,
            self._effort_scale, context.stiffness, context.slot, *self._energy,
            *(body[k] for k in ("c1", "c2", "a", "b", "quadratic", "linear", "first")), displacement, effort, converged,
        )  # fmt: skip
        return displacement, effort, converged

    def _stiffness(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        return self._hessian(context, displacement, self._energy, "quadratic")

    def _curvature(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        """Of the first member alone, in a fifth of the time: members agree that actuators become soft."""
        return self._hessian(context, displacement, [part[:1] for part in self._energy], "first")

    def _hessian(
        self, context: Context, displacement: np.ndarray, energy: Iterable[np.ndarray], quadratic: str
    ) -> np.ndarray:
        """Stiffness of the members whose weights are given, with their quadratic part by its name."""
        u, body = self._scaled(displacement), context.arrays
        hessian = np.empty((len(u), self.count, self.count), dtype=np.float32)
        coefficients = (body["c1"], body["c2"], body["a"], body["b"], body[quadratic], body["linear"])
        _hessians(u, context.slot, *energy, *coefficients, hessian)
        return hessian.astype(float) * (self._effort_scale[:, None] / self.half_range)

    def _compliance(self, context: Context, displacement: np.ndarray) -> np.ndarray:
        u, body = self._scaled(displacement), context.arrays
        rows, n, e = len(u), self.count, self.effectors
        jacobian = np.empty((rows, e, n), dtype=np.float32)
        held = np.empty((rows, e, e), dtype=np.float32)
        coefficients = (body["d1"], body["d2"], body["slope"], body["held"])
        _jacobians(u, context.slot, *self._shape, self._held, *coefficients, jacobian, held)
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
        return W


def train(
    robot: Robot, training: States, validation: States, trainer: Any
) -> tuple[dict[str, np.ndarray], dict[str, list[dict[str, float]]]]:
    """Train the members, ``trainer.workers`` at a time; each has its own seed and order of batches, all the same data.

    A process that runs one member uses one thread, so the weights do not depend on the number of workers.
    """
    options: Options = trainer.options
    scales = _scales(robot, training)
    data = {key: _targets(robot, states, scales) for key, states in (("t", training), ("v", validation))}
    rest = None
    if training.unloaded:
        middle = 0.5 * (robot.upper + robot.lower)
        rest = (0.0 - middle) / (robot.upper - middle)
    arguments = [(trainer, member, data, rest, robot.convex) for member in range(options.members)]
    found = sorted(parallel_map(_train_member, arguments, trainer.workers), key=lambda result: result[0])
    return stack_members([state for _, state, _ in found], scales), {f"member {k}": rows for k, _, rows in found}


def _train_member(
    trainer: Any, member: int, data: dict[str, list], rest: np.ndarray | None, convex: bool
) -> tuple[int, dict[str, np.ndarray], list[dict[str, float]]]:
    """Number, state and history of one member."""
    import torch

    from softgym_envs.surrogate.potential.torch import PotentialNet

    torch.set_num_threads(1)
    options: Options = trainer.options
    seed = trainer.seed + 1000 * member
    torch.manual_seed(seed)
    design, _, effort, effector, S = data["t"][:5]
    sizes = (effort.shape[1], effector.shape[1], design.shape[1], options.width, options.body_width)
    net = PotentialNet(*sizes, rest, convex=convex)
    effort_spread = float(((S.mT @ effort[:, :, None]) ** 2).mean())

    def loss(rows):
        batch = data["v"] if rows is None else [part[rows] for part in data["t"]]
        return potential_loss(net, batch, effort_spread)

    history = trainer.optimise(f"member {member}", net, loss, len(design), seed=seed)
    return member, {k: v.detach().numpy().copy() for k, v in net.state_dict().items()}, history


def stack_members(states: list[dict[str, np.ndarray]], scales: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the weights of `Model` from the states of its members in torch."""
    tensors = {k: states[0][k] if k == "rest" else np.stack([state[k] for state in states]) for k in states[0]}
    return tensors | {f"scale.{k}": v for k, v in scales.items()}


def unstack_members(tensors: Mapping[str, np.ndarray]) -> tuple[list[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Return the states of the members in torch and the scales: the inverse of `stack_members`."""
    scales = {k.removeprefix("scale."): np.asarray(v) for k, v in tensors.items() if k.startswith("scale.")}
    weights = {k: v for k, v in tensors.items() if not k.startswith("scale.")}
    members = range(len(tensors["energy1"]))
    return [{k: v if k == "rest" else v[member] for k, v in weights.items()} for member in members], scales


def _scales(robot: Robot, states: States) -> dict[str, np.ndarray]:
    """What makes energy, effector and held compliance of order one."""
    n = states.effort.shape[1]
    half = 0.5 * (robot.upper - robot.lower)
    K = np.linalg.inv(states.W[:, :n, :n])
    return {
        "energy": np.array(np.median(np.einsum("bii->bi", K) * half**2)),
        "effector_mean": states.effector.mean(axis=0),
        "effector": np.array(max(float(states.effector.std(axis=0).max()), 1e-9)),
        "held": np.array(np.median(np.einsum("bii->bi", states.W[:, n:, n:]))),
    }


def _targets(robot: Robot, states: States, scales: dict[str, np.ndarray]) -> list:
    """Scaled targets: design, actuation, effort, effector, metric, Hessian in it, Jacobian, whitening of C, and C.

    The metric is a factor of W_aa, where W_aa may have any sign that of the body's rest.
    """
    import torch

    n = states.effort.shape[1]
    a, c = slice(0, n), slice(n, None)
    half = 0.5 * (robot.upper - robot.lower)
    W_aa = states.W[:, a, a] / half[:, None] / half * scales["energy"]
    metric_of = np.arange(len(states)) if robot.convex else states.rest_of
    S = np.linalg.cholesky(0.5 * (W_aa + W_aa.swapaxes(1, 2))[metric_of])
    hessian = np.broadcast_to(np.eye(n), W_aa.shape) if robot.convex else S.swapaxes(1, 2) @ np.linalg.inv(W_aa) @ S
    J = np.linalg.solve(states.W[:, a, a], states.W[:, a, c]).swapaxes(1, 2)
    W_ee = states.W[:, c, c] / scales["held"]
    size = W_ee.shape[1]
    C = W_ee - J @ states.W[:, a, c] / scales["held"]
    W_ee = W_ee[metric_of]
    # A body without freedom left (a rigid direction) has C = 0 up to rounding: a factor needs a little more.
    floor = 1e-6 * np.einsum("bii->b", W_ee)[:, None, None] / size
    C = 0.5 * (C + C.swapaxes(1, 2)) + 2.0 * size * floor * np.eye(size)
    whitening = np.linalg.inv(np.linalg.cholesky(C + 0.03 * W_ee))
    parts = (
        states.design,
        states.actuation,
        states.effort * half / scales["energy"],
        (states.effector - scales["effector_mean"]) / scales["effector"],
        S,
        hessian,
        J * half / scales["effector"],
        whitening,
        C,
    )
    return [torch.as_tensor(np.ascontiguousarray(part), dtype=torch.float32) for part in parts]


def potential_loss(net, batch: list, effort_spread: float):
    """Sum of mean squared errors: efforts and Hessian in their metric, C in its own, effector and Jacobian plain."""
    design, u, effort, effector, S, K, J, whitening, C = batch
    gradient, hessian, x, jacobian, L = net(design, u)
    terms = (
        ((S.mT @ (gradient - effort)[:, :, None]) ** 2).mean() / effort_spread,
        ((S.mT @ hessian @ S - K) ** 2).mean(),
        ((x - effector) ** 2).mean(),
        ((jacobian - J) ** 2).mean(),
        ((whitening @ (L @ L.mT - C) @ whitening.mT) ** 2).mean(),
    )
    return sum(terms)

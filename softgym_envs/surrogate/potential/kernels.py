"""Compiled kernels of the potential networks: they evaluate many rows and members without temporary arrays per row."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgym_envs.mechanics.compilation import FAST, njit
from softgym_envs.mechanics.solvers.complementarity import solve_row

_FAST: Any = {"cache": True, "error_model": "numpy", "fastmath": FAST}
#: Rows evaluated together: each weight is then fetched once for all of them, and the weights and results of one member
#: stay in the fast caches.
ROWS_PER_BLOCK = 48
#: Steps of a search for slack cables after which none is simplified; two to four usually suffice.
PATIENCE = 8


@njit(**_FAST)
def _multiply(h, weights, z, rows):
    """``z += h @ weights`` for the first ``rows`` rows, four at a time with four inputs at a time.

    With sixteen products for each load and store of z, arithmetic limits the speed rather than memory.
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
def _gradients(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, each, effort):
    """Fill ``effort`` (rows, n) with the gradient of the energy at scaled actuation u (rows, n), for one block.

    ``slot`` (rows,) is the body of each row. ``kept`` (members, 3, rows, w) is filled for `_curvatures`: the slope of
    the first activation, and the weight of each layer's curvature in the Hessian; ``each`` (members, rows, n) with what
    the layers of each member add.
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
                each[m, r, i] = value
                effort[r, i] += share * value


@njit(**_FAST)
def _curvatures(index, slot, A1, A2, PT, quadratic, kept, hessian):
    """Fill the rows ``index`` of ``hessian`` (rows, n, n) of a block, from what `_gradients` stored in ``kept``."""
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
def member_efforts(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratics, linears, efforts):
    """Gradients of the energies of the members (rows, members, n) at scaled actuation u (rows, n).

    ``quadratics`` (bodies, members, n, n) and ``linears`` (bodies, members, n) are those of each member.
    """
    members, n, w = A1.shape
    most = min(ROWS_PER_BLOCK, len(u))
    kept, each = np.empty((members, 3, most, w), np.float32), np.empty((members, most, n), np.float32)
    effort = np.empty((most, n), np.float32)
    none, zero = np.zeros((len(c1), n, n), np.float32), np.zeros((len(c1), n), np.float32)
    for start in range(0, len(u), ROWS_PER_BLOCK):
        part = u[start : start + ROWS_PER_BLOCK]
        _gradients(part, slot[start : start + len(part)], A1, A2, P, PT, c1, c2, a, b, none, zero, kept, each, effort)
        for r in range(len(part)):
            s = slot[start + r]
            for m in range(members):
                for i in range(n):
                    value = each[m, r, i] + linears[s, m, i]
                    for j in range(n):
                        value += quadratics[s, m, i, j] * part[r, j]
                    efforts[start + r, m, i] = value


@njit(**_FAST)
def moved_spreads(efforts, slot, lever, spread):
    """How far differences of the efforts (rows, members, n) from their mean move a point: root mean square (rows,).

    ``lever`` (bodies, e, n) moves the points, three coordinates each; the largest counts.
    """
    rows, members, n = efforts.shape
    mean = np.empty(n, np.float32)
    for r in range(rows):
        s = slot[r]
        for i in range(n):
            mean[i] = 0.0
            for m in range(members):
                mean[i] += efforts[r, m, i] / np.float32(members)
        largest = np.float32(0.0)
        for first in range(0, lever.shape[1], 3):
            square = np.float32(0.0)
            for m in range(members):
                for k in range(first, first + 3):
                    move = np.float32(0.0)
                    for i in range(n):
                        move += lever[s, k, i] * (efforts[r, m, i] - mean[i])
                    square += move * move
            largest = max(largest, square)
        spread[r] = np.sqrt(largest / np.float32(members))


@njit(**_FAST)
def hessians(u, slot, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, hessian):
    """Hessian of the energy (rows, n, n) at scaled actuation u (rows, n) of bodies ``slot`` (rows,)."""
    size = min(ROWS_PER_BLOCK, len(u))
    kept, each = (
        np.empty((len(A1), 3, size, A1.shape[2]), np.float32),
        np.empty((len(A1), size, u.shape[1]), np.float32),
    )
    effort, index = np.empty((size, u.shape[1]), np.float32), np.arange(size)
    for start in range(0, len(u), ROWS_PER_BLOCK):
        rows = slice(start, start + ROWS_PER_BLOCK)
        part, bodies = u[rows], slot[rows]
        _gradients(part, bodies, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, each, effort)
        _curvatures(index[: len(part)], bodies, A1, A2, PT, quadratic, kept, hessian[rows])


@njit(**_FAST)
def effectors(u, slot, B1, B2, V, d1, d2, x0, slope, coordinates, effector, spread):
    """Effector (rows, e) and its spread (rows,) at scaled actuation u (rows, n) of bodies ``slot`` (rows,).

    The first ``coordinates`` rows are points, three each, whose spread counts; sensors follow.
    """
    members, n, w = B1.shape
    e = V.shape[1]
    one, share = np.float32(1.0), np.float32(1.0 / members)
    most = min(ROWS_PER_BLOCK, len(u))
    h, z = np.empty((most, w), np.float32), np.empty((most, w), np.float32)
    x = np.empty((most, members, e), np.float32)
    for start in range(0, len(u), ROWS_PER_BLOCK):
        rows = min(ROWS_PER_BLOCK, len(u) - start)
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
            for first in range(0, coordinates, 3):
                value = np.float32(0.0)
                for k in range(first, first + 3):
                    for m in range(members):
                        value += (x[r, m, k] - effector[start + r, k]) ** 2
                largest = max(largest, value)
            spread[start + r] = np.sqrt(share * largest)


@njit(**_FAST)
def effector_gradients(u, slot, B1, B1T, B2, B2T, V, d1, d2, slope, weights, gradient):
    """Gradient (rows, n) of ``weights . effector`` at scaled actuation u (rows, n), in reverse mode."""
    members, n, w = B1.shape
    e = V.shape[1]
    one, share = np.float32(1.0), np.float32(1.0 / members)
    most = min(ROWS_PER_BLOCK, len(u))
    h, z = np.empty((most, w), np.float32), np.empty((most, w), np.float32)
    first, back = np.empty((most, w), np.float32), np.empty((most, n), np.float32)
    for start in range(0, len(u), ROWS_PER_BLOCK):
        rows = min(ROWS_PER_BLOCK, len(u) - start)
        part = u[start : start + rows]
        gradient[start : start + rows] = np.float32(0.0)
        for m in range(members):
            for r in range(rows):
                s = slot[start + r]
                for j in range(w):
                    z[r, j] = d1[s, m, j]
            _multiply(part, B1[m], z, rows)
            for r in range(rows):
                s = slot[start + r]
                for j in range(w):
                    inverse = one / np.sqrt(one + z[r, j] * z[r, j])
                    h[r, j] = z[r, j] * inverse
                    first[r, j] = inverse * inverse * inverse
                    z[r, j] = d2[s, m, j]
            _multiply(h, B2[m], z, rows)
            for r in range(rows):
                for j in range(w):
                    value = np.float32(0.0)
                    for k in range(e):
                        value += weights[start + r, k] * V[m, k, j]
                    inverse = one / np.sqrt(one + z[r, j] * z[r, j])
                    z[r, j] = value * inverse * inverse * inverse
                    h[r, j] = np.float32(0.0)
            _multiply(z, B2T[m], h, rows)
            for r in range(rows):
                s = slot[start + r]
                for j in range(w):
                    h[r, j] *= first[r, j]
                for i in range(n):
                    back[r, i] = np.float32(0.0)
                    for k in range(e):
                        back[r, i] += weights[start + r, k] * slope[s, m, k, i]
            _multiply(h, B1T[m], back, rows)
            for r in range(rows):
                for i in range(n):
                    gradient[start + r, i] += share * back[r, i]


@njit(**_FAST)
def jacobians(u, slot, B1, B2, V, H, d1, d2, slope, held0, jacobian, held):
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
    """Invert a positive definite matrix in place (Gauss-Jordan without pivoting); return False if it is not one."""
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
def search(
    target, guess, unilateral, limit, tolerance, iterations, middle, half, scale, stiffness, slot,
    A1, A2, P, PT, c1, c2, a, b, quadratic, linear, first, displacement, effort, converged,
):  # fmt: skip
    """Newton's method on the complementarity problem of each row; see `SurrogateModel.search`.

    The first four steps use the curvature of the first member alone, whose quadratic part is ``first``. One row in five
    therefore needs one more step (cable trunk; up to one in four elsewhere). That costs less than the curvature of
    all members, which took half of the time. Rows that are still on the way then use all members, from step `PATIENCE`
    on anew in each step: where members disagree about the stiffness by half, steps with one of them would oscillate.

    The rows of a block take their steps together, so that one evaluation of the network serves all rows that move.
    """
    n = target.shape[1]
    size = min(ROWS_PER_BLOCK, len(target))
    kept, each = np.empty((len(A1), 3, size, A1.shape[2]), np.float32), np.empty((len(A1), size, n), np.float32)
    u, g, K = np.empty((size, n), np.float32), np.empty((size, n), np.float32), np.empty((size, n, n), np.float32)
    moving, asked, part = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    W, gap, taut, step = np.empty((size, n, n)), np.empty(n), np.empty(n), np.empty(n)
    last, damping = np.empty((size, n)), np.empty(size)
    work, index = np.empty((n, n + 1)), np.empty(n, np.int64)
    for start in range(0, len(target), ROWS_PER_BLOCK):
        # Displacements, efforts, and the rows of this block that still move.
        d, e = displacement[start : start + ROWS_PER_BLOCK], effort[start : start + ROWS_PER_BLOCK]
        count = len(d)
        for row in range(count):
            moving[row], damping[row] = row, 1.0
            converged[start + row] = False
            for i in range(n):
                d[row, i], last[row, i] = guess[start + row, i], 0.0
        for iteration in range(iterations + 1):
            for k in range(count):
                row = moving[k]
                part[k] = slot[start + row]
                for i in range(n):
                    u[k, i] = (d[row, i] - middle[i]) / half[i]
            _gradients(u[:count], part, A1, A2, P, PT, c1, c2, a, b, quadratic, linear, kept, each, g)
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
            # W changes slowly along the search; a simplified Newton step is cheaper than a new one.
            renew = iteration % 4 == 0 or iteration >= PATIENCE
            if renew and iteration == 0:
                _curvatures(asked[:count], part, A1[:1], A2[:1], PT[:1], first, kept, K)
            elif renew:
                _curvatures(asked[:count], part, A1, A2, PT, quadratic, kept, K)
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
                if not solve_row(W[row], gap, unilateral, taut, work, index):
                    continue
                share, turned = 1.0, 0.0
                for i in range(n):
                    step[i] = 0.0
                    for j in range(n):
                        step[i] += W[row, i, j] * (taut[j] - e[row, j])
                    # A long step is shortened as a whole, so that the network is evaluated near known states only. Cut
                    # one by one, cables that pull against each other would leave the direction of the solution.
                    if abs(step[i]) * share > limit[i]:
                        share = limit[i] / abs(step[i])
                    turned += step[i] * last[row, i] / limit[i] ** 2
                if iteration >= 4:
                    # A step that leads back has gone too far: on a convex energy, halving such steps ends the cycle.
                    damping[row] = 0.5 * damping[row] if turned < 0.0 else min(1.0, 2.0 * damping[row])
                far = False
                for i in range(n):
                    last[row, i] = step[i]
                    d[row, i] += damping[row] * share * step[i]
                    far = far or abs(step[i]) > tolerance[i]
                if far:
                    moving[left] = row
                    left += 1
                    continue
                # A last step below the tolerance is taken without evaluating the model again.
                converged[start + row] = True
                for i in range(n):
                    e[row, i] = taut[i]
            count = left
            if count == 0:
                break

"""The potential network in torch: for training, and for derivatives with respect to the design."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from softgym_envs.surrogate.potential.model import body_parts

__all__ = ["PotentialNet"]


class _Sigmoid(nn.Module):
    def forward(self, x):
        return x * torch.rsqrt(1.0 + x * x)


def _sigmoid(z):
    """The algebraic sigmoid and its derivative."""
    r = torch.rsqrt(1.0 + z * z)
    return z * r, r**3


def _ramp(z):
    """A convex, increasing ramp ``(z + sqrt(1 + z^2)) / 2`` with its first and second derivative."""
    r = torch.rsqrt(1.0 + z * z)
    return 0.5 * (z + 1.0 / r), 0.5 * (1.0 + z * r), 0.5 * r**3


class PotentialNet(nn.Module):
    """One member of `PotentialModel`, in scaled quantities.

    Args:
        count: actuators n.
        effectors: effector rows e.
        design: design features d; 0 for a single body.
        width: hidden units w of the actuation layers.
        body_width: hidden units of the design layers.
        rest: scaled actuation at which the effort is zero, shape (n,), or None where it is learned.
        convex: the energy is convex; otherwise its quadratic part has any sign.
    """

    rest: torch.Tensor | None
    lower_a: torch.Tensor
    lower_e: torch.Tensor

    def __init__(
        self, count: int, effectors: int, design: int, width: int, body_width: int, rest=None, convex: bool = True
    ) -> None:
        super().__init__()
        n, e, w = count, effectors, width
        self.n, self.e, self.w, self.convex = n, e, w, convex
        self.sizes = list(body_parts(n, e, w).values())
        self.body = nn.Sequential(
            nn.Linear(max(design, 1), body_width),
            _Sigmoid(),
            nn.Linear(body_width, body_width),
            _Sigmoid(),
            nn.Linear(body_width, sum(self.sizes)),
        )
        self.energy1 = nn.Parameter(torch.randn(w, n))
        self.energy2 = nn.Parameter(0.7 * torch.randn(w, n))
        self.pass_on = nn.Parameter(-5.0 + 0.5 * torch.randn(w, w))
        self.shape1 = nn.Parameter(0.7 * torch.randn(w, n))
        self.shape2 = nn.Parameter(torch.randn(w, w) / w**0.5)
        self.effector = nn.Parameter(0.1 * torch.randn(e, w))
        self.held = nn.Parameter(0.1 * torch.randn(e * (e + 1) // 2, w))
        with torch.no_grad():
            last: Any = self.body[-1]
            last.weight *= 0.3
            last.bias[: 2 * w] = torch.randn(2 * w)
            last.bias[-2 * w :] = 0.7 * torch.randn(2 * w)
        self.register_buffer("rest", None if rest is None else torch.as_tensor(rest, dtype=torch.float32))
        self.register_buffer("lower_a", torch.tril_indices(n, n), persistent=False)
        self.register_buffer("lower_e", torch.tril_indices(e, e), persistent=False)

    @staticmethod
    def _triangular(entries, index, size):
        matrix = torch.zeros(len(entries), size, size, dtype=entries.dtype)
        matrix[:, index[0], index[1]] = torch.where(index[0] == index[1], torch.exp(entries), entries)
        return matrix

    def _quadratic(self, entries):
        if self.convex:
            factor = self._triangular(entries, self.lower_a, self.n)
            return factor @ factor.mT
        half = torch.zeros(len(entries), self.n, self.n, dtype=entries.dtype)
        half[:, self.lower_a[0], self.lower_a[1]] = entries
        return half + half.mT

    def coefficients(self, design) -> dict:
        """What the body gives to the layers, from design features (B, d)."""
        if design.shape[1] == 0:
            design = torch.zeros(len(design), 1, dtype=design.dtype)
        c1, c2, a, b, quadratic, linear, x0, slope, held, d1, d2 = torch.split(self.body(design), self.sizes, dim=1)
        return {
            "c1": c1,
            "c2": c2,
            "a": nn.functional.softplus(a - 4.0),
            "b": nn.functional.softplus(b - 4.0),
            "quadratic": self._quadratic(quadratic),
            "linear": linear,
            "x0": x0,
            "slope": slope.reshape(-1, self.e, self.n),
            "held": held,
            "d1": d1,
            "d2": d2,
        }

    def _gradient(self, u, body, passed):
        z1 = u @ self.energy1.T + body["c1"]
        h1, h1p, h1pp = _ramp(z1)
        _, h2p, h2pp = _ramp(h1 @ passed.T + u @ self.energy2.T + body["c2"])
        upper = body["a"] * h2p
        lower = upper @ passed + body["b"]
        gradient = (h1p * lower) @ self.energy1 + upper @ self.energy2 + (body["quadratic"] @ u[:, :, None])[:, :, 0]
        return gradient, (h1p, h1pp * lower, body["a"] * h2pp)

    def forward(self, design, u):
        """Return gradient and Hessian of the energy, effector, its Jacobian, and the factor of the held compliance.

        Args:
            design: features (B, d).
            u: scaled actuation (B, n).
        """
        body = self.coefficients(design)
        passed = nn.functional.softplus(self.pass_on)
        gradient, (h1p, k1, k2) = self._gradient(u, body, passed)
        if self.rest is None:
            gradient = gradient + body["linear"]
        else:
            gradient = gradient - self._gradient(self.rest.to(u.dtype).expand(len(u), -1), body, passed)[0]
        # Tangents (B, n, w): one matrix product for all of them.
        through = (h1p[:, None] * self.energy1.T) @ passed.T + self.energy2.T
        hessian = (k1[:, None] * self.energy1.T) @ self.energy1
        hessian = hessian + (k2[:, None] * through) @ through.mT + body["quadratic"]
        g1, s1 = _sigmoid(u @ self.shape1.T + body["d1"])
        g2, s2 = _sigmoid(g1 @ self.shape2.T + body["d2"])
        effector = body["x0"] + (body["slope"] @ u[:, :, None])[:, :, 0] + g2 @ self.effector.T
        inner = ((s1[:, None] * self.shape1.T) @ self.shape2.T) * s2[:, None]
        jacobian = body["slope"] + (inner @ self.effector.T).mT
        held = self._triangular(body["held"] + g2 @ self.held.T, self.lower_e, self.e)
        return gradient, hessian, effector, jacobian, held

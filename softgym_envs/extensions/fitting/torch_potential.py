"""The potential networks in torch: for training, derivatives with respect to the design, GPUs and ONNX.

All four share the arithmetic of `PotentialEnsemble`. `PotentialNet` is one member that can be trained, `TorchModel` a
trained ensemble in SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from softgym_envs.surrogate.potential.model import SHIFT, Model, coefficient_sizes

Coefficients = dict[str, Tensor]
"""Coefficients of bodies by name; those of members have shape (M, S, ...), the others (S, ...), for S bodies."""


class PotentialEnsemble:
    """The members of an ensemble in one batch, in scaled quantities.

    Constant factors are part of the weights: the factors one half of the ramp and its derivatives, and each member's
    share of the mean. There is one body for each row of displacements, or one body for all rows.

    Args:
        weights: weights of the members by name, with leading dimension M, as in `Model.tensors`.
        rest: scaled displacement at which the effort is zero, shape (n,), or None where it is learned.
        convex: the energy is convex; otherwise its quadratic part may have any sign.
    """

    def __init__(self, weights: Mapping[str, Tensor], rest: Tensor | None, convex: bool) -> None:
        self.members, self.width, self.count = weights["energy1"].shape
        self.coordinates, self.convex = weights["effector"].shape[1], convex
        n, e, device = self.count, self.coordinates, weights["energy1"].device
        A1, A2 = weights["energy1"].transpose(-1, -2), weights["energy2"].transpose(-1, -2)
        P = nn.functional.softplus(weights["pass_on"])
        self._layers = [
            (weights[f"body.{k}.weight"].transpose(-1, -2), weights[f"body.{k}.bias"][:, None]) for k in range(3)
        ]
        outer = (0.5 * A1[:, :, None] * A1[:, None]).flatten(1, 2)
        self._weights = {
            "A": torch.cat([A1, A2], dim=2),
            "A1": A1[:, None],
            "A2": A2[:, None],
            "P": P,
            "PT": 0.5 * P.transpose(-1, -2),
            "E1": 0.5 * weights["energy1"],
            "E2": weights["energy2"],
            "outer": outer.transpose(-1, -2),
            "B1": weights["shape1"].transpose(-1, -2),
            "B2": weights["shape2"].transpose(-1, -2),
            "V": weights["effector"].transpose(-1, -2),
            "H": weights["held"].transpose(-1, -2),
        }
        self._rest = rest
        self._triangles = {size: _triangle(size, device) for size in {n, e}}

    @classmethod
    def of_model(
        cls, model: Model, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> PotentialEnsemble:
        """Return the ensemble of a trained model; its weights are combined in double precision."""
        tensors = {
            name: torch.as_tensor(np.asarray(value), dtype=torch.float64) for name, value in model.tensors.items()
        }
        ensemble = cls(tensors, tensors.get("rest"), model.robot.learning.convex)

        def put(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype).contiguous()

        ensemble._layers = [(put(weight), put(bias)) for weight, bias in ensemble._layers]
        ensemble._weights = {name: put(weight) for name, weight in ensemble._weights.items()}
        ensemble._rest = None if ensemble._rest is None else put(ensemble._rest)
        ensemble._triangles = {
            size: (index.to(device), diagonal.to(device)) for size, (index, diagonal) in ensemble._triangles.items()
        }
        return ensemble

    def coefficients(self, features: Tensor) -> Coefficients:
        """Evaluate the layers of the design, from features (S, d)."""
        M, n, e = self.members, self.count, self.coordinates
        x = features if features.shape[1] else features.new_zeros(features.shape[0], 1)
        h = x.expand(M, -1, -1)
        for k, (weight, bias) in enumerate(self._layers):
            h = torch.baddbmm(bias, h, weight)
            if k < 2:
                h = h * torch.rsqrt(1.0 + h * h)
        sizes = coefficient_sizes(n, e, self.width)
        part = dict(zip(sizes, torch.split(h, list(sizes.values()), dim=2), strict=True))
        if self.convex:
            factor = self._triangular(part["quadratic"], n, positive=True)
            quadratic = factor @ factor.transpose(-1, -2)
        else:
            factor = self._triangular(part["quadratic"], n, positive=False)
            quadratic = factor + factor.transpose(-1, -2)
        softplus = nn.functional.softplus
        body = {
            "c": torch.cat([part["c1"], part["c2"]], dim=2),
            "a": softplus(part["a"] - SHIFT) * (0.5 / M),
            "b": softplus(part["b"] - SHIFT) / M,
            "quadratic": quadratic.mean(dim=0),
            "quadratics": quadratic,
            "first": quadratic[0],
            "linear": part["linear"].mean(dim=0),
            "linears": part["linear"],
            "d1": part["d1"].contiguous(),
            "d2": part["d2"].contiguous(),
            "x0": part["x0"].contiguous(),
            "slope": part["slope"].reshape(M, -1, e, n),
            "held": part["held"].contiguous(),
        }
        if self._rest is not None:
            body["linears"] = torch.zeros_like(body["linears"])
            body["linears"] = -self.gradients(body, self._rest.expand(x.shape[0], n))
            body["linear"] = body["linears"].mean(dim=0)
        return body

    def _triangular(self, entries: Tensor, size: int, *, positive: bool) -> Tensor:
        """Lower triangular matrices (M, B, size, size) from their entries (M, B, t)."""
        index, diagonal = self._triangles[size]
        if positive:
            entries = torch.where(diagonal, torch.exp(entries), entries)
        # Entries above the diagonal read the appended zero.
        filled = nn.functional.pad(entries, (0, 1)).index_select(2, index)
        return filled.reshape(self.members, -1, size, size)

    def _forward(self, body: Coefficients, u: Tensor, m: int) -> tuple[Tensor, ...]:
        """Gradients of the layers of the first ``m`` members (m, B, n), and what `_hessian` needs.

        Each holds its share of the mean: their sum is the gradient of the ensemble's layers.
        """
        weights, U = self._weights, u.expand(m, -1, -1)
        z1, z2 = torch.baddbmm(body["c"][:m], U, weights["A"][:m]).split(self.width, dim=2)
        square = 1.0 + z1 * z1
        r1 = torch.rsqrt(square)
        ramp, slope = z1 + square * r1, 1.0 + z1 * r1  # twice the ramp and its derivative
        z2 = torch.baddbmm(z2, ramp, weights["PT"][:m])
        r2 = torch.rsqrt(1.0 + z2 * z2)
        upper = body["a"][:m] * (1.0 + z2 * r2)
        lower = torch.baddbmm(body["b"][:m], upper, weights["P"][:m])
        gradients = torch.baddbmm(torch.bmm(upper, weights["E2"][:m]), slope * lower, weights["E1"][:m])
        return gradients, slope, lower, r1, r2

    def _hessian(self, body: Coefficients, slope: Tensor, lower: Tensor, r1: Tensor, r2: Tensor) -> Tensor:
        """Sum over the first members of the Hessians of their layers (B, n, n), from results of `_forward`."""
        weights, m, w, n = self._weights, len(slope), self.width, self.count
        first = (slope[:, :, None] * weights["A1"][:m]).reshape(m, -1, w)
        through = torch.bmm(first, weights["PT"][:m]).reshape(m, -1, n, w) + weights["A2"][:m]
        bent = body["a"][:m] * r2**3
        hessian = torch.matmul(through * bent[:, :, None], through.transpose(-1, -2)).sum(dim=0)
        return hessian + torch.bmm(lower * r1**3, weights["outer"][:m]).sum(dim=0).reshape(-1, n, n)

    def _with_body(self, body: Coefficients, u: Tensor, gradients: Tensor) -> Tensor:
        return gradients.sum(dim=0) + body["linear"] + (body["quadratic"] * u[:, None, :]).sum(dim=2)

    def gradients(self, body: Coefficients, u: Tensor) -> Tensor:
        """Gradients of the energies of the members (M, B, n) at displacements u (B, n)."""
        own = self.members * self._forward(body, u, self.members)[0]
        return own + body["linears"] + (body["quadratics"] * u[:, None, :]).sum(dim=3)

    def lever(self, body: Coefficients, u: Tensor) -> Tensor:
        """How efforts move the rows that nothing drives (B, e, n), at displacements u (B, n): J K^-1."""
        _, hessian = self.derivatives(body, u)
        jacobian = self.shape(body, u)[1].mean(dim=0)
        return torch.linalg.solve(hessian, jacobian.transpose(-1, -2)).transpose(-1, -2)

    def gradient(self, body: Coefficients, u: Tensor) -> Tensor:
        """Gradient of the energy (B, n) at displacements u (B, n)."""
        return self._with_body(body, u, self._forward(body, u, self.members)[0])

    def derivatives(self, body: Coefficients, u: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (B, n) and Hessian (B, n, n) of the energy."""
        gradient, *parts = self._forward(body, u, self.members)
        return self._with_body(body, u, gradient), self._hessian(body, *parts) + body["quadratic"]

    def curvature(self, body: Coefficients, u: Tensor) -> Tensor:
        """Hessian (B, n, n) of the first member alone."""
        _, *parts = self._forward(body, u, 1)
        return self.members * self._hessian(body, *parts) + body["first"]

    def _shape(self, body: Coefficients, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Effectors of the members (M, B, e), their last hidden layer, and 1 / sqrt(1 + z^2) of both layers."""
        weights = self._weights
        z = torch.baddbmm(body["d1"], u.expand(self.members, -1, -1), weights["B1"])
        r1 = torch.rsqrt(1.0 + z * z)
        z = torch.baddbmm(body["d2"], z * r1, weights["B2"])
        r2 = torch.rsqrt(1.0 + z * z)
        plane = body["x0"] + (body["slope"] * u[:, None, :]).sum(dim=3)
        return torch.baddbmm(plane, z * r2, weights["V"]), z * r2, r1, r2

    def effectors(self, body: Coefficients, u: Tensor) -> Tensor:
        """Effectors of the members (M, B, e)."""
        return self._shape(body, u)[0]

    def shape(self, body: Coefficients, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Effectors (M, B, e), their Jacobians (M, B, e, n) and factors of the held compliances (M, B, e, e)."""
        weights, M, w, n = self._weights, self.members, self.width, self.count
        x, last, r1, r2 = self._shape(body, u)
        first = ((r1**3)[:, :, None] * weights["B1"][:, None]).reshape(M, -1, w)
        inner = torch.bmm(first, weights["B2"]).reshape(M, -1, n, w) * (r2**3)[:, :, None]
        jacobian = body["slope"] + (inner @ weights["V"][:, None]).transpose(-1, -2)
        held = torch.baddbmm(body["held"], last, weights["H"])
        return x, jacobian, self._triangular(held, self.coordinates, positive=True)


def _triangle(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the index of each matrix entry in the list of its lower triangle, and which of the list are diagonal."""
    rows, columns = np.tril_indices(size)
    index = np.full(size * size, len(rows))
    index[rows * size + columns] = np.arange(len(rows))
    return torch.as_tensor(index, device=device), torch.as_tensor(rows == columns, device=device)


class PotentialNet(nn.Module):
    """One member of the ensemble, in scaled quantities, with weights to be trained.

    Args:
        count: actuators n.
        effectors: effector rows e.
        design: design features d; 0 for a single body.
        width: hidden units w of the actuation layers.
        body_width: hidden units of the design layers.
        rest: scaled actuation at which the effort is zero, shape (n,), or None where it is learned.
        convex: the energy is convex; otherwise its quadratic part may have any sign.
    """

    rest: Tensor | None

    def __init__(
        self, count: int, effectors: int, design: int, width: int, body_width: int, rest=None, convex: bool = True
    ) -> None:
        super().__init__()
        n, e, w = count, effectors, width
        self.convex = convex
        outputs = sum(coefficient_sizes(n, e, w).values())
        widths = (max(design, 1), body_width, body_width, outputs)
        layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        self.body = nn.ModuleList(layers)
        self.energy1 = nn.Parameter(torch.randn(w, n))
        self.energy2 = nn.Parameter(0.7 * torch.randn(w, n))
        self.pass_on = nn.Parameter(-5.0 + 0.5 * torch.randn(w, w))
        self.shape1 = nn.Parameter(0.7 * torch.randn(w, n))
        self.shape2 = nn.Parameter(torch.randn(w, w) / w**0.5)
        self.effector = nn.Parameter(0.1 * torch.randn(e, w))
        self.held = nn.Parameter(0.1 * torch.randn(e * (e + 1) // 2, w))
        with torch.no_grad():
            layers[-1].weight *= 0.3
            layers[-1].bias[: 2 * w] = torch.randn(2 * w)
            layers[-1].bias[-2 * w :] = 0.7 * torch.randn(2 * w)
        self.register_buffer("rest", None if rest is None else torch.as_tensor(rest, dtype=torch.float32))

    def forward(self, design: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return gradient and Hessian of the energy, the effector, its Jacobian, and the factor of the held compliance.

        Args:
            design: features (B, d).
            u: scaled actuation (B, n).
        """
        weights = {name: parameter[None] for name, parameter in self.named_parameters()}
        ensemble = PotentialEnsemble(weights, self.rest, self.convex)
        body = ensemble.coefficients(design)
        x, jacobian, held = ensemble.shape(body, u)
        return *ensemble.derivatives(body, u), x[0], jacobian[0], held[0]


class TorchModel(nn.Module):
    """The condensed model of a trained ensemble as a function of tensors, differentiable in design and displacement.

    Args:
        model: a trained ensemble.
        dtype: type of all inputs and results.
        inverse: function that inverts symmetric matrices (B, n, n) with entries of order one.

    Raises:
        ValueError: for another kind of network: its outputs are not exact derivatives of each other.
    """

    def __init__(
        self,
        model: Model,
        *,
        dtype: torch.dtype = torch.float64,
        inverse: Callable[[Tensor], Tensor] = torch.linalg.inv,
    ) -> None:
        super().__init__()
        if not isinstance(model, Model):
            raise ValueError(f"gradients need a 'potential' network, got {getattr(model, 'network', model)!r}")
        self.model, self.features = model, model.features
        self._ensemble = PotentialEnsemble.of_model(model, dtype=dtype)
        self._inverse = inverse

        def put(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=dtype)

        self._middle, self._half = put(model.middle), put(model.half_range)
        self._effector_mean, self._units = put(model.effector_mean), put(model.features.units)

    def forward(self, design: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate the condensed model.

        Args:
            design: values in the order of the design space, shape (B, len(space)).
            displacement: reached actuator displacements, shape (B, n_a).

        Returns:
            Efforts (B, n_a), effector [m] (B, n_e) and W (B, n, n).
        """
        model, half = self.model, self._half
        u = (displacement - self._middle) / half
        features = self.features.design(design)
        body = self._ensemble.coefficients(features)
        gradient, hessian = self._ensemble.derivatives(body, u)
        x, J, L = self._ensemble.shape(body, u)
        effector = x.mean(dim=0) * model.effector_scale + self._effector_mean
        J = J.mean(dim=0) * model.effector_scale
        held = (L @ L.transpose(-1, -2)).mean(dim=0) * model.held_scale
        flexible = _symmetric(self._inverse(hessian))
        moved = J @ flexible / model.energy_scale
        W_aa = flexible * (half[:, None] * half / model.energy_scale)
        W_ea = moved * half
        W_ee = _symmetric(moved @ J.transpose(-1, -2)) + held
        W = torch.cat([torch.cat([W_aa, W_ea.transpose(-1, -2)], dim=2), torch.cat([W_ea, W_ee], dim=2)], dim=1)
        W = W * (self._units[:, None] * self._units)
        effector = effector[:, : model.effectors]
        stiffness = self.features.stiffness(design) * model.correction.factor(features)
        return gradient * (model.energy_scale / half) * stiffness, effector, W / stiffness[:, :, None]


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.transpose(-1, -2))

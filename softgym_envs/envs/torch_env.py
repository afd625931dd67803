"""Environments on the surrogate wholly in torch: a hundred thousand bodies at once on a GPU, nothing leaves the device.

The same environments as `SoftRobotVectorEnv`, with tensors in place of arrays. A step is a fixed sequence of batched
matrix products over all rows and all members of the ensemble: every row takes the same few Newton iterations, whether
it needs them or not, and none of them asks the host. It can therefore be captured as a CUDA graph or compiled. After
it the host asks once whether an episode ended; the few rows whose search takes longer are then finished alone.

Inside, displacements are scaled to [-1, 1] over the actuators' ranges, as the networks and the observation have them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.surrogate import TOLERANCE
from softgym_envs.envs.env import design_names
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.envs.spaces import Interface
from softgym_envs.envs.tasks.base import make_task
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.envs.tasks.track import Track
from softgym_envs.errors import ConvergenceError
from softgym_envs.robots import make_robot
from softgym_envs.surrogate.potential import model as potential
from softgym_envs.surrogate.pretrained import pretrained_model

__all__ = ["TorchVectorEnv"]

#: A quarter of an actuator's range, the unit of steps and tolerances of searches, in scaled displacements.
SPAN = 0.5
#: Newton steps of every row, with one Hessian. With random actions 7 % of the rows of GripperPinch and 2 % of the cable
#: trunk's need more, and none of the others'.
STEPS = 4
#: Bound on the Newton steps of those, with a new Hessian every fourth.
MORE_STEPS = 25
#: Passes of pivots in a complementarity problem: one to the last known slack set, the others to the right one.
PASSES = 3

Bodies = dict[str, Tensor]


class _Ensemble:
    """All members of `potential.Model` in one batch, in scaled quantities.

    Constant factors are in the weights: the halves of the ramp and its derivative, and the share of a member in the
    mean. Weights have a leading dimension M, coefficients of bodies (M, S, ...) with S bodies or one for all.
    """

    def __init__(self, model: potential.Model, device: torch.device, dtype: torch.dtype) -> None:
        def put(array: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(array, dtype=float), dtype=dtype, device=device)

        tensors = {k: np.asarray(v, dtype=float) for k, v in model.tensors.items()}
        self.trained = model.trained
        self.members, self.width, self.count, self.effectors = model.members, model.width, model.count, model.effectors
        self.unilateral = tuple(actuator.unilateral for actuator in model.robot.actuators)
        M, w, n = self.members, self.width, self.count
        A1, A2 = tensors["energy1"].swapaxes(1, 2), tensors["energy2"].swapaxes(1, 2)
        P = np.logaddexp(0.0, tensors["pass_on"])
        self._layers = [
            (put(tensors[f"body.{k}.weight"].swapaxes(1, 2)), put(tensors[f"body.{k}.bias"][:, None])) for k in range(3)
        ]
        self._A, self._A1, self._A2 = put(np.concatenate([A1, A2], axis=2)), put(A1[:, None]), put(A2[:, None])
        self._P, self._PT = put(P), put(0.5 * P.swapaxes(1, 2))
        self._E1, self._E2 = put(0.5 * tensors["energy1"]), put(tensors["energy2"])
        self._outer = put(0.5 * np.einsum("mij,mkj->mjik", A1, A1).reshape(M, w, n * n))
        self._B1, self._B2 = put(tensors["shape1"].swapaxes(1, 2)), put(tensors["shape2"].swapaxes(1, 2))
        self._V = put(tensors["effector"].swapaxes(1, 2))
        self._rest = put(tensors["rest"]) if "rest" in tensors else None
        self._lower = torch.tril_indices(n, n, device=device)
        self.pulls = torch.tensor(self.unilateral, device=device)

    def bodies(self, features: Tensor) -> Bodies:
        """Coefficients of bodies from features (S, d)."""
        M, n, e = self.members, self.count, self.effectors
        x = features if features.shape[1] else features.new_zeros(len(features), 1)
        h = x.expand(M, *x.shape)
        for k, (weight, bias) in enumerate(self._layers):
            h = torch.baddbmm(bias, h, weight)
            if k < 2:
                h = h * torch.rsqrt(1.0 + h * h)
        sizes = potential.body_parts(n, e, self.width)
        part = dict(zip(sizes, torch.split(h, list(sizes.values()), dim=2), strict=True))
        quadratic, (i, j) = part["quadratic"], self._lower
        factor = quadratic.new_zeros(M, len(x), n, n)
        factor[:, :, i, j] = torch.where(i == j, torch.exp(quadratic), quadratic)
        softplus = torch.nn.functional.softplus
        bodies = {
            "c": torch.cat([part["c1"], part["c2"]], dim=2),
            "a": softplus(part["a"] - 4.0) * (0.5 / M),
            "b": softplus(part["b"] - 4.0) / M,
            "quadratic": (factor @ factor.mT).mean(dim=0),
            "first": factor[0] @ factor[0].mT,
            "linear": part["linear"].mean(dim=0),
            "d1": part["d1"].contiguous(),
            "d2": part["d2"].contiguous(),
            "x0": part["x0"].contiguous(),
            "slope": part["slope"].reshape(M, -1, e, n),
        }
        if self._rest is not None:
            bodies["linear"] = torch.zeros_like(bodies["linear"])
            bodies["linear"] = -self.gradient(bodies, self._rest.expand(len(x), n))
        return bodies

    def _forward(self, bodies: Bodies, u: Tensor, m: int) -> tuple[Tensor, ...]:
        """Sum of the gradients of the first ``m`` members' networks (B, n), and what their Hessians need."""
        U = u.expand(m, *u.shape)
        z1, z2 = torch.baddbmm(bodies["c"][:m], U, self._A[:m]).split(self.width, dim=2)
        square = 1.0 + z1 * z1
        r1 = torch.rsqrt(square)
        ramp, slope = z1 + square * r1, 1.0 + z1 * r1  # twice the ramp and its derivative
        z2 = torch.baddbmm(z2, ramp, self._PT[:m])
        r2 = torch.rsqrt(1.0 + z2 * z2)
        upper = bodies["a"][:m] * (1.0 + z2 * r2)
        lower = torch.baddbmm(bodies["b"][:m], upper, self._P[:m])
        gradient = torch.baddbmm(torch.bmm(upper, self._E2[:m]), slope * lower, self._E1[:m]).sum(dim=0)
        return gradient, slope, lower, r1, r2

    def _hessian(self, bodies: Bodies, slope: Tensor, lower: Tensor, r1: Tensor, r2: Tensor) -> Tensor:
        """Sum of the Hessians of the first members' networks (B, n, n), from what `_forward` says of them."""
        (m, B, w), n = slope.shape, self.count
        first = (slope[:, :, None] * self._A1[:m]).reshape(m, B * n, w)
        through = torch.bmm(first, self._PT[:m]).reshape(m, B, n, w) + self._A2[:m]
        bent = bodies["a"][:m] * r2**3
        hessian = torch.matmul(through * bent[:, :, None], through.mT).sum(dim=0)
        return hessian + torch.bmm(lower * r1**3, self._outer[:m]).sum(dim=0).reshape(B, n, n)

    def gradient(self, bodies: Bodies, u: Tensor) -> Tensor:
        """Gradient of the energy (B, n) at displacements u (B, n)."""
        return self._plus_body(bodies, u, self._forward(bodies, u, self.members)[0])

    def _plus_body(self, bodies: Bodies, u: Tensor, gradient: Tensor) -> Tensor:
        return gradient + bodies["linear"] + (bodies["quadratic"] * u[:, None, :]).sum(dim=2)

    def derivatives(self, bodies: Bodies, u: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (B, n) and Hessian (B, n, n) of the energy."""
        gradient, *parts = self._forward(bodies, u, self.members)
        return self._plus_body(bodies, u, gradient), self._hessian(bodies, *parts) + bodies["quadratic"]

    def curvature(self, bodies: Bodies, u: Tensor) -> Tensor:
        """Hessian (B, n, n) of the first member alone."""
        _, *parts = self._forward(bodies, u, 1)
        return self.members * self._hessian(bodies, *parts) + bodies["first"]

    def effector(self, bodies: Bodies, u: Tensor) -> tuple[Tensor, Tensor]:
        """Effector (B, e) and its spread (B,) over the members, infinite where they are not all."""
        U = u.expand(self.members, *u.shape)
        z = torch.baddbmm(bodies["d1"], U, self._B1)
        z = torch.baddbmm(bodies["d2"], z * torch.rsqrt(1.0 + z * z), self._B2)
        plane = bodies["x0"] + (bodies["slope"] * u[:, None, :]).sum(dim=3)
        x = torch.baddbmm(plane, z * torch.rsqrt(1.0 + z * z), self._V)
        mean = x.mean(dim=0)
        if self.members < self.trained:
            return mean, torch.full_like(mean[:, 0], torch.inf)
        square = ((x - mean) ** 2).mean(dim=0).reshape(len(u), -1, 3).sum(dim=2)
        return mean, torch.sqrt(square.amax(dim=1))

    def search(
        self, bodies: Bodies, target: Tensor, guess: Tensor, iterations: int, *, stop: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As `SurrogateModel.search`, on scaled displacements (B, n).

        Args:
            bodies: their coefficients.
            target: commanded displacements.
            guess: where the search begins.
            iterations: Newton steps of every row.
            stop: ask the host before every step whether a row still moves, and end when none does.

        Returns:
            Displacements (B, n), gradients (B, n), and whether they were found (B,).
        """
        if not any(self.unilateral):
            gradient = self.gradient(bodies, guess)
            return guess, gradient, torch.isfinite(gradient).all(dim=1)
        u = guess
        for iteration in range(iterations):
            # The Hessian changes slowly along the search; a simplified Newton step is cheaper than a new one.
            if iteration % 4 == 0:
                gradient, hessian = self.derivatives(bodies, u)
            else:
                gradient = self.gradient(bodies, u)
            if iteration == 0:
                wrong = ((gradient < 0.0) | (guess > target)) & self.pulls
                found = torch.isfinite(gradient).all(dim=1) & ~wrong.any(dim=1)
                effort, slack = gradient, guess > target
            if stop and bool(found.all()):
                break
            # In the displacement beyond the command, z >= 0, the effort is K z + q >= 0.
            ahead = target - u
            q = gradient + (hessian * ahead[:, None, :]).sum(dim=2)
            z, taut, slack, solved = _complementarity(hessian, q, slack, self.unilateral)
            step = torch.clamp(ahead + z, -SPAN, SPAN)
            still = (step.abs() <= TOLERANCE * SPAN).all(dim=1)
            # A last step below the tolerance is taken without asking the model again.
            u = torch.where(found[:, None], u, u + step)
            effort = torch.where(found[:, None], effort, taut)
            found = found | (still & solved)
        return u, effort, found

    def released(self, bodies: Bodies, start: Tensor) -> Tensor:
        """Displacements (B, n) without effort, by Newton's method; asks the host."""
        u = start
        for _ in range(50):
            gradient, hessian = self.derivatives(bodies, u)
            step = -torch.linalg.solve_ex(hessian, gradient)[0]
            moving = (step.abs() > TOLERANCE * SPAN).any(dim=1, keepdim=True)
            if not bool(moving.any()):
                break
            u = torch.where(moving, u + step.clamp(-SPAN, SPAN), u)
        return u


def _complementarity(
    K: Tensor, q: Tensor, slack: Tensor, unilateral: tuple[bool, ...]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve ``0 <= z _|_ K z + q >= 0`` (z = 0 in bilateral rows) by principal pivots, in a fixed number of passes.

    A pivot exchanges an actuator's z with its effort: a rank-one update of the tableau, masked by row of the batch.
    The first pass exchanges those that were slack before, the others every one of a wrong sign, in turn.

    Args:
        K: symmetric positive definite, shape (B, n, n).
        q: shape (B, n).
        slack: guess of where z > 0, shape (B, n).
        unilateral: n flags.

    Returns:
        z (B, n), K z + q (B, n), the slack set (B, n), and whether its signs are right (B,).
    """
    n = q.shape[1]
    # With a unit diagonal the pivots are of order one: the sum that makes a rank-one update exact loses no digits.
    scale = torch.rsqrt(torch.diagonal(K, dim1=1, dim2=2))
    q = scale * q
    tableau = torch.cat([K * scale[:, :, None] * scale[:, None, :], q[:, :, None]], dim=2).permute(1, 2, 0).contiguous()
    slightly = -4.0 * torch.finfo(q.dtype).eps * q.abs().amax(dim=1)
    unit = torch.eye(n, n + 1, dtype=q.dtype, device=q.device)[:, :, None]
    free = list(slack.unbind(dim=1))
    pull = [p for p in range(n) if unilateral[p]]
    for sweep in range(PASSES):
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


def _definite(a: Tensor) -> Tensor:
    """Whether symmetric matrices (B, n, n) are positive definite, (B,): all pivots of the elimination are positive."""
    found = torch.ones(len(a), dtype=torch.bool, device=a.device)
    while a.shape[1]:
        pivot = a[:, :1, :1]
        found &= pivot[:, 0, 0] > 0.0
        a = a[:, 1:, 1:] - a[:, 1:, :1] * a[:, :1, 1:] / pivot
    return found


class TorchVectorEnv:
    """``num_envs`` copies of an environment on the surrogate, stepped together on one device.

    `reset` and `step` are those of `gymnasium.vector.VectorEnv`, whose contract asks for arrays; here everything is a
    tensor on ``device``, so that it is none. Episodes that end are reset in the same step: the observation is the first
    of the next episode, and ``info["final_obs"]``, ``info["final_info"]`` hold the end of the last one;
    ``info["_final_obs"]`` says of which rows. What the step returns stays valid after the next one.

    Args:
        id: an environment ID whose backend is the surrogate, with the task reach or track.
        num_envs: number of sub-environments.
        device: where everything is: ``"cuda"``, ``"cpu"``, ...
        dtype: of the networks and all results; ``torch.float32`` or ``torch.float64``.
        members: how many members of the ensemble to use, fewer for speed; default all.
        seed: of the first `reset`.
        compile: compile the step with ``torch.compile``; the first step then takes a minute or so.
        cuda_graph: capture the step as a CUDA graph and replay it; for CUDA devices.
        max_episode_steps: time limit; default that of the ID.
        design: body of every episode unless sampled or given in `reset`.
        sample_design: draw the body at each reset: True for all variables, or their names.
        design_in_observation: show the body to the agent: True for all variables, or their names.
        action_mode: ``"increment"`` or ``"absolute"``, see `Interface`.
        robot_options: options of the robot, over those of the ID.
        task_options: options of the task, over those of the ID.

    Raises:
        ValueError: for an ID, a task, a network, a device or an option that is not supported.
        DesignError: for a malformed design.
        WeightsError: where no weights ship for the robot, or have not so many members.
    """

    def __init__(
        self,
        id: str,
        num_envs: int = 1,
        *,
        device: str | torch.device = "cuda",
        dtype: torch.dtype = torch.float32,
        members: int | None = None,
        seed: int | None = None,
        compile: bool = False,
        cuda_graph: bool = False,
        max_episode_steps: int | None = None,
        design: Mapping[str, float] | None = None,
        sample_design: bool | Sequence[str] = False,
        design_in_observation: bool | Sequence[str] = False,
        action_mode: str = "increment",
        robot_options: Mapping[str, Any] | None = None,
        task_options: Mapping[str, Any] | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs = {num_envs} must be at least 1")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps = {max_episode_steps} must be at least 1")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype = {dtype} is not supported; allowed: torch.float32, torch.float64")
        supported = [name for name, row in ENVIRONMENTS.items() if row.backend == "surrogate"]
        if id not in supported:
            raise ValueError(f"id = {id!r} is not an environment on the surrogate; allowed: {', '.join(supported)}")
        self.device = torch.device(device)
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"device = {str(device)!r} is not available here; allowed: 'cpu'")
        if cuda_graph and self.device.type != "cuda":
            raise ValueError(f"cuda_graph needs a CUDA device, got device = {str(device)!r}")
        row = ENVIRONMENTS[id]
        self.robot = make_robot(row.robot, **{**row.robot_options, **(robot_options or {})})
        task = make_task(row.task, self.robot, **{**row.task_options, **(task_options or {})})
        if not isinstance(task, Reach | Track):
            raise ValueError(f"task '{row.task}' is not supported; allowed: reach, track")
        model = pretrained_model(self.robot, members=members)
        if not isinstance(model, potential.Model):
            raise ValueError(f"network '{model.network}' is not supported; allowed: potential")
        self.task: Reach | Track = task
        self.num_envs, self.dtype = num_envs, dtype
        self.max_episode_steps = row.max_episode_steps if max_episode_steps is None else max_episode_steps
        space = self.design_space = self.robot.design_space
        shown = design_names(space, design_in_observation)
        self.interface = Interface(self.robot, action_mode=action_mode, design_names=shown, axes=self.task.axes)
        self.single_action_space = self.interface.action_space
        self.single_observation_space = self.interface.observation_space

        def put(values: Any, kind: torch.dtype = dtype) -> Tensor:
            return torch.as_tensor(np.array(values, dtype=float), dtype=kind, device=self.device)

        self._ensemble = _Ensemble(model, self.device, dtype)
        self._loaded = bool(model.card.get("loaded", False))
        self._middle, self._half = put(model.middle), put(model.half_range)
        self._effort_scale, self._typical_effort = (
            put(model.energy_scale / model.half_range),
            put(self.robot.effort_scale),
        )
        self._effector_scale, self._effector_mean = model.effector_scale, put(model.effector_mean)
        self._rates, self._axes = put(self.interface.rates / model.half_range), put(self.task.axes)
        self._inflation, self._limit = model._inflation, model._limit
        self._growth = model._growth if np.isfinite(model._growth) else None  # the compiler knows no `isfinite`
        self._known_low, self._known_high = (
            put((bound - model.middle) / model.half_range) for bound in (model._low, model._high)
        )

        # Bodies are kept in double precision: near 0.5 a Poisson's ratio needs its digits.
        variables = list(space.variables.values())
        double = torch.float64
        self._log = torch.tensor([v.log for v in variables], device=self.device)
        self._ends = put([np.log([v.low, v.high]) if v.log else [v.low, v.high] for v in variables], double).T
        low, high = np.full(len(space), -np.inf), np.full(len(space), np.inf)
        for name, (least, largest) in model._known.items():
            margin = 0.01 * (largest - least) + 1e-9 * abs(largest)
            low[space.names.index(name)], high[space.names.index(name)] = least - margin, largest + margin
        self._box = put(low, double), put(high, double)
        self._learned = model.features.learned
        self._sampled = [space.names.index(name) for name in design_names(space, sample_design)]
        self._shown = [space.names.index(name) for name in shown]
        self._fixed = put(list(space.complete(design).values()), double)

        self._generator = torch.Generator(self.device)
        self._generator.seed()
        self._first_seed = seed
        self._compile, self._cuda_graph = compile, cuda_graph
        self._hot: Callable[[Tensor], dict[str, Any]] | None = None
        self.designs = self._fixed.expand(num_envs, -1).clone()
        self._changed = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        # One body for all, until they differ.
        self._bodies = self._prepare(self._fixed[None])
        self._state = self._at_rest(self._bodies, num_envs)
        self._started = False

    # -- bodies -----------------------------------------------------------------------------------------------------

    def _prepare(self, designs: Tensor) -> Bodies:
        """Coefficients, scaling, observation and rest of bodies from designs (S, len(space)) in double precision."""
        low, high = self._ends
        unit = 2.0 * (torch.where(self._log, torch.log(designs), designs) - low) / (high - low) - 1.0
        columns = []
        for name in self._learned:
            index = self.design_space.names.index(name)
            columns.append(unit[:, index])
            if name == "poisson_ratio":
                least, largest = torch.log(1.0 - 2.0 * self._ends[:, index])
                columns.append(2.0 * (torch.log(1.0 - 2.0 * designs[:, index]) - least) / (largest - least) - 1.0)
        features = torch.stack(columns, dim=1) if columns else designs[:, :0]
        bodies = self._ensemble.bodies(features.to(self.dtype))
        variable = self.robot.stiffness_variable
        factor = torch.ones_like(designs[:, :1])
        if variable is not None:
            factor = designs[:, [self.design_space.names.index(variable)]] / self.design_space[variable].baseline
        bodies["effort"] = factor.to(self.dtype) * self._effort_scale
        bodies["known"] = ((designs >= self._box[0]) & (designs <= self._box[1])).all(dim=1)
        bodies["unit"] = unit[:, self._shown].to(self.dtype)
        zero = (-self._middle / self._half).expand(len(designs), -1)
        if self._growth is not None:
            bodies["unmoved"] = self._ensemble.curvature(bodies, zero)
            bodies["known"] &= _definite(bodies["unmoved"])
        if self._loaded:
            u, gradient, _ = self._ensemble.search(bodies, zero, zero, MORE_STEPS, stop=True)
        else:
            u = self._ensemble.released(bodies, zero)
            gradient = self._ensemble.gradient(bodies, u)
        bodies["rest"], bodies["rest_effort"] = u, gradient * bodies["effort"]
        bodies["rest_effector"], bodies["rest_uncertainty"], bodies["rest_trusted"] = self._measure(bodies, u)
        return bodies

    def _take_bodies(self, index: Tensor, designs: Tensor) -> None:
        """Give the rows ``index`` new bodies: one for all of them (1, len(space)), or one each."""
        self.designs[index] = designs
        new, old = self._prepare(designs), self._bodies
        if len(designs) == 1 and len(index) == self.num_envs:
            if len(old["rest"]) == 1:
                for name, value in new.items():
                    old[name].copy_(value)  # a captured graph reads them where they are
            else:
                self._bodies, self._hot = new, None
            return
        if len(old["rest"]) != self.num_envs:
            self._bodies = {name: _repeat(value, _axis(name), self.num_envs) for name, value in old.items()}
            self._hot = None
        for name, value in new.items():
            self._bodies[name][_at(name, index)] = value

    def _rows(self, index: Tensor) -> Bodies:
        if len(self._bodies["rest"]) == 1:
            return self._bodies
        return {name: value[_at(name, index)] for name, value in self._bodies.items()}

    def _measure(self, bodies: Bodies, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Effector [m] (B, 3), its uncertainty [m] (B,), and whether it is trusted (B,)."""
        effector, spread = self._ensemble.effector(bodies, u)
        effector = (effector * self._effector_scale + self._effector_mean)[:, :3]
        uncertainty = spread * (self._effector_scale * self._inflation)
        inside = ((u >= self._known_low) & (u <= self._known_high)).all(dim=1)
        trusted = inside & bodies["known"] & ((uncertainty <= self._limit) | torch.isinf(uncertainty))
        if self._growth is not None:
            trusted &= _definite(self._growth * self._ensemble.curvature(bodies, u) - bodies["unmoved"])
        return effector, uncertainty, trusted

    # -- episodes ---------------------------------------------------------------------------------------------------

    def _at_rest(self, bodies: Bodies, count: int) -> dict[str, Tensor]:
        """State of ``count`` rows at the beginning of an episode, without their goals."""
        n = self._ensemble.count
        parts = {
            "command": (-self._middle / self._half)[None],
            "u": bodies["rest"],
            "effort": bodies["rest_effort"],
            "effector": bodies["rest_effector"],
            "slack": torch.zeros(1, n, dtype=torch.bool, device=self.device),
            "uncertainty": bodies["rest_uncertainty"],
            "trusted": bodies["rest_trusted"],
            "converged": torch.ones(1, dtype=torch.bool, device=self.device),
            "steps": torch.zeros(1, dtype=torch.int64, device=self.device),
            "paths": torch.zeros(1, 1, 3, dtype=self.dtype, device=self.device),
            "counts": torch.ones(1, dtype=torch.int64, device=self.device),
        }
        return {name: part.expand(count, *part.shape[1:]).clone() for name, part in parts.items()}

    def _uniform(self, low: float, high: float, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        draws = torch.rand(*shape, generator=self._generator, dtype=dtype or self.dtype, device=self.device)
        return low + (high - low) * draws

    def _begin_episodes(self, index: Tensor, designs: Tensor | None = None, paths: Tensor | None = None) -> None:
        """Start episodes in the rows ``index``."""
        if designs is not None:
            self._take_bodies(index, designs)
            self._changed[index] = True
        elif self._sampled:
            designs = self._fixed.expand(len(index), -1).clone()
            low, high = self._ends[:, self._sampled]
            drawn = low + (high - low) * self._uniform(0.0, 1.0, len(index), len(self._sampled), dtype=torch.float64)
            bounds = torch.where(self._log, torch.exp(self._ends), self._ends)[:, self._sampled]
            drawn = torch.where(self._log[self._sampled], torch.exp(drawn), drawn)
            designs[:, self._sampled] = torch.minimum(torch.maximum(drawn, bounds[0]), bounds[1])
            self._take_bodies(index, designs)
        elif bool(self._changed[index].any()):
            self._take_bodies(index, self._fixed[None])
            self._changed[index] = False
        bodies = self._rows(index)
        if paths is None:
            paths = self._draw_goals(bodies, len(index))
        if paths.shape[1] > self._state["paths"].shape[1]:
            self._state["paths"] = self._state["paths"].new_zeros(self.num_envs, *paths.shape[1:])
            self._hot = None
        rest = self._at_rest(bodies, len(index))
        del rest["paths"]
        rest["counts"].fill_(paths.shape[1])
        for name, value in rest.items():
            self._state[name][index] = value
        self._state["paths"][index, : paths.shape[1]] = paths

    def _draw_goals(self, bodies: Bodies, count: int) -> Tensor:
        """Paths [m] (count, p, 3), as the tasks draw them with NumPy."""

        def put(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=self.dtype, device=self.device)

        task = self.task
        if isinstance(task, Track):
            return put(task.path) + self._uniform(-task.jitter, task.jitter, count, 1, 3)
        if task.fixed_goals is not None:
            chosen = torch.randint(len(task.fixed_goals), (count,), generator=self._generator, device=self.device)
            return put(task.fixed_goals)[chosen][:, None]
        low, n = 2.0 * task.command_low - 1.0, self._ensemble.count
        goals = torch.full((count, 3), torch.nan, dtype=self.dtype, device=self.device)
        for _ in range(51):
            lost = torch.isnan(goals[:, :1])  # commands without an equilibrium are drawn again
            if not bool(lost.any()):
                return (goals + self._uniform(-task.spread, task.spread, count, 3))[:, None]
            target = self._uniform(low, 1.0, count, n)
            u, _, found = self._ensemble.search(bodies, target, target, MORE_STEPS, stop=True)
            drawn = torch.where(found[:, None], self._measure(bodies, u)[0], torch.nan)
            goals = torch.where(lost, drawn, goals)
        raise ConvergenceError("50 random commands in a row have no equilibrium: no goal can be drawn", fraction=0.0)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start an episode in every sub-environment.

        Args:
            seed: of all random numbers from here on; default they go on, from the constructor's seed if it has one.
            options: ``"design"``: the body of all for one episode, a mapping, or values of all design variables in
                their order for each, shape (num_envs, len(design_space)); ``"goal"``: a point (3,) or a path (p, 3)
                [m] for all, or a path for each (num_envs, p, 3).

        Returns:
            Observation (num_envs, d) and info.

        Raises:
            DesignError: for a malformed design.
            ValueError: for an unknown option or a malformed goal.
        """
        options = dict(options or {})
        unknown = set(options) - {"design", "goal"}
        if unknown:
            raise ValueError(f"unknown reset option '{sorted(unknown)[0]}'; allowed: design, goal")
        paths, designs = None, None
        if options.get("goal") is not None:
            goal = _array(options["goal"])
            paths = torch.as_tensor(
                self.task.check_paths(goal, () if np.ndim(goal) < 3 else (self.num_envs,)),
                dtype=self.dtype,
                device=self.device,
            )
            paths = paths.expand(self.num_envs, *paths.shape[-2:])
        if options.get("design") is not None:
            designs = self._check_designs(options["design"])
        seed = self._first_seed if seed is None else seed
        self._first_seed = None
        if seed is not None:
            self._generator.manual_seed(seed)
        self._begin_episodes(torch.arange(self.num_envs, device=self.device), designs, paths)
        self._started = True
        report = self._report(self._bodies, self._state)
        return report["observation"], report["info"]

    def _check_designs(self, design: Any) -> Tensor:
        if isinstance(design, Mapping):
            fixed = dict(zip(self.design_space.names, self._fixed.tolist(), strict=True))
            values = np.array([list(self.design_space.override(fixed, design).values())])
        else:
            values = np.asarray(_array(design), dtype=float)
            shape = (self.num_envs, len(self.design_space))
            if values.shape != shape:
                raise ValueError(f"design must be a mapping or an array of shape {shape}, got {values.shape}")
            for variable, column in zip(self.design_space.variables.values(), values.T, strict=True):
                variable.check(column.min()), variable.check(column.max())
        return torch.as_tensor(values, device=self.device)

    # -- steps ------------------------------------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions (num_envs, n_a) in [-1, 1].

        Returns:
            Observation (num_envs, d), reward, terminated and truncated (num_envs,), and info.

        Raises:
            RuntimeError: before the first `reset`.
            ValueError: for actions of a wrong shape or ones that are not finite.
        """
        if not self._started:
            raise RuntimeError("step was called before reset")
        actions = torch.as_tensor(actions, dtype=self.dtype, device=self.device)
        shape = (self.num_envs, self._ensemble.count)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, got {tuple(actions.shape)}")
        if self._hot is None:
            self._hot = self._prepare_step(actions)
        result = self._hot(actions)
        # The only question to the host in a step without ends.
        finite, found, ended = result["questions"].tolist()
        if not finite:
            raise ValueError("actions must be finite; allowed: -1 to 1")
        if not found:
            result = self._finish(result)
            ended = bool(result["truncated"].any())
        for name, value in result["state"].items():
            self._state[name].copy_(value)
        observation, info, truncated = result["observation"], result["info"], result["truncated"]
        if ended:
            final, mask = {"final_obs": observation, "final_info": info}, truncated
            self._begin_episodes(torch.nonzero(mask)[:, 0])
            report = self._report(self._bodies, self._state)
            observation = report["observation"]
            info = {**report["info"], **final, **{f"_{name}": mask for name in final}}
        return observation, result["reward"], torch.zeros_like(truncated), truncated, info

    def _prepare_step(self, actions: Tensor) -> Callable[[Tensor], dict[str, Any]]:
        """The step as it is, compiled, or captured as a graph of the device."""
        advance: Callable[..., dict[str, Any]] = self._advance
        if self._compile:
            advance = torch.compile(advance, dynamic=False)
        bodies, state = self._bodies, self._state
        if not self._cuda_graph:
            return lambda actions: advance(bodies, state, actions)
        # State and bodies are read where they lie; nothing is written but the result.
        given, stream = actions.clone(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                advance(bodies, state, given)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = advance(bodies, state, given)

        def replay(actions: Tensor) -> dict[str, Any]:
            given.copy_(actions)
            graph.replay()
            return _map(torch.clone, result)

        return replay

    def _advance(self, bodies: Bodies, state: dict[str, Tensor], actions: Tensor) -> dict[str, Any]:
        """One step of every row, with `STEPS` Newton steps; changes nothing."""
        a = actions.clamp(-1.0, 1.0)
        before = state["command"]
        if self.interface.action_mode == "increment":
            target = before + a * self._rates
        else:
            target = before + torch.minimum(torch.maximum(a - before, -self._rates), self._rates)
        target = target.clamp(-1.0, 1.0)
        u, gradient, found = self._ensemble.search(bodies, target, _guess(state, target), STEPS)
        result = self._settle(bodies, state, target, u, gradient, found)
        questions = torch.stack([torch.isfinite(actions).all(), found.all(), result["truncated"].any()])
        return result | {"questions": questions, "search": (target, u, gradient, found)}

    def _finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """Search again, and longer, where `STEPS` Newton steps were not enough."""
        target, u, gradient, found = result["search"]
        rows = torch.nonzero(~found)[:, 0]
        wanted, guess = target[rows], _guess(self._state, target)[rows]
        parts = self._ensemble.search(self._rows(rows), wanted, guess, MORE_STEPS, stop=True)
        u, gradient, found = (x.index_copy(0, rows, part) for x, part in zip((u, gradient, found), parts, strict=True))
        return self._settle(self._bodies, self._state, target, u, gradient, found)

    def _settle(
        self, bodies: Bodies, state: dict[str, Tensor], target: Tensor, u: Tensor, gradient: Tensor, found: Tensor
    ) -> dict[str, Any]:
        """State after a search, and all that is said about it."""
        effector, uncertainty, trusted = self._measure(bodies, u)
        pulls = self._ensemble.pulls
        slack = pulls & (u > target + (10.0 * TOLERANCE) * SPAN)
        gradient = torch.where(pulls, gradient.clamp(min=0.0), gradient).masked_fill(slack, 0.0)
        new = {
            "command": target,
            "u": u,
            "effort": gradient * bodies["effort"],
            "effector": effector,
            "slack": slack,
            "uncertainty": uncertainty,
            "trusted": trusted,
        }
        # Rows without a state stay where they were, and their episodes end.
        new = {
            name: torch.where(found if value.ndim == 1 else found[:, None], value, state[name])
            for name, value in new.items()
        }
        new |= {"converged": found, "steps": state["steps"] + 1}
        truncated = (new["steps"] >= self.max_episode_steps) | ~found
        report = self._report(bodies, state | new)
        report["reward"] = torch.where(found, report["reward"], 0.0)
        return report | {"state": new, "truncated": truncated}

    def _report(self, bodies: Bodies, state: dict[str, Tensor]) -> dict[str, Any]:
        """Observation, reward and info of a state, laid out as `Interface.observe` and `Task` have them."""
        paths, counts, steps = state["paths"], state["counts"], state["steps"]
        if paths.shape[1] == 1:
            goal = paths[:, 0]
        else:
            index = torch.minimum(steps * counts // self.task.horizon, counts - 1)
            goal = paths.gather(1, index[:, None, None].expand(-1, 1, 3))[:, 0]
        effector, relative = state["effector"], state["effort"] / self._typical_effort
        error = self._axes * (goal - effector)
        distance = torch.linalg.vector_norm(error, dim=1)
        margins = self.task.success_distance, self.robot.workspace_scale
        near, far = (1.0 / (1.0 + 9.0 * (distance / m) ** 2) for m in margins)
        terms = {"distance": 0.5 * (near + far), "effort": 1.0 - 0.05 * relative.abs().mean(dim=1).clamp(0.0, 1.0)}
        error = error * (2.5 / self.robot.workspace_scale)
        reach = 1.25 * self.robot.size
        parts = (
            state["command"],
            state["u"],
            relative / (1.0 + relative.abs()),
            effector / reach,
            goal / reach,
            error / (1.0 + error.abs()),
            bodies["unit"].expand(self.num_envs, -1),
        )
        info = {
            "effector": effector.clone(),
            "goal": goal.clone(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            "reward_terms": terms,
            "displacement": self._middle + self._half * state["u"],
            "effort": state["effort"].clone(),
            "stable": torch.ones_like(state["converged"]),
            "uncertainty": state["uncertainty"].clone(),
            "trusted": state["trusted"].clone(),
            "converged": state["converged"].clone(),
        }
        observation = torch.cat(parts, dim=1).clamp(-1.0, 1.0)
        return {"observation": observation, "reward": terms["distance"] * terms["effort"], "info": info}


#: Coefficients of bodies that every member has its own of: (M, S, ...), the others are (S, ...).
_OF_MEMBERS = frozenset({"c", "a", "b", "d1", "d2", "x0", "slope"})


def _axis(name: str) -> int:
    return int(name in _OF_MEMBERS)


def _at(name: str, index: Tensor) -> Any:
    return (slice(None), index) if _axis(name) else index


def _repeat(value: Tensor, axis: int, count: int) -> Tensor:
    shape = list(value.shape)
    shape[axis] = count
    return value.expand(shape).clone()


def _guess(state: dict[str, Tensor], target: Tensor) -> Tensor:
    """Where a search begins: slack cables where they were, the others at their command."""
    return torch.where(state["slack"], torch.maximum(state["u"], target), target)


def _map(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _map(function, value) for name, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(_map(function, value) for value in tree)
    return function(tree)


def _array(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else values

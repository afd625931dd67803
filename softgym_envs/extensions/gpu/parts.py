"""Robots of learned parts in torch: many bodies at once, in equilibrium or in motion, on any device.

The equations are those of `softgym_envs.extensions.beams.parts.backends`, from arrays of the same mechanical models:
rows of frames, coordinates of parts, masses and loads. Every row takes the same few Newton steps on the equilibrium
with held servos; servos beyond their largest effort are driven by it, as complementary pairs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.time_steps import TimeSteps
from softgym_envs.extensions.beams.elements import PoseParts, tip_stiffness
from softgym_envs.extensions.beams.parts.energy import LegFunction
from softgym_envs.extensions.beams.parts.leg import LegScale
from softgym_envs.extensions.beams.parts.trust import SOFTEST
from softgym_envs.extensions.beams.parts.weights import of_learned_parts
from softgym_envs.extensions.beams.servo import Servo
from softgym_envs.extensions.gpu.surrogates import Bodies
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot

NEWTON_STEPS, MAX_NEWTON_STEPS = 4, 25
"""Newton steps of every row in a time step, and of rows that take more."""
LONGEST, TOLERANCE = 0.1, {torch.float32: 1e-5, torch.float64: 1e-8}
"""Longest Newton step, and that of a solution: turns [rad] and motions over the robot's `workspace_scale`."""
INCREMENTS = 16
"""Increments in which equilibria under commands are approached from rest."""

State = dict[str, Tensor]


class TorchParts:
    """States of many bodies of learned parts under commanded displacements.

    Args:
        robot: the robot.
        device: of all tensors.
        dtype: of the networks and all results.
        weights: folder of the weights of the part; default the shipped ones.
        dynamics: step in time.
        **options: of `TimeSteps`.

    Raises:
        WeightsError: if the weights are missing, damaged or of another part.
        ValueError: for a robot that may touch something.
    """

    def __init__(
        self,
        robot: Robot,
        device: torch.device,
        dtype: torch.dtype,
        *,
        weights: Any = None,
        dynamics: bool = False,
        **options: Any,
    ) -> None:
        self._robot, self.part = of_learned_parts(robot, weights)
        self.device, self.dtype, self.moving = device, dtype, dynamics
        self.steps = TimeSteps(**options)
        self.count = len(robot.actuators)
        self._lower, self._span = self._put(robot.lower), self._put(robot.upper - robot.lower)
        self.middle, self.half_range = self._lower + 0.5 * self._span, 0.5 * self._span
        self._limit = self._put([actuator.max_effort for actuator in robot.actuators])
        self._tensors = {name: self._put(value) for name, value in self.part.tensors.items()}
        model = self._robot.build()
        self._learn_structure(model)
        self._arm = robot.workspace_scale
        self._tolerance = min(robot.goal_tolerance, self.part.limit)
        self._scale = torch.where(self._is_spin, 1.0 / self._arm, 1.0).to(dtype)

    def _put(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=float), dtype=self.dtype, device=self.device)

    def _index(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=torch.int64, device=self.device)

    def _learn_structure(self, model: MechanicalModel) -> None:
        """Keep what all bodies share: the numbering of rows and equations, servos and the effector."""
        kinematics, frames = model.kinematics, model.frames
        (parts,) = (block for block in model.blocks if isinstance(block, PoseParts))
        n, self._equations = len(model.nodes), kinematics.equations
        self._port_rows = self._index(parts.port_rows)
        # How equations move rows: origins by a constant, directors by a cross product with themselves.
        shift, turn = np.zeros((n, 3, self._equations)), np.zeros((n, 3, 3, self._equations))
        cross = np.zeros((3, 3, 3))
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            cross[i, k, j], cross[i, j, k] = 1.0, -1.0  # (e_i x d)_k = d_j, (e_i x d)_j = -d_k
        self._spins = np.zeros((len(frames.rows), 3), dtype=np.int64)
        is_spin = np.zeros(self._equations, dtype=bool)
        for f, row in enumerate(frames.rows):
            for axis in range(3):
                if (equation := kinematics.number[3 * row + axis]) >= 0:
                    shift[row, axis, equation] = 1.0
                if (equation := kinematics.spin_number[f, axis]) >= 0:
                    turn[row + 1 : row + 4, :, :, equation] = cross[axis]
                    is_spin[equation] = True
        self._shift, self._turn = self._put(shift), self._put(turn)
        self._is_spin = torch.as_tensor(is_spin, device=self.device)
        self._frames = self._index(frames.rows)
        numbers = np.array([[kinematics.number[3 * row + axis] for axis in range(3)] for row in frames.rows])
        self._origin, self._spin = (self._selection(part) for part in (numbers, kinematics.spin_number))
        statics = Statics(model)
        assembled = statics.linearisation.assemble(model.nodes, statics.effort)
        assert assembled is not None
        # A servo turns about a fixed axis: its angle is linear in its own spin.
        self._H = self._put(np.round(assembled.gradients[:, : self.count].T))
        (point,) = (c for c in model.constraints["e"] if isinstance(c, Point))
        effector = np.zeros(n)
        effector[point.embedding.node_ids[0]] = point.embedding.weights[0]
        self._effector = self._put(effector)
        servos = [c for c in model.constraints["a"] if isinstance(c, Servo)]
        self._servo_rows = self._index([servo.row for servo in servos])
        self._directions = self._put([servo.directions for servo in servos])

    def _selection(self, numbers: np.ndarray) -> Tensor:
        """Return the matrix (f, 3, N) that picks the equations of frames; fixed components are zero."""
        chosen = np.zeros((*numbers.shape, self._equations))
        for f, axis in zip(*np.nonzero(numbers >= 0), strict=True):
            chosen[f, axis, numbers[f, axis]] = 1.0
        return self._put(chosen)

    # -- bodies -----------------------------------------------------------------------------------------------------

    def prepare(self, designs: Tensor) -> Bodies:
        """Return bodies and their states at rest; each is built and solved at rest on the host.

        Args:
            designs: values in the order of the design space, shape (S, len(space)).

        Raises:
            ConvergenceError: if a body has no equilibrium at rest.
        """
        names = self._robot.design_space.names
        arrays: dict[str, list[np.ndarray]] = {}
        for values in designs.cpu().tolist():
            design = dict(zip(names, values, strict=True))
            model = self._robot.build(design)
            (parts,) = (block for block in model.blocks if isinstance(block, PoseParts))
            statics = Statics(model)
            rest = statics.solve(np.zeros(self.count))
            found = {
                "forms": parts.forms,
                "linear": parts.linear,
                "energy": np.array(parts.scale),
                "softest": np.array(SOFTEST * parts.scale / parts.length**2),
                "shape": LegScale.of(design).shape,
                "mass": statics.linearisation.assembly.mass_matrix().rows.toarray(),
                "loads": model.loads,
                "inflation": np.array(self.part.inflation_of(design)),
                "rest_x": rest.x,
            }
            for name, value in found.items():
                arrays.setdefault(name, []).append(value)
        bodies = {name: self._put(np.stack(values)) for name, values in arrays.items()}
        zero = (-self.middle / self.half_range).expand(len(designs), -1)
        bodies["rest"] = zero.clone()
        still = torch.zeros_like(bodies["rest_x"])
        state = {"x": bodies["rest_x"], "speed": still, "held": torch.ones_like(zero, dtype=torch.bool)}
        gradient, tangent, motion = self._assemble(bodies, state["x"], None)
        bodies["rest_effort"] = self._efforts(gradient, motion)
        judged = self._judge(bodies, state["x"], state["held"], tangent, motion)
        bodies["rest_effector"], bodies["rest_uncertainty"], bodies["rest_trusted"], bodies["rest_soft"] = judged
        return bodies

    def at_rest(self, bodies: Bodies) -> State:
        """Return the states of bodies at rest, by name."""
        x = bodies["rest_x"]
        return {
            "u": bodies["rest"],
            "effort": bodies["rest_effort"],
            "effector": bodies["rest_effector"],
            "velocity": torch.zeros_like(bodies["rest_effector"]),
            "slack": torch.zeros_like(bodies["rest"], dtype=torch.bool),
            "uncertainty": bodies["rest_uncertainty"],
            "trusted": bodies["rest_trusted"],
            "soft": bodies["rest_soft"],
            "x": x,
            "speed": torch.zeros_like(x),
            "held": torch.ones_like(bodies["rest"], dtype=torch.bool),
        }

    # -- steps ------------------------------------------------------------------------------------------------------

    def advance(self, bodies: Bodies, state: State, command: Tensor) -> tuple[State, Tensor]:
        """Return the states (B) a control step later under commands (B, n_a), and whether they were found (B,)."""
        return self._march(bodies, state, command, NEWTON_STEPS)

    def finish(self, bodies: Bodies, state: State, command: Tensor) -> tuple[State, Tensor]:
        """As `advance`, for rows that need more Newton steps; waits for the device."""
        return self._march(bodies, state, command, MAX_NEWTON_STEPS)

    def kinematics(self, bodies: Bodies, command: Tensor) -> Tensor:
        """Return effectors [m] (B, 3) of equilibria under commands (B, n_a), approached from rest; NaN without one."""
        rest = {name: value.expand(len(command), *value.shape[1:]) for name, value in self.at_rest(bodies).items()}
        x, held, found = rest["x"], rest["held"], torch.ones(len(command), dtype=torch.bool, device=self.device)
        for k in range(1, INCREMENTS + 1):
            target = command * (k / INCREMENTS)
            x, held, _, solved = self._solve(bodies, x, held, target, None, MAX_NEWTON_STEPS)
            found &= solved
        return torch.where(found[:, None], self._effector @ x, torch.nan)

    def _march(self, bodies: Bodies, state: State, command: Tensor, iterations: int) -> tuple[State, Tensor]:
        x, speed, held = state["x"], state["speed"], state["held"]
        found = torch.ones(len(x), dtype=torch.bool, device=self.device)
        if self.moving:
            for k in range(1, self.steps.count + 1):
                share = k / self.steps.count
                target = state["command"] + share * (command - state["command"])
                step = (x, speed, self._viscosity(bodies, x))
                new, held, effort, solved = self._solve(bodies, x, held, target, step, iterations)
                x, speed, found = new, (new - x) / self.steps.step, found & solved
        else:
            x, held, effort, found = self._solve(bodies, x, held, command, None, iterations)
        _, tangent, motion = self._assemble(bodies, x, None)
        effector, uncertainty, trusted, soft = self._judge(bodies, x, held, tangent, motion)
        soft = soft | state["soft"]
        new_state = {
            "u": (self._angles(x) - self.middle) / self.half_range,
            "effort": effort,
            "effector": effector,
            "velocity": self._effector @ speed,
            "slack": torch.zeros_like(held),
            "uncertainty": uncertainty,
            "trusted": trusted & ~soft,
            "soft": soft,
            "x": x,
            "speed": speed,
            "held": held,
        }
        return new_state, found

    def _solve(
        self,
        bodies: Bodies,
        x: Tensor,
        held: Tensor,
        target: Tensor,
        step: tuple[Tensor, Tensor, Tensor] | None,
        iterations: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Find rows (B, n, 3) at which servos reach targets (B, n_a) or their largest effort.

        Args:
            bodies: from `prepare`.
            x: where the search begins, shape (B, n, 3).
            held: servos that followed their commands before, shape (B, n_a).
            target: angles.
            step: rows and their velocities at the start of a time step, and the viscosity of the parts; None for an
                equilibrium.
            iterations: Newton steps.

        Returns:
            Rows, which servos follow, their efforts, and whether the rows were found (B,).
        """
        B, N, n = len(x), self._equations, self.count
        unit = torch.eye(n, dtype=self.dtype, device=self.device)
        effort, found = torch.zeros_like(target), torch.zeros(B, dtype=torch.bool, device=self.device)
        sign, last = torch.zeros_like(target), held
        for k in range(iterations):
            gradient, tangent, motion = self._assemble(bodies, x, step)
            residual = torch.einsum("brd,brde->be", gradient, motion)
            if k == 0:
                sign = torch.sign(self._efforts(gradient, motion))
            # [K  -H^T] [dq]   [-r]      H dq = gap where a servo is held; its effort is given where it is not
            # [D H 1-D] [ f] = [ s]
            D = held.to(self.dtype)
            gap = target - self._angles(x)
            top = torch.cat([tangent, -self._H.T.expand(B, N, n)], 2)
            bottom = torch.cat([D[:, :, None] * self._H, (1.0 - D)[:, :, None] * unit], 2)
            limit = torch.where(held, gap, sign * self._limit)
            right = torch.cat([-residual, torch.where(torch.isfinite(limit), limit, 0.0)], 1)
            answer, info = torch.linalg.solve_ex(torch.cat([top, bottom], 1), right)
            move, effort = answer[:, :N], answer[:, N:]
            size = (move / self._scale / self._arm).abs().amax(1)
            part = (LONGEST / size.clamp(min=LONGEST))[:, None]
            # Servos whose effort is too large, or whose command asks for less than they have reached.
            over = held & (effort.abs() > self._limit) & (size < LONGEST)[:, None]
            back = ~held & (sign * gap < 0.0)
            sign = torch.where(over, torch.sign(effort), sign)
            last, held = held, torch.where(found[:, None], held, (held & ~over) | back)
            settled = (size < TOLERANCE[self.dtype]) & (last == held).all(1) & (info == 0)
            moved = self._move(x, part * move)
            x = torch.where(found[:, None, None], x, moved)
            found = found | settled
            if iterations > NEWTON_STEPS and bool(found.all()):
                break
        return x, held, effort, found & torch.isfinite(x).all(2).all(1)

    # -- mechanics --------------------------------------------------------------------------------------------------

    def _coordinates(self, bodies: Bodies, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coordinates (B, k, 15) of the parts at rows (B, n, 3), and their slopes (B, k, 15, 8, 3)."""
        z = x[:, self._port_rows]
        slopes = (bodies["forms"] @ z[:, :, None]) + bodies["linear"]
        return 0.5 * ((slopes + bodies["linear"]) * z[:, :, None]).sum((3, 4)), slopes

    def _function(self, bodies: Bodies, y: Tensor) -> LegFunction:
        """Return the energy of the parts at coordinates (B, k, 15)."""
        B, k, _ = y.shape
        shape = bodies["shape"][:, None].expand(-1, k, -1).expand(B, -1, -1).reshape(-1, 5)
        return LegFunction(self._tensors, shape)

    def _energies(self, bodies: Bodies, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradients (B, k, 15) and Hessians (B, k, 15, 15) of the energies of the parts at coordinates."""
        B, k, m = y.shape
        scale = bodies["energy"].expand(B)[:, None, None]
        _, gradient, hessian = self._function(bodies, y).evaluate(y.reshape(-1, m))
        return scale * gradient.reshape(B, k, m), scale[..., None] * hessian.reshape(B, k, m, m)

    def _motion(self, x: Tensor) -> Tensor:
        """Return how equations move rows at rows (B, n, 3), shape (B, n, 3, N)."""
        return self._shift + torch.einsum("rcde,brd->brce", self._turn, x)

    def _assemble(
        self, bodies: Bodies, x: Tensor, step: tuple[Tensor, Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return forces on rows (B, n, 3), the tangent (B, N, N) and the motion of the rows (B, n, 3, N)."""
        y, slopes = self._coordinates(bodies, x)
        gradient, hessian = self._energies(bodies, y)
        motion = self._motion(x)
        forces = -bodies["loads"].expand_as(x).clone()
        if step is not None:
            start, speed, viscosity = step
            h, beta = self.steps.step, self.steps.stiffness_damping / self.steps.step
            y0, _ = self._coordinates(bodies, start)
            gradient = gradient + beta * (viscosity @ (y - y0)[..., None])[..., 0]
            hessian = hessian + beta * viscosity
            rate = (x - start) / h
            forces = forces + bodies["mass"] @ ((rate - speed) / h + self.steps.mass_damping * rate)
        pulls = torch.einsum("bki,bkiad->bkad", gradient, slopes)
        forces = forces.index_add(1, self._port_rows.reshape(-1), pulls.reshape(len(x), -1, 3))
        ports = motion[:, self._port_rows]
        along = torch.einsum("bkiad,bkade->bkie", slopes, ports)
        tangent = (along.transpose(2, 3) @ hessian @ along).sum(1)
        form = torch.einsum("bki,bkiac->bkac", gradient, bodies["forms"].expand(len(x), -1, -1, -1, -1))
        tangent = tangent + torch.einsum("bkade,bkac,bkcdf->bef", ports, form, ports)
        if step is not None:
            factor = 1.0 / self.steps.step**2 + self.steps.mass_damping / self.steps.step
            mass = bodies["mass"].expand(len(x), -1, -1)
            tangent = tangent + factor * torch.einsum("brde,brs,bsdf->bef", motion, mass, motion)
        return forces, tangent + self._curvature(x, forces), motion

    def _curvature(self, x: Tensor, forces: Tensor) -> Tensor:
        """Return the second derivative of rotations under forces on rows, ``sym(g d^T) - g . d`` for each frame."""
        rows = self._frames[:, None] + torch.arange(1, 4, device=self.device)
        g, d = forces[:, rows], x[:, rows]
        outer = torch.einsum("bfki,bfkj->bfij", g, d)
        trace = (g * d).sum((2, 3))[:, :, None, None] * torch.eye(3, dtype=self.dtype, device=self.device)
        block = 0.5 * (outer + outer.transpose(2, 3)) - trace
        return torch.einsum("fie,bfij,fjg->beg", self._spin, block, self._spin)

    def _move(self, x: Tensor, move: Tensor) -> Tensor:
        """Return the rows after motions of the equations (B, N), with rotations by their spins."""
        shift = torch.einsum("fie,be->bfi", self._origin, move)
        spin = torch.einsum("fie,be->bfi", self._spin, move)
        square = (spin * spin).sum(2).clamp(min=1e-16)
        angle = square.sqrt()[:, :, None, None]
        zero = torch.zeros_like(spin[..., 0])
        a, b, c = spin.unbind(2)
        W = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], 2).reshape(*spin.shape[:2], 3, 3)
        eye = torch.eye(3, dtype=self.dtype, device=self.device)
        half = torch.sin(0.5 * angle) / angle
        turn = eye + torch.sin(angle) / angle * W + 2.0 * half**2 * (W @ W)
        rows = self._frames[:, None] + torch.arange(1, 4, device=self.device)
        d = x[:, rows] @ turn.transpose(2, 3)
        d = 1.5 * d - 0.5 * (d @ d.transpose(2, 3)) @ d  # orthonormal to rounding
        moved = x.index_copy(1, rows.reshape(-1), d.reshape(len(x), -1, 3))
        return moved.index_add(1, self._frames, shift)

    def _angles(self, x: Tensor) -> Tensor:
        """Return the angles of the servos [rad], shape (B, n_a)."""
        pair = torch.einsum("bad,aid->bai", x[:, self._servo_rows], self._directions)
        return torch.atan2(pair[..., 1], pair[..., 0])

    def _efforts(self, forces: Tensor, motion: Tensor) -> Tensor:
        """Return the efforts (B, n_a) that hold the servos under forces on rows."""
        return torch.einsum("brd,brde,ae->ba", forces, motion, self._H)

    def _viscosity(self, bodies: Bodies, x: Tensor) -> Tensor:
        """Return the stiffness (B, k, 15, 15) by which rates of the coordinates are damped, as `PoseParts` does."""
        y, _ = self._coordinates(bodies, x)
        stiffness, back = self._tips(bodies, y)
        values, vectors = torch.linalg.eigh(stiffness)
        positive = (vectors * values.clamp(min=0.0)[:, None]) @ vectors.transpose(1, 2)
        return (back.transpose(1, 2) @ positive @ back).reshape(*y.shape, -1)

    def _tips(self, bodies: Bodies, y: Tensor) -> tuple[Tensor, Tensor]:
        gradient, hessian = self._energies(bodies, y)
        m = y.shape[2]
        return tip_stiffness(y.reshape(-1, m), gradient.reshape(-1, m), hessian.reshape(-1, m, m))

    def _judge(
        self, bodies: Bodies, x: Tensor, held: Tensor, tangent: Tensor, motion: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return effectors [m] (B, 3), their uncertainty [m], and whether they are trusted and soft (B,), as `judge`.

        States that came from soft ones are not trusted either.
        """
        # Held servos do not move: their equations are replaced by stiff ones.
        still = ((self._H != 0.0).to(self.dtype) * held[:, :, None]).sum(1)
        scaled = tangent * self._scale[:, None] * self._scale
        keep = 1.0 - still
        stiff = scaled.abs().amax((1, 2))
        scaled = scaled * keep[:, :, None] * keep[:, None, :] + torch.diag_embed(still * stiff[:, None])
        values, vectors = torch.linalg.eigh(scaled)
        toward = torch.einsum("r,brde->bed", self._effector, motion) * (self._scale * keep)[:, :, None]
        unit = vectors @ ((vectors.transpose(1, 2) @ toward) / values[:, :, None])
        fields = unit * self._scale[:, None]
        y, slopes = self._coordinates(bodies, x)
        stiffness, back = self._tips(bodies, y)
        along = torch.einsum("bkiad,bkade->bkie", slopes, motion[:, self._port_rows])
        rates = (along @ fields[:, None]).reshape(-1, along.shape[2], 3)
        scale = bodies["energy"].expand(len(x)).repeat_interleave(y.shape[1])
        sizes, axes = torch.linalg.eigh(stiffness)
        root = axes * torch.sqrt(scale[:, None] * torch.maximum(sizes.abs(), 2.0 * scale[:, None]))[:, None]
        wrong = self._function(bodies, y).errors(y.reshape(-1, y.shape[2]))[:, None, None] * (
            root.transpose(1, 2) @ (back @ rates)
        )
        uncertainty = bodies["inflation"] * wrong.reshape(len(x), -1, 3).square().sum((1, 2)).sqrt()
        gradient, _ = self._energies(bodies, y)
        known = self._known(y, gradient / bodies["energy"].expand(len(x))[:, None, None])
        soft = ~(values[:, 0] > bodies["softest"])
        trusted = known & ~soft & (uncertainty <= self._tolerance)
        return self._effector @ x, uncertainty, trusted, soft

    def _known(self, y: Tensor, gradient: Tensor) -> Tensor:
        """Return whether all parts are at poses and under loads that they have learned, shape (B,)."""
        domain = self.part.domain
        R = y[..., 3:12]
        turn = torch.atan2(-(R[..., 0] + R[..., 8]), R[..., 2] - R[..., 6]) + 0.5 * np.pi
        force = gradient[..., :3].norm(dim=-1)
        axes, slopes = R.reshape(*R.shape[:-1], 3, 3), gradient[..., 3:12].reshape(*R.shape[:-1], 3, 3)
        moment = torch.linalg.cross(axes, slopes, dim=-2).sum(-1).norm(dim=-1)
        low, high = domain.turn
        inside = (turn > low) & (turn < high) & (R[..., 4] > domain.across)
        inside &= (y[..., :3].norm(dim=-1) < domain.longest) & (force < domain.force) & (moment < domain.moment)
        return inside.all(dim=1)

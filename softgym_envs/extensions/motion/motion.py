"""Motion of a learned condensed model in time: its energy, and the learned inertia of the module `inertia`.

The coordinates are the constraint values of the body (displacements ``q`` of its actuators and positions ``e`` of its
effectors) and the amplitudes ``r`` of its inner modes. With the equilibrium effectors ``x(q)`` and ``z = e - x(q)``,
the energy is ``U(q) + z^T K_h z / 2 + r^T r / 2``, where ``K_h`` is the stiffness of the effectors with held actuators,
the block of ``W^-1`` that belongs to them. So the tangent is ``diag(W^-1, 1)``, damped in proportion.

A time step is implicit Euler's, as on finite elements. There, the change of velocity is projected on the modes ``T`` at
the end of the step: ``T_1^T M (T_s v_1 - T_p v_0)``, with modes ``T_s`` in the middle of this step and ``T_p`` in the
middle of the last one. Between the modes of two places there is the mass ``K_1^1/2 P K_2^1/2``, with stiffnesses at the
two places and the squared periods ``P`` halfway between them, which change far less.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgym_envs.backends.batch import BatchState, Rows
from softgym_envs.backends.time_steps import TimeSteps
from softgym_envs.extensions.motion.inertia import half_stiffness, read_inertia
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.solvers.complementarity import solve_rows
from softgym_envs.surrogate.model import Context, SurrogateModel

ITERATIONS = 20
#: A time step ends when its displacements move less than this [quarter of the actuator range].
TOLERANCE = 5e-5


@dataclass(frozen=True)
class MotionState(Rows):
    """Bodies at an instant.

    Attributes:
        place: constraint values and amplitudes of inner modes, shape (B, k).
        velocity: their rates, shape (B, k).
        effort: of the actuators, shape (B, n_a).
        compliance: of the constraint values in the last time step, inertia included, shape (B, n, n).
        root: of the stiffness in the middle of the last time step (`half_stiffness`), shape (B, n, n).
    """

    place: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    compliance: np.ndarray
    root: np.ndarray


class SurrogateMotion:
    """Steps bodies of a learned model in time.

    Args:
        model: the learned condensed model.
        folder: of weights, with the learned inertia of the same robot.
        steps: time steps and damping.

    Attributes:
        inertia: the learned inertia.
        body: see `LearnedInertia.body`.

    Raises:
        WeightsError: if there is no inertia in the folder, or it does not fit.
    """

    def __init__(self, model: SurrogateModel, folder: str | Path, steps: TimeSteps) -> None:
        self.model, self.inertia, self.steps = model, read_inertia(folder, model.robot), steps
        self.body = self.inertia.body
        self._actuators, self._values = model.count, model.size

    def at_rest(self, context: Context, displacement: np.ndarray, effort: np.ndarray) -> MotionState:
        """Return bodies that do not move, in equilibria with displacements and efforts (B, n_a)."""
        place = np.zeros((len(displacement), 2 * self._values))
        place[:, : self._actuators] = displacement
        place[:, self._actuators : self._values] = self.model.effector(context, displacement)[0]
        W = self.model.compliance(context, displacement)
        return MotionState(place, np.zeros_like(place), effort.copy(), W, half_stiffness(W, self.inertia.sizes))

    def advance(
        self, context: Context, body: np.ndarray, state: MotionState, command: np.ndarray, target: np.ndarray
    ) -> tuple[MotionState, np.ndarray]:
        """Advance by a control step, along which displacements are commanded from ``command`` to ``target`` (B, n_a).

        Args:
            context: prepared bodies.
            body: inertia features of each design, see `LearnedInertia.body`.
            state: where they are.
            command: the last command.
            target: the next one.

        Returns:
            The state at the end, and which bodies have one, shape (B,).
        """
        found = np.ones(len(target), dtype=bool)
        for part in self.steps.ramp(command, target):
            state, solved = self._step(context, body, state, part)
            found &= solved
        return state, found

    def _step(
        self, context: Context, body: np.ndarray, state: MotionState, target: np.ndarray
    ) -> tuple[MotionState, np.ndarray]:
        n_a, unilateral, span = self._actuators, self.model.robot.unilateral, self.model.span
        # Taut cables go where they are commanded; slack ones at first go on as they move.
        drift = state.place[:, :n_a] + self.steps.step * state.velocity[:, :n_a]
        slack = unilateral & (state.effort <= 0.0)
        place = state.place.copy()
        place[:, :n_a] = np.where(slack, np.maximum(drift, target), target)
        moved, found = state.rows(np.arange(len(target))), np.zeros(len(target), dtype=bool)
        rows = np.arange(len(target))
        for _ in range(ITERATIONS):
            new, solved = self._iterate(context.rows(rows), body[rows], state.rows(rows), place[rows], target[rows])
            step = new.place[:, :n_a] - place[rows, :n_a]
            ended = solved & (np.abs(step) <= TOLERANCE * span).all(axis=1)
            found[rows[ended]] = True
            moved = moved.replaced(rows[ended], new.rows(np.flatnonzero(ended)))
            place[rows] = new.place
            place[rows, :n_a] += np.clip(step, -span, span) - step
            rows = rows[solved & ~ended]
            if not len(rows):
                break
        return moved, found

    def _iterate(
        self, context: Context, body: np.ndarray, start: MotionState, place: np.ndarray, target: np.ndarray
    ) -> tuple[MotionState, np.ndarray]:
        """Solve a time step that is linearised at ``place`` (B, k); return its end, and which rows have one (B,)."""
        h, n_a, n = self.steps.step, self._actuators, self._values
        q, since = place[:, :n_a], start.place[:, :n_a]
        middle = 0.5 * (q + since)
        last = since - 0.5 * h * start.velocity[:, :n_a]
        W = self.model.compliance(_twice(context), np.concatenate([q, middle]))
        W[~np.isfinite(W).all(axis=(1, 2))] = np.eye(n)
        roots = half_stiffness(W, self.inertia.sizes)
        stiffness = np.tile(np.eye(2 * n), (len(q), 1, 1))
        stiffness[:, :n, :n] = roots[: len(q)] @ roots[: len(q)].swapaxes(1, 2)
        periods = self.inertia.periods(np.tile(body, (2, 1)), 0.5 * np.concatenate([q + middle, q + last]))
        now = _between(roots[: len(q)], periods[: len(q)], roots[len(q) :])
        before = _between(roots[: len(q)], periods[len(q) :], start.root)

        growth = 1.0 + self.steps.mass_damping * h
        rate = (place - start.place) / h
        force = (_times(now, growth * rate) - _times(before, start.velocity)) / h
        force += self._elastic(context, place, stiffness)
        force += self.steps.stiffness_damping * _times(stiffness, rate)
        tangent = now * (growth / h**2) + stiffness * (1.0 + self.steps.stiffness_damping / h)
        yielding = np.linalg.inv(tangent)
        free = place - _times(yielding, force)
        effort, solved = solve_rows(yielding[:, :n_a, :n_a], free[:, :n_a] - target, self.model.robot.unilateral)
        end = free + _times(yielding[:, :, :n_a], effort)
        velocity = (end - start.place) / h
        solved &= np.isfinite(end).all(axis=1)
        return MotionState(end, velocity, effort, yielding[:, :n, :n], roots[len(q) :]), solved

    def _elastic(self, context: Context, place: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Return the forces (B, k) of the energy at places (B, k), with the tangent stiffness (B, k, k)."""
        n_a, n = self._actuators, self._values
        effort, effector, _ = self.model.state(context, place[:, :n_a])
        away = np.zeros_like(place)
        away[:, n_a:n] = place[:, n_a:n] - effector
        away[:, n:] = place[:, n:]
        force = _times(stiffness, away)
        force[:, :n_a] += effort
        return force

    def batch_state(self, context: Context, state: MotionState, command: np.ndarray, found: np.ndarray) -> BatchState:
        """Return what the environment sees of states that commands (B, n_a) led to; ``found`` (B,): they are solved."""
        n_a, model = self._actuators, self.model
        q, effector = state.place[:, :n_a].copy(), state.place[:, n_a : self._values].copy()
        slack = model.robot.unilateral & (q > command + 10.0 * TOLERANCE * model.span)
        distrust = model.distrust(context, q, model.effector(context, q)[1], command)
        return BatchState(q, state.effort.copy(), effector, slack, found, *distrust)

    def effector_velocity(self, state: MotionState) -> np.ndarray:
        """Return the velocities of the effectors [m/s], shape (B, n_e)."""
        return state.velocity[:, self._actuators : self._values].copy()

    def condensed(self, state: MotionState) -> CondensedModel:
        """Return the condensed models of the last time step, inertia included."""
        n_a, n = self._actuators, self._values
        full = np.zeros((len(state.effort), n))
        full[:, :n_a] = state.effort
        free = state.place[:, :n] - np.einsum("bij,bj->bi", state.compliance, full)
        return CondensedModel(state.compliance.copy(), free, full, self.model.roles, self.model.rows)


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return products of matrices (B, i, j) and vectors (B, j)."""
    return np.matmul(matrices, vectors[:, :, None])[:, :, 0]


def _twice(context: Context) -> Context:
    """Return the bodies of a context, and then again."""
    return context.rows(np.tile(np.arange(len(context.slot)), 2))


def _between(first: np.ndarray, periods: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return masses (B, 2 n, 2 n) between modes at places with the given roots of their stiffness (B, n, n)."""
    n = first.shape[1]
    mass = periods.copy()
    mass[:, :n] = np.matmul(first, mass[:, :n])
    mass[:, :, :n] = np.matmul(mass[:, :, :n], second.swapaxes(1, 2))
    return mass

"""Inverse control by quadratic programming on the condensed model (thesis, eq. 2.14)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from softgym_envs.backends.backend import check_command
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from softgym_envs.robots.base import Robot

#: A bound that is never active in a problem scaled to order one.
UNBOUNDED = 1e6


class StepLimits(NamedTuple):
    """What one step may change, from the state of the model, and the commands that may follow; each of shape (n_a,).

    Attributes:
        displacement: lowest and highest changes of the displacements; they allow standing still.
        effort: lowest and highest changes of the efforts.
        commanded_displacement: lowest and highest commands of actuators that are commanded in displacement.
        commanded_effort: lowest and highest commands of actuators that are commanded in effort.
    """

    displacement: tuple[np.ndarray, np.ndarray]
    effort: tuple[np.ndarray, np.ndarray]
    commanded_displacement: tuple[np.ndarray, np.ndarray]
    commanded_effort: tuple[np.ndarray, np.ndarray]


class _Program(NamedTuple):
    """The QP of a step as ProxQP takes it, and what turns its solution into a command; leading shapes are a batch."""

    arguments: tuple[np.ndarray | None, ...]
    displacement: np.ndarray
    effort: np.ndarray
    scale: np.ndarray
    to_effort: np.ndarray
    limits: StepLimits

    def row(self, index: int) -> tuple[np.ndarray | None, ...]:
        """Return the QP of one row of a batch."""
        return tuple(None if each is None else each[index] for each in self.arguments)


def _transposed(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, -1, -2)


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return (matrices @ vectors[..., None])[..., 0]


class InverseQP:
    """Controller that finds actuator displacements or efforts to bring the effectors to a goal, step by step.

    With ``d`` the change of the actuator displacements (so efforts change by ``W_aa^-1 d`` and effectors by
    ``W_ea W_aa^-1 d``), each call minimises

        |delta_e - goal|^2 + eps (effort_weight * effort^T W_aa effort + step_weight * change^T W_aa change)

    where ``change`` is the step of the efforts and ``eps = |W_ea^T W_ea|_F / |W_aa|_F``, subject to

        effort >= 0 for unilateral actuators,  min_effort <= effort <= max_effort,  |change| <= effort_rate,
        lower <= delta_a <= upper,  |delta_a - command| <= rate.

    Regularisation: published codes use three definitions of eps; this one makes the weights dimensionless. The defaults
    are far below the 0.01 in some codes, for which the finger stops 0.58 mm short of a goal 54 mm away; with 1e-5 it
    stops 0.6 um short.
    ``effort_weight`` decides between redundant actuators and pulls the result towards rest by about that fraction of
    its distance; ``step_weight`` only slows down the last part of the approach and causes no steady error.
    ``goal_weights`` multiply the squared error of each effector coordinate: zero leaves a coordinate free, and if
    not all coordinates can be reached, those with larger weights get closer to their goals.

    The problem is scaled to order one (displacements by the rate, efforts by the compliance) before ProxQP's dense
    backend solves it with box constraints and a warm start. The two norms in ``eps`` are taken in units of the rates,
    so the result does not depend on the units of displacements and efforts, even when actuators differ in unit.

    Args:
        lower: smallest displacements [m, m3, ...], shape (n_a,).
        upper: largest displacements, shape (n_a,).
        rates: largest change of the displacements per call, shape (n_a,); inf for actuators that are commanded in
            effort and have an effort rate.
        unilateral: actuators that cannot push, shape (n_a,).
        effort_weight: see above.
        step_weight: see above.
        goal_weights: see above, shape (n_e,); default one each.
        min_effort: smallest efforts [N, Pa, ...], shape (n_a,), or None.
        max_effort: largest efforts, shape (n_a,), or None.
        effort_rates: largest change of the efforts per call, shape (n_a,), or None.
        mode: ``"displacement"`` or ``"effort"`` for all actuators, or one of them per actuator: what `solve` takes as
            the current command and returns as the next. Rates limit the step from the command in the actuator's own
            quantity, and from the state of the model in the other.

    Attributes:
        displacement: displacements at the drives that the model predicts for the last result, shape (n_a,).
        effort: actuator efforts that the model predicts for the last result, shape (n_a,).

    Raises:
        ValueError: for malformed bounds, rates, weights or modes.
    """

    displacement: np.ndarray
    effort: np.ndarray

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        rates: np.ndarray,
        unilateral: np.ndarray,
        *,
        effort_weight: float = 1e-5,
        step_weight: float = 1e-3,
        goal_weights: np.ndarray | None = None,
        min_effort: np.ndarray | None = None,
        max_effort: np.ndarray | None = None,
        effort_rates: np.ndarray | None = None,
        mode: str | Sequence[str] = "displacement",
    ) -> None:
        from proxsuite import proxqp

        self.lower, self.upper, self.rates = (np.asarray(v, dtype=float) for v in (lower, upper, rates))
        if not (self.rates > 0).all():
            raise ValueError(f"rates must be positive, got {self.rates.tolist()}")
        count = len(self.rates)
        self.unilateral = np.asarray(unilateral, dtype=bool)
        for name, weight in (("effort_weight", effort_weight), ("step_weight", step_weight)):
            if not (np.isfinite(weight) and weight >= 0.0):
                raise ValueError(f"{name} = {weight} must be finite and not negative")
        if self.unilateral.shape != (count,):
            raise ValueError(f"unilateral must have shape ({count},), got {self.unilateral.shape}")
        self.effort_weight = effort_weight
        self.step_weight = step_weight
        self.goal_weights = None if goal_weights is None else np.asarray(goal_weights, dtype=float)
        if self.goal_weights is not None and not (np.isfinite(self.goal_weights) & (self.goal_weights >= 0.0)).all():
            raise ValueError(f"goal_weights must be finite and not negative, got {self.goal_weights.tolist()}")

        def bound(values: np.ndarray | None, missing: float) -> np.ndarray:
            return np.full(count, missing) if values is None else np.asarray(values, dtype=float)

        floor = bound(min_effort, -np.inf)
        self.min_effort = np.where(self.unilateral, np.maximum(floor, 0.0), floor)
        self.max_effort = bound(max_effort, np.inf)
        self.effort_rates = bound(effort_rates, np.inf)
        if not (self.effort_rates > 0).all():
            raise ValueError(f"effort_rates must be positive, got {self.effort_rates.tolist()}")
        modes = [mode] * count if isinstance(mode, str) else list(mode)
        if len(modes) != count or any(m not in ("displacement", "effort") for m in modes):
            raise ValueError(f"mode must be 'displacement' or 'effort' (one, or {count} of them), got {mode!r}")
        self.by_effort = np.array([m == "effort" for m in modes], dtype=bool)
        if not np.isfinite(np.where(self.by_effort, np.minimum(self.rates, self.effort_rates), self.rates)).all():
            raise ValueError(
                "every actuator needs a finite rate of its displacement or, in mode 'effort', of its effort"
            )
        for low, high, word in (
            (self.lower, self.upper, "displacement"),
            (self.min_effort, self.max_effort, "effort"),
        ):
            if low.shape != (count,) or high.shape != (count,) or not (low <= high).all():
                raise ValueError(
                    f"bounds of {word} must be {counted(count, 'pair')}, low <= high, got {low} and {high}"
                )
        self._proxqp = proxqp
        self._robot: Robot | None = None
        self._qp: Any = None
        self._rows: list[Any] = []  # the solvers of `solve_batch`

    @classmethod
    def for_robot(cls, robot: Robot, **options: Any) -> Self:
        """Return the controller of a robot, with the ranges, rates and largest efforts of its actuators.

        Actuators that the robot commands in effort are commanded so here, and their displacements are not bounded. It
        refuses goals that are far from the robot, such as those in millimetres.

        Args:
            robot: the robot. The goal weights of a robot with one effector are its goal axes.
            **options: arguments of the class, which replace those of the robot.
        """
        largest = np.array([actuator.max_effort for actuator in robot.actuators])
        by_effort = robot.by_effort
        arguments = {
            "lower": np.where(by_effort, -np.inf, robot.lower),
            "upper": np.where(by_effort, np.inf, robot.upper),
            "rates": np.where(by_effort, np.inf, robot.rates),
            "effort_rates": np.where(by_effort, robot.command_rates, np.inf),
            "mode": robot.command_modes,
            "unilateral": robot.unilateral,
            "min_effort": -largest,
            "max_effort": largest,
            "goal_weights": None if len(robot.effectors) > 1 or np.all(robot.goal_axes) else robot.goal_axes,
        }
        made = cls(**{**arguments, **options})
        made._robot = robot
        return made

    @classmethod
    def by_efforts(cls, robot: Robot, largest: float, rate: float, **options: Any) -> Self:
        """Return the controller of a robot that commands efforts and does not bound displacements.

        Args:
            robot: the robot.
            largest: largest effort of every actuator, either way [N, Pa, ...].
            rate: largest change of an effort per call.
            **options: arguments of the class, which replace those of the robot.

        Raises:
            ValueError: for an effort or rate that is not positive.
        """
        if not (0.0 < largest < np.inf and 0.0 < rate < np.inf):
            raise ValueError(f"the largest effort and its rate must be positive, got {largest} and {rate}")
        unbounded = np.full(len(robot.actuators), np.inf)
        drive = {
            "lower": -unbounded,
            "upper": unbounded,
            "rates": unbounded,
            "min_effort": np.full(len(unbounded), -largest),
            "max_effort": np.full(len(unbounded), largest),
            "effort_rates": np.full(len(unbounded), rate),
            "mode": "effort",
        }
        return cls.for_robot(robot, **{**drive, **options})

    def _make_qp(self) -> Any:
        """Return a new solver; a solver that failed would warm-start from its bad result."""
        n = len(self.rates)
        # One inequality per actuator (its effort), besides the box of displacements.
        qp = self._proxqp.dense.QP(n, 0, n, True)
        qp.settings.eps_abs = 1e-11  # with many actuators for one effector, 1e-9 is inaccurate by 5e-5 of their ranges
        qp.settings.eps_rel = 0.0
        qp.settings.eps_primal_inf = 1e-14  # the default 1e-4 takes programs with a solution for infeasible
        qp.settings.max_iter = 1000
        qp.settings.initial_guess = self._proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        return qp

    def checked(
        self, condensed: CondensedModel, goal: np.ndarray, command: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return goal (n_e,) and command (n_a,) as arrays.

        Raises:
            ValueError: if goal, command or model has a wrong shape or is not finite, or if goal or command are far
                beyond what the robot of `for_robot` can do.
        """
        count = len(self.rates)
        goal = np.asarray(goal, dtype=float).ravel()
        command = np.asarray(command, dtype=float)
        delta, effort = condensed.delta, condensed.lambda_.a
        if goal.shape != delta.e.shape or not np.isfinite(goal).all():
            raise ValueError(f"goal must be {counted(delta.e.size, 'finite coordinate')}, got {goal.tolist()}")
        if command.shape != self.rates.shape or effort.shape != self.rates.shape or not np.isfinite(command).all():
            raise ValueError(
                f"command must be {counted(len(self.rates), 'finite number')}, got {command.tolist()} for "
                f"{counted(len(effort), 'actuator')}"
            )
        if not (np.isfinite(condensed.compliance).all() and np.isfinite(delta.array).all()):
            raise ValueError("the condensed model contains values that are not finite")
        if self.goal_weights is not None and self.goal_weights.shape != goal.shape:
            raise ValueError(f"goal_weights must be {counted(goal.size, 'number')}, got {self.goal_weights.tolist()}")
        self.check_near("goal", goal)
        if self._robot is not None and len(self._robot.actuators) == count and not self.by_effort.any():
            check_command(self._robot, command, "displacement")
        return goal, command

    def check_near(self, name: str, goals: np.ndarray) -> None:
        """Check that effector coordinates are near the robot of `for_robot`, where their weights are not zero.

        Args:
            name: what they are, for messages.
            goals: one or more coordinates of all effectors [m], shape (..., n_e).

        Raises:
            ValueError: for points farther from the effector at rest than three times the robot's size.
        """
        robot = self._robot
        if robot is not None and goals.shape[-1] == 3 * len(robot.effectors):
            if self.goal_weights is not None:
                goals = np.where(self.goal_weights > 0.0, goals, np.tile(robot.effector_rest, len(robot.effectors)))
            robot.check_point(name, goals.reshape(-1, 3))

    def limits(
        self, condensed: CondensedModel, command: np.ndarray, slack: np.ndarray | None = None, size: float = 1.0
    ) -> StepLimits:
        """Return what the next step may change.

        Args:
            condensed: model at the current state.
            command: current command, shape (n_a,).
            slack: actuators that are slack, shape (n_a,): the command does not bound the displacement of a slack cable.
            size: share of the rates that the step may use.
        """
        rates, effort_rates = size * self.rates, size * self.effort_rates
        displacement, effort = condensed.delta.a, condensed.lambda_.a
        start = np.where(self.by_effort, displacement, command)
        low, high = np.maximum(self.lower, start - rates), np.minimum(self.upper, start + rates)
        # Standing still is allowed (unless it exceeds max_effort), so round-off cannot make the problem infeasible.
        box_low, box_high = np.minimum(low - displacement, 0.0), np.maximum(high - displacement, 0.0)
        if slack is not None:
            box_high = np.where(slack, np.inf, box_high)
        effort_low = np.maximum(-np.maximum(effort - self.min_effort, 0.0), -effort_rates)
        effort_high = np.minimum(self.max_effort - effort, effort_rates)
        # Steps of commanded efforts start from the last command, which may differ from the effort of the model.
        least = np.clip(command - effort_rates, self.min_effort, self.max_effort)
        most = np.clip(command + effort_rates, self.min_effort, self.max_effort)
        effort_low = np.where(self.by_effort, least - effort, effort_low)
        effort_high = np.where(self.by_effort, most - effort, effort_high)
        return StepLimits((box_low, box_high), (effort_low, effort_high), (low, high), (least, most))

    def command(self, limits: StepLimits) -> np.ndarray:
        """Return the command, shape (n_a,), for the predicted displacements and efforts."""
        return np.where(
            self.by_effort,
            np.clip(self.effort, *limits.commanded_effort),
            np.clip(self.displacement, *limits.commanded_displacement),
        )

    def solve(
        self, condensed: CondensedModel, goal: np.ndarray, command: np.ndarray, slack: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the next command, shape (n_a,): displacements or efforts, according to the actuators' modes.

        Args:
            condensed: model at the current state.
            goal: desired effector coordinates [m], shape (n_e,) or (k, 3).
            command: current command, shape (n_a,).
            slack: actuators that are slack, shape (n_a,); default none.

        Raises:
            ValueError: if goal, command, slack or model has a wrong shape or is not finite, or if goal or command are
                far beyond what the robot of `for_robot` can do.
            ConvergenceError: if ProxQP does not reach its tolerance, for example because no step within the rates
                brings an effort back below ``max_effort``.
        """
        goal, command = self.checked(condensed, goal, command)
        if slack is not None and np.shape(slack) != self.rates.shape:
            raise ValueError(f"slack must have shape {self.rates.shape}, got {np.shape(slack)}")
        program = self._program(condensed, goal, command, slack)
        self._qp, found = self._solved(self._qp, program.arguments)
        if found is None:
            raise ConvergenceError(f"ProxQP does not reach its tolerance for goal {goal.tolist()} m")
        return self._keep(program, found)

    def solve_batch(
        self, condensed: CondensedModel, goals: np.ndarray, commands: np.ndarray, slack: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the next commands of n plants, shape (n, n_a), as `solve` does for each.

        The QPs are set up together. Each row warm-starts from its own last solution, unless its command is zero, with
        which an episode begins. A row that ProxQP cannot solve holds its command.

        Args:
            condensed: models at the current states, leading shape (n,).
            goals: desired effector coordinates [m], shape (n, n_e).
            commands: current commands, shape (n, n_a).
            slack: actuators that are slack, shape (n, n_a); default none.

        Raises:
            ValueError: if the models or goals are not finite, or if a goal is far from the robot of `for_robot`.
        """
        if not all(np.isfinite(values).all() for values in (condensed.compliance, condensed.delta.array, goals)):
            raise ValueError("the condensed models or goals contain values that are not finite")
        self.check_near("goal", goals)
        if len(self._rows) != len(commands):
            self._rows = [None] * len(commands)
        program = self._program(condensed, goals, commands, slack)
        steps, solved = np.zeros(commands.shape), np.ones(len(commands), dtype=bool)
        for i in range(len(commands)):
            solver = self._rows[i] if commands[i].any() else None
            self._rows[i], found = self._solved(solver, program.row(i))
            if found is None:
                solved[i] = False
            else:
                steps[i] = found
        return np.where(solved[:, None], self._keep(program, steps), commands)

    def _program(
        self, condensed: CondensedModel, goal: np.ndarray, command: np.ndarray, slack: np.ndarray | None
    ) -> _Program:
        """Return the scaled QP of a step; leading shapes of the arguments are a batch."""
        condensed = condensed.at_drives  # commands are what the far ends of the drives do
        delta, effort = condensed.delta, condensed.lambda_.a
        root = np.ones(goal.shape[-1]) if self.goal_weights is None else np.sqrt(self.goal_weights)
        Waa, Wea = condensed.W.aa, root[:, None] * condensed.W.ea
        try:
            stiffness = np.linalg.inv(Waa)
        except np.linalg.LinAlgError:
            raise ValueError("W_aa is singular: two actuators have the same effect") from None

        limited = np.isfinite(self.effort_rates)
        diagonal = np.diagonal(Waa, axis1=-2, axis2=-1)
        effort_lengths = np.abs(diagonal) * np.where(limited, self.effort_rates, 0.0)
        scale = np.where(limited, np.minimum(self.rates, effort_lengths), self.rates)
        unit = scale.max(axis=-1, keepdims=True) / scale
        reach = Wea * unit[..., None, :]
        epsilon = np.linalg.norm(_transposed(reach) @ reach, axis=(-2, -1))
        epsilon = epsilon / np.linalg.norm(unit[..., :, None] * Waa * unit[..., None, :], axis=(-2, -1))
        jacobian = Wea @ stiffness * scale[..., None, :]  # effector motion per scaled displacement
        to_effort = stiffness * scale[..., None, :]
        quadratic = _transposed(to_effort) @ Waa @ to_effort * epsilon[..., None, None]
        pull = _times(_transposed(to_effort), _times(Waa, effort))
        energies, modes = np.linalg.eigh(0.5 * (quadratic + _transposed(quadratic)))
        if (unstable := energies[..., 0] < 0.0).any():
            # The state is stable only while its actuators are held: make the energy of efforts positive.
            positive = (modes * np.abs(energies)[..., None, :]) @ _transposed(modes)
            change = np.linalg.solve(to_effort, effort[..., None])[..., 0]
            quadratic = np.where(unstable[..., None, None], positive, quadratic)
            pull = np.where(unstable[..., None], _times(quadratic, change) / epsilon[..., None], pull)
        hessian = _transposed(jacobian) @ jacobian + (self.effort_weight + self.step_weight) * quadratic
        gradient = _times(_transposed(jacobian), root * (delta.e - goal))
        gradient = gradient + self.effort_weight * epsilon[..., None] * pull
        # Scale to order one: displacements by the rate, the objective by its curvature.
        norm = np.trace(hessian, axis1=-2, axis2=-1)
        norm = np.where(norm == 0.0, scale.mean(axis=-1) ** 2, norm)

        limits = self.limits(condensed, command, slack)
        box_low = np.maximum(limits.displacement[0] / scale, -UNBOUNDED)
        box_high = np.minimum(limits.displacement[1] / scale, UNBOUNDED)
        if slack is not None:
            box_high = np.where(slack, 1e3, box_high)
        effort_scale = np.abs(to_effort).sum(axis=-1)
        effort_low = np.maximum(limits.effort[0] / effort_scale, -UNBOUNDED)
        effort_high = np.clip(limits.effort[1] / effort_scale, effort_low, UNBOUNDED)
        arguments = (
            hessian / norm[..., None, None],
            gradient / norm[..., None],
            None,
            None,
            to_effort / effort_scale[..., :, None],
            effort_low,
            effort_high,
            box_low,
            box_high,
        )
        return _Program(arguments, delta.a, effort, scale, to_effort, limits)

    def _solved(self, solver: Any, arguments: tuple[np.ndarray | None, ...]) -> tuple[Any, np.ndarray | None]:
        """Return a solver to warm-start from and the scaled step, shape (n_a,); both None if ProxQP fails."""
        # A warm start from a distant solution may fail where a cold one converges.
        for warm in (True, False):
            if solver is None or not warm:
                solver = self._make_qp()
                solver.init(*arguments)
            else:
                solver.update(*arguments)
            solver.solve()
            if solver.results.info.status == self._proxqp.QPSolverOutput.PROXQP_SOLVED:
                return solver, solver.results.x
        return None, None

    def _keep(self, program: _Program, step: np.ndarray) -> np.ndarray:
        """Keep what the model predicts for scaled steps (..., n_a), and return the commands."""
        self.displacement = program.displacement + step * program.scale
        self.effort = program.effort + _times(program.to_effort, step)
        return self.command(program.limits)

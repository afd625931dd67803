"""Closed loop that brings a robot in contact to goals of effectors and contact forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.control.contact_qp import ContactQP, ForceGoal
from softgym_envs.mechanics.condensation import CondensedModel

#: Steps never become smaller than this share of the controller's rates.
SMALLEST_STEP = 1.0 / 64.0
#: Growth of an error that does not count [m].
ROUND_OFF = 1e-9
#: Smallest change of a force, relative to it, from which the ratio of measured to predicted changes is taken.
LEAST_CHANGE = 1e-4
#: Largest ratio of measured to predicted changes that counts; the smallest is one.
LARGEST_RATIO = 4.0


class ContactControl:
    """Quasi-static loop: linearise with contacts, solve for the next command, apply it.

    The linear model does not know how contacts move along a surface, which points touch next and, without ``friction``,
    how friction changes. So steps are limited: a step after which the error is larger than before halves the next ones,
    down to a 64th of the controller's rates; others let them grow again. And the change of a force that is asked for is
    divided by the ratio of measured to predicted change in the last step, as the secant method does: where friction is
    large, forces can change by several times what a model without friction predicts.

    Args:
        backend: of a robot whose model can touch something, quasi-static.
        controller: its rates are those of the largest steps.
        friction: whether the linear model knows friction. Without, friction forces stay as they are during a step, and
            an object that only friction holds cannot be controlled.

    Raises:
        ValueError: if the controller commands displacements of some actuators and efforts of others.

    Attributes:
        size: of the next step over the controller's rates.
        error: before the last step [m], see `ContactQP.error`; inf before the first one.
    """

    def __init__(self, backend: Backend, controller: ContactQP, *, friction: bool = False) -> None:
        self._mode = "effort" if controller.by_effort.all() else "displacement"
        if controller.by_effort.any() and self._mode != "effort":
            raise ValueError("contact control commands all actuators in one mode: its ContactQP mixes two")
        self.backend = backend
        self.controller = controller
        self.friction = friction
        self.reset()

    def reset(self) -> None:
        """Forget the past steps; the backend stays where it is."""
        self.size = 1.0
        self.error = np.inf
        self._last: tuple[CondensedModel, np.ndarray | None, Sequence[ForceGoal]] | None = None
        self._planned: dict[str, tuple[float, float]] = {}  # contact forces before the last step and predicted after it
        self._ratios: dict[tuple[tuple[str, float], ...], float] = {}

    def step(self, goal: np.ndarray | None, *, forces: Sequence[ForceGoal] = ()) -> State:
        """Go one step towards goals, and return the state there.

        Args:
            goal: desired effector coordinates [m], shape (n_e,) or (k, 3), or None if only forces matter.
            forces: goals of contact forces.

        Raises:
            ValueError: for malformed goals, or a backend without contact.
            ConvergenceError: if there is no equilibrium even after the smallest step, or the controller finds no step;
                the backend's state is unchanged.
        """
        condensed = self.backend.contact_model(friction=self.friction)
        if self._last is not None:
            before, last_goal, last_forces = self._last
            now = self.controller.error(condensed, last_goal, last_forces, reference=before)
            grew = now > self.error + ROUND_OFF
            self.size = max(0.5 * self.size, SMALLEST_STEP) if grew else min(1.0, 1.5 * self.size)
        self._last = (condensed, goal, tuple(forces))
        self.error = self.controller.error(condensed, goal, forces)
        present = dict(zip(self.controller.contact_names(condensed), condensed.lambda_.c.tolist(), strict=True))
        aims = [self._aim(force, present) for force in forces]
        state = self.backend.state
        while True:
            command = self.controller.solve(condensed, goal, state.command, state.slack, forces=aims, size=self.size)
            predicted = self.controller.contact_force.tolist()
            self._planned = {name: (present[name], after) for name, after in zip(present, predicted, strict=True)}
            try:
                return self.backend.step(command, self._mode)
            except ConvergenceError:
                if self.size <= SMALLEST_STEP:
                    raise
                self.size = max(0.5 * self.size, SMALLEST_STEP)

    def _aim(self, goal: ForceGoal, present: Mapping[str, float]) -> ForceGoal:
        """Return the goal to ask the linear model for, with the measured ratio of changes."""
        if not all(name in self._planned and present.get(name) for name in goal.contacts):
            return goal
        now = sum(factor * present[name] for name, factor in goal.contacts.items())
        before, after = (
            sum(factor * self._planned[name][k] for name, factor in goal.contacts.items()) for k in range(2)
        )
        key = tuple(goal.contacts.items())
        if before > 0.0 and abs(after - before) > LEAST_CHANGE * abs(now):
            ratio = (now - before) / (after - before)
            self._ratios[key] = min(max(ratio, 1.0), LARGEST_RATIO)
        ratio = self._ratios.get(key, 1.0)
        low, high = (now + (limit - now) / ratio for limit in goal.range)
        return replace(goal, lower=low, upper=high)

    def reach(
        self, goal: np.ndarray | None, *, forces: Sequence[ForceGoal] = (), steps: int = 100, tolerance: float = 1e-5
    ) -> list[State]:
        """Step until nothing moves by more than a tolerance, and return the states.

        Args:
            goal: see `step`.
            forces: see `step`.
            steps: most steps.
            tolerance: of commands, in shares of their rates.

        Raises:
            ValueError: as `step`.
            ConvergenceError: as `step`.
        """
        states, controller = [self.backend.state], self.controller
        rates = controller.effort_rates if self._mode == "effort" else controller.rates
        for _ in range(steps):
            states.append(self.step(goal, forces=forces))
            moved = np.abs(states[-1].command - states[-2].command)
            if (moved <= tolerance * rates).all():
                break
        return states[1:]

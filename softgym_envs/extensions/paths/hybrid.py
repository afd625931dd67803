"""Hybrid backends whose states depend on the path: a learned backend where it is trusted, finite elements elsewhere.

With friction or in motion a state follows from the commands before it, so finite elements follow the commands of the
episode before they answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from softgym_envs.backends.backend import Backend, PointForce, Snapshot, State, refuse_force
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot


class Command(NamedTuple):
    """A control step.

    Attributes:
        values: of the actuators, shape (n_a,).
        mode: ``"displacement"`` or ``"effort"``.
        touch: what touches the body.
    """

    values: np.ndarray
    mode: str
    touch: PointForce | None


class Followed(NamedTuple):
    """How far both models have followed the commands of an episode.

    Attributes:
        learned: the last state that the learned model found.
        fem: the last state of the finite elements; None at rest.
        path: commands since then.
    """

    learned: State
    fem: State | None
    path: tuple[Command, ...]


class PathHybridBackend(Backend):
    """A learned backend where it is trusted, elsewhere finite elements.

    Finite elements follow all commands of the episode that they have not seen yet. The learned model does not learn
    from them.

    Attributes:
        calls: states requested by `step` and `probe`.
        fem_calls: solutions of finite elements, including those of bodies at rest.
        learned: the learned backend.
    """

    robot: Robot
    learned: Backend

    def _start(self, robot: Robot, learned: Backend, **fem_options: Any) -> None:
        self._fem_options = fem_options
        self.robot, self.learned, self.takes_touch = robot, learned, learned.takes_touch
        self._touch: PointForce | None = None
        self.calls = self.fem_calls = 0
        self._fem: FEMBackend | None = None
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(learned.design)

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            learned = self.learned.reset(complete)
            rest = replace(learned, memory=Followed(learned, None, ()))
            if not learned.trusted:
                try:
                    fem = self._fem_of(complete).reset()
                except BaseException:
                    if self.design is not None:  # the learned model goes back to the body that stays
                        self.learned.reset(self.design)
                    raise
                rest = replace(fem, memory=Followed(learned, fem, ()))
            self._rest, self.design = rest, complete
        self.state, self._touch = self._rest, None
        return self.state

    def touch(self, load: PointForce | None) -> None:
        if load is not self._touch:
            self.learned.touch(load)
            self._touch = load

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        known = self._known
        self.calls += 1
        self._go_to(known.learned)
        try:
            learned, found = self.learned.step(command, mode), True
        except ConvergenceError:
            learned, found = known.learned, False
        path = (*known.path, Command(np.array(command, dtype=float), mode, self._touch))
        if found and learned.trusted:
            self.state = replace(learned, memory=Followed(learned, known.fem, path))
        else:
            fem = self._follow(known.fem, path).state
            self.state = replace(fem, memory=Followed(learned, fem, ()))
        return self.state

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the equilibrium under a command without going there."""
        known = self._known
        self.calls += 1
        self._go_to(known.learned)
        try:
            found = self.learned.probe(command, mode)
        except ConvergenceError:
            found = None
        if found is not None and found.trusted:
            return found
        fem = self._follow(known.fem, known.path)
        fem.touch(self._touch)
        self.fem_calls += 1
        return fem.probe(command, mode)

    def contact_model(self, *, friction: bool = False) -> CondensedModel:
        known = self._known
        if known.path or known.fem is None:
            self._go_to(known.learned)
            return self.learned.contact_model(friction=friction)
        return self._follow(known.fem, ()).contact_model(friction=friction)

    def restore(self, state: State) -> None:
        """Go back to a state of this backend.

        Raises:
            ValueError: for a state of another backend.
        """
        if not isinstance(state.memory, Followed):
            raise ValueError("the state was not computed by this hybrid backend, which can only restore its own states")
        self.state = state

    @property
    def _known(self) -> Followed:
        assert isinstance(self.state.memory, Followed)
        return self.state.memory

    def _finite_elements(self, design: Design) -> FEMBackend:
        """Return the finite elements for a body, on the mesh that its parts were learned from."""
        return FEMBackend(self.robot.learned_mesh(), design, **self._fem_options)

    def _fem_of(self, design: Design) -> FEMBackend:
        """Return the finite elements of a body, which are built, and solved at rest, when they are first needed."""
        if self._fem is None:
            self._fem = self._finite_elements(design)
            self.fem_calls += 1
        elif self._fem.design != design:
            self._fem.reset(design)
            self.fem_calls += 1
        return self._fem

    def _go_to(self, state: State) -> None:
        """Bring the learned model to a state of it, under what touches the body now."""
        self.learned.touch(self._touch)
        self.learned.restore(state)

    def _extra_state(self) -> PointForce | None:
        return self._touch

    def _resume(self, snapshot: Snapshot) -> None:
        super()._resume(snapshot)
        self.touch(snapshot.extra)

    def _follow(self, start: State | None, path: tuple[Command, ...]) -> FEMBackend:
        """Return the finite elements of the present body after commands from a state, or from rest."""
        # A copy or another episode may have left them at another body.
        fem = self._fem_of(self.design)
        fem.restore(fem.reset() if start is None else start)
        for command, mode, touch in path:
            fem.touch(touch)
            fem.step(command, mode)
            self.fem_calls += 1
        return fem

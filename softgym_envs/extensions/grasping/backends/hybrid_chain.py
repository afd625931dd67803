"""The hybrid backends of learned chains, alone or as a hand: the chain where it is trusted, finite elements elsewhere.

Friction depends on the path, so finite elements follow the commands of the episode before they answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softgym_envs.backends.backend import Backend, State, refuse_force
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.grasping.backends.chain import ChainBackend
from softgym_envs.extensions.grasping.backends.chain_hand import ChainHandBackend
from softgym_envs.extensions.grasping.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.extensions.grasping.robots.grasping_hands import ContactAidedGripper
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot


class Followed(NamedTuple):
    """How far both models have followed the commands of an episode.

    Attributes:
        chain: the last state that the learned chain found.
        fem: the last state of the finite elements; None at rest.
        path: commands and modes since then.
    """

    chain: State
    fem: State | None
    path: tuple[tuple[np.ndarray, str], ...]


class HybridChainBackend(Backend):
    """A learned chain where it is trusted, elsewhere finite elements.

    The chain is not trusted for bodies outside its training, and where the finger would touch itself. Finite elements
    then follow all commands of the episode that they have not seen yet. The chain does not learn from them.

    Args:
        robot: a contact-aided finger, with anything to touch.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.

    Attributes:
        calls: states requested by `step` and `probe`.
        fem_calls: solutions of finite elements, including those of bodies at rest.
        learned: backend of the learned chain.

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
    """

    robot: Robot
    learned: Backend

    def __init__(
        self,
        robot: ContactAidedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
    ) -> None:
        self._start(robot, ChainBackend(robot, design, weights))

    def _start(self, robot: Robot, learned: ChainBackend | ChainHandBackend) -> None:
        self.robot, self.learned = robot, learned
        self.calls = self.fem_calls = 0
        self._fem: FEMBackend | None = None
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(learned.design)

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            chain = self.learned.reset(complete)
            rest = replace(chain, memory=Followed(chain, None, ()))
            if not chain.trusted:
                try:
                    fem = self._fem_of(complete).reset()
                except BaseException:
                    if self.design is not None:  # the chain goes back to the body that stays
                        self.learned.reset(self.design)
                    raise
                rest = replace(fem, memory=Followed(chain, fem, ()))
            self._rest, self.design = rest, complete
        self.state = self._rest
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        known = self._known
        self.calls += 1
        self.learned.restore(known.chain)
        try:
            chain, found = self.learned.step(command, mode), True
        except ConvergenceError:
            chain, found = known.chain, False
        path = (*known.path, (np.array(command, dtype=float), mode))
        if found and chain.trusted:
            self.state = replace(chain, memory=Followed(chain, known.fem, path))
        else:
            fem = self._follow(known.fem, path).state
            self.state = replace(fem, memory=Followed(chain, fem, ()))
        return self.state

    def contact_model(self, *, friction: bool = False) -> CondensedModel:
        known = self._known
        if known.path or known.fem is None:
            self.learned.restore(known.chain)
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
        """Return the finite elements for a body."""
        return FEMBackend(self.robot, design)

    def _fem_of(self, design: Design) -> FEMBackend:
        """Return the finite elements of a body, which are built, and solved at rest, when they are first needed."""
        if self._fem is None:
            self._fem = self._finite_elements(design)
            self.fem_calls += 1
        elif self._fem.design != design:
            self._fem.reset(design)
            self.fem_calls += 1
        return self._fem

    def _follow(self, start: State | None, path: tuple[tuple[np.ndarray, str], ...]) -> FEMBackend:
        """Return the finite elements of the present body after commands from a state, or from rest."""
        # A copy or another episode may have left them at another body.
        fem = self._fem_of(self.design)
        fem.restore(fem.reset() if start is None else start)
        for command, mode in path:
            fem.step(command, mode)
            self.fem_calls += 1
        return fem


class HybridHandBackend(HybridChainBackend):
    """A hand of two learned chains with a free box where it is trusted, elsewhere finite elements in motion.

    As for a single finger. A step of finite elements is one implicit time step with the damping of `FEMBackend`.

    Args:
        robot: a hand of two contact-aided fingers.
        design: first design; missing variables take their baseline.
        weights: folder of weights of its finger; default the shipped ones.
        control_step: duration of one `step` [s].

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
        ValueError: for a hand that cannot be learned, see `ChainHandBackend`.
    """

    moving = True

    def __init__(
        self,
        robot: ContactAidedGripper,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        control_step: float = 0.05,
    ) -> None:
        self.control_step = control_step
        self._start(robot, ChainHandBackend(robot, design, weights, control_step))

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the equilibrium under a command without going there."""
        known = self._known
        self.calls += 1
        self.learned.restore(known.chain)
        try:
            chain = self.learned.probe(command, mode)
        except ConvergenceError:
            chain = None
        if chain is not None and chain.trusted:
            return chain
        fem = self._follow(known.fem, known.path)
        self.fem_calls += 1
        return fem.probe(command, mode)

    def _finite_elements(self, design: Design) -> FEMBackend:
        return FEMBackend(
            self.robot, design, dynamics=True, control_step=self.control_step, time_step=self.control_step
        )

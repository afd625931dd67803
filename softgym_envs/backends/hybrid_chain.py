"""The hybrid backend of learned chains: the chain where it is trusted, finite elements elsewhere.

Friction depends on the path, so finite elements follow the commands of the episode before they answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softgym_envs.backends.backend import Backend, State
from softgym_envs.backends.chain import ChainBody
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.contact_aided_finger import ContactAidedFinger
from softgym_envs.surrogate.chain.model import load_chain


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
        model: the learned chain.

    Raises:
        WeightsError: if the weights are damaged, or belong to a finger with another mesh or material.
        InfeasibleDesign: if the body cannot exist.
    """

    robot: ContactAidedFinger

    def __init__(
        self,
        robot: ContactAidedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
    ) -> None:
        self.robot = robot
        self.model = load_chain(robot.alone, weights)
        self.calls = self.fem_calls = 0
        self._fem: FEMBackend | None = None
        self.design = None  # type: ignore[assignment]  # until the first reset
        self.reset(robot.design_space.complete(design))

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        if complete != self.design:
            body = ChainBody(self.robot, self.model, complete)
            chain = body.rest()
            rest = replace(chain, memory=Followed(chain, None, ()))
            if not chain.trusted:
                fem = self._at_rest(complete)
                rest = replace(fem, memory=Followed(chain, fem, ()))
            self._body, self._rest, self.design = body, rest, complete
        self.state = self._rest
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        if force is not None and np.any(force):
            raise ValueError("the hybrid backend does not support forces on effectors; use backend='fem'")
        known = self._known
        self.calls += 1
        try:
            chain, found = self._body.solve(command, mode, known.chain), True
        except ConvergenceError:
            chain, found = known.chain, False
        path = (*known.path, (np.array(command, dtype=float), mode))
        if found and chain.trusted:
            self.state = replace(chain, memory=Followed(chain, known.fem, path))
        else:
            fem = self._follow(known.fem, path)
            self.state = replace(fem, memory=Followed(chain, fem, ()))
        return self.state

    def contact_model(self) -> CondensedModel:
        known = self._known
        if known.path or known.fem is None:
            return self._body.contact_model(known.chain)
        assert self._fem is not None
        self._fem.restore(known.fem)
        return self._fem.contact_model()

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

    def _at_rest(self, design: Mapping[str, float]) -> State:
        """Return the state of the finite elements at rest, for a new body."""
        self.fem_calls += 1
        if self._fem is None:
            self._fem = FEMBackend(self.robot, design)
        return self._fem.reset(design)

    def _follow(self, start: State | None, path: tuple[tuple[np.ndarray, str], ...]) -> State:
        """Return the state of the finite elements after commands from a state, or from rest."""
        state = self._at_rest(self.design) if start is None else start
        assert self._fem is not None
        self._fem.restore(state)
        for command, mode in path:
            state = self._fem.step(command, mode)
            self.fem_calls += 1
        return state

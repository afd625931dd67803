"""Bodies that are stepped one by one, each on a backend of its own: any backend as that of a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from softgym_envs.backends.backend import Backend, Ground, PointForce, Snapshot, State
from softgym_envs.backends.batch import BatchBackend, BatchState, condensed_gradient
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, InfeasibleDesign
from softgym_envs.mechanics.condensation import CondensedModel


class OneByOne(BatchBackend):
    """A batch of which each row has a `Backend` of its own; an environment of one body is such a batch of one.

    Args:
        make: returns the backend of a body. It must be picklable where the batch is copied.
        designs: bodies, one for each row.

    Attributes:
        owners: the backends.
        converged: whether the last step of each found its state, shape (B,).

    Raises:
        InfeasibleDesign: if a body cannot exist.
    """

    owners: list[Backend]

    def __init__(self, make: Callable[[Design], Backend], designs: Sequence[Design]) -> None:
        self._make, self._designs = make, list(designs)
        self.owners = [make(design) for design in designs]
        first = self.owners[0]
        self.robot, self.moving = first.robot, first.moving
        self.takes_force, self.takes_touch = first.takes_force, first.takes_touch
        self.converged = np.ones(len(self.owners), dtype=bool)
        self._forces: list[np.ndarray | None] = [None] * len(self.owners)

    def __getstate__(self) -> dict[str, Any]:
        # Factors of matrices cannot be pickled: a copy makes its backends anew.
        kept = {name: value for name, value in self.__dict__.items() if name != "owners"}
        return {**kept, "snapshots": [owner.snapshot() for owner in self.owners]}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        snapshots: list[Snapshot] = kept.pop("snapshots")
        self.__dict__.update(kept)
        self.owners = [self._make(design) for design in self._designs]
        for owner, snapshot in zip(self.owners, snapshots, strict=True):
            owner.resume(snapshot)

    def begin(self, index: np.ndarray, designs: np.ndarray) -> Mapping[int, InfeasibleDesign]:
        impossible: dict[int, InfeasibleDesign] = {}
        names = self.robot.design_space.names
        for i, values in zip(index.tolist(), designs.tolist(), strict=True):
            design = self.robot.design_space.complete(dict(zip(names, values, strict=True)))
            try:
                self.owners[i].reset(design)
            except InfeasibleDesign as error:
                impossible[i] = error
            else:
                self._designs[i], self.converged[i] = design, True
        return impossible

    def rest(self, index: np.ndarray) -> None:
        for i in index.tolist():
            self.owners[i].reset(self._designs[i])
        self.converged[index] = True

    def step(self, command: np.ndarray) -> None:
        for i, owner in enumerate(self.owners):
            try:
                owner.step(command[i], force=self._forces[i])
                self.converged[i] = True
            except ConvergenceError:
                self.converged[i] = False

    def push(self, forces: Sequence[np.ndarray | None]) -> None:
        self._forces = list(forces)

    def touch(self, loads: Sequence[PointForce | None]) -> None:
        for owner, load in zip(self.owners, loads, strict=True):
            owner.touch(load)

    def stand_on(self, index: np.ndarray, grounds: Sequence[Ground]) -> None:
        for i, ground in zip(index.tolist(), grounds, strict=True):
            self.owners[i].stand_on(ground)

    def set_cables(self, index: np.ndarray, friction: Sequence[float], compliance: Sequence[Any]) -> None:
        for i, *values in zip(index.tolist(), friction, compliance, strict=True):
            self.owners[i].cable_friction, self.owners[i].cable_compliance = values

    def effectors(self, index: np.ndarray, commands: np.ndarray) -> np.ndarray:
        found = np.full((len(index), 3), np.nan)
        for k, i in enumerate(index.tolist()):
            try:
                found[k] = self.owners[i].probe(commands[k]).effector[0]
            except ConvergenceError:
                pass
        return found

    @property
    def states(self) -> list[State]:
        return [owner.state for owner in self.owners]

    @property
    def command(self) -> np.ndarray:  # type: ignore[override]
        return _stack([state.command for state in self.states])

    @property
    def state(self) -> BatchState:  # type: ignore[override]
        return self._together(self.states, self.converged.copy())

    @staticmethod
    def _together(states: Sequence[State], converged: np.ndarray) -> BatchState:
        effectors = _stack([state.effector for state in states])
        return BatchState(
            _stack([state.displacement for state in states]),
            _stack([state.effort for state in states]),
            effectors.reshape(len(states), -1),
            _stack([state.slack for state in states]),
            converged,
            np.array([state.uncertainty for state in states]),
            np.array([state.distrust for state in states]),
        )

    @property
    def velocity(self) -> np.ndarray | None:
        return _stack([state.velocity[0] for state in self.states]) if self.moving else None

    @property
    def stable(self) -> np.ndarray:
        return np.array([owner.state.stable for owner in self.owners])

    @property
    def condensed(self) -> CondensedModel:
        found = [owner.state.condensed for owner in self.owners]
        parts: Any = {name: _stack([getattr(one, name) for one in found]) for name in ("compliance", "free", "effort")}
        if any(np.any(one.stretch) for one in found):
            actuators = dict(found[0].roles)["a"]
            parts["stretch"] = np.stack([np.broadcast_to(one.stretch, (actuators,)) for one in found])
        return replace(found[0], **parts)

    def settled(self) -> BatchState:
        self._settled = self.states
        found = self.converged.copy()
        if self.moving:
            for i, owner in enumerate(self.owners):
                try:
                    self._settled[i] = owner.probe(owner.state.command)
                except ConvergenceError:
                    found[i] = False
        return self._together(self._settled, found)

    def gradient(self, effector: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        models = [state.condensed.at_drives for state in self._settled]
        # Commands move the far ends of drives that stretch.
        stretched = [state.displacement + state.condensed.stretch * state.effort for state in self._settled]
        gap = np.stack(stretched) - np.stack([state.command for state in self._settled])
        a, e = (models[0].slices[role] for role in "ae")
        compliance, follows = np.stack([model.compliance for model in models]), np.abs(gap) < 1e-6 * self.robot.rates
        return condensed_gradient(compliance, a, e, follows, effector, effort, self.robot.by_effort)


def _stack(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays of rows as one, shape (B, ...); that of a single row is a view."""
    return values[0][None] if len(values) == 1 else np.stack(values)

"""The hybrid backend: the learned model where it is trusted, the finite elements where it is not (thesis 5.3).

What the finite elements had to find is kept, and between episodes the ensemble learns it: the longer a task goes on,
the less often they are asked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend, at_rest
from softgym_envs.errors import ConvergenceError, DataError
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import load_model
from softgym_envs.surrogate.online import StateStore, check_ensemble, fine_tune, is_of, save_model
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model

__all__ = ["HybridBackend"]

#: Within this of a state of the finite elements [fraction of the actuator range] its own condensed model, which is its
#: tangent, stands for them. What is left out is of second order: 0.3 um at the tip of the finger.
NEAR = 1e-3

#: States nearer than this to one already kept of the same body teach nothing new [fraction of the actuator range].
DISTINCT = 5e-3

#: Kept states wait in memory for this many, or the end of the episode, before they are written.
WRITTEN = 10


class HybridBackend(SurrogateBackend):
    """The learned model where its ensemble is trusted, else the finite elements, whose states it learns.

    A state is that of the learned model if the search for it converged, its body and displacement lie where states are
    known, and the ensemble is sure of its effector. Otherwise the finite elements go to the command from the nearest
    state that they know in this episode, or from rest; their model is built when it is first needed. A controller that
    has arrived moves by next to nothing: so near to a state of the finite elements its condensed model is used as it
    is. Learning happens in `reset`, between episodes: within an episode the learned model does not change.

    Weights are not fine-tuned again and again: each time the original ones learn all states kept so far. The outcome
    does not depend on how often that was done, and a folder taken up again continues where it was left.

    Args:
        robot: the family of bodies.
        design: first design; missing variables take their baseline.
        weights: folder of weights of kind ``potential``; default the shipped ones.
        members: how many members of the ensemble to use, 2 or more; default all.
        folder: where states of the finite elements (npz shards) and the weights that learned them (``weights``) are
            kept and taken up again; default in memory alone.
        retrain_after: new states of the finite elements after which the ensemble learns; 0 never.
        steps: steps of Adam for each member each time.
        tolerance: uncertainty of the effector that is accepted [m]; default a tenth of the robot's ``goal_tolerance``.
            The limit of the weights is accepted in any case.
        seed: of the learning.

    Attributes:
        calls: states asked for by `step` and `probe`.
        fem_calls: solutions asked of the finite elements, rests of bodies among them.
        tangent_calls: states taken from the condensed model of a state of the finite elements beside them.
        retrainings: how often the ensemble learned.
        retraining_seconds: the time that took.
        original: the model of the given weights, with the accepted uncertainty.
        model: the present one, that learned states.

    Raises:
        WeightsError: if the weights have no ensemble that could decide.
        DataError: if the folder holds states of another robot.
        ValueError: for a malformed option.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        members: int | None = None,
        *,
        folder: str | Path | None = None,
        retrain_after: int = 50,
        steps: int = 800,
        tolerance: float | None = None,
        seed: int = 0,
    ) -> None:
        for name, value, least in (("retrain_after", retrain_after, 0), ("steps", steps, 1)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} = {value!r} must be a whole number of {least} or more")
        if tolerance is None:
            tolerance = 0.1 * robot.goal_tolerance
        elif not (np.isfinite(tolerance) and tolerance > 0.0):
            raise ValueError(f"tolerance = {tolerance} m must be positive and finite")
        self.robot = robot
        self._unilateral = robot.unilateral
        self._max_effort = np.array([actuator.max_effort for actuator in robot.actuators])
        self._retrain_after, self._steps, self._seed = retrain_after, steps, seed
        given = check_ensemble(pretrained_model(robot, weights, members))
        domain = given.card["domain"]
        card = {**given.card, "domain": {**domain, "limit": max(tolerance, float(domain["limit"]))}}
        self.original = Model(robot, given.tensors, card)
        self.model = self.original
        self.calls = self.fem_calls = self.tangent_calls = self.retrainings = 0
        self.retraining_seconds = 0.0
        self._fem: FEMBackend | None = None
        self._known: list[State] = []  # of the finite elements in this episode, rest first
        self._waiting: list[State] = []
        self._taught: dict[tuple[float, ...], list[np.ndarray]] = {}  # displacements [range] of states kept, by body
        self._store = StateStore(robot, folder)
        self._learned = 0  # of the states in the store
        self.design = None  # type: ignore[assignment]  # until the first reset
        if self._store.count:
            data = self._store.data
            for body, displacement in zip(data["design"].tolist(), data["displacement"], strict=True):
                self._taught.setdefault(tuple(body), []).append(displacement / (robot.upper - robot.lower))
            self._take_up()
        self.reset(robot.design_space.complete(design))

    # -- the interface ----------------------------------------------------------------------------------------------

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        self._write()
        self._known = []
        changed = complete != self.design
        if self._retrain_after and self._store.count - self._learned >= self._retrain_after:
            self._learn()
            changed = True
        if changed:
            zero = np.zeros(self.model.count)
            context = self.model.context(complete.array[None])
            rest = at_rest(self.model, context, self._unilateral)
            if rest.converged[0] and rest.trusted[0]:
                self._context, self.design = context, complete
                self._rest = self._state(zero, rest)
            else:
                known = self._ready(complete)
                self._context, self.design, self._rest = context, complete, known
        self.state = self._rest
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        if force is not None and np.any(force):
            raise ValueError("the hybrid backend knows no forces on effectors; use backend='fem'")
        kept = self.state
        try:
            found = super().step(command, mode)
        except ConvergenceError:
            found = None
        self.calls += 1
        if found is None or not found.trusted:
            self.state = kept  # stands if the finite elements do not find one either
            self.state = self._solve(np.asarray(command, dtype=float), mode)
        return self.state

    # -- finite elements --------------------------------------------------------------------------------------------

    def _ready(self, design: Mapping[str, float]) -> State:
        """Have the finite elements of a body, and return its rest."""
        if self._fem is None:
            self._fem = FEMBackend(self.robot, design)
            self.fem_calls += 1
        elif self._fem.design != design:
            self._fem.reset(design)
            self.fem_calls += 1
        rest = self._fem.reset()
        self._known = [rest]
        return rest

    def _solve(self, command: np.ndarray, mode: str) -> State:
        """State of the finite elements under a command, from the nearest one they know, else from rest."""
        if not self._known:
            self._ready(self.design)
        assert self._fem is not None
        span = self.robot.upper - self.robot.lower

        def distance(state: State) -> float:
            if mode == "effort":
                return float(np.linalg.norm((state.effort - command) / self.robot.effort_scale))
            # A slack cable is where it is for any command below.
            place = np.where(state.slack, state.command, state.displacement)
            return float(np.linalg.norm((place - command) / span))

        nearest, rest = min(self._known, key=distance), self._known[0]
        beside = self._beside(nearest, command, mode)
        if beside is not None:
            self.tangent_calls += 1
            return beside
        for start in (nearest, rest) if nearest is not rest else (rest,):
            self._fem.restore(start)
            self.fem_calls += 1
            try:
                found = self._fem.step(command, mode)
                break
            except ConvergenceError:
                if start is rest:
                    raise
        self._known.append(found)
        place = found.displacement / span
        # What the learned model cannot represent (equilibria that only hold while driven) teaches nothing.
        taught = self._taught.setdefault(tuple(self.design.array.tolist()), [])
        if found.stable and rest.stable and all(np.abs(place - p).max() > DISTINCT for p in taught):
            taught.append(place)
            self._waiting.append(found)
            if len(self._waiting) >= WRITTEN:
                self._write()
        return found

    def _beside(self, state: State, command: np.ndarray, mode: str) -> State | None:
        """State under a command by the condensed model of one that is very near, or None where none is so near."""
        condensed = state.condensed
        W, free = condensed.W, condensed.delta_free
        if mode == "effort":
            effort = command
        else:
            try:
                effort = solve_complementarity(W.aa[None], (free.a - command)[None], self._unilateral)[0]
            except np.linalg.LinAlgError:  # a state that only holds while it is driven
                return None
        displacement = free.a + W.aa @ effort
        away = np.abs(displacement - state.displacement) / (self.robot.upper - self.robot.lower)
        # An actuator that gives way at its largest effort is no linear matter.
        if away.max() > NEAR or (np.abs(effort) > self._max_effort).any():
            return None
        full = condensed.effort.copy()
        full[: len(effort)] = effort
        return replace(
            state,
            command=command.copy(),
            displacement=displacement,
            effort=effort,
            effector=(free.e + W.ea @ effort).reshape(-1, 3),
            slack=self._unilateral & (mode == "displacement") & (displacement > command + 1e-9),
            condensed=replace(condensed, effort=full),
        )

    # -- learning ---------------------------------------------------------------------------------------------------

    def _write(self) -> None:
        """Hand the waiting states to the store, after the rest of their body."""
        if not self._waiting:
            return
        rows = [self._known[0], *self._waiting]
        upper = np.triu_indices(len(rows[0].condensed.effort))
        self._store.add(
            {
                "design": np.tile(self.design.array, (len(rows), 1)),
                "displacement": np.stack([row.displacement for row in rows]),
                "effort": np.stack([row.effort for row in rows]),
                "effector": np.stack([row.effector.ravel() for row in rows]),
                "compliance": np.stack([row.condensed.compliance[upper] for row in rows]),
                "rest": np.arange(len(rows)) == 0,
            }
        )
        self._waiting = []

    def _learn(self) -> None:
        """Let the original ensemble learn all states kept so far."""
        self._take(fine_tune(self.original, self._store.data, steps=self._steps, seed=self._seed))
        self._learned = self._store.count
        self.retrainings += 1
        self.retraining_seconds += self.model.card["online"]["seconds"]
        if self._store.folder is not None:
            save_model(self.model, self._store.folder / "weights")

    def _take(self, model: Model) -> None:
        """Go over to a model, with the present body."""
        self.model = model
        if self.design is not None:
            self._context = model.context(self.design.array[None])

    def _take_up(self) -> None:
        """Go on from states of an earlier run: with the weights that learned them, else learn them now."""
        assert self._store.folder is not None
        data = self._store.data
        try:
            model = load_model(self._store.folder / "weights", self.robot)
        except DataError:  # none yet, or an interrupted write
            model = None
        if isinstance(model, Model) and is_of(model, self.original, data, self._steps, self._seed):
            self._take(model)
            self._learned = int(model.card["online"]["states"])
        elif self._retrain_after and self._store.count >= self._retrain_after:
            self._learn()

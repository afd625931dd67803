"""The hybrid backend: the learned model where it is trusted, finite elements elsewhere (thesis, sec. 5.3).

States that the finite elements found are kept, and the ensemble learns them between episodes: the longer a task runs,
the less often finite elements are needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softgym_envs.backends.backend import Backend, Snapshot, State, refuse_force
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.designs import Design
from softgym_envs.errors import ConvergenceError, DataError
from softgym_envs.extensions.hybrid.online import StateStore, check_ensemble, fine_tune, is_tuned_from
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity
from softgym_envs.mechanics.solvers.equilibrium import RowLayout
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model
from softgym_envs.surrogate.weight_files import load_model, save_model

#: Within this distance of an FEM state [fraction of the actuator range] its condensed model, the tangent, replaces a
#: new solution. The error is of second order: 0.3 um at the tip of the finger.
EXTRAPOLATION_DISTANCE = 1e-3

#: States closer than this to a kept one of the same body are not kept [fraction of the actuator range].
MIN_DISTANCE = 5e-3

#: Kept states are written when there are this many, or at the end of the episode.
FLUSH_EVERY = 10


class _Episode(NamedTuple):
    """What the next steps of an episode depend on besides body and state.

    Attributes:
        tensors: weights of the learned model.
        card: its card.
        learned: number of states that it has learned.
        rest: state of the body at rest.
        known: FEM states of the episode, rest first.
    """

    tensors: Mapping[str, np.ndarray]
    card: Mapping[str, Any]
    learned: int
    rest: State
    known: tuple[State, ...]


class HybridBackend(Backend):
    """The learned model where its ensemble is trusted, elsewhere finite elements, whose states the ensemble learns.

    The learned model answers if its search converged, body and displacement lie in its domain, and the ensemble agrees
    about the effector. Otherwise finite elements solve for the command, starting from the nearest state that they found
    in this episode, or from rest; their model is built when it is first needed. A controller that has arrived hardly
    moves: very close to an FEM state, its condensed model is used without a new solution. The ensemble learns in
    `reset`: within an episode the learned model does not change.

    Each time, the original weights learn all states kept so far. The result therefore does not depend on how often they
    learned, and a folder of an earlier run continues where that run stopped.

    Args:
        robot: the robot.
        design: first design; missing variables take their baseline.
        weights: folder of weights of kind ``potential``; default the shipped ones.
        members: how many members of the ensemble to use, 2 or more; default all.
        folder: folder of FEM states (npz shards) and of the weights that learned them (``weights``); existing ones are
            read. By default both stay in memory.
        retrain_after: number of new FEM states after which the ensemble learns; 0 for never.
        steps: steps of Adam for each member in each retraining.
        tolerance: largest accepted uncertainty of the effector [m]; below the limit of the weights, that limit holds.
            Default: the limit of calibrated weights, because errors above the robot's ``goal_tolerance`` were found
            beyond it; of other weights, at least a tenth of that tolerance, because 2 % of their validation states are
            above their limit, however small it is.
        seed: seed of the learning.

    Attributes:
        calls: states requested by `step` and `probe`.
        fem_calls: FEM solutions, including those of bodies at rest.
        tangent_calls: states extrapolated from a nearby FEM state.
        retrainings: how many times the ensemble learned.
        retraining_seconds: time spent on retraining [s].
        original: the model of the given weights, with the accepted uncertainty.
        model: the current model, after learning.

    Raises:
        WeightsError: if the weights have no ensemble to decide where they are trusted.
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
                raise ValueError(f"{name} = {value!r} must be an integer of at least {least}")
        if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0.0):
            raise ValueError(f"tolerance = {tolerance} m must be positive and finite")
        self.robot = robot
        self._unilateral = robot.unilateral
        self._max_effort = np.array([actuator.max_effort for actuator in robot.actuators])
        self._retrain_after, self._steps, self._seed = retrain_after, steps, seed
        given = check_ensemble(pretrained_model(robot, weights, members))
        domain = given.card["domain"]
        if tolerance is None:
            tolerance = 0.0 if domain.get("calibration") else 0.1 * robot.goal_tolerance
        card = {**given.card, "domain": {**domain, "limit": max(tolerance, float(domain["limit"]))}}
        self.original = Model(robot, given.tensors, card)
        self.model = self.original
        self.calls = self.fem_calls = self.tangent_calls = self.retrainings = 0
        self.retraining_seconds = 0.0
        self._fem: FEMBackend | None = None
        self._known: list[State] = []  # FEM states of this episode, rest first
        self._waiting: list[State] = []  # waiting to be written
        # Displacements of kept states [fraction of the actuator range], by body.
        self._kept: dict[tuple[float, ...], list[np.ndarray]] = {}
        self._store = StateStore(robot, folder)
        self._learned = 0  # number of states in the store that the model has learned
        self.design = None  # type: ignore[assignment]  # until the first reset
        if self._store.count:
            data = self._store.data
            for body, displacement in zip(data["design"].tolist(), data["displacement"], strict=True):
                self._kept.setdefault(tuple(body), []).append(displacement / (robot.upper - robot.lower))
            self._load_learned()
        self.reset(robot.design_space.complete(design))

    # -- the interface ----------------------------------------------------------------------------------------------

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        complete = self.design if design is None else self.robot.design_space.complete(design)
        self._flush()
        self._known = []
        changed = complete != self.design
        if self._retrain_after and self._store.count - self._learned >= self._retrain_after:
            self._learn()
            changed = True
        if changed:
            body, rest = self._learned_body(complete)
            if rest is None or not rest.trusted:
                rest = self._build_fem(complete)
            self._body, self.design, self._rest = body, complete, rest
        self.state = self._rest
        return self.state

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        found = None
        if self._body is not None:
            self._body.restore(self.state)
            with suppress(ConvergenceError):
                found = self._body.probe(command, mode)
        self.calls += 1
        # The learned model does not know the largest efforts.
        if found is None or not found.trusted or (np.abs(found.effort) > self._max_effort).any():
            found = self._solve(np.asarray(command, dtype=float), mode)
        self.state = found
        return self.state

    def restore(self, state: State) -> None:
        self.state = state

    def _learned_body(self, design: Design) -> tuple[SurrogateBackend | None, State | None]:
        """Return a body on the present learned model, with its state at rest; None where it finds none."""
        try:
            body = SurrogateBackend(self.robot, design, self.model)
        except ConvergenceError:
            return None, None
        return body, body.state

    def _extra_state(self) -> _Episode:
        # Without the kept states: a copy collects its own for the ensemble to learn.
        return _Episode(self.model.tensors, self.model.card, self._learned, self._rest, tuple(self._known))

    def _resume(self, snapshot: Snapshot) -> None:
        self._flush()
        self.design = self.robot.design_space.complete(snapshot.design)
        episode: _Episode = snapshot.extra
        self._learned = min(episode.learned, self._store.count)
        self._use(Model(self.robot, episode.tensors, episode.card))
        if episode.known:
            self._build_fem(self.design)
        self._known, self._rest, self.state = list(episode.known), episode.rest, snapshot.state

    # -- finite elements --------------------------------------------------------------------------------------------

    def _build_fem(self, design: Mapping[str, float]) -> State:
        """Build the finite-element model of a body if necessary, and return its state at rest."""
        if self._fem is None:
            self._fem = FEMBackend(self.robot, design)
            self.fem_calls += 1
        elif self._fem.design != design:
            self._fem.reset(design)
            self.fem_calls += 1
        self._slack_tolerance = RowLayout.of(self._fem.model).slack_tolerance
        rest = self._fem.reset()
        self._known = [rest]
        return rest

    def _solve(self, command: np.ndarray, mode: str) -> State:
        """Return the FEM state under a command, starting from the nearest known one, then from rest."""
        if not self._known:
            self._build_fem(self.design)
        assert self._fem is not None
        span = self.robot.upper - self.robot.lower

        def distance(state: State) -> float:
            if mode == "effort":
                return float(np.linalg.norm((state.effort - command) / self.robot.effort_scale))
            # A slack cable stays where it is for any smaller command.
            place = np.where(state.slack, state.command, state.displacement)
            return float(np.linalg.norm((place - command) / span))

        nearest, rest = min(self._known, key=distance), self._known[0]
        extrapolated = self._extrapolate(nearest, command, mode)
        if extrapolated is not None:
            self.tangent_calls += 1
            return extrapolated
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
        # The learned model cannot represent equilibria that are stable only while their displacements are held.
        kept = self._kept.setdefault(tuple(self.design.array.tolist()), [])
        if found.stable and rest.stable and all(np.abs(place - p).max() > MIN_DISTANCE for p in kept):
            kept.append(place)
            self._waiting.append(found)
            if len(self._waiting) >= FLUSH_EVERY:
                self._flush()
        return found

    def _extrapolate(self, state: State, command: np.ndarray, mode: str) -> State | None:
        """Return the state under a command by a linear step from an FEM state, or None if it is not close enough."""
        condensed = state.condensed
        W, free = condensed.W, condensed.delta_free
        if mode == "effort":
            effort = command
        else:
            try:
                effort = solve_complementarity(W.aa[None], (free.a - command)[None], self._unilateral)[0]
            except np.linalg.LinAlgError:  # the state is stable only while its displacements are held
                return None
        displacement = free.a + W.aa @ effort
        away = np.abs(displacement - state.displacement) / (self.robot.upper - self.robot.lower)
        # Beyond its largest effort an actuator behaves differently.
        if away.max() > EXTRAPOLATION_DISTANCE or (np.abs(effort) > self._max_effort).any():
            return None
        full = condensed.effort.copy()
        full[: len(effort)] = effort
        return replace(
            state,
            command=command.copy(),
            displacement=displacement,
            effort=effort,
            effector=(free.e + W.ea @ effort).reshape(-1, 3),
            slack=self._unilateral & (mode == "displacement") & (displacement > command + self._slack_tolerance),
            condensed=replace(condensed, effort=full),
        )

    # -- learning ---------------------------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Write the waiting states to the store, after the state at rest of their body."""
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
        """Make the original ensemble learn all states kept so far."""
        self._use(fine_tune(self.original, self._store.data, steps=self._steps, seed=self._seed))
        self._learned = self._store.count
        self.retrainings += 1
        self.retraining_seconds += self.model.card["online"]["seconds"]
        if self._store.folder is not None:
            save_model(self.model, self._store.folder / "weights")

    def _use(self, model: Model) -> None:
        """Use another model, for the current body too."""
        self.model = model
        if self.design is not None:
            self._body, _ = self._learned_body(self.design)

    def _load_learned(self) -> None:
        """Continue from the states of an earlier run: load the weights that learned them, or train on them now."""
        assert self._store.folder is not None
        data = self._store.data
        try:
            model = load_model(self._store.folder / "weights", self.robot)
        except DataError:  # no weights yet, or writing them was interrupted
            model = None
        if isinstance(model, Model) and is_tuned_from(model, self.original, data, self._steps, self._seed):
            self._use(model)
            self._learned = int(model.card["online"]["states"])
        elif self._retrain_after and self._store.count >= self._retrain_after:
            self._learn()

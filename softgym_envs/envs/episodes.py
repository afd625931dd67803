"""Episodes of many bodies: what all environments share. An environment of one body has a batch of one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from gymnasium.utils.seeding import np_random

from softgym_envs.backends.backend import Ground, Snapshot, State
from softgym_envs.backends.batch import BatchState
from softgym_envs.envs.options import Setup, task_by_row
from softgym_envs.envs.plant import Plant, Sensed, play, sensed, stiffened
from softgym_envs.envs.random import RowRandom
from softgym_envs.envs.spaces import squash
from softgym_envs.envs.tasks.base import Task, draw_paths
from softgym_envs.errors import InfeasibleDesign

MAX_DRAWS = 100
"""Number of infeasible bodies that are drawn in turn before `reset` gives up."""

Sampler = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class EpisodeState:
    """A moment of an episode of `SoftRobotEnv`; it can be pickled.

    Attributes:
        robot: name of the robot.
        task: name of the task.
        options: robot and task as they were made: name -> value, as text.
        physics: body and mechanical state.
        path: goals of the episode [m, or the unit of the task's goals], shape (p, 3).
        step: control steps so far.
        progress: attributes of the task, which may change in an episode.
        random: state of the random numbers; None if none have been drawn.
        plant: how the robot differs from its model.
        sent: commands that were sent last, the newest first, shape (k, 1, n_a).
        sensed: what the sensors show; None where that is the physics.
    """

    robot: str
    task: str
    options: Mapping[str, str]
    physics: Snapshot
    path: np.ndarray
    step: int
    progress: dict[str, Any]
    random: Mapping[str, Any] | None
    plant: Plant
    sent: np.ndarray
    sensed: Sensed | None


class Episodes:
    """Episodes of B bodies of one robot with one task, each with a generator of random numbers of its own.

    Row k draws what an environment of one body with the same seed draws: body, plant, goals, touches, noise.

    Args:
        setup: robot, task, backend and options.
        count: number of rows.
        alone: one body with a backend of its own; what `report` returns then has no axis of rows.

    Attributes:
        robot: the robot.
        task: the task, that of the first row.
        backend: physics of all rows.
        spaces: the agent's spaces.
        designs: bodies, shape (B, number of design variables).
        unit_designs: what observations show of them, shape (B, k).
        paths: goals of the episodes [m, or the unit of the task's goals], shape (B, p, 3).
        counts: number of goals in each path, shape (B,).
        steps: control steps so far, shape (B,).
        plant: how the present robots differ from their model, one for each row.
        stiffness: of the plants, shape (B, 1).
        noise: of the plants, shape (B,).
        delay: of the plants, shape (B,).
        sent: commands that were sent last, the newest first, shape (k, B, n_a).
        shown: what the sensors show; None where that is the present state.
        generators: one for each row, made when it is first needed.
        sampler: returns the sampled variables of some rows in unit coordinates [-1, 1], shape (rows, number of sampled
            variables).
    """

    def __init__(self, setup: Setup, count: int, *, alone: bool = False) -> None:
        self.robot, self.task, self.plants = setup.robot, setup.task, setup.plants
        self.fixed, self.sampled = setup.design, setup.sampled
        self._space = self.robot.design_space
        self.designs = np.tile(self.fixed.array, (count, 1))
        self.backend = setup.make_backend(count, alone=alone)
        task = self.task
        if (load := task.load) is not None and not (
            self.backend.takes_touch if load.on_body else self.backend.takes_force
        ):
            raise ValueError(
                f"task '{task.name}' pushes the robot, but backend '{setup.backend}' takes no forces; allowed: 'fem'"
            )
        self._alone, self._only = alone, 0 if alone else slice(None)
        self._reads_states = bool(task_by_row(task))
        # What a task remembers of an episode is in the task itself.
        self._draws_ground = type(task).draw_ground is not Task.draw_ground
        self._remembers = self._reads_states or self._draws_ground or type(task).begin is not Task.begin
        copies = [copy.deepcopy(task, {id(self.robot): self.robot}) for _ in range((count - 1) * self._remembers)]
        self._tasks = [task, *copies] if self._remembers else [task] * count
        self._records = type(task).record is not Task.record
        self.spaces = setup.spaces(moving=self.backend.moving)
        self.unit_designs = self._space.observe(self.designs, self.spaces.design_names)
        self.generators: list[np.random.Generator | None] = [None] * count
        self.sampler: Sampler = self._draw_uniformly
        self._changed = np.zeros(count, dtype=bool)  # bodies given in reset that differ from the fixed one

        stretch = np.atleast_1d(setup.backend_options.get("cable_compliance", 0.0))
        own = Plant(
            cable_friction=setup.backend_options.get("cable_friction", 0.0),
            cable_compliance=tuple(map(float, stretch)) if stretch.any() else 0.0,
        )
        self._own_plant = own
        self._differ = self.plants is not None  # whether plants differ from the own one
        n_a = len(self.robot.actuators)
        self.plant = [own] * count
        self.stiffness, self.noise = np.ones((count, 1)), np.zeros(count)
        self.delay = np.zeros(count, dtype=np.int64)
        self._inexact: set[int] = set()  # rows whose drives do something else than they are commanded to
        self._drives = {name: np.tile(getattr(own, name), (count, n_a)) for name in ("gain", "offset", "backlash")}
        # The last command is kept too, if the drives did something else.
        longest = 0 if self.plants is None else self.plants.longest_delay + (not self.plants.drive_exactly)
        self.sent = np.zeros((longest + 1, count, n_a))
        self.shown: Sensed | None = None
        self.paths = np.zeros((count, 1, 3))
        self.counts = np.ones(count, dtype=np.int64)
        self.steps = np.zeros(count, dtype=np.int64)

    # -- random numbers ---------------------------------------------------------------------------------------------

    def seed(self, index: np.ndarray, seeds: Sequence[int | None]) -> None:
        """Give some rows generators from seeds; None continues that of the row."""
        for i, seed in zip(index.tolist(), seeds, strict=True):
            if seed is not None:
                self.generators[i] = np_random(seed)[0]

    def random(self, index: np.ndarray) -> RowRandom:
        """Return the random numbers of some rows."""
        return RowRandom([self._generator(i) for i in index.tolist()])

    def _generator(self, i: int) -> np.random.Generator:
        found = self.generators[i]
        if found is None:
            found = self.generators[i] = np_random()[0]
        return found

    # -- the beginning ----------------------------------------------------------------------------------------------

    def begin(self, index: np.ndarray, designs: np.ndarray | None = None, paths: np.ndarray | None = None) -> None:
        """Start episodes in some rows.

        Args:
            index: the rows.
            designs: their bodies, shape (len(index), number of design variables); by default sampled or the fixed one.
            paths: their goals, shape (len(index), p, 3); by default drawn by the task.

        Raises:
            InfeasibleDesign: if a body cannot exist.
        """
        if designs is not None:
            self._changed[index] = True  # also if some of the bodies cannot exist
            for error in self._begin_bodies(index, designs).values():
                raise error
        elif self.sampled:
            self._draw_bodies(index)
        elif self._changed[index].any():
            self._begin_bodies(index, np.tile(self.fixed.array, (len(index), 1)))
            self._changed[index] = False
        else:
            self.backend.rest(index)
        if self._differ:
            for i in index.tolist():
                self.set_plant(i, self._own_plant if self.plants is None else self.plants.sample(self._generator(i)))
            self.sent[:, index] = 0.0
            self._differ = self.plants is not None
            self.set_cables(index)
        self.steps[index] = 0
        if paths is None:
            paths = draw_paths(self.task, index, self.random, self.backend.effectors)
        missing = paths.shape[1] - self.paths.shape[1]
        if missing > 0:
            self.paths = np.pad(self.paths, ((0, 0), (0, missing), (0, 0)))
        self.paths[index, : paths.shape[1]] = paths
        self.counts[index] = paths.shape[1]
        if self._draws_ground:
            grounds = [self._tasks[i].draw_ground(self._generator(i)) for i in index.tolist()]
            self.backend.stand_on(index, [Ground() if each is None else each for each in grounds])
        if self._remembers:
            for i in index.tolist():
                own, random = self._tasks[i], self._generator(i)
                own.wanted = self.paths[i, : self.counts[i]].copy()
                own.begin(random)
                if own.load is not None:
                    own.load.begin(random)
                if own.sensors is not None:
                    own.sensors.begin()
        self._record(index)

    def _begin_bodies(self, index: np.ndarray, designs: np.ndarray) -> dict[int, InfeasibleDesign]:
        """Give some rows bodies; those that cannot exist are left as they were and returned."""
        impossible = dict(self.backend.begin(index, designs))
        changed = np.array([i not in impossible for i in index.tolist()], dtype=bool)
        self.designs[index[changed]] = designs[changed]
        self.unit_designs[index] = self._space.observe(self.designs[index], self.spaces.design_names)
        return impossible

    def _draw_bodies(self, index: np.ndarray) -> None:
        """Draw the sampled variables; bodies that cannot exist are drawn again.

        Raises:
            InfeasibleDesign: if `MAX_DRAWS` bodies in turn cannot exist.
        """
        names = self._space.names
        for attempt in range(MAX_DRAWS):
            designs = np.tile(self.fixed.array, (len(index), 1))
            for name, drawn in zip(self.sampled, self.sampler(index).T, strict=True):
                designs[:, names.index(name)] = self._space[name].from_unit(drawn)
            impossible = self._begin_bodies(index, designs)
            if not impossible:
                return
            if attempt == MAX_DRAWS - 1:
                raise next(iter(impossible.values()))
            index = np.array(sorted(impossible))

    def _draw_uniformly(self, index: np.ndarray) -> np.ndarray:
        return self.random(index).uniform(-1.0, 1.0, (len(index), len(self.sampled)))

    def set_plant(self, i: int, plant: Plant) -> None:
        """Give a row another plant, but for its cables."""
        self.plant[i] = plant
        (self._inexact.discard if plant.drives_exactly else self._inexact.add)(i)
        self.stiffness[i], self.noise[i], self.delay[i] = plant.stiffness, plant.noise, plant.delay
        for name, values in self._drives.items():
            values[i] = getattr(plant, name)

    def set_cables(self, index: np.ndarray) -> None:
        """Give the cables of some rows at rest the friction and the compliance of their plants."""
        plants = [self.plant[i] for i in index.tolist()]
        self.backend.set_cables(
            index, [plant.cable_friction for plant in plants], [plant.cable_compliance for plant in plants]
        )

    def resume(self, design: np.ndarray, state: EpisodeState) -> None:
        """Go on from a moment of an episode of one row, whose physics the backend has resumed."""
        self.designs[:], self.steps[:] = design, state.step
        self._changed[:] = True
        self.unit_designs[:] = self._space.observe(self.designs, self.spaces.design_names)
        self._differ = True
        longest = max(len(state.sent), len(self.sent))
        self.sent = np.concatenate([state.sent, np.zeros((longest - len(state.sent), *state.sent.shape[1:]))])
        self.shown = state.sensed
        self.paths, self.counts[:] = state.path[None].copy(), len(state.path)

    # -- the present ------------------------------------------------------------------------------------------------

    @property
    def state(self) -> BatchState:
        """The present mechanical states of the plants, without noise of sensors."""
        state = self.backend.state
        return replace(state, effort=self.stiffness * state.effort) if self._differ else state

    @property
    def command(self) -> np.ndarray:
        """Commands that were sent last, shape (B, n_a); with a delay some have not arrived yet."""
        return self.sent[0] if len(self.sent) > 1 else self.backend.command

    def goals(self, ahead: int = 0) -> np.ndarray:
        """Return the goals that states are rated by in ``ahead`` control steps, shape (B, 3)."""
        return self.task.goals(self.paths, self.counts, self.steps + ahead)

    # -- steps ------------------------------------------------------------------------------------------------------

    def advance(self, actions: np.ndarray) -> None:
        """Move commands and states by one step, for actions (B, n_a) in [-1, 1]."""
        command = arriving = self.spaces.command(actions, self.command)
        if len(self.sent) > 1:
            self.sent = np.concatenate([command[None], self.sent[:-1]])
            arriving = self.sent[self.delay, np.arange(len(self.delay))]
        if self._inexact:
            gain, offset, backlash = self._drives.values()
            arriving = play(gain * arriving + offset, self.backend.command, backlash)
        if self.task.load is not None:
            loads = [
                None if task.load is None else task.load.at(int(self.steps[i])) for i, task in enumerate(self._tasks)
            ]
            if self.task.load.on_body:
                self.backend.touch([self.plant[i].equivalent_model_force(load) for i, load in enumerate(loads)])
            else:
                self.backend.push([None if f is None else f / self.stiffness[i] for i, f in enumerate(loads)])
        self.backend.step(arriving)
        self.steps += 1
        self._record(np.arange(len(self._tasks)))

    def _record(self, index: np.ndarray) -> None:
        """Show the present states of some rows to their tasks, if these take note of them."""
        if self._records:
            states = self._states()
            for i in index.tolist():
                self._tasks[i].record(states[i])

    def report(self, index: np.ndarray | None = None) -> tuple[np.ndarray, Any, dict[str, Any]]:
        """Return observations (B, d), rewards (B,) and infos of the present states; ``alone`` without the axis of rows.

        Args:
            index: rows whose sensors are read anew; default all.
        """
        only, task, states = self._only, self.task, self._states()
        state, goals = self._present(states), self.goals()[only]
        measured = state.effector[..., :3]
        if self._reads_states:
            measured = np.stack([self._tasks[i].measure(one) for i, one in enumerate(states)])[only]
        distance, terms, reward = task.rate(measured, goals, self.spaces.effort_share(state.effort))
        failed = np.zeros(reward.shape, dtype=bool)
        if self._reads_states:
            further = [self._tasks[i].state_terms(one) for i, one in enumerate(states)]
            if further[0]:
                terms = terms | {name: np.array([row[name] for row in further])[only] for name in further[0]}
                reward = task.reward(terms)
            failed = np.array([self._tasks[i].is_failed(one) for i, one in enumerate(states)])[only]
        info: dict[str, Any] = {
            "measured": measured.copy(),
            "goal": goals.copy(),
            "distance": distance,
            "is_success": distance < task.success_distance,
            "is_failed": failed,
            **{f"reward_{name}": term for name, term in terms.items()},
            "effector": state.effector[..., :3].copy(),
            "displacement": state.displacement.copy(),
            "effort": state.effort.copy(),
            "stable": self.backend.stable[only],
            "uncertainty": state.uncertainty,
            "trusted": state.trusted,
            "distrust": state.distrust,
            "converged": state.converged,
        }
        if task.tallies:
            counted = [each.tally() for each in self._tasks]
            info |= {name: np.array([row[name] for row in counted])[only] for name in task.tallies}
        if states and states[0].contacts is not None:
            info |= {name: values[only] for name, values in _contact_info(states).items()}
        if self.plants is not None:
            for field in fields(Plant):
                info[f"plant_{field.name}"] = np.array([getattr(plant, field.name) for plant in self.plant])[only]
        readings = measured[..., :0]
        if task.sensors is not None:
            sensing: list[Any] = [each.sensors for each in self._tasks]
            readings = np.stack([sensing[i].readings(one) for i, one in enumerate(states)])[only]
        shown = self._read(Sensed(state.displacement, state.effort, measured, readings), index)
        velocity = self.backend.velocity
        observation = self.spaces.observe(
            self.command[only],
            shown.displacement,
            shown.effort,
            shown.effector,
            self.goals(task.lookahead)[only] if task.lookahead else goals,
            self.unit_designs[only],
            None if velocity is None else velocity[only],
            None if task.sensors is None else self._sensor_values(squash(shown.sensors), index),
        )
        if self._alone:
            return observation, reward if state.converged else np.float64(0.0), info
        return observation, np.where(state.converged, reward, 0.0), info

    def _present(self, states: Sequence[State]) -> BatchState:
        """Return the present states, for ``alone`` without the axis of rows."""
        if not self._alone:
            state = self.state
            return replace(state, uncertainty=state.uncertainty.copy(), distrust=state.distrust.copy())
        one: Any = states[0]
        found: Any = self.backend
        effector = one.effector.reshape(-1)
        return BatchState(
            one.displacement, one.effort, effector, one.slack, found.converged[0], one.uncertainty, one.distrust
        )

    def _states(self) -> list[State]:
        states = self.backend.states
        if not self._differ:
            return states
        return [stiffened(one, float(self.stiffness[i, 0])) for i, one in enumerate(states)]

    def _read(self, true: Sensed, index: np.ndarray | None) -> Sensed:
        """Read the sensors of some rows (default all), and return what those of all show."""
        if not (self._differ and self.noise.any()):
            self.shown = None
            return true
        if index is None or (self.shown is None and len(index)):
            index = np.arange(len(self.noise))
        if not len(index):
            return self.shown_rows(self._only) or true
        names = [field.name for field in fields(Sensed)]
        rows = {name: getattr(true, name)[None if self._alone else index] for name in names}
        new = sensed(self.robot, Sensed(**rows), self.noise[index], self.random(index), self.task.measured_scale)
        if self._alone:
            self.shown = new
        else:
            self.shown = Sensed(*(np.array(getattr(self.shown or true, name)) for name in names))
            for name in names:
                getattr(self.shown, name)[index] = getattr(new, name)
        return self.shown_rows(self._only) or true

    def _sensor_values(self, readings: np.ndarray, index: np.ndarray | None) -> np.ndarray:
        """Return the sensor values of observations for readings in [-1, 1] (B, s): these and further ones."""
        readings = readings.reshape(len(self._tasks), -1)
        commands = (self.command - self.spaces.middle) / self.spaces.half_range
        both = np.concatenate([commands, readings], axis=1)
        values = []
        for i, task in enumerate(self._tasks):
            assert task.sensors is not None
            values.append(np.concatenate([readings[i], task.sensors.further(both[i], index is None or i in index)]))
        return np.stack(values)[self._only]

    def shown_rows(self, rows: int | slice) -> Sensed | None:
        """Return what the sensors of some rows show; None where that is the present state."""
        if self.shown is None:
            return None
        return Sensed(*(getattr(self.shown, field.name)[rows] for field in fields(Sensed)))


def _contact_info(states: Sequence[State]) -> dict[str, np.ndarray]:
    """Return what ``info`` says of contacts."""
    contacts: list[Any] = [state.contacts for state in states]
    return {
        "contact_force": np.stack([each.total for each in contacts]),
        "smallest_gap": np.array([each.smallest_gap for each in contacts]),
        "sliding": np.array([float(each.sliding.mean()) if each.count else 0.0 for each in contacts]),
    }

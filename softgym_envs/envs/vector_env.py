"""SoftRobotVectorEnv: environments that step all bodies together."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from softgym_envs.backends.batch import BatchState
from softgym_envs.backends.registry import is_batched, make_batch_backend
from softgym_envs.envs.env import MAX_DRAWS
from softgym_envs.envs.gradients import RewardGradient, StepGradient
from softgym_envs.envs.options import (
    EnvironmentOptions,
    check_autoreset,
    check_batchable,
    check_counts,
    check_design_option,
    check_reset_options,
    complete_bodies,
    joined_seed,
    set_up,
    take_reset_mask,
)
from softgym_envs.envs.plant import OF_DRIVES, Plant, Sensed, sensed
from softgym_envs.envs.tasks.base import check_drawn
from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.condensation import CondensedModel

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource


class SoftRobotVectorEnv(VectorEnv):
    """``num_envs`` copies of a `SoftRobotEnv` that step together, on the surrogate or on finite elements of beams.

    Sub-environments that end are reset as Gymnasium's `AutoresetMode` says. ``"SameStep"``: the returned observation is
    the first of the next episode, and ``info["final_obs"]``, ``info["final_info"]`` hold the end of the last one.
    ``"NextStep"``: the next step resets them in place of a step, with a reward of 0. ``"Disabled"``: they must be reset
    with ``options={"reset_mask": mask}``.

    Args:
        robot: as for `SoftRobotEnv`.
        task: as for `SoftRobotEnv`.
        num_envs: number of sub-environments.
        max_episode_steps: time limit; default none.
        autoreset_mode: ``"SameStep"``, ``"NextStep"`` or ``"Disabled"``.
        backend: ``"surrogate"``, or ``"fem"`` for robots of beams; ``gymnasium.make_vec`` steps the others in processes
            (`ParallelVectorEnv`).
        render_mode: must be None; batches are not rendered.
        **options: ``design``, ``action_mode`` and the other arguments that the page of each environment ID lists;
            every sub-environment samples its own design.

    Raises:
        ValueError: for a wrong option, or a robot whose bodies cannot be stepped together on this backend.
        DesignError: for a malformed design.
        InfeasibleDesign: if the body cannot exist.
        WeightsError: if the surrogate's weights are damaged or belong to another robot.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(
        self,
        robot: RobotSource | None = None,
        task: TaskSource = "reach",
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        backend: str | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode is not None:
            raise ValueError(
                f"render_mode = {render_mode!r} is not available in the batched environment; allowed: None"
            )
        check_counts(num_envs, max_episode_steps)
        self.autoreset_mode = check_autoreset(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        checked = EnvironmentOptions.check(options, own=("max_episode_steps", "autoreset_mode"))
        setup = set_up(robot, task, backend, checked)
        self.robot, self.task = setup.robot, setup.task
        if not is_batched(setup.backend, self.robot, setup.backend_options):
            raise ValueError(
                f"backend = {setup.backend!r} of robot '{self.robot.name}' has no batched environment; "
                "allowed: 'surrogate', or gymnasium.make_vec, which steps it in processes"
            )
        check_batchable(self.task)
        self.num_envs = num_envs
        self.render_mode = None
        self.design_space = self.robot.design_space
        self.max_episode_steps = max_episode_steps if max_episode_steps is not None else np.iinfo(np.int64).max
        self._fixed_design, self.sampled_variables = setup.design, setup.sampled
        #: Draws the sampled variables of sub-environments ``index`` in unit coordinates [-1, 1], shape (len(index),
        #: number of sampled variables). Replace this function to draw bodies in another way.
        self.design_sampler: Callable[[np.random.Generator, np.ndarray], np.ndarray] = self._draw_uniformly
        self.designs = np.tile(self._fixed_design.array, (num_envs, 1))
        self.backend = make_batch_backend(setup.backend, self.robot, designs=self.designs, **setup.backend_options)
        self.spaces = setup.spaces(moving=self.backend.moving)
        self.single_action_space = self.spaces.action_space
        self.single_observation_space = self.spaces.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._plants = setup.plants
        if setup.plants is not None and setup.plants.high.cable_friction:
            raise ValueError("plant cable_friction is not available together for many bodies; allowed: 0")
        if setup.plants is not None and not setup.plants.drive_exactly:
            raise ValueError(f"plant {', '.join(OF_DRIVES)}: not available together for many bodies; allowed: defaults")
        self._stiffness, self._noise = np.ones((num_envs, 1)), np.zeros(num_envs)
        self._delay = np.zeros(num_envs, dtype=np.int64)
        longest = 0 if setup.plants is None else setup.plants.longest_delay
        self._sent = np.zeros((longest + 1, num_envs, len(self.robot.actuators)))  # the newest command first
        self._sensed: Sensed | None = None  # what the sensors showed when they were last read
        self._reward_gradient: RewardGradient | None = None  # made when it is first needed, because it loads torch
        self._unit_design = self.design_space.observe(self.designs, self.spaces.design_names)
        self._paths = np.zeros((num_envs, 1, 3))
        self._counts = np.ones(num_envs, dtype=np.int64)  # goals in each path
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._begun = np.zeros(num_envs, dtype=bool)  # sub-environments that have been reset
        self._ended = np.zeros(num_envs, dtype=bool)  # episodes that are over and not reset yet
        self._changed = np.zeros(num_envs, dtype=bool)  # bodies given in reset that differ from the fixed one

    def _draw_uniformly(self, rng: np.random.Generator, index: np.ndarray) -> np.ndarray:
        return rng.uniform(-1.0, 1.0, (len(self.sampled_variables), len(index))).T

    # -- bodies -----------------------------------------------------------------------------------------------------

    def _begin_bodies(self, index: np.ndarray, designs: np.ndarray) -> dict[int, InfeasibleDesign]:
        """Change bodies, and return why some of them cannot exist."""
        impossible = dict(self.backend.begin(index, designs))
        changed = np.array([i not in impossible for i in index.tolist()], dtype=bool)
        self.designs[index[changed]] = designs[changed]
        self._unit_design[index] = self.design_space.observe(self.designs[index], self.spaces.design_names)
        return impossible

    def _draw_bodies(self, index: np.ndarray) -> None:
        """Draw the sampled variables; bodies that cannot exist are drawn again.

        Raises:
            InfeasibleDesign: if `MAX_DRAWS` bodies in turn cannot exist.
        """
        names = self.design_space.names
        columns = [names.index(name) for name in self.sampled_variables]
        for attempt in range(MAX_DRAWS):
            designs = np.tile(self._fixed_design.array, (len(index), 1))
            for column, name, draws in zip(
                columns, self.sampled_variables, self.design_sampler(self.np_random, index).T, strict=True
            ):
                designs[:, column] = self.design_space[name].from_unit(draws)
            impossible = self._begin_bodies(index, designs)
            if not impossible:
                return
            if attempt == MAX_DRAWS - 1:
                raise next(iter(impossible.values()))
            index = np.array(sorted(impossible))

    def _begin_episodes(
        self,
        index: np.ndarray,
        design: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        goal: np.ndarray | None = None,
    ) -> None:
        """Start episodes in the sub-environments ``index``."""
        if design is not None:
            designs = complete_bodies(self.design_space, design, self._fixed_design, index)
            self._changed[index] = True  # also if some of the bodies cannot exist
            for error in self._begin_bodies(index, designs).values():
                raise error
        elif self.sampled_variables:
            self._draw_bodies(index)
        elif self._changed[index].any():
            self._begin_bodies(index, np.tile(self._fixed_design.array, (len(index), 1)))
            self._changed[index] = False
        if self._plants is not None:
            for i in index:
                plant = self._plants.sample(self.np_random)
                self._stiffness[i], self._noise[i], self._delay[i] = plant.stiffness, plant.noise, plant.delay
            self._sent[:, index] = 0.0
        self.backend.rest(index)
        self._steps[index] = 0
        self._begun[index], self._ended[index] = True, False
        if goal is not None:
            paths = goal
        else:
            drawn = self.task.sample(self.np_random, len(index), partial(self.backend.effectors, index))
            paths = check_drawn(self.task, drawn, len(index))
        missing = paths.shape[1] - self._paths.shape[1]
        if missing > 0:
            self._paths = np.pad(self._paths, ((0, 0), (0, missing), (0, 0)))
        self._paths[index, : paths.shape[1]] = paths
        self._counts[index] = paths.shape[1]

    # -- for controllers --------------------------------------------------------------------------------------------

    @property
    def command(self) -> np.ndarray:
        """Commands that were sent last, shape (num_envs, n_a); with a delay some have not arrived yet."""
        return self._sent[0] if len(self._sent) > 1 else self.backend.command

    @property
    def slack(self) -> np.ndarray:
        """Whether each actuator is slack, shape (num_envs, n_a)."""
        return self._state.slack

    @property
    def goals(self) -> np.ndarray:
        """Goals that the present states are rated by [m], shape (num_envs, 3)."""
        return self.task.goals(self._paths, self._counts, self._steps)

    @property
    def observed_goals(self) -> np.ndarray:
        """Goals that the observations show, ``task.lookahead`` steps ahead of `goals`, shape (num_envs, 3)."""
        return self.task.goals(self._paths, self._counts, self._steps + self.task.lookahead)

    @property
    def paths(self) -> np.ndarray:
        """Goals of the present episodes [m], shape (num_envs, p, 3)."""
        return self._paths

    @property
    def steps(self) -> np.ndarray:
        """Steps of the present episodes so far, shape (num_envs,).

        Learners set them so that episodes end at different times, which makes the states of a batch less alike.
        """
        return self._steps

    @steps.setter
    def steps(self, values: np.ndarray) -> None:
        steps = np.asarray(values)
        if steps.shape != (self.num_envs,) or not np.issubdtype(steps.dtype, np.integer) or (steps < 0).any():
            raise ValueError(f"steps must be {self.num_envs} non-negative integers, got {values!r}")
        self._steps[:] = steps

    @property
    def condensed(self) -> CondensedModel:
        """Condensed models of the present states, evaluated at each access; leading shape (num_envs,)."""
        found = self.backend.condensed
        if self._plants is None:
            return found
        stiffness = self._stiffness
        return replace(found, compliance=found.compliance / stiffness[:, :, None], effort=stiffness * found.effort)

    @property
    def _state(self) -> BatchState:
        state = self.backend.state
        return state if self._plants is None else replace(state, effort=self._stiffness * state.effort)

    # -- Gymnasium --------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in every sub-environment.

        Args:
            seed: seed of the random numbers, which all sub-environments share, or a list of ``num_envs`` seeds to make
                it from; None continues them, or stands for a random seed in a list.
            options: ``"design"``: the body of all sub-environments, or a list of ``num_envs`` bodies; ``"goal"``: a
                point (3,) or a path (p, 3) for all [m], or a path for each (num_envs, p, 3); ``"reset_mask"``: which
                sub-environments to reset, boolean (num_envs,); default all.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if a body cannot exist.
            ValueError: for an unknown option, a malformed seed, goal or mask, or another number of seeds or bodies.
        """
        super().reset(seed=joined_seed(seed, self.num_envs, lambda: int(self.np_random.integers(2**31))))
        index, options = take_reset_mask(options, self.num_envs)
        design, goal = check_reset_options(options)
        bodies = check_design_option(design, self.num_envs)
        if bodies is not None:
            design = [bodies[i] for i in index]
        if goal is not None:
            shared = np.ndim(goal) < 3
            goal = self.task.check_paths(goal, () if shared else (self.num_envs,))
            goal = np.broadcast_to(goal, (self.num_envs, *goal.shape[-2:]))[index]
        self._begin_episodes(index, design, goal)
        return self._observe(index), self._info()[0]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (num_envs, n_a) in [-1, 1].

        Raises:
            ValueError: for actions with a wrong shape or values that are not finite.
            ResetNeeded: before the first `reset`, or without autoreset if an episode is over.
        """
        self._advance(self._checked(actions))
        return self._finish_step()

    def step_with_gradient(
        self, actions: np.ndarray, *, log: bool = False, effort_weight: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any], StepGradient]:
        """As `step`; also returns the derivatives of the rewards in the actions, or with ``log`` of `Task.log_reward`.

        The part of the derivatives that comes through the efforts is multiplied by ``effort_weight``.
        In dynamics these are rewards of the equilibria where the present commands lead if they are held.
        Rows that found no equilibrium or are reset have a reward and derivatives of zero.

        Raises:
            ValueError: for actions with a wrong shape or values that are not finite.
            ResetNeeded: before the first `reset`, or without autoreset if an episode is over.
            ImportError: without torch, which differentiates the task.
        """
        if len(self._sent) > 1:
            raise ValueError("plant delay: rewards of delayed commands have no derivatives in the actions of one step")
        actions = self._checked(actions)
        slope, limited = self.spaces.command_slope(actions, self.command)
        self._advance(actions)
        gradient = self._gradient(slope, limited, log, effort_weight)
        return *self._finish_step(), gradient

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        actions = self.spaces.check_action(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {actions.shape}")
        if not self._begun.all():
            waiting = np.flatnonzero(~self._begun).tolist()
            raise ResetNeeded(f"step was called before reset of sub-environments {waiting}")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise ResetNeeded(f"the episodes of sub-environments {ended} are over; reset them with a reset_mask")
        return actions

    def _advance(self, actions: np.ndarray) -> None:
        """Move commands and states by one step."""
        command = arriving = self.spaces.command(actions, self.command)
        if len(self._sent) > 1:
            self._sent = np.concatenate([command[None], self._sent[:-1]])
            arriving = self._sent[self._delay, np.arange(self.num_envs)]
        self.backend.step(arriving)
        self._steps += 1

    def _gradient(self, slope: np.ndarray, limited: np.ndarray, log: bool, effort_weight: float) -> StepGradient:
        if self._reward_gradient is None:
            self._reward_gradient = RewardGradient(self.task, self.spaces)
        state, goals = self.backend.settled(), self.goals
        effector, effort = np.zeros_like(state.effector), self._stiffness * state.effort
        effector[:, :3], by_effort = self._reward_gradient(state.effector[:, :3], effort, goals, log)
        held, command = self.backend.gradient(effector, effort_weight * self._stiffness * by_effort)
        _, _, reward = self.task.rate(state.effector[:, :3], goals, self.spaces.effort_share(effort))
        rated = state.converged & self._state.converged & ~self._ended
        found, gap = rated[:, None], state.displacement - self.command
        held, command = np.where(found, held, 0.0), np.where(found, command, 0.0)
        reward = np.where(rated, reward, 0.0)
        return StepGradient(reward, command, held, state.slack.copy(), gap, slope, limited)

    def _finish_step(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Rate the present states, and start new episodes where the last ones have ended."""
        rated = self._state.converged & ~self._ended
        if self._ended.any():  # only where the next step resets them
            self._begin_episodes(np.flatnonzero(self._ended))
        info, reward = self._info()
        observation = self._observe()
        reward = np.where(rated, reward, 0.0)
        truncated = (self._steps >= self.max_episode_steps) | ~self._state.converged
        ended = np.flatnonzero(truncated)
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._ended = truncated.copy()
        elif len(ended):
            final_info = info
            final_obs = np.full(self.num_envs, None, dtype=object)
            for i in ended:
                final_obs[i] = observation[i].copy()
            self._begin_episodes(ended)
            observation = self._observe(ended)
            info = {**self._info()[0], "final_info": final_info, "_final_info": truncated.copy()}
            info |= {"final_obs": final_obs, "_final_obs": truncated.copy()}
        return observation, reward, np.zeros(self.num_envs, dtype=bool), truncated, info

    def _observe(self, index: np.ndarray | None = None) -> np.ndarray:
        """Return observations; only the sensors of sub-environments ``index`` (default all) are read anew."""
        shown = self._read(index)
        return self.spaces.observe(
            self.command,
            shown.displacement,
            shown.effort,
            shown.effector,
            self.observed_goals,
            self._unit_design,
            self.backend.velocity,
        )

    def _read(self, index: np.ndarray | None) -> Sensed:
        """Read the sensors of sub-environments ``index`` (default all), and return what those of all show."""
        state = self._state
        true = Sensed(state.displacement, state.effort, state.effector[:, :3])
        if self._plants is None or not self._plants.high.noise:
            return true
        if index is None or self._sensed is None:
            index = np.arange(self.num_envs)
        rows = Sensed(true.displacement[index], true.effort[index], true.effector[index])
        new = sensed(self.robot, rows, self._noise[index], self.np_random, self.task.measured_scale)
        shown = copy.deepcopy(self._sensed or true)
        for name in ("displacement", "effort", "effector"):
            getattr(shown, name)[index] = getattr(new, name)
        self._sensed = shown
        return shown

    def _info(self) -> tuple[dict[str, Any], np.ndarray]:
        state, goals = self._state, self.goals
        effector = state.effector[:, :3]
        distance, terms, reward = self.task.rate(effector, goals, self.spaces.effort_share(state.effort))
        every = np.ones(self.num_envs, dtype=bool)
        info: dict[str, Any] = {
            "effector": effector.copy(),
            "goal": goals.copy(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            **{f"reward_{name}": term for name, term in terms.items()},
            "stable": self.backend.stable,
        }
        for name in ("displacement", "effort", "uncertainty", "trusted", "distrust", "converged"):
            info[name] = getattr(state, name).copy()
        if self._plants is not None:
            zero = np.zeros(self.num_envs)
            info |= {"plant_stiffness": self._stiffness[:, 0].copy(), "plant_cable_friction": zero}
            info |= {"plant_delay": self._delay.copy(), "plant_noise": self._noise.copy()}
            info |= {f"plant_{name}": np.full(self.num_envs, getattr(Plant, name)) for name in OF_DRIVES}
        info |= {f"_{name}": every for name in tuple(info)}
        return info, reward

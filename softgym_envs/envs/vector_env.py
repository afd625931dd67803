"""SoftRobotVectorEnv: environments that step all bodies together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from softgym_envs.backends.batch import BatchState
from softgym_envs.envs.episodes import Episodes
from softgym_envs.envs.gradients import RewardGradient, StepGradient
from softgym_envs.envs.options import (
    EnvironmentOptions,
    check_autoreset,
    check_counts,
    check_design_option,
    check_reset_options,
    check_seeds,
    complete_bodies,
    set_up,
    take_reset_mask,
)
from softgym_envs.mechanics.condensation import CondensedModel

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource


class SoftRobotVectorEnv(VectorEnv):
    """``num_envs`` copies of a `SoftRobotEnv` in one process, each with the episodes of its seed.

    The surrogate, and finite elements of beams, step them in one call. All others are stepped one after the other:
    ``gymnasium.make_vec`` takes processes for them (`ParallelVectorEnv`).

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
        backend: as for `SoftRobotEnv`.
        render_mode: must be None; batches are not rendered.
        **options: ``design``, ``action_mode`` and the other arguments that the page of each environment ID lists;
            every sub-environment samples its own design.

    Raises:
        ValueError: for a wrong option.
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
                f"render_mode = {render_mode!r} is not available in the batched environment; allowed: None. To film, "
                "use gymnasium.make_vec(ID, vectorization_mode='sync', render_mode='rgb_array') or `softgym rollout ID "
                "--video FILE`"
            )
        check_counts(num_envs, max_episode_steps)
        self.autoreset_mode = check_autoreset(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        checked = EnvironmentOptions.check(options, own=("max_episode_steps", "autoreset_mode"))
        self._episodes = Episodes(set_up(robot, task, backend, checked), num_envs)
        self.robot, self.task, self.spaces = self._episodes.robot, self._episodes.task, self._episodes.spaces
        self.backend = self._episodes.backend
        self.num_envs = num_envs
        self.render_mode = None
        self.design_space = self.robot.design_space
        self.max_episode_steps = max_episode_steps if max_episode_steps is not None else np.iinfo(np.int64).max
        self.single_action_space = self.spaces.action_space
        self.single_observation_space = self.spaces.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._reward_gradient: RewardGradient | None = None  # made when it is first needed, because it loads torch
        self._begun = np.zeros(num_envs, dtype=bool)  # sub-environments that have been reset
        self._ended = np.zeros(num_envs, dtype=bool)  # episodes that are over and not reset yet

    # -- for controllers --------------------------------------------------------------------------------------------

    @property
    def designs(self) -> np.ndarray:
        """Bodies of the sub-environments, shape (num_envs, number of design variables)."""
        return self._episodes.designs

    @property
    def sampled_variables(self) -> tuple[str, ...]:
        """Design variables that each reset draws."""
        return self._episodes.sampled

    def set_design_sampler(self, sampler: Callable[[np.random.Generator, np.ndarray], np.ndarray]) -> None:
        """Draw bodies in another way than uniformly, row by row.

        Args:
            sampler: maps `np_random`, a generator for all sub-environments, and the numbers of those to draw for to
                their sampled variables in unit coordinates [-1, 1], shape (numbers, sampled variables).
        """
        self._episodes.sampler = partial(self._sample_designs, sampler)

    def _sample_designs(
        self, sampler: Callable[[np.random.Generator, np.ndarray], np.ndarray], index: np.ndarray
    ) -> np.ndarray:
        return sampler(self.np_random, index)

    @property
    def state(self) -> BatchState:
        """The present mechanical states of the plants, without noise of sensors."""
        return self._episodes.state

    @property
    def command(self) -> np.ndarray:
        """Commands that were sent last, shape (num_envs, n_a); with a delay some have not arrived yet."""
        return self._episodes.command

    @property
    def slack(self) -> np.ndarray:
        """Whether each actuator is slack, shape (num_envs, n_a)."""
        return self.backend.state.slack

    @property
    def goals(self) -> np.ndarray:
        """Goals that the present states are rated by [m], shape (num_envs, 3)."""
        return self._episodes.goals()

    @property
    def observed_goals(self) -> np.ndarray:
        """Goals that the observations show, ``task.lookahead`` steps ahead of `goals`, shape (num_envs, 3)."""
        return self._episodes.goals(self.task.lookahead)

    @property
    def paths(self) -> np.ndarray:
        """Goals of the present episodes [m], shape (num_envs, p, 3)."""
        return self._episodes.paths

    @property
    def steps(self) -> np.ndarray:
        """Steps of the present episodes so far, shape (num_envs,).

        Learners set them so that episodes end at different times, which makes the states of a batch less alike.
        """
        return self._episodes.steps

    @steps.setter
    def steps(self, values: np.ndarray) -> None:
        steps = np.asarray(values)
        if steps.shape != (self.num_envs,) or not np.issubdtype(steps.dtype, np.integer) or (steps < 0).any():
            raise ValueError(f"steps must be {self.num_envs} non-negative integers, got {values!r}")
        self._episodes.steps[:] = steps

    @property
    def condensed(self) -> CondensedModel:
        """Condensed models of the present states, evaluated at each access; leading shape (num_envs,)."""
        found, stiffness = self.backend.condensed, self._episodes.stiffness
        if (stiffness == 1.0).all():
            return found
        return replace(found, compliance=found.compliance / stiffness[:, :, None], effort=stiffness * found.effort)

    # -- Gymnasium --------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in every sub-environment.

        Args:
            seed: seed of the first sub-environment, to which the next ones add 1, 2, ...; or a list of ``num_envs``
                seeds. Each draws what a single environment with its seed does; None continues the random numbers.
            options: ``"design"``: the body of all sub-environments, or a list of ``num_envs`` bodies; ``"goal"``: a
                point (3,) or a path (p, 3) for all [m], or a path for each (num_envs, p, 3); ``"reset_mask"``: which
                sub-environments to reset, boolean (num_envs,); default all.

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if a body cannot exist.
            ValueError: for an unknown option, a malformed seed, goal or mask, or another number of seeds or bodies.
        """
        seeds = check_seeds(seed, self.num_envs)
        index, options = take_reset_mask(options, self.num_envs)
        design, goal = check_reset_options(options)
        bodies = check_design_option(design, self.num_envs)
        if bodies is not None:
            design = [bodies[i] for i in index]
        if goal is not None:
            shared = np.ndim(goal) < 3
            goal = self.task.check_paths(goal, () if shared else (self.num_envs,))
            goal = np.broadcast_to(goal, (self.num_envs, *goal.shape[-2:]))[index]
        if design is not None:
            design = complete_bodies(self.design_space, design, self._episodes.fixed, index)
        super().reset(seed=next((one for one in seeds if one is not None), None))
        self._episodes.seed(index, [seeds[i] for i in index])
        self._begin(index, design, goal)
        observation, _, info = self._episodes.report(index)
        return observation, self._masked(info)

    def _begin(self, index: np.ndarray, designs: np.ndarray | None = None, paths: np.ndarray | None = None) -> None:
        self._episodes.begin(index, designs, paths)
        self._begun[index], self._ended[index] = True, False

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (num_envs, n_a) in [-1, 1].

        Raises:
            ValueError: for actions with a wrong shape or values that are not finite.
            ResetNeeded: before the first `reset`, or without autoreset if an episode is over.
        """
        self._episodes.advance(self._checked(actions))
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
        if self._episodes.delay.any():
            raise ValueError("plant delay: rewards of delayed commands have no derivatives in the actions of one step")
        actions = self._checked(actions)
        slope, limited = self.spaces.command_slope(actions, self.command)
        self._episodes.advance(actions)
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

    def _gradient(self, slope: np.ndarray, limited: np.ndarray, log: bool, effort_weight: float) -> StepGradient:
        if self._reward_gradient is None:
            self._reward_gradient = RewardGradient(self.task, self.spaces)
        state, goals, stiffness = self.backend.settled(), self.goals, self._episodes.stiffness
        effector, effort = np.zeros_like(state.effector), stiffness * state.effort
        effector[:, :3], by_effort = self._reward_gradient(state.effector[:, :3], effort, goals, log)
        held, command = self.backend.gradient(effector, effort_weight * stiffness * by_effort)
        _, _, reward = self.task.rate(state.effector[:, :3], goals, self.spaces.effort_share(effort))
        rated = state.converged & self.backend.state.converged & ~self._ended
        found, gap = rated[:, None], state.displacement - self.command
        held, command = np.where(found, held, 0.0), np.where(found, command, 0.0)
        reward = np.where(rated, reward, 0.0)
        return StepGradient(reward, command, held, state.slack.copy(), gap, slope, limited)

    def _finish_step(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Rate the present states, and start new episodes where the last ones have ended."""
        episodes, ended, fresh = self._episodes, self._ended, None
        if ended.any():  # only where the next step resets them
            fresh = ended.copy()
            self._begin(np.flatnonzero(fresh))
        observation, reward, info = episodes.report()
        truncated = (episodes.steps >= self.max_episode_steps) | ~info["converged"]
        terminated = info["is_failed"].copy()
        if fresh is not None:
            reward = np.where(fresh, 0.0, reward)
        over = truncated | terminated
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._ended = over
            return observation, reward, terminated, truncated, self._masked(info)
        rows = np.flatnonzero(over)
        if not len(rows):
            return observation, reward, terminated, truncated, self._masked(info)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in rows:
            final_obs[i] = observation[i].copy()
        final = {"final_info": self._masked(info), "_final_info": over.copy()}
        final |= {"final_obs": final_obs, "_final_obs": over.copy()}
        self._begin(rows)
        observation, _, info = episodes.report(rows)
        return observation, reward, terminated, truncated, self._masked(info) | final

    def _masked(self, info: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return infos with the masks of Gymnasium: those of every row are there."""
        every = np.ones(self.num_envs, dtype=bool)
        return info | {f"_{name}": every for name in info}

"""SoftRobotEnv: a robot, a task and a backend behind Gymnasium's interface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import EzPickle

from softgym_envs.backends import make_backend
from softgym_envs.backends.backend import Backend, State
from softgym_envs.designs import Design, DesignSpace
from softgym_envs.envs.spaces import Interface
from softgym_envs.envs.tasks.base import make_task
from softgym_envs.errors import ConvergenceError
from softgym_envs.robots import make_robot

__all__ = ["SoftRobotEnv", "design_names", "merge_defaults"]


def merge_defaults(
    defaults: Mapping[str, Any] | None, backend: str, *given: Mapping[str, Any] | None
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Put options of a robot, a task and a backend over the defaults of an environment's row."""
    rows = dict(defaults or {})
    if rows.get("backend") != backend:
        rows["backend_options"] = {}
    robot, task, physics = (
        {**rows.get(name, {}), **(options or {})}
        for name, options in zip(("robot_options", "task_options", "backend_options"), given, strict=True)
    )
    return robot, task, physics


def design_names(space: DesignSpace, choice: bool | Sequence[str]) -> tuple[str, ...]:
    """Resolve an option that is False, True (all variables) or a list of names.

    Raises:
        DesignError: for an unknown name.
    """
    if isinstance(choice, bool):
        return space.names if choice else ()
    return tuple(space[name].name for name in choice)


class SoftRobotEnv(gymnasium.Env, EzPickle):
    """A soft robot with a task. See the page of each environment ID for its tables.

    Args:
        robot: registry name of the robot.
        task: registry name of the task.
        backend: ``"surrogate"``, ``"fem"``, or ``"hybrid"`` of both.
        design: body of every episode unless given in `reset`; missing variables take their baseline.
        sample_design: draw the body at each reset: True for all variables, or their names.
        design_in_observation: show the body to the agent: True for all variables, or their names.
        action_mode: ``"increment"`` or ``"absolute"``, see `Interface`.
        robot_options: options of the robot.
        task_options: options of the task.
        backend_options: options of the backend.
        defaults: options of the environment's row, under those given here; its ``backend_options`` count on its
            ``backend`` only.
        render_mode: None or ``"rgb_array"``.
        render_size: width and height of an image [pixels].
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        robot: str,
        task: str,
        *,
        backend: str = "surrogate",
        design: Mapping[str, float] | None = None,
        sample_design: bool | Sequence[str] = False,
        design_in_observation: bool | Sequence[str] = False,
        action_mode: str = "increment",
        robot_options: Mapping[str, Any] | None = None,
        task_options: Mapping[str, Any] | None = None,
        backend_options: Mapping[str, Any] | None = None,
        defaults: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 480),
    ) -> None:
        EzPickle.__init__(
            self,
            robot,
            task,
            backend=backend,
            design=design,
            sample_design=sample_design,
            design_in_observation=design_in_observation,
            action_mode=action_mode,
            robot_options=robot_options,
            task_options=task_options,
            backend_options=backend_options,
            defaults=defaults,
            render_mode=render_mode,
            render_size=render_size,
        )
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode = {render_mode!r} is unknown; allowed: None, 'rgb_array'")
        self.render_mode = render_mode
        self.render_size = render_size
        robot_options, task_options, backend_options = merge_defaults(
            defaults, backend, robot_options, task_options, backend_options
        )
        self.robot = make_robot(robot, **robot_options)
        self.design_space = self.robot.design_space
        self._fixed_design = self.design_space.complete(design)
        self._sampled = design_names(self.design_space, sample_design)
        shown = design_names(self.design_space, design_in_observation)
        self.task = make_task(task, self.robot, **task_options)
        self.backend: Backend = make_backend(backend, self.robot, design=self._fixed_design, **backend_options)
        if self.task.pushes and not self.backend.takes_force:
            raise ValueError(f"task '{task}' pushes the effector, backend '{backend}' knows no forces; use 'fem'")
        self.interface = Interface(
            self.robot,
            action_mode=action_mode,
            design_names=shown,
            axes=self.task.axes,
            moving=self.backend.moving,
        )
        self.action_space = self.interface.action_space
        self.observation_space = self.interface.observation_space
        self._renderer: Any = None
        self._path = np.zeros((1, 3))
        self._unit_design = np.zeros(len(shown))
        self._step = 0

    @property
    def design(self) -> Design:
        """The present body."""
        return self.backend.design

    @property
    def state(self) -> State:
        """The present mechanical state."""
        return self.backend.state

    @property
    def goal(self) -> np.ndarray:
        """The present goal [m], shape (3,)."""
        return self.task.goals(self._path[None], np.array([len(self._path)]), np.array([self._step]))[0]

    @property
    def path(self) -> np.ndarray:
        """All goals of the episode [m], shape (p, 3)."""
        return self._path

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of everything random in this environment.
            options: ``"design"``: body of the episode; ``"goal"``: a goal (3,) or a path of goals (p, 3) [m].

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the body cannot exist.
            ValueError: for an unknown option or a malformed goal.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        unknown = set(options) - {"design", "goal"}
        if unknown:
            raise ValueError(f"unknown reset option '{sorted(unknown)[0]}'; allowed: design, goal")
        if options.get("design") is not None:
            design = self.design_space.complete(options["design"], self._fixed_design)
        elif self._sampled:
            drawn = self.design_space.sample(self.np_random, self._sampled)
            design = self.design_space.complete({name: drawn[name] for name in self._sampled}, self._fixed_design)
        else:
            design = self._fixed_design
        self.backend.reset(design)
        shown = self.interface.design_names
        self._unit_design = np.array([self.design_space[name].to_unit(design[name]) for name in shown], dtype=float)
        goal = options.get("goal")
        if goal is None:
            self._path = self.task.sample(self.np_random, 1, self._kinematics)[0]
        else:
            self._path = self.task.check_paths(goal)
        self.task.begin(self.np_random)
        self._step = 0
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply one action, shape (n_a,) in [-1, 1]; values outside are clipped.

        A step whose equilibrium is not found ends the episode (truncated) with ``info["converged"] = False``.

        Raises:
            ValueError: for an action of a wrong shape or one that is not finite.
        """
        action = self.interface.check_action(action)
        if action.ndim != 1:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        command = self.interface.command(action, self.backend.state.command)
        converged = True
        try:
            self.backend.step(command, force=self.task.push(self._step))
        except ConvergenceError:
            converged = False
        self._step += 1
        observation, info = self._observe()
        reward = 1.0
        for term in info["reward_terms"].values():
            reward *= term
        if not converged:
            info["converged"] = False
            reward = 0.0
        return observation, float(reward), False, not converged, info

    def _observe(self) -> tuple[np.ndarray, dict[str, Any]]:
        state, goal = self.backend.state, self.goal
        effector = state.effector[0]
        distance = float(self.task.distance(effector, goal))
        share = np.abs(state.effort / self.robot.effort_scale).mean()
        info = {
            "effector": effector.copy(),
            "goal": goal.copy(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            "reward_terms": {k: float(v) for k, v in self.task.reward_terms(np.asarray(distance), share).items()},
            "displacement": state.displacement.copy(),
            "effort": state.effort.copy(),
            "stable": state.stable,
            "uncertainty": state.uncertainty,
            "trusted": state.trusted,
            "converged": True,
        }
        velocity = state.velocity[0] if self.interface.moving else None
        observation = self.interface.observe(
            state.command, state.displacement, state.effort, effector, goal, self._unit_design, velocity
        )
        return observation, info

    def _kinematics(self, commands: np.ndarray) -> np.ndarray:
        """Effectors [m] (1, 3) that commands (1, n_a) lead to; NaN where no equilibrium is found."""
        try:
            return self.backend.probe(commands[0]).effector[:1]
        except ConvergenceError:
            return np.full((1, 3), np.nan)

    def render(self) -> np.ndarray | None:
        """Return an image (height, width, 3) of the body, its cables, effector and goal, or None without a mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' in gymnasium.make")
            return None
        if self._renderer is None:
            from softgym_envs.viewer.image import ImageRenderer

            self._renderer = ImageRenderer(self.robot, self.render_size)
        distance = float(self.task.distance(self.backend.state.effector[0], self.goal))
        return self._renderer.render(self.backend.design, self.backend.state, self._path, self.goal, distance)

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

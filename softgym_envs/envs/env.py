"""SoftRobotEnv: a robot, a task and a backend behind Gymnasium's interface."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import EzPickle

from softgym_envs.backends.backend import Backend, State
from softgym_envs.designs import Design
from softgym_envs.envs.episodes import Episodes, EpisodeState
from softgym_envs.envs.options import EnvironmentOptions, check_reset_options, set_up
from softgym_envs.envs.plant import Plant, Sensed, stiffened

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource
    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot

#: All rows of an environment of one body, and no row.
ONLY, NONE = np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int64)


class SoftRobotEnv(gymnasium.Env, EzPickle):
    """A soft robot with a task. The page of each environment ID has the tables of its spaces.

    A copy or pickle of the environment continues the episode of the original, with the same random numbers. Robot
    and task objects are copied with it; classes and names stay references, so their modules must be importable where it
    is unpickled. ``spec.to_json`` needs names or paths ``"module:class"``.

    Args:
        robot: registered name, path ``"module:class"``, class or object.
        task: registered name, path ``"module:class"``, class, or object made for the same robot object.
        backend: ``"surrogate"``, ``"fem"``, or ``"hybrid"`` of both; default the surrogate where weights ship for the
            robot, else FEM.
        render_mode: None, ``"rgb_array"`` for images, or ``"human"`` for a window that every step draws.
        render_size: width and height of an image [pixels].
        **options: ``design``, ``action_mode`` and the other arguments that the page of each environment ID lists.

    Raises:
        ValueError: for a wrong option.
        DesignError: for a malformed design.
        InfeasibleDesign: if the body cannot exist.
        WeightsError: if the surrogate has no weights for the robot, or they are damaged.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}

    def __init__(
        self,
        robot: RobotSource | None = None,
        task: TaskSource = "reach",
        *,
        backend: str | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 480),
        **options: Any,
    ) -> None:
        EzPickle.__init__(
            self, robot, task, backend=backend, render_mode=render_mode, render_size=render_size, **options
        )
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode = {render_mode!r} is unknown; allowed: None, 'human', 'rgb_array'")
        if np.shape(render_size) != (2,) or not all(isinstance(n, Integral) and n > 0 for n in render_size):
            raise ValueError(f"render_size = {render_size!r} must be two positive integers: width and height in pixels")
        if render_mode == "human":
            from softgym_envs.viewer.scene import check_display

            check_display()
        self.render_mode = render_mode
        self.render_size = render_size
        checked = EnvironmentOptions.check(options, own=("render_mode", "render_size"))
        self._episodes = Episodes(set_up(robot, task, backend, checked), 1, alone=True)
        self.robot, self.task, self.spaces = self._episodes.robot, self._episodes.task, self._episodes.spaces
        self._made = _option_texts(self.robot, self.task)
        self.design_space = self.robot.design_space
        owned: Any = self._episodes.backend
        self.backend: Backend = owned.owners[0]
        self.action_space = self.spaces.action_space
        self.observation_space = self.spaces.observation_space
        self._renderer: Any = None

    @property
    def design(self) -> Design:
        """The present body."""
        return self.backend.design

    @property
    def plant(self) -> Plant:
        """How the present robot differs from its model."""
        return self._episodes.plant[0]

    @property
    def state(self) -> State:
        """The present mechanical state of the plant, without noise of sensors."""
        return stiffened(self.backend.state, self.plant.stiffness)

    @property
    def command(self) -> np.ndarray:
        """The command that was sent last, shape (n_a,); with a delay it has not arrived yet."""
        return self._episodes.command[0]

    @property
    def sensed(self) -> Sensed:
        """What the sensors show of the present state."""
        if (shown := self._episodes.shown_rows(0)) is not None:
            return shown
        state, sensors = self.state, self.task.sensors
        readings = np.zeros(0) if sensors is None else sensors.readings(state)
        return Sensed(state.displacement, state.effort, self.task.measure(state), readings)

    @property
    def goal(self) -> np.ndarray:
        """The goal that the present state is rated by [m, or the unit of the task's goals], shape (3,)."""
        return self._episodes.goals()[0]

    @property
    def observed_goal(self) -> np.ndarray:
        """The goal that the observation shows, ``task.lookahead`` steps ahead of `goal`, shape (3,)."""
        return self._episodes.goals(self.task.lookahead)[0]

    @property
    def steps(self) -> int:
        """Steps of the present episode so far."""
        return int(self._episodes.steps[0])

    @property
    def path(self) -> np.ndarray:
        """All goals of the episode [m, or the unit of the task's goals], shape (p, 3)."""
        return self._episodes.paths[0, : self._episodes.counts[0]]

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of all random numbers of this environment.
            options: ``"design"``: body of the episode; ``"goal"``: a goal (3,) or a path of goals (p, 3) [m].

        Raises:
            DesignError: for a malformed design.
            InfeasibleDesign: if the body cannot exist.
            ValueError: for an unknown option or a malformed goal.
        """
        super().reset(seed=seed)
        given, goal = check_reset_options(options)
        # Check everything before anything changes.
        paths = None if goal is None else self.task.check_paths(goal)[None]
        designs = None
        if given is not None:
            designs = self.design_space.complete(given, self._episodes.fixed).array[None]
        self._episodes.generators[0] = self.np_random
        self._episodes.begin(ONLY, designs, paths)
        if self.render_mode == "human":
            self.render()
        observation, _, info = self._report()
        return observation, info

    def get_state(self) -> EpisodeState:
        """Return the present moment of the episode, for `set_state`.

        Wrappers count steps for themselves: a time limit goes on counting after `set_state`.
        """
        now = self._episodes
        return EpisodeState(
            robot=self.robot.name,
            task=self.task.name,
            options=self._made,
            physics=self.backend.snapshot(),
            path=self.path.copy(),
            step=self.steps,
            progress=copy.deepcopy({name: value for name, value in vars(self.task).items() if name != "robot"}),
            random=None if self._np_random is None else self._np_random.bit_generator.state,
            plant=self.plant,
            sent=now.sent.copy(),
            sensed=now.shown,
        )

    def set_state(self, state: EpisodeState) -> tuple[np.ndarray, dict[str, Any]]:
        """Go to a moment of an episode of this environment or of another one with the same robot, task and backend.

        Returns:
            Observation and info of that moment.

        Raises:
            ValueError: for what is not a state, or a state of another robot, task or backend, or of a robot or task
                with other options.
        """
        if not isinstance(state, EpisodeState):
            raise ValueError(f"state = {state!r:.80} must be what get_state returned")
        for kind, name, own in (("robot", state.robot, self.robot.name), ("task", state.task, self.task.name)):
            if name != own:
                raise ValueError(f"the state belongs to {kind} '{name}', but the environment has {kind} '{own}'")
        for option in sorted({*state.options, *self._made}):
            theirs, mine = (made.get(option, "its default") for made in (state.options, self._made))
            if theirs != mine:
                raise ValueError(f"the state belongs to a {option} = {theirs:.80}, but the environment has {mine:.80}")
        self._episodes.set_plant(0, state.plant)
        self._episodes.set_cables(ONLY)
        self.backend.resume(state.physics)
        self._episodes.resume(self.backend.design.array, state)
        vars(self.task).update(copy.deepcopy(state.progress))
        if state.random is not None:
            self.np_random.bit_generator.state = state.random
            self._episodes.generators[0] = self.np_random
        observation, _, info = self._report(NONE)
        return observation, info

    def __getstate__(self) -> dict[str, Any]:
        own = {"spec": self.spec, "episode": self.get_state(), "action_space": self.action_space}
        return {**EzPickle.__getstate__(self), **own}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        EzPickle.__setstate__(self, kept)
        self.spec = kept["spec"]
        self._made = kept["episode"].options  # a task object may have changed since
        self.set_state(kept["episode"])
        self.action_space = self.spaces.action_space = kept["action_space"]  # with its random numbers

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply one action, shape (n_a,) in [-1, 1]; values outside are clipped.

        A step whose equilibrium is not found ends the episode (truncated) with ``info["converged"] = False``. An
        episode whose task has failed ends too (terminated), with ``info["is_failed"] = True``.

        Raises:
            ValueError: for an action with a wrong shape or a value that is not finite.
        """
        action = self.spaces.check_action(action)
        if action.ndim != 1:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        self._episodes.advance(action[None])
        if self.render_mode == "human":
            self.render()
        observation, reward, info = self._report()
        return observation, reward, bool(info["is_failed"]), not info["converged"], info

    def _report(self, index: np.ndarray | None = None) -> tuple[np.ndarray, float, dict[str, Any]]:
        """Return observation, reward and info of the present state; the sensors are read anew unless in no row."""
        observation, reward, info = self._episodes.report(index)
        for name, value in info.items():
            if (typed := _TYPED.get(type(value))) is not None:
                info[name] = typed(value)
        return observation, float(reward), info

    def render(self) -> np.ndarray | None:
        """Return an image (height, width, 3) of the body, its cables, effector and goal.

        With ``render_mode="human"`` the image is shown in the window and None is returned, as without a render mode.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' or 'human' in gymnasium.make")
            return None
        if self._renderer is None:
            from softgym_envs.backends.fem import FEMBackend
            from softgym_envs.viewer.image import ImageRenderer

            source = self.backend if isinstance(self.backend, FEMBackend) else None
            window = self.render_mode == "human"
            self._renderer = ImageRenderer(self.robot, self.render_size, window=window, source=source)
        state = self.backend.state
        distance = float(self.task.distance(self.task.measure(state), self.goal))
        scale = self.task.distance_scale
        text = f"{scale.name} {scale.text(distance)}"
        path, goal = self.task.drawn_goals(state, self.path, self.goal)
        image = self._renderer.render(self.backend.design, state, path, goal, text=text)
        return None if self.render_mode == "human" else image

    def close(self) -> None:
        """Free the renderer, and what the backend holds."""
        self.backend.close()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _option_texts(robot: Robot, task: Task) -> dict[str, str]:
    """Return what a new robot and task were made with, as texts that can be compared; what has none is left out."""
    try:
        values = {f"robot with {name}": value for name, value in robot.mechanics_key.items()}
    except TypeError:  # an option that cannot be stored
        values = {}
    values |= {f"task with {name}": value for name, value in vars(task).items() if not name.startswith("_")}
    texts = {}
    for name, value in values.items():
        try:
            texts[name] = json.dumps(value, default=lambda array: array.tolist())
        except (AttributeError, TypeError, ValueError):
            continue
    return texts


# Values of ``info`` get a dtype, which TorchRL reads. Gymnasium batches arrays of booleans, but not NumPy's boolean
# scalars.
_TYPED: dict[type, Callable[[Any], Any]] = {bool: np.array, np.bool_: np.array, int: np.int64, float: np.float64}

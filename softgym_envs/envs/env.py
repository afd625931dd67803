"""SoftRobotEnv: a robot, a task and a backend behind Gymnasium's interface."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from math import prod
from numbers import Integral
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import EzPickle

from softgym_envs.backends.backend import Backend, Snapshot, State
from softgym_envs.backends.registry import make_backend
from softgym_envs.designs import Design
from softgym_envs.envs.options import EnvironmentOptions, check_reset_options, set_up
from softgym_envs.envs.plant import Plant, Sensed, sensed, stiffened
from softgym_envs.envs.spaces import squash
from softgym_envs.envs.tasks.base import check_drawn
from softgym_envs.errors import ConvergenceError, InfeasibleDesign

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource
    from softgym_envs.envs.tasks.base import Task
    from softgym_envs.robots.base import Robot

MAX_DRAWS = 100
"""Number of infeasible bodies that are drawn in turn before `reset` gives up."""


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
        sent: commands that have not arrived at the drives yet, the oldest first, shape (delay, n_a).
        sensed: what the sensors show.
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
        setup = set_up(robot, task, backend, checked)
        self.robot, self.task = setup.robot, setup.task
        self._made = _option_texts(self.robot, self.task)
        self.design_space = self.robot.design_space
        self._fixed_design, self._sampled = setup.design, setup.sampled
        self.backend: Backend = make_backend(
            setup.backend, self.robot, design=self._fixed_design, **setup.backend_options
        )
        takes = self.backend.takes_force or not self.task.pushes
        if not takes or (self.task.touches and not self.backend.takes_touch):
            raise ValueError(
                f"task '{self.task.name}' pushes the robot, but backend '{setup.backend}' takes no forces; "
                "allowed: 'fem'"
            )
        self.spaces = setup.spaces(moving=self.backend.moving)
        self.action_space = self.spaces.action_space
        self.observation_space = self.spaces.observation_space
        self._plants = setup.plants
        stretch = np.atleast_1d(self.backend.cable_compliance)
        own = Plant(
            cable_friction=self.backend.cable_friction,
            cable_compliance=tuple(map(float, stretch)) if stretch.any() else 0.0,
        )
        self._fixed_plant = self.plant = own  # unless there are `_plants`
        self._sent = np.zeros((0, len(self.robot.actuators)))
        self._sensed: Sensed | None = None
        self._renderer: Any = None
        self._path = np.zeros((1, 3))
        self._observe_design(self._fixed_design)
        self._step = 0

    @property
    def design(self) -> Design:
        """The present body."""
        return self.backend.design

    @property
    def state(self) -> State:
        """The present mechanical state of the plant, without noise of sensors."""
        return stiffened(self.backend.state, self.plant.stiffness)

    @property
    def command(self) -> np.ndarray:
        """The command that was sent last, shape (n_a,); with a delay it has not arrived yet."""
        return self._sent[-1] if len(self._sent) else self.backend.state.command

    @property
    def sensed(self) -> Sensed:
        """What the sensors show of the present state."""
        state = self.state
        return self._sensed or Sensed(
            state.displacement, state.effort, self.task.measure(state), self.task.sensor_readings(state)
        )

    @property
    def goal(self) -> np.ndarray:
        """The goal that the present state is rated by [m, or the unit of the task's goals], shape (3,)."""
        return self._goal_at(self._step)

    @property
    def observed_goal(self) -> np.ndarray:
        """The goal that the observation shows, ``task.lookahead`` steps ahead of `goal`, shape (3,)."""
        return self._goal_at(self._step + self.task.lookahead)

    def _goal_at(self, step: int) -> np.ndarray:
        return self.task.goals(self._path[None], np.array([len(self._path)]), np.array([step]))[0]

    @property
    def steps(self) -> int:
        """Steps of the present episode so far."""
        return self._step

    @property
    def path(self) -> np.ndarray:
        """All goals of the episode [m, or the unit of the task's goals], shape (p, 3)."""
        return self._path

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
        path = None if goal is None else self.task.check_paths(goal)
        if given is None and self._sampled:
            design = self._draw_body()
        else:
            design = self._fixed_design if given is None else self.design_space.complete(given, self._fixed_design)
            self.backend.reset(design)
        self._begin_plant()
        self._observe_design(design)
        if path is None:
            path = check_drawn(self.task, self.task.sample(self.np_random, 1, self._kinematics), 1)[0]
        self._path = path
        self.task.begin(self.np_random)
        self._step = 0
        if self.render_mode == "human":
            self.render()
        observation, _, info = self._observe()
        return observation, info

    def _begin_plant(self) -> None:
        """Choose the plant of an episode, at rest."""
        self.plant = self._fixed_plant if self._plants is None else self._plants.sample(self.np_random)
        # The commands that have not arrived yet; and the last one, if the drives did something else.
        kept = self.plant.delay + (not self.plant.drives_exactly)
        self._sent = np.zeros((kept, len(self.robot.actuators)))
        self._sensed = None
        self.backend.cable_friction = self.plant.cable_friction
        self.backend.cable_compliance = self.plant.cable_compliance

    def _observe_design(self, design: Design) -> None:
        self._unit_design = self.design_space.observe(design.array, self.spaces.design_names)

    def get_state(self) -> EpisodeState:
        """Return the present moment of the episode, for `set_state`.

        Wrappers count steps for themselves: a time limit goes on counting after `set_state`.
        """
        return EpisodeState(
            robot=self.robot.name,
            task=self.task.name,
            options=self._made,
            physics=self.backend.snapshot(),
            path=self._path.copy(),
            step=self._step,
            progress=copy.deepcopy({name: value for name, value in vars(self.task).items() if name != "robot"}),
            random=None if self._np_random is None else self._np_random.bit_generator.state,
            plant=self.plant,
            sent=self._sent.copy(),
            sensed=self._sensed,
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
        self.backend.cable_friction = state.plant.cable_friction
        self.backend.cable_compliance = state.plant.cable_compliance
        self.backend.resume(state.physics)
        self.plant, self._sent, self._sensed = state.plant, state.sent.copy(), state.sensed
        self._observe_design(self.backend.design)
        vars(self.task).update(copy.deepcopy(state.progress))
        self._path, self._step = state.path.copy(), state.step
        if state.random is not None:
            self.np_random.bit_generator.state = state.random
        observation, _, info = self._observe(sense=False)
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

    def _draw_body(self) -> Design:
        """Draw the sampled variables and go to the rest state of that body; bodies that cannot exist are drawn again.

        Raises:
            InfeasibleDesign: if `MAX_DRAWS` bodies in turn cannot exist.
        """
        for attempt in range(MAX_DRAWS):
            drawn = self.design_space.sample(self.np_random, self._sampled)
            design = self.design_space.complete({name: drawn[name] for name in self._sampled}, self._fixed_design)
            try:
                self.backend.reset(design)
            except InfeasibleDesign:
                if attempt == MAX_DRAWS - 1:
                    raise
            else:
                break
        return design

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
        command = self.spaces.command(action, self.command)
        if len(self._sent):
            waiting = np.vstack([self._sent, command])
            command, self._sent = waiting[-1 - self.plant.delay], waiting[1:]
        command = self.plant.drive(command, self.backend.state.command)
        converged = True
        if self.task.touches:
            self.backend.touch(self.plant.equivalent_model_force(self.task.touch(self._step)))
        push = self.task.push(self._step)
        try:
            self.backend.step(command, force=None if push is None else push / self.plant.stiffness)
        except ConvergenceError:
            converged = False
        self._step += 1
        if self.render_mode == "human":
            self.render()
        observation, reward, info = self._observe(converged)
        return observation, reward, bool(info["is_failed"]), not converged, info

    def _observe(self, converged: bool = True, *, sense: bool = True) -> tuple[np.ndarray, float, dict[str, Any]]:
        """Return observation, reward and info of the present state; with ``sense``, the sensors are read anew."""
        state, goal = self.state, self.goal
        measured = self.task.measure(state)
        true = Sensed(state.displacement, state.effort, measured, self.task.sensor_readings(state))
        if sense and self.plant.noise:
            self._sensed = sensed(self.robot, true, self.plant.noise, self.np_random, self.task.measured_scale)
        distance, terms, _ = self.task.rate(measured, goal, self.spaces.effort_share(state.effort))
        terms |= self.task.state_terms(state)
        reward = float(prod(terms.values())) if converged else 0.0
        info = {
            "measured": measured.copy(),
            "goal": goal.copy(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            "is_failed": self.task.is_failed(state),
            **{f"reward_{name}": term for name, term in terms.items()},
            "converged": converged,
            **_mechanics(state),
        }
        if self._plants is not None:
            for name, value in asdict(self.plant).items():
                info[f"plant_{name}"] = np.array(value) if isinstance(value, tuple) else value
        velocity = state.velocity[0] if self.spaces.moving else None
        shown = self._sensed or true
        sensors = self._sensor_values(squash(shown.sensors), sense) if self.task.sensors else None
        observation = self.spaces.observe(
            self.command,
            shown.displacement,
            shown.effort,
            shown.effector,
            self.observed_goal,
            self._unit_design,
            velocity,
            sensors,
        )
        return observation, reward, {name: _with_dtype(value) for name, value in info.items()}

    def _sensor_values(self, readings: np.ndarray, new: bool) -> np.ndarray:
        """Return the sensor values of an observation for readings in [-1, 1] (s,): these, touch, earlier readings."""
        command = (self.command - self.spaces.middle) / self.spaces.half_range
        earlier = self.task.past_readings(np.concatenate([command, readings]), new)
        return np.concatenate([readings, self.task.touch_readings(), earlier])

    def _kinematics(self, commands: np.ndarray) -> np.ndarray:
        """Return the effectors [m] (1, 3) that commands (1, n_a) lead to; NaN without an equilibrium."""
        try:
            return self.backend.probe(commands[0]).effector[:1]
        except ConvergenceError:
            return np.full((1, 3), np.nan)

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
        path, goal = self.task.drawn_goals(state, self._path, self.goal)
        image = self._renderer.render(self.backend.design, state, path, goal, text=text)
        return None if self.render_mode == "human" else image

    def close(self) -> None:
        """Free the renderer."""
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


def _mechanics(state: State) -> dict[str, Any]:
    """Return what ``info`` says of a mechanical state."""
    info: dict[str, Any] = {
        "effector": state.effector[0].copy(),
        "displacement": state.displacement.copy(),
        "effort": state.effort.copy(),
        "stable": state.stable,
        "uncertainty": state.uncertainty,
        "trusted": state.trusted,
        "distrust": state.distrust,
    }
    if state.contacts is not None:
        contacts = state.contacts
        info |= {
            "contact_force": contacts.total,
            "smallest_gap": contacts.smallest_gap,
            "sliding": contacts.sliding.mean() if contacts.count else 0.0,
        }
    return info


# Gymnasium batches arrays of booleans, but not NumPy's boolean scalars.
_TYPED: dict[type, Callable[[Any], Any]] = {bool: np.array, np.bool_: np.array, int: np.int64, float: np.float64}


def _with_dtype(value: Any) -> Any:
    """Return a value of ``info`` with a dtype, which TorchRL reads."""
    typed = _TYPED.get(type(value))
    return value if typed is None else typed(value)

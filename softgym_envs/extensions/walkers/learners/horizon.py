"""Analytic policy gradient over a short horizon of a motion (model-based): gaits with feedback.

The policy acts in the environment, whose motion is recorded (`softgym_envs.extensions.beams.recorder`). Behind each
window of control steps, the derivative of the way ahead in that window goes back through contact and friction to all
commands, and from there into the weights. What the robot will gain after the window is estimated from where it faces
then: the closer to its heading, the more. There is no critic and no exploration noise.

The derivative leaves out how the policy reacts to states of the body that its commands change; it contains how it
reacts to commands, which it observes too. Where no command can be improved, it vanishes as the whole one does. Compare
Xu et al., Accelerated policy learning with parallel differentiable simulation, 2022, who learn a critic in place of the
estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from softgym_envs.agents.config import TrainConfig
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.beams.recorder import recording
from softgym_envs.extensions.learners.network import NetworkLearner, RateConfig
from softgym_envs.extensions.walkers.learners.gait import (
    TIGHTNESS,
    check_compiled,
    command_gradient,
    resampled_gait,
    shift_of_sides,
)
from softgym_envs.extensions.walkers.tasks.locomotion import Locomotion, Pose

if TYPE_CHECKING:
    import torch


class HorizonConfig(RateConfig):
    """Hyperparameters of the analytic policy gradient over a short horizon."""

    learning_rate: float = Field(default=0.1, gt=0)
    final_learning_rate: float = Field(default=0.01, gt=0, description="reached linearly at the last step")
    horizon: int = Field(default=20, gt=1, description="control steps of a window")
    period: int = Field(default=10, gt=1, description="control steps of the gait")
    facing: float = Field(
        default=1.0,
        ge=0,
        description="way that a robot is expected to make after the window if it looks along its heading [its sizes]",
    )


class Window(NamedTuple):
    """What happened in a window of one environment, and how it could be better.

    Attributes:
        observations: before each step, shape (h, d).
        phases: steps of the gait, shape (h,).
        by_command: derivative of what is gained [sizes of the robot] by the commands in half ranges, shape (h, n_a).
    """

    observations: np.ndarray
    phases: np.ndarray
    by_command: np.ndarray


class HorizonLearner(NetworkLearner):
    """A gait whose commands follow how the body stands and moves, by weights of their own in each step of its period.

    It begins as the reference gait of the robot, or as one that was trained, without feedback. Where the robot has two
    equal sides that do the same in that gait, at once or in turns, these do the same in mirrored states.

    Args:
        config: configuration of the training.

    Raises:
        ValueError: for a task without a heading, for drawn bodies, or without motion on finite elements in compiled
            code.
    """

    Config = HorizonConfig
    title = "analytic gradient, short horizon"
    model_based = True

    def __init__(self, config: TrainConfig) -> None:
        import torch

        super().__init__(config)
        self._envs: list[Any] = [config.environment.make().unwrapped for _ in range(config.num_envs)]
        first, period = self._envs[0], config.settings.period
        check_compiled(config, first.backend)
        if not isinstance(first.task, Locomotion):
            raise ValueError(f"learner 'horizon' needs a task with a heading, got task '{first.task.name}'")
        robot, spaces = first.robot, first.spaces
        self._half, self._middle, self._size = spaces.half_range, spaces.middle, robot.size
        self._rates = torch.tensor(robot.rates / self._half)
        self._range = [torch.tensor((end - self._middle) / self._half) for end in (robot.lower, robot.upper)]
        gain = torch.tensor(TIGHTNESS * self._half / robot.rates, dtype=torch.float32)
        n, d = len(gain), spaces.observation_space.shape[0]
        self._command = spaces.slices["command"]
        # An action pulls a command towards that of the gait.
        self._pull = torch.zeros(n, d)
        self._pull[:, self._command] = -torch.diag(gain)
        gait = resampled_gait(robot, period)
        self._clock = torch.nn.Parameter(torch.tensor(gait, dtype=torch.float32) * gain)
        shown = first.task.sensors
        assert isinstance(shown, Pose)
        begin, self._signs = spaces.slices["sensors"].start, shown.signs
        self._body = slice(begin, begin + len(shown.signs))
        self._gains = torch.nn.Parameter(torch.zeros(period, n, len(shown.signs)))
        self._shift = shift_of_sides(robot, gait)
        self._mirror = None if self._shift is None else self._mirrored(first)
        self._begin({"actor.clock": self._clock, "actor.gains": self._gains}, config.settings)

    def _mirrored(self, env: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return which observation is that of the mirrored state, and with which sign, each of shape (d,)."""
        other, slices, after = np.array(env.robot.mirrored_actuators), env.spaces.slices, self._body.stop
        order, signs = np.arange(env.observation_space.shape[0]), np.ones(env.observation_space.shape[0])
        order[self._command] = self._command.start + other
        order[after : slices["sensors"].stop] = after + other  # efforts
        signs[self._body] = self._signs
        signs[slices["goal"].start + 1] = -1.0
        return order, signs

    def weights(self) -> dict[str, np.ndarray]:
        found = super().weights()
        gains = np.zeros((*self._gains.shape[:2], self._pull.shape[1]), dtype=np.float32)
        gains[..., self._body] = found["actor.gains"]
        return {
            "actor.clock": found["actor.clock"],
            "actor.gains": gains,
            "actor.mu.weight": self._pull.numpy().copy(),
            "actor.mu.bias": np.zeros(len(self._pull), dtype=np.float32),
        }

    def _act(self, observation: torch.Tensor, phase: Any) -> torch.Tensor:
        """Return actions (..., n_a) for observations (..., d) at steps (...) of the gait."""
        import torch

        follow = (self._gains[phase] @ observation[..., self._body, None])[..., 0]
        return torch.tanh(observation @ self._pull.T + self._clock[phase] + follow)

    def learn(self, target: int, progress: Callable[[int], object]) -> None:
        rng = np.random.default_rng([self.config.seed, self.step])
        count, horizon = len(self._envs), self.config.settings.horizon
        limit = self._envs[0].task.max_episode_steps
        seen: list[Any] = [env.reset(seed=int(rng.integers(2**31)))[0] for env in self._envs]
        # The first episodes end at different times, so that later windows are of all ages.
        ends = [limit * (i + 1) // count for i in range(count)]
        while self.step < target:
            self._set_learning_rate()
            windows = []
            for i, env in enumerate(self._envs):
                if seen[i] is None or env.steps + horizon > ends[i]:
                    seen[i], ends[i] = env.reset()[0], limit
                seen[i], window = self._window(env, seen[i])
                if window is not None:
                    windows += [window] if self._mirror is None else [window, self._reflected(window)]
            self.step += count * horizon
            progress(count * horizon)
            if windows:
                self.descend(self._loss(windows))

    def _reflected(self, window: Window) -> Window:
        """Return the window of a robot that does the same on the other side."""
        assert self._mirror is not None and self._shift is not None
        order, signs = self._mirror
        other = list(self._envs[0].robot.mirrored_actuators)
        return Window(
            (signs * window.observations[:, order]).astype(np.float32),
            (window.phases + self._shift) % self.config.settings.period,
            window.by_command[:, other],
        )

    def _window(self, env: Any, observation: np.ndarray) -> tuple[np.ndarray | None, Window | None]:
        """Let the policy act in a window.

        Returns:
            The next observation, None after a step that could not be computed; and the window, None where compiled code
            alone cannot compute it.
        """
        import torch

        settings, task, backend, row = self.config.settings, env.task, env.backend, env.robot.body_frame
        observations, phases = [], []
        places, directions = [env.state.nodes[row].copy()], []
        with recording(backend) as recorder:
            for _ in range(settings.horizon):
                observations.append(observation)
                phases.append(env.steps % settings.period)
                with torch.no_grad():
                    action = self._act(torch.from_numpy(observation), phases[-1]).numpy()
                observation, _, _, lost, _ = env.step(action)
                if lost:
                    return None, None
                directions.append(task.turn_to()[0])
                places.append(env.state.nodes[row].copy())
        ahead, parts = task.turn_to(task.lookahead)[0], backend.steps.count
        try:
            rollout = recorder.rollout()
            by_x = np.zeros_like(rollout.x)
            for k, along in enumerate(directions):
                left = np.array([-along[1], along[0], 0.0])
                across = left @ (places[k + 1] - places[k])
                by_way = (along - task.charges["drift"] * np.sign(across) * left) / self._size
                by_x[(k + 1) * parts - 1, row] += by_way
                if k:
                    by_x[k * parts - 1, row] -= by_way
            by_x[-1, row + 1] += settings.facing * ahead
            by_command = command_gradient(rollout.gradient(by_x=by_x).commands, parts)
        except ConvergenceError:
            return observation, None
        return observation, Window(np.array(observations), np.array(phases), by_command * self._half)

    def _loss(self, windows: list[Window]) -> torch.Tensor:
        """Return a number whose derivative in the weights is that of what windows gain on average, with a minus."""
        import torch

        seen, phases, by_command = (torch.from_numpy(np.stack(part)) for part in zip(*windows, strict=True))
        command, gained = seen[:, 0, self._command].double(), torch.zeros((), dtype=torch.float64)
        for k in range(seen.shape[1]):
            observation = torch.cat([command.float(), seen[:, k, self._command.stop :]], dim=1)
            command = (command + self._rates * self._act(observation, phases[:, k])).clamp(*self._range)
            gained = gained + (by_command[:, k] * command).sum()
        return -gained / len(windows)

    def load_weights(self, tensors: Mapping[str, np.ndarray], path: Path) -> None:
        import torch

        # A gait without feedback may be the start.
        none = np.zeros((*self._gains.shape[:2], self._pull.shape[1]), dtype=np.float32)
        gains = tensors.get("actor.gains", none)[..., self._body]
        super().load_weights({**tensors, "actor.gains": gains}, path)
        self._pull = torch.from_numpy(tensors["actor.mu.weight"].copy())

    def close(self) -> None:
        for env in self._envs:
            env.close()

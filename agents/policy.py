"""Trained policies: files in safetensors and JSON, evaluated without torch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.config import check_config
from softgym_envs.envs.options import design_names
from softgym_envs.errors import ConfigError, DataError, WeightsError, unknown_name
from softgym_envs.registry import class_path
from softgym_envs.storage import atomic_write, hash_of, read_json, write_json

FORMAT = 1

POLICY_FILE = "the folder of a training, a policy file (.safetensors)"
"""What may be given instead of the name of a shipped policy, for messages."""
_SHIPPED = Path(__file__).parent / "weights"


def policy_path(policy: str | Path) -> Path:
    """Return the file of a policy, given its path, the folder of its training, or its name in ``agents/weights``.

    Raises:
        WeightsError: if there is no such file or shipped policy.
    """
    path = Path(policy)
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise WeightsError(f"policy '{path}' does not exist; train one with 'softgym train'")
        return path
    folder = _SHIPPED / path if str(policy) in shipped_policies() else path
    if not (folder / "policy.safetensors").is_file():
        raise WeightsError(unknown_name("policy", str(policy), shipped_policies(), other=POLICY_FILE))
    return folder / "policy.safetensors"


def shipped_policies() -> list[str]:
    """Return the names of the policies that ship with the package."""
    return sorted(path.parent.name for path in _SHIPPED.glob("*/policy.safetensors"))


def save_policy(path: Path, tensors: dict[str, np.ndarray], card: dict[str, Any]) -> None:
    """Write ``policy.safetensors`` and its JSON card next to it; the card's ``config`` is that of the training."""
    from safetensors.numpy import save

    with atomic_write(path) as stream:
        stream.write(save({k: np.ascontiguousarray(v) for k, v in tensors.items()}))
    write_json(path.with_suffix(".json"), {"format": FORMAT, **card, "sha256": hash_of(path)})


def read_tensors(path: str | Path) -> dict[str, np.ndarray]:
    """Read a safetensors file.

    Raises:
        WeightsError: if it is missing, damaged or truncated.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = Path(path)
    try:
        return load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"policy '{path}' is damaged or truncated: {error}") from None


Layer = tuple[np.ndarray, np.ndarray]
"""Weights (inputs, outputs) and biases (outputs,)."""


def remember(memory: np.ndarray, observation: np.ndarray, read: Layer, recall: Layer) -> np.ndarray:
    """Return the next memory (..., h) of a gated recurrent unit (Cho et al. 2014, with the gates of cuDNN).

    Args:
        memory: the last memory, shape (..., h).
        observation: shape (..., d).
        read: weights (d, 3 h) and biases (3 h,) of reset gate, update gate and proposal, for the observation.
        recall: weights (h, 3 h) and biases (3 h,) of the same for the memory.
    """
    seen, kept = observation @ read[0] + read[1], memory @ recall[0] + recall[1]
    h = memory.shape[-1]
    reset, update = (0.5 * (1.0 + np.tanh(0.5 * (seen + kept)[..., k * h : (k + 1) * h])) for k in (0, 1))
    proposal = np.tanh(seen[..., 2 * h :] + reset * kept[..., 2 * h :])
    return proposal + update * (memory - proposal)


def memory_layers(tensors: Mapping[str, np.ndarray]) -> tuple[Layer, Layer]:
    """Return the weights and biases that `remember` takes, for observation and memory, from those of an actor."""
    read, recall = ((tensors[f"actor.memory.weight_{s}"].T, tensors[f"actor.memory.bias_{s}"]) for s in ("ih", "hh"))
    return read, recall


class Policy:
    """Policy that takes the mean action of a trained actor, which may have a memory or a clock.

    Args:
        path: ``policy.safetensors``, with its card next to it, or the name of a shipped policy.

    Attributes:
        path: file of the policy.
        card: JSON card of the policy.
        environment: the environment of its training.
        hidden: weights (d, w) and biases (w,) of each hidden layer.
        memory: weights of a gated recurrent unit in place of hidden layers, see `remember`; None without.
        clock: further biases of the last layer in the steps of a period, shape (p, n_a); None without.
        gains: what observations add to these, shape (p, n_a, d); None without.
        mean: weights and biases of the last layer.
        observation_size: number of inputs.

    Raises:
        WeightsError: if a file is missing, damaged or of another version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = policy_path(path)
        tensors = read_tensors(self.path)
        card = self.path.with_suffix(".json")
        try:
            self.card = read_json(card)
        except DataError as error:
            raise WeightsError(f"policy card {error}") from None
        if not isinstance(self.card, dict) or self.card.get("format") != FORMAT:
            raise WeightsError(f"policy card '{card}' must have format {FORMAT}")
        config = self.card.get("config")
        if not isinstance(config, dict) or not isinstance(config.get("environment"), dict):
            raise WeightsError(f"policy card '{card}' lacks config.environment, the environment of the training")
        try:
            self.environment = check_config(EnvironmentConfig, config["environment"], f"policy card '{card}'")
        except ConfigError as error:
            raise WeightsError(str(error)) from None
        if self.card.get("sha256") != hash_of(self.path):
            raise WeightsError(f"policy '{self.path}' is damaged, or not that of the card beside it")
        try:
            self.hidden: list[Layer] = []
            self.memory: tuple[Layer, Layer] | None = None
            if "actor.memory.weight_ih" in tensors:
                self.memory = memory_layers(tensors)
            k = 0
            while f"actor.latent_pi.{k}.weight" in tensors:
                self.hidden.append((tensors[f"actor.latent_pi.{k}.weight"].T, tensors[f"actor.latent_pi.{k}.bias"]))
                k += 2  # activations sit between the linear layers
            self.mean = tensors["actor.mu.weight"].T, tensors["actor.mu.bias"]
            self.clock: np.ndarray | None = tensors.get("actor.clock")
            self.gains: np.ndarray | None = tensors.get("actor.gains")
        except KeyError as error:
            raise WeightsError(f"policy '{self.path}' lacks tensor {error}") from None
        first = self.memory[0] if self.memory else self.hidden[0] if self.hidden else self.mean
        self.observation_size = int(first[0].shape[0])

    @property
    def remembers(self) -> bool:
        """Whether actions depend on more than the present observation."""
        return self.memory is not None or self.clock is not None

    @property
    def widths(self) -> list[int]:
        """Widths of the hidden layers."""
        return [weight.shape[1] for weight, _ in self.hidden]

    def check_environment(self, environment: EnvironmentConfig, *, any_task: bool = False) -> None:
        """Refuse an environment in which observations or actions have another meaning than in training.

        Backend, body, goals and ID may differ if robot and task are the same.

        Args:
            environment: the environment.
            any_task: allow another task with goals and sensors of the same kind, as the start of a training does.

        Raises:
            ConfigError: with the key, its value and the policy's value.
        """
        own = _meaning(self.environment, any_task)
        for key, (meaning, shown) in _meaning(environment, any_task).items():
            if meaning != own[key][0]:
                name = "robot" if key == "id" and environment.id is None else key
                raise ConfigError(
                    f"environment.{name} = {shown} does not fit policy '{self.path}', which was trained with "
                    f"{own[key][1]}; allowed: that, or another policy"
                )

    def begin(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function like `__call__` for one episode, or a batch of episodes that begin together."""
        if self.clock is not None:
            phases, gains = itertools.cycle(range(len(self.clock))), self.gains
            biases = self.clock

            def step(observation: np.ndarray) -> np.ndarray:
                k, last = next(phases), self._last(observation)
                return np.tanh(last + biases[k] + (0.0 if gains is None else observation @ gains[k].T))

            return step
        if self.memory is None:
            return self
        read, recall = self.memory
        memory = np.zeros(len(recall[0]), dtype=np.float32)

        def act(observation: np.ndarray) -> np.ndarray:
            nonlocal memory
            x = self._checked(observation)
            memory = remember(np.broadcast_to(memory, (*x.shape[:-1], memory.shape[-1])), x, read, recall)
            return np.tanh(memory @ self.mean[0] + self.mean[1])

        return act

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., n_a) in [-1, 1] for observations (..., d).

        Raises:
            ValueError: for observations of another size than the policy was trained on, and for one that `remembers`,
                whose actions depend on the episode: use `begin`.
        """
        if self.remembers:
            raise ValueError(f"policy '{self.path.name}' has a memory: call what begin() returns, in each episode")
        return np.tanh(self._last(observation))

    def _last(self, observation: np.ndarray) -> np.ndarray:
        """Return what the last layer makes of observations (..., d), shape (..., n_a)."""
        x = self._checked(observation)
        for weight, bias in self.hidden:
            x = np.maximum(x @ weight + bias, 0.0)
        return x @ self.mean[0] + self.mean[1]

    def _checked(self, observation: np.ndarray) -> np.ndarray:
        x = np.asarray(observation, dtype=np.float32)
        if x.shape[-1] != self.observation_size:
            raise ValueError(
                f"policy '{self.path.name}' takes observations of size {self.observation_size}, got {x.shape[-1]}: "
                "was it trained with another design_in_observation or number of cables?"
            )
        return x


def _meaning(environment: EnvironmentConfig, any_task: bool) -> dict[str, tuple[Any, object]]:
    """Return what defines observations and actions: for each key, the value to compare and the text for a message."""
    row, robot = environment.row, environment.make_robot()
    shown = design_names(robot.design_space, environment.design_in_observation, "design_in_observation")
    variables = [robot.design_space[name] for name in shown]
    task = environment.make_task(robot)
    # Goals of other tasks are read alike if they have the same unit and scales.
    sensors = None if task.sensors is None else task.sensors.count
    kind: object = (task.distance_scale.goal_unit, sensors, task.goal_scale, task.error_scale)
    lookahead = 0 if any_task else task.lookahead
    scales = (
        [(actuator.name, actuator.low, actuator.high, actuator.rate) for actuator in robot.actuators],
        (robot.size, robot.workspace_scale, robot.effort_scale.tolist()),
        [(variable.low, variable.high, variable.log, variable.choices) for variable in variables],
    )
    return {
        "id": (
            (class_path(type(robot)), kind if any_task else class_path(environment.task_class)),
            f"{environment.title} (robot {row.robot}, task {row.task})",
        ),
        "residual_scale": (environment.residual_scale, environment.residual_scale),
        "residual_on": (environment.residual_on, environment.residual_on),
        "action_mode": (environment.action_mode, environment.action_mode),
        "design_in_observation": (shown, list(shown)),
        "robot_options": (scales, environment.robot_options),
        "task_options.lookahead": (lookahead, lookahead),
    }

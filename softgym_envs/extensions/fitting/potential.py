"""Training of the potential networks, with what the table of networks expects: ``Model``, ``Options``, ``train``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from softgym_envs.executors import parallel_map
from softgym_envs.extensions.fitting.data.states import States
from softgym_envs.extensions.fitting.trainer import History, Trainer, TrainingOptions
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.potential.model import Model as Model

if TYPE_CHECKING:
    from torch import Tensor

    from softgym_envs.extensions.fitting.torch_potential import PotentialNet


class Options(TrainingOptions):
    """Hyper-parameters of the potential network.

    Attributes:
        kind: names this network.
        width: hidden units of the layers of the actuation.
        body_width: hidden units of the layers of the design.
        members: of the ensemble.
        sensor_weight: of the squared errors of sensor rows, relative to those of effectors.
        command_weight: of the squared errors of effectors at equal commands (see `potential_loss`), which slack cables
            make larger than those at equal displacements.
    """

    kind: Literal["potential"] = "potential"
    width: int = Field(default=64, gt=0)
    body_width: int = Field(default=64, gt=0)
    members: int = Field(default=5, gt=0)
    sensor_weight: float = Field(default=1.0, gt=0.0)
    command_weight: float = Field(default=0.0, ge=0.0)


def train(
    robot: Robot,
    training: States,
    validation: States,
    trainer: Trainer,
    start: Mapping[str, np.ndarray] | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, History]]:
    """Train the members, ``trainer.workers`` at a time: on the same data, each with its own seed and order of batches.

    A process that trains a member uses one thread, so the weights do not depend on the number of workers.

    Args:
        robot: the robot of the states.
        training: states to learn.
        validation: states that choose the best step.
        trainer: hyper-parameters, seed and folder.
        start: weights of `Model` to start from, learned on other states of the same inputs; default random ones.

    Returns:
        The weights of `Model`, and the history of each member.
    """
    options: Options = trainer.options
    scales = _scales(robot, training)
    states: list[Any] = [None] * options.members
    if start is not None:
        # Energies and held compliances keep their order of magnitude when the stiffness changes, effectors their value.
        states, old = unstack_members(start)
        scales |= {name: old[name] for name in ("effector_mean", "effector")}
    data = make_targets(robot, training, scales), make_targets(robot, validation, scales)
    rest = None
    if training.unloaded:
        middle = 0.5 * (robot.upper + robot.lower)
        rest = (0.0 - middle) / (robot.upper - middle)
    weights = np.ones(training.effector.shape[1], dtype=np.float32)
    weights[len(weights) - len(robot.sensing.scale) :] = options.sensor_weight
    shared = data, rest, robot.learning.convex, weights / weights.mean()
    arguments = [(trainer, member, *shared, states[member]) for member in range(options.members)]
    found = sorted(parallel_map(_train_member, arguments, trainer.workers), key=lambda result: result[0])
    return stack_members([state for _, state, _ in found], scales), {f"member {k}": rows for k, _, rows in found}


def _train_member(
    trainer: Trainer,
    member: int,
    data: tuple[Targets, Targets],
    rest: np.ndarray | None,
    convex: bool,
    weights: np.ndarray,
    start: dict[str, np.ndarray] | None,
) -> tuple[int, dict[str, np.ndarray], History]:
    """Train one member; return its number, weights and history."""
    import torch

    from softgym_envs.extensions.fitting.torch_potential import PotentialNet

    torch.set_num_threads(1)
    options: Options = trainer.options
    seed = trainer.seed + 1000 * member
    torch.manual_seed(seed)
    training, validation = data
    sizes = (training.effort.shape[1], training.effector.shape[1], training.design.shape[1])
    net = PotentialNet(*sizes, options.width, options.body_width, rest, convex=convex)
    if start is not None:
        net.load_state_dict({k: torch.tensor(v) for k, v in start.items()})
    effort_spread, row_weights = training.effort_spread, torch.as_tensor(weights)

    def loss(rows: Tensor | None) -> Tensor:
        batch = validation if rows is None else training.rows(rows)
        return potential_loss(net, batch, effort_spread, row_weights, options.command_weight)

    history = trainer.optimise(f"member {member}", net, loss, len(training.design), seed=seed)
    return member, {k: v.detach().numpy().copy() for k, v in net.state_dict().items()}, history


def stack_members(states: list[dict[str, np.ndarray]], scales: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the weights of `Model` from the states of its members in torch."""
    tensors = {k: states[0][k] if k == "rest" else np.stack([state[k] for state in states]) for k in states[0]}
    return tensors | {f"scale.{k}": v for k, v in scales.items()}


def unstack_members(tensors: Mapping[str, np.ndarray]) -> tuple[list[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Return the states of the members in torch and the scales: the inverse of `stack_members`."""
    scales = {k.removeprefix("scale."): np.asarray(v) for k, v in tensors.items() if k.startswith("scale.")}
    weights = {k: v for k, v in tensors.items() if not k.startswith("scale.")}
    members = range(len(tensors["energy1"]))
    return [{k: v if k == "rest" else v[member] for k, v in weights.items()} for member in members], scales


def _scales(robot: Robot, states: States) -> dict[str, np.ndarray]:
    """Scales that make energy, effector and held compliance of order one."""
    n = states.effort.shape[1]
    half = 0.5 * (robot.upper - robot.lower)
    K = np.linalg.inv(states.W[:, :n, :n])
    return {
        "energy": np.array(np.median(np.einsum("bii->bi", K) * half**2)),
        "effector_mean": states.effector.mean(axis=0),
        "effector": np.array(max(float(states.effector.std(axis=0).max()), 1e-9)),
        "held": np.array(np.median(np.einsum("bii->bi", states.W[:, n:, n:]))),
    }


class Targets(NamedTuple):
    """Scaled inputs and targets of a network, one row per state, in single precision.

    Attributes:
        design: features of the design, shape (N, d).
        actuation: shape (N, n).
        effort: shape (N, n).
        effector: shape (N, e).
        metric: factor of W_aa in which efforts and Hessians are measured, shape (N, n, n); for robots whose W_aa may
            have any sign, that of the body at rest.
        hessian: of the energy, in this metric, shape (N, n, n).
        jacobian: of the effector, shape (N, e, n).
        whitening: metric of the held compliance, shape (N, e, e).
        held: held compliance, shape (N, e, e).
        sliding: how far the effector moves per effort on slack actuators while the others are held, shape (N, e, n);
            zero for taut ones.
    """

    design: Tensor
    actuation: Tensor
    effort: Tensor
    effector: Tensor
    metric: Tensor
    hessian: Tensor
    jacobian: Tensor
    whitening: Tensor
    held: Tensor
    sliding: Tensor

    def rows(self, index: Tensor) -> Targets:
        """Return some of the rows."""
        return Targets(*(part[index] for part in self))

    @property
    def effort_spread(self) -> float:
        """Mean square of the efforts in their metric, by which their errors are divided."""
        return float(((self.metric.mT @ self.effort[:, :, None]) ** 2).mean())


def make_targets(robot: Robot, states: States, scales: dict[str, np.ndarray]) -> Targets:
    """Return the scaled inputs and targets that a network is trained on."""
    import torch

    n = states.effort.shape[1]
    a, c = slice(0, n), slice(n, None)
    half = 0.5 * (robot.upper - robot.lower)
    W_aa = states.W[:, a, a] / half[:, None] / half * scales["energy"]
    metric_of = np.arange(len(states)) if robot.learning.convex else states.rest_of
    S = np.linalg.cholesky(0.5 * (W_aa + W_aa.swapaxes(1, 2))[metric_of])
    hessian = (
        np.broadcast_to(np.eye(n), W_aa.shape) if robot.learning.convex else S.swapaxes(1, 2) @ np.linalg.inv(W_aa) @ S
    )
    J = np.linalg.solve(states.W[:, a, a], states.W[:, a, c]).swapaxes(1, 2)
    W_ee = states.W[:, c, c] / scales["held"]
    size = W_ee.shape[1]
    C = W_ee - J @ states.W[:, a, c] / scales["held"]
    W_ee = W_ee[metric_of]
    # Where nothing can move while the actuators are held, C is 0 up to rounding, and a Cholesky factor needs a little
    # more.
    floor = 1e-6 * np.einsum("bii->b", W_ee)[:, None, None] / size
    C = 0.5 * (C + C.swapaxes(1, 2)) + 2.0 * size * floor * np.eye(size)
    whitening = np.linalg.inv(np.linalg.cholesky(C + 0.03 * W_ee))
    J = J * half / scales["effector"]
    parts = (
        states.design,
        states.actuation,
        states.effort * half / scales["energy"],
        (states.effector - scales["effector_mean"]) / scales["effector"],
        S,
        hessian,
        J,
        whitening,
        C,
        J @ _slack_compliance(robot, states.effort, W_aa),
    )
    return Targets(*(torch.as_tensor(np.ascontiguousarray(part), dtype=torch.float32) for part in parts))


def _slack_compliance(robot: Robot, effort: np.ndarray, W_aa: np.ndarray) -> np.ndarray:
    """Return the compliance of the slack actuators while the others are held, zero for those, shape (N, n, n).

    Training states in which slack cables were moved back towards their commands have negative efforts there.
    """
    slack = robot.unilateral & (effort <= 1e-6 * robot.effort_scale)
    both = slack[:, :, None] & slack[:, None, :]
    return np.where(both, np.linalg.inv(np.where(both, np.linalg.inv(W_aa), np.eye(effort.shape[1]))), 0.0)


def potential_loss(
    net: PotentialNet,
    batch: Targets,
    effort_spread: float,
    weights: Tensor | float = 1.0,
    command_weight: float = 0.0,
) -> Tensor:
    """Return the sum of mean squared errors of a network.

    Efforts and Hessian are measured in their metric, the held compliance in its own, effector and Jacobian as they are,
    their rows with weights (e,).

    At equal commands, a slack cable reaches where its effort vanishes, so an error of the effort there moves it by the
    compliance, and the effector with it. With a ``command_weight`` the effector counts once more with this motion
    included, to first order.
    """
    gradient, hessian, x, jacobian, L = net(batch.design, batch.actuation)
    S, whitening = batch.metric, batch.whitening
    terms = (
        ((S.mT @ (gradient - batch.effort)[:, :, None]) ** 2).mean() / effort_spread,
        ((S.mT @ hessian @ S - batch.hessian) ** 2).mean(),
        ((x - batch.effector) ** 2 * weights).mean(),
        ((jacobian - batch.jacobian).mT ** 2 * weights).mean(),
        ((whitening @ (L @ L.mT - batch.held) @ whitening.mT) ** 2).mean(),
    )
    total = sum(terms[1:], terms[0])
    if command_weight:
        slid = x - (batch.sliding @ (gradient - batch.effort)[:, :, None])[:, :, 0]
        total = total + command_weight * ((slid - batch.effector) ** 2 * weights).mean()
    return total

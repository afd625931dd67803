"""Learned chains: bodies without contact, their spread over the ensemble, and their files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softgym_envs.errors import WeightsError
from softgym_envs.extensions.grasping.chain.body import KINDS, ChainBodies, FingerChain
from softgym_envs.extensions.grasping.chain.equilibrium import advance, condense
from softgym_envs.extensions.grasping.chain.segments import segment_stiffness
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import OUTSIDE, SPREAD
from softgym_envs.surrogate.weight_files import new_card, read_weights, write_weights

NETWORK = "chain"
WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped weights."""


def relative_stiffness(robot: Robot, designs: np.ndarray) -> np.ndarray:
    """Return Young's moduli relative to the baseline, which scale all forces, shape (S,)."""
    space = robot.design_space
    return designs[:, space.names.index("young_modulus")] / space["young_modulus"].baseline


def depth_features(chain: FingerChain, designs: np.ndarray) -> np.ndarray:
    """Return what the logarithm of the tip's compliance along z depends on linearly, shape (S, 15)."""
    names = chain.robot.design_space.names
    walls = designs[:, [names.index(name) for name in ("e1", "e2", "e3")]]
    zigzag = chain.bodies(designs).length[:, chain.first :].sum(axis=1)
    x = np.log(np.column_stack([walls / 0.006, zigzag / chain.robot.length]))
    products = [x[:, i] * x[:, j] for i in range(4) for j in range(i + 1)]
    return np.column_stack([np.ones(len(x)), x, *products])


@dataclass(frozen=True)
class PreparedChains:
    """Bodies, ready for the compiled solver.

    Attributes:
        chain: how they are divided.
        bodies: their geometry.
        stiffness: of the segments at the baseline modulus, shape (S, N - 1, 3, 3).
        relative: Young's modulus relative to the baseline, shape (S,).
        distrust: `OUTSIDE` where the chain was not trained, plus `SPREAD` where the members disagree; 0 for known
            bodies, shape (S,).
        uncertainty: bound on the relative error of the compliance, shape (S,).
        tip_uncertainty: bound on 95 % of the errors of the tip in contact [m], shape (S,).
        depth: compliance of the tip along z at the baseline modulus [m/N], shape (S,).
    """

    chain: FingerChain
    bodies: ChainBodies
    stiffness: np.ndarray
    relative: np.ndarray
    distrust: np.ndarray
    uncertainty: np.ndarray
    tip_uncertainty: np.ndarray
    depth: np.ndarray

    def __len__(self) -> int:
        return len(self.relative)

    @property
    def known(self) -> np.ndarray:
        """Whether the chain knows each body, shape (S,)."""
        return self.distrust == 0

    @property
    def segments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Drive, lengths, directions and stiffness, as the solver takes them."""
        length = self.bodies.length
        return self.bodies.drive, length, self.bodies.spans / length[:, :, None], self.stiffness

    @property
    def skin(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nodes, shares, arms, heights and areas of the points of the skin, as the solver takes them."""
        chain, bodies = self.chain, self.bodies
        return chain.skin_nodes, chain.skin_shares, bodies.arms, chain.skin_heights, bodies.areas

    @property
    def at_rest(self) -> np.ndarray:
        """Coordinates of the nodes at rest, shape (S, N, 3)."""
        nodes = self.bodies.nodes
        return np.concatenate([nodes, np.zeros((*nodes.shape[:2], 1))], axis=2)


class MarkerStates(NamedTuple):
    """Chains without contact, at the baseline modulus; rows that were not found must not be used.

    Attributes:
        markers: [m], shape (B, m, 2).
        tip: [m], shape (B, 2).
        torque: [N m], shape (B,).
        held: compliance of the markers at a fixed angle [m/N], shape (B, 2 m, 2 m).
        jacobian: derivative of the markers by the angle [m/rad], shape (B, 2 m).
        torsion: derivative of the torque by the angle [N m/rad], shape (B,).
        found: shape (B,).
    """

    markers: np.ndarray
    tip: np.ndarray
    torque: np.ndarray
    held: np.ndarray
    jacobian: np.ndarray
    torsion: np.ndarray
    found: np.ndarray


class ChainModel:
    """A learned chain for all bodies of the contact-aided finger.

    Args:
        robot: the robot the weights are for.
        tensors: weights by name, see `segment_stiffness`, and ``depth`` (15,).
        card: the JSON file that describes the weights.

    Attributes:
        chain: how bodies are divided, with one row of skin points across the thickness.
    """

    def __init__(self, robot: Robot, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> None:
        self.robot = robot
        self.chain = FingerChain(robot, rows=1)
        self.tensors = {name: np.asarray(value, dtype=float) for name, value in tensors.items()}
        self.card = dict(card)
        domain = self.card.get("domain", {})
        self._inflation, self._limit = float(domain.get("inflation", 1.0)), float(domain.get("limit", np.inf))
        self._tip_inflation = float(domain.get("tip_inflation", 1.0))
        names = robot.design_space.names
        self._low, self._high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        for name, (low, high) in domain.get("design", {}).items():
            margin = 0.01 * (high - low) + 1e-9 * abs(high)
            self._low[names.index(name)], self._high[names.index(name)] = low - margin, high + margin

    def prepare(self, designs: np.ndarray, rows: int = 1) -> PreparedChains:
        """Prepare bodies.

        Args:
            designs: values in the order of the design space, shape (S, len(space)).
            rows: of skin points across the thickness; one is enough for obstacles that do not change along z.
        """
        chain = self.chain if rows == 1 else FingerChain(self.robot, rows=rows)
        bodies = chain.bodies(designs)
        members = self._members(bodies)
        spread = self._spread(bodies, members)
        inside = ((designs >= self._low) & (designs <= self._high)).all(axis=1)
        return PreparedChains(
            chain=chain,
            bodies=bodies,
            stiffness=members.mean(axis=0),
            relative=relative_stiffness(self.robot, designs),
            distrust=np.where(inside, 0, OUTSIDE) | np.where(spread <= self._limit, 0, SPREAD),
            uncertainty=self._inflation * spread,
            tip_uncertainty=self._tip_inflation * spread,
            depth=self.depth(designs),
        )

    def depth(self, designs: np.ndarray) -> np.ndarray:
        """Return the compliance of the tip along z at the baseline modulus [m/N], shape (S,)."""
        return np.exp(depth_features(self.chain, designs) @ self.tensors["depth"])

    def spread(self, designs: np.ndarray) -> np.ndarray:
        """Return by how much the members disagree about the compliance of bodies at rest, shape (S,).

        This is the standard deviation over the members, relative to the mean, of the trace of the compliance of the
        zigzag leg's upper half at a fixed angle.
        """
        bodies = self.chain.bodies(designs)
        return self._spread(bodies, self._members(bodies))

    def markers(self, designs: np.ndarray, angles: np.ndarray) -> MarkerStates:
        """Return bodies (B, len(space)) without contact at angles [rad] (B,), with the compliance of their markers."""
        bodies = self.chain.bodies(designs)
        return self._respond(bodies, self._members(bodies).mean(axis=0), angles)

    def _members(self, bodies: ChainBodies) -> np.ndarray:
        modulus = self.robot.design_space["young_modulus"].baseline
        return segment_stiffness(self.tensors, bodies, modulus, self.robot.thickness)  # type: ignore[attr-defined]

    def _spread(self, bodies: ChainBodies, members: np.ndarray) -> np.ndarray:
        zero = np.zeros(len(bodies.nodes))
        chosen = slice(0, 2 + self.chain.points)
        traces = [np.einsum("bii->b", self._respond(bodies, m, zero).held[:, chosen, chosen]) for m in members]
        return np.std(traces, axis=0) / np.mean(traces, axis=0)

    def _respond(self, bodies: ChainBodies, stiffness: np.ndarray, angles: np.ndarray) -> MarkerStates:
        chain, count = self.chain, len(angles)
        length = bodies.length
        segments = bodies.drive, length, bodies.spans / length[:, :, None], stiffness
        nodes, shares, heights = chain.skin_nodes[:0], chain.skin_shares[:0], chain.skin_heights[:0]
        skin = nodes, shares, bodies.arms[:, :0], heights, bodies.areas[:, :0]
        slot = np.arange(count)
        q = np.concatenate([bodies.nodes, np.zeros((*bodies.nodes.shape[:2], 1))], axis=2)
        nothing = np.zeros((count, 0, 17)), np.zeros((count, 0, 1, 7))
        anchors, law = np.zeros((count, 0, 0, 3)), np.ones((count, 3))
        torque, found, definite = np.zeros(count), np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        angles = np.asarray(angles, dtype=float)
        advance(
            q, np.zeros(count), angles, slot, *segments, *skin, *nothing, anchors, anchors.copy(), law, torque, found
        )
        arms = bodies.markers - bodies.nodes[:, chain.marker_nodes]
        rows = 2 * len(chain.marker_nodes)
        torsion, jacobian, back = np.zeros(count), np.zeros((count, rows)), np.zeros((count, rows))
        held = np.zeros((count, rows, rows))
        condense(
            q, angles, slot, *segments, *skin, *nothing, anchors, law, chain.marker_nodes, arms, torsion, jacobian,
            back, held, definite,
        )  # fmt: skip
        return MarkerStates(
            markers=carried_points(q, chain.marker_nodes, arms),
            tip=carried_points(q, chain.effectors, bodies.effector_arms)[:, 0],
            torque=torque,
            held=held,
            jacobian=jacobian,
            torsion=torsion,
            found=found & definite,
        )


def carried_points(q: np.ndarray, nodes: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return points [m] (B, m, 2) that nodes (m,) of chains (B, N, 3) carry on arms (B, m, 2)."""
    c, s = np.cos(q[:, nodes, 2]), np.sin(q[:, nodes, 2])
    turned = np.stack([c * arms[..., 0] - s * arms[..., 1], s * arms[..., 0] + c * arms[..., 1]], axis=2)
    return q[:, nodes, :2] + turned


def save_chain(model: ChainModel, folder: str | Path) -> None:
    """Write the weights of a chain and its card, for `load_chain`."""
    write_weights(model.tensors, {**new_card(model.robot, NETWORK), **model.card}, folder)


def load_chain(robot: Robot, folder: str | Path | None = None) -> ChainModel:
    """Load the weights of a chain.

    Args:
        robot: the robot they must be for.
        folder: the folder with the weights and their card; default the shipped ones.

    Raises:
        WeightsError: if a file is missing, damaged, of another kind or for another robot.
        ValueError: for a robot that cannot be a chain.
    """
    folder = WEIGHTS / robot.learning.weights if folder is None else Path(folder)
    card, tensors = read_weights(folder, robot)
    if card.get("network") != NETWORK:
        raise WeightsError(f"weights '{folder}' have network {json.dumps(card.get('network'))}, needed '{NETWORK}'")
    layers = {f"{kind}.{layer}.{part}" for kind in KINDS for layer in range(3) for part in ("weight", "bias")}
    if tensors.keys() != layers | {"depth"}:
        wrong = sorted(tensors.keys() ^ (layers | {"depth"}))
        raise WeightsError(f"weights '{folder}' do not fit network '{NETWORK}': {', '.join(wrong)}")
    return ChainModel(robot, tensors, card)

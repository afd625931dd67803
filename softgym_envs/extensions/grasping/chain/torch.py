"""The networks of the segments in torch, and the compliance of a chain at rest as a function of their weights."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from softgym_envs.extensions.grasping.chain.body import KINDS, ChainBodies, FingerChain
from softgym_envs.extensions.grasping.chain.segments import BEAM, OUTPUTS, beam_scale


class Frame(NamedTuple):
    """Chains at rest, as the parts of a linear frame.

    Attributes:
        features: of the segments of each kind.
        scale: `beam_scale`, shape (S, N - 1, 3).
        strain: derivative of the deformations of a segment by the coordinates of its nodes, shape (S, N - 1, 3, 6).
        drive: derivative of the driven node's coordinates by the angle, shape (S, 3).
        markers: derivative of the markers by the free coordinates, shape (S, 2 m, 3 N - 6).
    """

    features: dict[str, Tensor]
    scale: Tensor
    strain: Tensor
    drive: Tensor
    markers: Tensor

    @classmethod
    def of_bodies(cls, chain: FingerChain, bodies: ChainBodies) -> Frame:
        """Return the frames of chains at the baseline stiffness."""
        count, nodes = len(bodies.nodes), bodies.nodes.shape[1]
        c, s = (bodies.spans / bodies.length[:, :, None]).transpose(2, 0, 1)
        zero, one = np.zeros_like(c), np.ones_like(c)
        turn = np.stack([s, -c, zero, -s, c, zero], axis=-1) / bodies.length[:, :, None]
        strain = np.stack(
            [
                np.stack([-c, -s, zero, c, s, zero], axis=-1),
                np.stack([zero, zero, one, zero, zero, zero], axis=-1) - turn,
                np.stack([zero, zero, zero, zero, zero, one], axis=-1) - turn,
            ],
            axis=2,
        )
        x, y = bodies.drive[:, 2], bodies.drive[:, 3]
        rows = np.zeros((count, 2 * len(chain.marker_nodes), 3 * nodes))
        for k, node in enumerate(chain.marker_nodes):
            arm = bodies.markers[:, k] - bodies.nodes[:, node]
            rows[:, 2 * k, 3 * node] = rows[:, 2 * k + 1, 3 * node + 1] = 1.0
            rows[:, 2 * k, 3 * node + 2], rows[:, 2 * k + 1, 3 * node + 2] = -arm[:, 1], arm[:, 0]
        robot = chain.robot
        modulus = robot.design_space["young_modulus"].baseline
        return cls(
            {kind: torch.as_tensor(values) for kind, values in bodies.features.items()},
            torch.as_tensor(beam_scale(bodies, modulus, robot.thickness)),
            torch.as_tensor(strain),
            torch.as_tensor(np.stack([y, -x, -np.ones(count)], axis=1)),
            torch.as_tensor(rows[:, :, 3:-3]),
        )

    def rows(self, index: Tensor) -> Frame:
        """Return some of the chains."""
        return Frame({kind: values[index] for kind, values in self.features.items()}, *(p[index] for p in self[1:]))


class ChainNet(nn.Module):
    """One member of the ensemble, in double precision.

    Args:
        sizes: number of features of each kind of segments.
        width: hidden units of each layer.
    """

    def __init__(self, sizes: dict[str, int], width: int) -> None:
        super().__init__()
        for kind in KINDS:
            last = nn.Linear(width, OUTPUTS)
            with torch.no_grad():
                # The training begins near beam theory.
                last.weight *= 0.05
                last.bias.zero_()
            self.add_module(kind, nn.ModuleList([nn.Linear(sizes[kind], width), nn.Linear(width, width), last]))
        self.double()

    def stiffness(self, frame: Frame) -> Tensor:
        """Return the stiffness of the segments, shape (S, N - 1, 3, 3); see `segment_stiffness`."""
        parts = []
        for kind in KINDS:
            first, second, last = cast(nn.ModuleList, self.get_submodule(kind))
            parts.append(last(torch.tanh(second(torch.tanh(first(frame.features[kind]))))))
        out = torch.cat(parts, dim=1)
        lower = torch.zeros(*out.shape[:2], 3, 3, dtype=out.dtype)
        lower[..., 1, 0], lower[..., 2, 0], lower[..., 2, 1] = out[..., 3], out[..., 4], out[..., 5]
        factor = out[..., :3].exp()[..., None] * torch.as_tensor(BEAM) + lower
        factor = frame.scale[..., None] * factor
        return factor @ factor.mT

    def frame_response(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """Return held compliance (S, 2 m, 2 m), motion with the servo (S, 2 m) and its stiffness (S,) at rest."""
        blocks = frame.strain.mT @ self.stiffness(frame) @ frame.strain
        count, segments = blocks.shape[:2]
        size = 3 * (segments + 1)
        # Where the entries of all blocks lie in the flattened matrix.
        rows = 3 * torch.arange(segments)[:, None] + torch.arange(6)
        places = (size * rows[:, :, None] + rows[:, None]).ravel()
        K = blocks.new_zeros(count, size * size).index_add(1, places, blocks.reshape(count, -1)).view(count, size, size)
        free = slice(3, size - 3)
        drive = frame.drive[:, :, None]
        across = K[:, free, :3] @ drive
        response = torch.linalg.solve(K[:, free, free], torch.cat([frame.markers.mT, across], dim=2))
        held = frame.markers @ response[:, :, :-1]
        jacobian = -(frame.markers @ response[:, :, -1:])[:, :, 0]
        torsion = drive.mT @ K[:, :3, :3] @ drive - across.mT @ response[:, :, -1:]
        return held, jacobian, torsion[:, 0, 0]

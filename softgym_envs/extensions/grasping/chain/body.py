"""The contact-aided finger as a chain of segments: nodes, features of the segments, skin and effectors.

The chain runs from the servo up the left leg, through the top wall and down the zigzag leg to the foot that is held. A
node is the middle of a cross-section of the outline and moves with it; the corners of the zigzag are such sections.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from softgym_envs.extensions.grasping.robots.contact_aided_finger import HELD, ON_SERVO, SERVO_AXIS, ContactAidedFinger
from softgym_envs.extensions.grasping.robots.zigzag_shape import LEFT_FOOT, RIGHT_FOOT

LEG_SEGMENTS = 4
"""Segments of the left leg."""

KINDS = ("leg", "first_corner", "wall", "second_corner", "zigzag")
"""Kinds of segments, in their order along the chain; each has a network of its own."""

ELEMENT = 8.0e-3
"""Edge length [m] of the finite elements whose contact points the skin imitates."""


@dataclass(frozen=True)
class ChainBodies:
    """Chains of S bodies at rest, with N nodes, and P points of the skin.

    Attributes:
        nodes: [m], shape (S, N, 2).
        thickness: of the segments [m], shape (S, N - 1).
        features: inputs of the networks of each kind of segments, shape (S, segments of the kind, features).
        drive: the servo's axis, and the first node from it [m], shape (S, 4).
        arms: from both nodes of each point of the skin to the ends of its edge [m], shape (S, P, 4).
        areas: of the points [m2], shape (S, P).
        effector_arms: from the node of each effector to it [m], shape (S, e, 2).
        markers: points whose compliance is learned [m], shape (S, m, 2).
        fold_arms: from their nodes to the corners that can touch each other [m], shape (S, c, 2).
        fold_sides: on which side of the edge the corner of each fold is, 1 or -1, shape (S, f).
    """

    nodes: np.ndarray
    thickness: np.ndarray
    features: dict[str, np.ndarray]
    drive: np.ndarray
    arms: np.ndarray
    areas: np.ndarray
    effector_arms: np.ndarray
    markers: np.ndarray
    fold_arms: np.ndarray
    fold_sides: np.ndarray

    @cached_property
    def spans(self) -> np.ndarray:
        """Vectors from each node to the next [m], shape (S, N - 1, 2)."""
        return np.diff(self.nodes, axis=1)

    @cached_property
    def length(self) -> np.ndarray:
        """Lengths of the segments [m], shape (S, N - 1)."""
        return np.linalg.norm(self.spans, axis=2)


class FingerChain:
    """How contact-aided fingers are divided into segments.

    Args:
        robot: the robot.

    Attributes:
        first: node at the top of the zigzag leg.
        count: number of nodes N.
        skin_nodes: nodes of each point of the skin, shape (P, 2).
        skin_shares: where the point lies between them, shape (P,).
        skin_heights: z of the points [m], shape (P,).
        effectors: node of each effector, shape (1,).
        marker_nodes: node of each marker, shape (m,).
        fold_nodes: node of each corner that can touch another part of the finger, shape (c,).
        folds: corners, each with both corners of an edge that it can touch, shape (f, 3).

    Raises:
        ValueError: for another robot.
    """

    def __init__(self, robot: Any, rows: int = 11) -> None:
        if not isinstance(robot, ContactAidedFinger):
            raise ValueError(f"chains are made for the robot 'contact_aided_finger', not for '{robot.name}'")
        self.robot = robot
        n = self.points = robot.control_points
        self.first = LEG_SEGMENTS + 4
        self.count = self.first + n + 2
        strips = int(np.ceil(2.0 * robot.length / (n + 1) / ELEMENT))
        # Simpson's 3/8 rule on each strip: the rule of the points at which finite elements test obstacles.
        places = np.arange(3 * strips + 1) / (3 * strips)
        weights = np.full(3 * strips + 1, 3.0)
        weights[::3], weights[[0, -1]] = 2.0, 1.0
        self._shares, self._weights = places, weights / weights.sum()
        starts = np.concatenate([[self.first], self.first + np.arange(n + 1)])
        ends = np.concatenate([[self.first], self.first + 1 + np.arange(n + 1)])
        edges = np.repeat(np.column_stack([starts, ends]), len(places), axis=0)
        z = robot.thickness * ((np.arange(rows) + 0.5) / rows - 0.5)
        self.rows = rows
        self.skin_nodes = np.repeat(edges, rows, axis=0)
        self.skin_shares = np.repeat(np.tile(places, n + 2), rows)
        self.skin_heights = np.tile(z, len(edges))
        self.effectors = np.array([self.first])
        zigzag = self.first + 1 + np.arange(n)
        leg = np.arange(LEG_SEGMENTS, 0, -1)
        self.marker_nodes = np.concatenate([[self.first, self.first], zigzag, [self.first], zigzag, leg])
        line = self.first + np.arange(n + 2)
        self.fold_nodes = np.concatenate([line, line, np.arange(LEG_SEGMENTS + 1)])
        self.folds = _folds(n + 2)

    def bodies(self, designs: np.ndarray) -> ChainBodies:
        """Divide bodies, given as designs (S, len(space)) in the order of the design space."""
        robot, n, rows = self.robot, self.points, self.rows
        names = robot.design_space.names
        e1, e2, e3 = (designs[:, names.index(name)] for name in ("e1", "e2", "e3"))
        distances = designs[:, [names.index(f"d{k}") for k in range(n)]]
        count, zero = len(designs), np.zeros(len(designs))
        top, foot = robot.length - e2, 1e-3 * LEFT_FOOT
        held = robot.width - 0.5e-3 * RIGHT_FOOT
        up = np.arange(LEG_SEGMENTS + 1) / LEG_SEGMENTS
        widths = foot + (e1[:, None] - foot) * up
        leg = np.stack([0.5 * widths, top[:, None] * up], axis=2)
        leg[:, 0, 1] = ON_SERVO
        wall_x = e1[:, None] + (robot.width - e3 - e1)[:, None] * np.array([0.0, 0.5, 1.0])
        wall = np.stack([wall_x, np.repeat((robot.length - 0.5 * e2)[:, None], 3, axis=1)], axis=2)
        middle = np.concatenate(
            [(robot.width - 0.5 * e3)[:, None], e1[:, None] + distances + 0.5 * e3[:, None], zero[:, None] + held],
            axis=1,
        )
        heights = top[:, None] * (1.0 - np.arange(n + 2) / (n + 1))
        zigzag = np.stack([middle, heights], axis=2)
        nodes = np.concatenate([leg, wall, zigzag], axis=1)
        nodes[:, -1, 1] = HELD
        length = np.linalg.norm(np.diff(nodes, axis=1), axis=2)
        step = top / (n + 1)
        thickness = np.concatenate(
            [
                0.5 * (widths[:, 1:] + widths[:, :-1]),
                np.minimum(e1, e2)[:, None],
                np.repeat(e2[:, None], 2, axis=1),
                np.minimum(e2, e3)[:, None],
                (e3 * step)[:, None] / length[:, -(n + 1) :],
            ],
            axis=1,
        )
        # Outer corners: of the top wall, of the zigzag, and of the foot.
        half = np.concatenate(
            [np.repeat(0.5 * e3[:, None], n + 1, axis=1), (zero + 0.5e-3 * RIGHT_FOOT)[:, None]], axis=1
        )
        outer = zigzag + np.stack([half, 0.0 * half], axis=2)
        inner = zigzag - np.stack([half, 0.0 * half], axis=2)
        edge_corners = np.concatenate(
            [np.stack([zero + robot.width, zero + robot.length], axis=1)[:, None], outer], axis=1
        )
        tips = np.repeat(edge_corners[:, :-1], len(self._shares) * rows, axis=1)
        ends = np.repeat(edge_corners[:, 1:], len(self._shares) * rows, axis=1)
        arms = np.concatenate([tips - nodes[:, self.skin_nodes[:, 0]], ends - nodes[:, self.skin_nodes[:, 1]]], axis=2)
        edge_length = np.linalg.norm(np.diff(edge_corners, axis=1), axis=2)
        areas = (edge_length[:, :, None] * self._weights).reshape(count, -1) * (robot.thickness / rows)
        axis = SERVO_AXIS[:2]
        drive = np.concatenate([np.tile(axis, (count, 1)), nodes[:, 0] - axis], axis=1)
        tip = np.stack([zero + robot.width, robot.length - 0.5 * e2], axis=1)
        # The face of the left leg that the zigzag can touch.
        leg_face = np.stack([widths, top[:, None] * up], axis=2)
        corners = np.concatenate([outer, inner, leg_face], axis=1)
        corner, start, end = (corners[:, self.folds[:, k]] for k in range(3))
        edge, way = end - start, corner - start
        markers = np.concatenate(
            [edge_corners[:, :2], outer[:, 1 : n + 1], inner[:, :1], inner[:, 1 : n + 1], leg_face[:, :0:-1]],
            axis=1,
        )
        return ChainBodies(
            nodes=nodes,
            thickness=thickness,
            features=self._features(e1, e2, e3, wall_x, middle, step),
            drive=drive,
            arms=arms,
            areas=np.repeat(areas, rows, axis=1),
            effector_arms=(tip - nodes[:, self.first])[:, None],
            markers=markers,
            fold_arms=corners - nodes[:, self.fold_nodes],
            fold_sides=np.sign(edge[..., 0] * way[..., 1] - edge[..., 1] * way[..., 0]),
        )

    def _features(
        self, e1: np.ndarray, e2: np.ndarray, e3: np.ndarray, wall: np.ndarray, middle: np.ndarray, step: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Inputs of the networks, each of order one: the shape of a segment and of what it joins."""
        n = self.points
        a, b, c = e1 / 5e-3 - 1.5, e2 / 5e-3 - 1.5, e3 / 3e-3 - 1.5
        height, one = step / 4e-3 - 2.0, np.ones(len(e1))
        slopes = 0.5 * np.diff(middle, axis=1) / step[:, None]
        around = np.pad(slopes, ((0, 0), (1, 1)))
        span = (wall[:, 2] - wall[:, 0]) / 1e-2 - 1.5

        def joined(rows: list[list[np.ndarray]]) -> np.ndarray:
            return np.stack([np.stack(row, axis=1) for row in rows], axis=1)

        return {
            "leg": joined([[a, b, *(one * (i == k) for k in range(LEG_SEGMENTS))] for i in range(LEG_SEGMENTS)]),
            "first_corner": joined([[a, b]]),
            "wall": joined([[a, b, c, span, one * i] for i in range(2)]),
            "second_corner": joined([[b, c, 2.0 * slopes[:, 0], height]]),
            "zigzag": joined(
                [
                    [
                        c,
                        height,
                        around[:, k],
                        around[:, k + 1],
                        around[:, k + 2],
                        one * (k == 0),
                        one * (k == n),
                        b * (k == 0),
                    ]
                    for k in range(n + 1)
                ]
            ),
        }


def _folds(count: int) -> np.ndarray:
    """Return which corners can touch which edges, shape (f, 3): a corner, and both corners of the edge.

    Corners are those of the outer face of the zigzag leg, of its inner face (``count`` each, from the top), and of the
    left leg from below. A corner of a face can touch every edge of that face that does not end there; one of the inner
    face can also touch the left leg below its uppermost part.
    """
    rows = [
        (start + k, start + edge, start + edge + 1)
        for start in (0, count)
        for k in range(count)
        for edge in range(count - 1)
        if k not in (edge, edge + 1)
    ]
    rows += [
        (count + k, 2 * count + edge, 2 * count + edge + 1) for k in range(1, count) for edge in range(LEG_SEGMENTS)
    ]
    return np.array(rows)

"""Bodies and rollouts as binary glTF files (.glb), which Blender, browsers and game engines open: shape keys over time.

Written by hand after the specification of glTF 2.0 (registry.khronos.org/glTF): one buffer, no textures, no extensions.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.errors import ConfigError
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write
from softgym_envs.viewer.moment import Moment
from softgym_envs.viewer.scene import COLORS, STUB, Color
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines, surface_kinds

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv

FRAMES_PER_SECOND = 20.0
CABLE_POINTS, CABLE_SIDES = 48, 6
"""Points along a cable and around it."""
_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
"""Quaternion (x, y, z, w) that turns z up, as here, into y up, as in glTF."""
FLOAT, UNSIGNED, BYTES = 5126, 5125, 5121
"""Numbers of glTF for the types of numbers."""


class GlbWriter:
    """Writes the states of one rollout to a .glb file: an animation of the body, its cables, effectors and goal.

    Lengths are in metres, y is up as glTF wants it. Use it as a context manager: the file is complete when the block
    ends, and does not exist if the block fails.

    Args:
        robot: the family of bodies.
        path: file that ends with .glb.

    Raises:
        ConfigError: for another ending.
    """

    def __init__(self, robot: Robot, path: str | Path) -> None:
        self.robot, self.path = robot, Path(path)
        if self.path.suffix != ".glb":
            raise ConfigError(f"'{self.path}' must end with .glb")
        self._shapes = ShapeFinder(robot)
        self._model: MechanicalModel | None = None
        self._body: list[np.ndarray] = []
        self._cables: dict[int, list[np.ndarray]] = {}
        self._effectors: list[np.ndarray] = []
        self._goals: list[np.ndarray] = []

    def __enter__(self) -> GlbWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            with atomic_write(self.path) as stream:
                stream.write(self._content())

    def log(self, moment: Moment, /) -> None:
        """Add one state.

        Raises:
            ConfigError: if the body has another mesh than the one before.
        """
        self.add(moment.design, moment.state)
        self._goals.append(np.asarray(moment.goal, dtype=float).reshape(-1, 3)[0])

    def add(self, design: Mapping[str, float], state: State) -> None:
        """Add one state without a goal."""
        model = self._shapes.load(design)
        if self._model is None:
            self._model, self._surface = model, BodySurface(model)
        elif model is not self._model:
            raise ConfigError("a .glb file holds one body; write another file for another design")
        x = self._shapes.nodes(design, state)
        self._body.append(self._surface.points(x))
        for row, line in cable_lines(model, x, state, stub=STUB * self.robot.size).items():
            self._cables.setdefault(row, []).append(_tube(line, 0.008 * self.robot.size))
        self._effectors.append(np.asarray(state.effector))

    def _content(self) -> bytes:
        size, file = self.robot.size, _File()
        triangles = self._surface.triangles
        kinds = surface_kinds(self._surface)
        colors = np.tile(np.array([*COLORS["body"], 255], dtype=np.uint8), (len(self._surface.nodes), 1))
        for kind, name in ((1, "clamp"), (2, "object")):
            colors[triangles[kinds == kind], :3] = COLORS[name]
        normals = [self._surface.normals(points) for points in self._body]
        file.add_shape("body", self._body, triangles, normals=normals, colors=colors)
        for row, tubes in self._cables.items():
            name = self.robot.actuators[row].name
            file.add_shape(name, tubes, _tube_triangles(), color=COLORS["cable high"])
        for k, effector in enumerate(self.robot.effectors):
            places = [each[k] for each in self._effectors]
            file.add_ball(effector, places, 0.026 * size, COLORS["effector"])
        if self._goals:
            file.add_ball("goal", self._goals, 0.034 * size, COLORS["goal"])
        return file.content()


def writer_of(env: SoftRobotEnv, path: str | Path) -> GlbWriter:
    """Return a writer of an environment's rollouts."""
    return GlbWriter(env.robot, path)


def write_glb(robot: Robot, path: str | Path, design: Mapping[str, float] | None = None) -> Path:
    """Write a body at rest.

    Args:
        robot: the family of bodies.
        path: file that ends with .glb.
        design: the body; missing variables have their baseline.

    Returns:
        The path.

    Raises:
        ConfigError: for another ending.
        DesignError: for a malformed design.
        InfeasibleDesign: if the geometry cannot exist.
    """
    complete = robot.design_space.complete(design)
    with GlbWriter(robot, path) as writer:
        writer.add(complete, ShapeFinder(robot).rest(complete))
    return Path(path)


class _File:
    """A glTF document in the making."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._times: int | None = None

    def add_shape(
        self,
        name: str,
        shapes: Sequence[np.ndarray],
        triangles: np.ndarray,
        *,
        normals: Sequence[np.ndarray] | None = None,
        colors: np.ndarray | None = None,
        color: Color = (255, 255, 255),
    ) -> None:
        """Add a mesh that takes shapes (v, 3) [m] one after the other; all but the first are shape keys."""
        first = {"POSITION": self._array(shapes[0], bounds=True)}
        if normals is not None:
            first["NORMAL"] = self._array(normals[0])
        if colors is not None:
            first["COLOR_0"] = self._array(colors, kind=BYTES, normalized=True)
        indices = self._array(triangles.reshape(-1), kind=UNSIGNED, shape="SCALAR")
        primitive: dict[str, Any] = {"attributes": first, "indices": indices, "material": self._material(color)}
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if len(shapes) > 1:
            keys = []
            for k in range(1, len(shapes)):
                key = {"POSITION": self._array(shapes[k] - shapes[0], bounds=True)}
                if normals is not None:
                    key["NORMAL"] = self._array(normals[k] - normals[0])
                keys.append(key)
            primitive["targets"], mesh["weights"] = keys, [0.0] * len(keys)
        self._meshes.append(mesh)
        self._nodes.append({"name": name, "mesh": len(self._meshes) - 1})
        if len(shapes) > 1:
            weights = np.eye(len(shapes))[:, 1:]  # each shape for itself at its time
            self._animate("weights", weights.reshape(-1), len(shapes), "SCALAR")

    def add_ball(self, name: str, places: Sequence[np.ndarray], radius: float, color: Color) -> None:
        """Add a ball that is at places (3,) [m] one after the other."""
        points, triangles = _ball(radius)
        self.add_shape(name, [points], triangles, color=color)
        self._nodes[-1]["translation"] = [float(value) for value in places[0]]
        if len(places) > 1:
            self._animate("translation", np.array(places), len(places), "VEC3")

    def _animate(self, path: str, values: np.ndarray, count: int, shape: str) -> None:
        if self._times is None:
            self._times = self._array(np.arange(count) / FRAMES_PER_SECOND, shape="SCALAR", bounds=True)
        output = self._array(values, shape=shape)
        self._samplers.append({"input": self._times, "output": output, "interpolation": "LINEAR"})
        target = {"node": len(self._nodes) - 1, "path": path}
        self._channels.append({"sampler": len(self._samplers) - 1, "target": target})

    def _material(self, color: Color) -> int:
        linear = [(value / 255.0) ** 2.2 for value in color]
        surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7}
        self._materials.append({"pbrMetallicRoughness": surface, "doubleSided": True})
        return len(self._materials) - 1

    def _array(
        self, values: np.ndarray, *, kind: int = FLOAT, shape: str = "", bounds: bool = False, normalized: bool = False
    ) -> int:
        """Add numbers to the buffer and return the number of their accessor."""
        dtype = {FLOAT: "<f4", UNSIGNED: "<u4", BYTES: "<u1"}[kind]
        array = np.ascontiguousarray(values, dtype=dtype)
        self._views.append({"buffer": 0, "byteOffset": len(self._buffer), "byteLength": array.nbytes})
        self._buffer += array.tobytes()
        self._buffer += bytes(-len(self._buffer) % 4)
        accessor: dict[str, Any] = {
            "bufferView": len(self._views) - 1,
            "componentType": kind,
            "count": len(array),
            "type": shape or f"VEC{array.shape[1]}",
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor["min"], accessor["max"] = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def content(self) -> bytes:
        """Return the bytes of the file."""
        root = {"name": "robot", "rotation": _UP, "children": list(range(len(self._nodes)))}
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "softgym-envs"},
            "scene": 0,
            "scenes": [{"nodes": [len(self._nodes)]}],
            "nodes": [*self._nodes, root],
            "meshes": self._meshes,
            "materials": self._materials,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._buffer)}],
        }
        if self._channels:
            document["animations"] = [{"name": "rollout", "channels": self._channels, "samplers": self._samplers}]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        parts = [(b"JSON", text), (b"BIN\0", bytes(self._buffer))]
        chunks = b"".join(len(data).to_bytes(4, "little") + kind + data for kind, data in parts)
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def _tube(line: np.ndarray, radius: float) -> np.ndarray:
    """Return points (CABLE_POINTS * CABLE_SIDES, 3) around a polyline [m] (p, 3)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, along[-1], CABLE_POINTS)
    centre = np.column_stack([np.interp(places, along, line[:, d]) for d in range(3)])
    tangent = np.gradient(centre, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    # The axis that is most across the whole cable, so that the tube does not twist.
    axis = np.eye(3)[np.argmin(np.abs(tangent).max(axis=0))]
    one = np.cross(tangent, axis)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12)
    other = np.cross(tangent, one)
    angle = 2.0 * np.pi * np.arange(CABLE_SIDES) / CABLE_SIDES
    ring = np.cos(angle)[None, :, None] * one[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    return np.asarray((centre[:, None] + radius * ring).reshape(-1, 3))


def _tube_triangles() -> np.ndarray:
    """Return the triangles (t, 3) of `_tube`."""
    k = np.arange((CABLE_POINTS - 1) * CABLE_SIDES)
    right = k - k % CABLE_SIDES + (k + 1) % CABLE_SIDES
    up, up_right = k + CABLE_SIDES, right + CABLE_SIDES
    return np.vstack([np.column_stack([k, right, up]), np.column_stack([right, up_right, up])])


def _ball(radius: float, rings: int = 8, sides: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return points [m] (v, 3) and triangles (t, 3) of a ball."""
    polar, turn = np.meshgrid(np.linspace(0.0, np.pi, rings + 1), 2.0 * np.pi * np.arange(sides) / sides, indexing="ij")
    points = radius * np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    k = np.arange(rings * sides)
    right = k - k % sides + (k + 1) % sides
    down, down_right = k + sides, right + sides
    triangles = np.vstack([np.column_stack([k, down, right]), np.column_stack([right, down, down_right])])
    return points.reshape(-1, 3), triangles

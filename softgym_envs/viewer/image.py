"""Images of a robot: the ``rgb_array`` mode of environments, and stills for reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.tasks.base import LENGTHS
from softgym_envs.robots.base import Robot
from softgym_envs.viewer.scene import STUB, Scene, check_display, ground_of, obstacle_skins
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines

MAX_DEFLECTION = 0.725
"""Largest sideways motion of the tip of a beam that bends uniformly by an angle t, relative to its length: the maximum
of (1 - cos t) / t."""


class ImageRenderer:
    """Renders states of a robot off screen with a fixed camera.

    An image shows the body with its clamped base in dark grey, the cables (amber to red with tension; grey and wavy if
    slack) with a bead at their pulled end, the effectors (blue), the goal (green) and its path, in front of a wall with
    a scale grid. Cables, effectors and goal remain faintly visible where the body hides them.

    Args:
        robot: the family of bodies. The camera view contains the baseline body at rest and where its actuators may move
            its effectors.
        size: width and height [pixels].
        window: show the images in a window too.
        source: finite elements of the robot whose states are rendered: their model is used instead of a new one.
        framed: other bodies that the camera view contains at rest.

    Attributes:
        shapes: finds the shapes that are drawn.

    Raises:
        ValueError: for a size that is not two positive integers, or a window without a display.
    """

    def __init__(
        self,
        robot: Robot,
        size: tuple[int, int] = (480, 480),
        *,
        window: bool = False,
        source: FEMBackend | None = None,
        framed: Sequence[Mapping[str, float] | None] = (),
    ) -> None:
        if window:
            check_display()
        width, height = (int(n) for n in size)
        if width < 1 or height < 1:
            raise ValueError(f"size = {size!r} must be two positive integers: width and height in pixels")
        self.robot = robot
        self.size = (width, height)
        self._window = window
        self._framed = framed
        self.shapes = ShapeFinder(robot, source)
        self._scene: Scene | None = None

    def render(
        self,
        design: Mapping[str, float],
        state: State,
        path: np.ndarray,
        goal: np.ndarray,
        *,
        text: str | None = None,
    ) -> np.ndarray:
        """Return an image of a state, shape (height, width, 3) uint8.

        A state without nodes is drawn in the shape of a finite-element model with the same actuator displacements.

        Args:
            design: the body.
            state: its state.
            path: all goals of the episode [m], shape (p, 3).
            goal: the current goal [m], shape (3,).
            text: caption; default the Euclidean distance to the goal.
        """
        scene = self._open()
        model = self.shapes.load(design)
        x = self.shapes.nodes(design, state)
        scene.set_body(model, x)
        scene.set_ghost(None)
        scene.set_state(x, state)
        scene.set_goal(np.asarray(goal), np.asarray(path))
        scene.set_text(text or f"distance {LENGTHS.text(float(np.linalg.norm(state.effector[0] - goal)))}")
        if self._window:
            scene.update()
        return scene.image()

    def render_body(
        self,
        design: Mapping[str, float] | None = None,
        command: np.ndarray | None = None,
        *,
        ghost: Mapping[str, float] | None = None,
        text: str = "",
    ) -> np.ndarray:
        """Return an image of a body without a task, shape (height, width, 3) uint8.

        Args:
            design: the body; missing variables take their baseline.
            command: actuator displacements, shape (n_a,); default: at rest.
            ghost: another body for comparison, drawn pale behind the first one at the same command.
            text: a caption.
        """
        scene = self._open()
        command = None if command is None else np.asarray(command, dtype=float)
        if ghost is None:
            scene.set_ghost(None)
        else:
            scene.set_ghost(self.shapes.load(ghost), self.shapes.at(ghost, command))
        model, x = self.shapes.load(design), self.shapes.at(design, command)
        scene.set_body(model, x)
        scene.set_state(x, self.shapes.state)
        scene.set_goal(None, None)
        scene.set_text(text)
        return scene.image()

    def close(self) -> None:
        """Close the window. A later image opens a new one."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _open(self) -> Scene:
        if self._scene is None:
            baseline = self.robot.design_space.baseline
            model, rest = self.shapes.load(baseline), self.shapes.rest(baseline)
            x = rest.nodes
            assert x is not None
            lines = cable_lines(model, x, rest, stub=STUB * self.robot.size)
            pulled = [_pulled(line, self.robot.upper[row]) for row, line in lines.items()]
            seen = [BodySurface(model).points(x), *pulled, _reached(self.robot, rest)]
            if way := self.robot.view.way * self.robot.size:
                seen += [points + [way, 0.0, 0.0] for points in seen]
            else:
                seen += [points for points, _ in obstacle_skins(model, self.robot)]
            for other in {self.robot.design_space.complete(body) for body in self._framed} - {baseline}:
                shape, nodes = BodySurface(self.shapes.load(other)), self.shapes.rest(other).nodes
                assert nodes is not None
                seen.append(shape.points(nodes))
            ground = ground_of(model, self.robot)
            self._scene = Scene(self.robot, self.size, np.concatenate(seen), ground=ground, window=self._window)
        return self._scene


def _pulled(line: np.ndarray, length: float) -> np.ndarray:
    """Return both ends of the visible line (p, 3) of a cable after it was pulled by a length, shape (2, 3) [m]."""
    outwards = (line[0] - line[1]) / np.linalg.norm(line[0] - line[1])
    return np.stack([line[0] + length * outwards, line[-1]])


def _reached(robot: Robot, rest: State) -> np.ndarray:
    """Return where the effectors come with each actuator alone, and with all, at the limits, shape (m, 3) [m].

    It is estimated from the condensed model at rest, without another equilibrium, which takes up to a minute on large
    meshes. The linear prediction is cut at `MAX_DEFLECTION`, because bodies that bend far move along an arc.
    """
    if robot.view.at_rest:
        return rest.effector
    compliance = rest.condensed.W
    ends = np.stack([robot.lower, robot.upper]) - rest.displacement  # (2, n_a)
    alone = compliance.ea / np.diag(compliance.aa)  # effector displacements per displacement of one actuator
    moves = [end * alone for end in ends] + [(compliance.ea @ np.linalg.solve(compliance.aa, ends.T))]
    steps = np.concatenate(moves, axis=1).T.reshape(-1, *rest.effector.shape)
    lengths = np.linalg.norm(steps, axis=-1, keepdims=True)
    limit = MAX_DEFLECTION * robot.size
    return (rest.effector + steps * np.minimum(1.0, limit / np.maximum(lengths, 1e-12))).reshape(-1, 3)


def render_body(
    robot: Robot,
    design: Mapping[str, float] | None = None,
    command: np.ndarray | None = None,
    size: tuple[int, int] = (480, 480),
    *,
    ghost: Mapping[str, float] | None = None,
    text: str = "",
) -> np.ndarray:
    """Return an image of one body, shape (height, width, 3) uint8; see `ImageRenderer.render_body`."""
    return render_bodies(robot, [design], command, size, ghost=ghost, texts=[text])


def render_bodies(
    robot: Robot,
    designs: Sequence[Mapping[str, float] | None],
    command: np.ndarray | None = None,
    size: tuple[int, int] = (480, 480),
    *,
    ghost: Mapping[str, float] | None = None,
    texts: Sequence[str] | None = None,
) -> np.ndarray:
    """Return images of several bodies with one camera, which sees all of them, shape (height, k * width, 3) uint8.

    Args:
        robot: the family of bodies.
        designs: k bodies.
        command: actuator displacements of all bodies, shape (n_a,); default: at rest.
        size: width and height of one image [pixels].
        ghost: a body drawn pale behind each body.
        texts: k captions.
    """
    renderer = ImageRenderer(robot, size, framed=designs)
    try:
        captions = [""] * len(designs) if texts is None else texts
        images = [
            renderer.render_body(design, command, ghost=ghost, text=text)
            for design, text in zip(designs, captions, strict=True)
        ]
    finally:
        renderer.close()
    return np.concatenate(images, axis=1)

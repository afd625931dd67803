"""Pictures of baseline and winner."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.robots.base import Robot

IMAGE_SIZE = (420, 420)


@dataclass(frozen=True)
class BodyPictures:
    """Pictures of baseline and winner as sources of image elements.

    Attributes:
        poses: captions of the poses.
        of_bodies: role of each body, and its picture in each pose.
        missing: why there are no pictures; empty if there are some.
    """

    poses: list[str]
    of_bodies: list[tuple[str, list[str]]] = field(default_factory=list)
    missing: str = ""


def body_pictures(snapshot: StudySnapshot, results: StudyResults) -> BodyPictures:
    """Return pictures of baseline and winner, or why there are none."""
    bodies = {"baseline": snapshot.config.baseline}
    if results.winner is not None:
        bodies["winner"] = results.winner.design
    poses = _poses(snapshot)
    captions = [caption for caption, _ in poses]
    try:
        return BodyPictures(captions, _photographs(snapshot.config.robot, bodies, poses))
    except Exception as error:  # pictures need a working OpenGL, a report does not
        return BodyPictures(captions, missing=f"No pictures: {type(error).__name__}: {error}")


def _poses(snapshot: StudySnapshot) -> list[tuple[str, np.ndarray | None]]:
    """Return captions and commands (n_a,) of the pictures."""
    robot = snapshot.config.robot
    half = 0.5 * robot.upper
    poses: list[tuple[str, np.ndarray | None]] = [("at rest", None)]
    if not robot.antagonists:  # all of these at once would only pull against each other
        poses.append(("all actuators at 50 %", half))
    if len(half) > 1:
        first = np.zeros_like(half)
        first[0] = half[0]
        poses.append(("first actuator at 50 %", robot.balanced(first)))
    return poses


def _photographs(
    robot: Robot, bodies: Mapping[str, dict[str, float]], poses: Sequence[tuple[str, np.ndarray | None]]
) -> list[tuple[str, list[str]]]:
    """Return the pictures of each body, in every pose."""
    from softgym_envs.viewer.image import ImageRenderer

    renderer = ImageRenderer(robot, IMAGE_SIZE, framed=list(bodies.values()))
    try:
        return [
            (role, [_source(renderer.render_body(body, command)) for _, command in poses])
            for role, body in bodies.items()
        ]
    finally:
        renderer.close()


def _source(image: np.ndarray) -> str:
    """Return an image (h, w, 3) uint8 as WebP data for HTML."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="webp", quality=85)
    return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode()}"

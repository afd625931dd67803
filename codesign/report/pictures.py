"""Pictures of baseline and winner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softgym_envs.codesign.report import plots
from softgym_envs.codesign.report.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.robots.base import Robot

IMAGE_SIZE = (420, 420)


@dataclass(frozen=True)
class BodyPictures:
    """Pictures of baseline and winner as sources of image elements.

    Attributes:
        poses: captions of the poses.
        of_bodies: role of each body, and its picture in each pose.
        overlay: both bodies over each other; None without pictures.
        missing: why there are no pictures; empty if there are some.
    """

    poses: list[str]
    of_bodies: list[tuple[str, list[str]]] = field(default_factory=list)
    overlay: str | None = None
    missing: str = ""


def body_pictures(snapshot: StudySnapshot, results: StudyResults) -> BodyPictures:
    """Return pictures of baseline and winner, or why there are none."""
    bodies = {"baseline": snapshot.config.baseline}
    if results.winner is not None:
        bodies["winner"] = results.winner.design
    poses = _poses(snapshot)
    captions = [caption for caption, _ in poses]
    try:
        pictures, shapes = _photographs(snapshot.config.robot, bodies, poses)
        return BodyPictures(captions, pictures, plots.overlay(shapes))
    except Exception as error:  # pictures need a working OpenGL, a report does not
        return BodyPictures(captions, missing=f"No pictures: {type(error).__name__}: {error}")


def _poses(snapshot: StudySnapshot) -> list[tuple[str, np.ndarray | None]]:
    """Return captions and commands (n_a,) of the pictures."""
    robot = snapshot.config.robot
    half = 0.5 * robot.upper
    poses: list[tuple[str, np.ndarray | None]] = [("at rest", None), ("all actuators at 50 %", half)]
    if len(half) > 1:
        first = np.zeros_like(half)
        first[0] = half[0]
        poses.append(("first actuator at 50 %", first))
    return poses


def _photographs(
    robot: Robot, bodies: Mapping[str, dict[str, float]], poses: Sequence[tuple[str, np.ndarray | None]]
) -> tuple[list[tuple[str, list[str]]], list[tuple[str, dict[str, Any]]]]:
    """Return the pictures of each body, and what `plots.overlay` draws: all bodies in the first two poses."""
    from softgym_envs.viewer.image import ImageRenderer
    from softgym_envs.viewer.surface import BodySurface

    renderer = ImageRenderer(robot, IMAGE_SIZE)
    pictures: list[tuple[str, list[str]]] = []
    shapes: list[tuple[str, dict[str, Any]]] = [(caption, {}) for caption, _ in poses[:2]]
    try:
        for role, body in bodies.items():
            pictures.append((role, []))
            surface = BodySurface(renderer.shapes.load(body))
            for index, (_, command) in enumerate(poses):
                pictures[-1][1].append(plots.picture(renderer.render_body(body, command)))
                if index < len(shapes):  # the renderer has just found this shape: asking for it again costs nothing
                    points = surface.points(renderer.shapes.at(body, command))
                    shapes[index][1][role] = (points, surface.triangles, renderer.shapes.state.effector)
    finally:
        renderer.close()
    return pictures, shapes

"""Draw the pictures of the documentation: ``make docs-images``, or ``python docs/make_images.py [NAME ...]``.

Names are those of robots, of environment pages (``finger_reach``) and of other pictures; default: all. Pictures go to
``docs/images/NAME.png``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from generate import ROOT, environment_pages
from PIL import Image

from agents.evaluation import make_agent
from softgym_envs.robots import ROBOTS, make_robot
from softgym_envs.viewer.image import ImageRenderer, render_bodies

# Share of the range of each actuator, for the actuated half of a robot's picture.
COMMANDS: dict[str, tuple[float, ...]] = {
    "finger": (0.85, 0.70),
    "diamond": (0.9, 0.25, 0.25, 0.9),
    "cable_trunk": (0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.9, 0.0),
    "sensorized_finger": (0.9,),
    "trunk": (0.7, 0.0, 0.0, 0.0, 0.45, 0.45),
    "press_finger": (0.8, 0.8),
    "tetrapod": (-0.5, 0.0, 0.5, 0.0),
    "two_finger_gripper": (0.7, 0.1, 0.1, 0.7),
    "three_finger_gripper": (0.35, 0.35, 0.35, 0.35, 0.35, 0.35),
}
WIDTH, HEIGHT = 800, 520


def draw_robot(name: str) -> np.ndarray:
    """Draw a robot at rest and actuated, side by side."""
    robot = make_robot(name)
    count = len(robot.actuators)
    command = robot.upper * np.array(COMMANDS.get(name, (0.5,) * count)[:count])
    renderer = ImageRenderer(robot, (WIDTH // 2, HEIGHT))
    try:
        return np.concatenate([renderer.render_body(), renderer.render_body(command=command)], axis=1)
    finally:
        renderer.close()


def draw_environment(name: str) -> np.ndarray:
    """Draw an environment on the finite elements, on the way to its goal under the inverse QP."""
    env = gymnasium.make(environment_pages()[name], backend="fem", render_mode="rgb_array", render_size=(WIDTH, HEIGHT))
    act = make_agent("qp")
    observation, _ = env.reset(seed=1)
    unwrapped: Any = env.unwrapped
    for _ in range(unwrapped.task.horizon // 2 - 1 if unwrapped.task.horizon > 1 else 16):
        observation, *_ = env.step(act(observation, unwrapped))
    image = np.asarray(env.render())
    env.close()
    return image


def draw_codesign() -> np.ndarray:
    """Draw the baseline finger and the winner of the demo study."""
    designs = [{}, {"length": 0.038, "height": 0.0211, "joint_height": 0.005}]
    return render_bodies(
        make_robot("finger"), designs, np.array([0.020, 0.017]), (480, 480), texts=["baseline", "co-designed"]
    )


def draw_arm() -> np.ndarray:
    """Take the picture that the tutorial on one's own robot makes."""
    with tempfile.TemporaryDirectory() as folder:
        page = ROOT / "tutorials" / "own_robot.md"
        subprocess.run([sys.executable, str(ROOT / "run_page.py"), str(page), folder], check=True)
        return np.asarray(Image.open(Path(folder) / "arm.png"))


def main(names: list[str]) -> None:
    """Draw the named pictures, or all."""
    table: dict[str, Callable[[], np.ndarray]] = {"codesign": draw_codesign, "arm": draw_arm}
    table |= {name: partial(draw_robot, name) for name in ROBOTS}
    table |= {name: partial(draw_environment, name) for name in environment_pages()}
    for name in names or table:
        path = ROOT / "images" / f"{name}.png"
        image = Image.fromarray(table[name]())
        image.save(path, optimize=True)
        print(f"wrote {path}, {image.width} x {image.height}, {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main(sys.argv[1:])

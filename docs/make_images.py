"""Draw the pictures of the documentation: ``make docs-images``, or ``python docs/make_images.py [NAME ...]``.

Names are those of robots, of the films of environment pages (``finger_reach.webp``) and of other pictures; default:
all. Pictures go to ``docs/images/NAME.png``, the animation to ``docs/images/episodes.webp``. The picture ``report``
needs a finished study (``make demo``) and Chromium, so it is drawn only when it is named.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageSequence
from site_writing import DOCS, environment_pages

from softgym_envs import make_robot
from softgym_envs.agents.evaluation import make_agent
from softgym_envs.agents.policy import Policy
from softgym_envs.backends import make_backend
from softgym_envs.extensions.leaderboard import plots
from softgym_envs.extensions.modules import MODULES
from softgym_envs.extensions.recordings.films import write_video
from softgym_envs.mechanics import Statics
from softgym_envs.robots import ROBOTS
from softgym_envs.viewer.image import ImageRenderer

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
    "two_finger_friction_gripper": (0.6, 0.6, 0.6, 0.6),
    "three_finger_friction_gripper": (0.5, 0.5, 0.3, 0.3, 0.3, 0.3),
}
ROBOT_OPTIONS: dict[str, dict[str, Any]] = {"modular_arm": {"body": "solid"}}
MODULE_MOTIONS = {
    "solid_block": (2, -0.003),
    "leaf_spring": (4, 0.5),
    "crossed_leaves": (4, 0.4),
    "notch_hinge": (4, 0.4),
    "torsion_tube": (5, 0.8),
    "accordion": (2, 0.008),
}
"""Component of `softgym_envs.extensions.modules.base.POSE` and value, for the picture of each module."""
WITHOUT_REST = ("swimmer",)
"""Robots that have no equilibrium; their films show them."""
WIDTH, HEIGHT = 800, 520
SHOWN = ("finger_reach", "trunk_track", "gripper_lift")
"""Environments of the animation of the home page."""
FILM_SIZE, FILM_FRAMES = (360, 300), 30
FILM_AGENTS = {
    "crawler_walk": "crawler_walk_gait", "finger_grasp": "force", "gripper_lift": "close", "quadruped_climb": "gait",
    "quadruped_follow": "steer", "quadruped_walk": "gait", "swimmer_swim": "gait", "tetrapod_carry": "tetrapod_carry",
    "whip_throw": "whip_throw_gait",
}  # fmt: skip
"""Agents of the films of environments, where it is not the inverse QP."""
FILM_STEPS = {
    "crawler_walk": 100, "gripper_lift": 50, "quadruped_climb": 100, "quadruped_follow": 200, "quadruped_walk": 100,
    "swimmer_swim": 100,
    "tetrapod_carry": 60, "whip_throw": 30,
}  # fmt: skip
WALKERS = {"baseline": "quadruped_walk_gait", "winner": "quadruped_walk_winner"}
"""Policies of the film of walkers, each for its own body."""
STRIP, WALKED = (800, 170), 5.5
"""Size of the picture of a walker [pixels], and the way that it shows [sizes of the robot]."""
OPTIONS: dict[str, dict[str, Any]] = {
    "composed_gripper_manipulate": {"design": {"fingers": "2+2", "angle": 0.4}},
    "finger_grasp": {"backend": "fem", "robot_options": {"object": "hexagon"}},  # easier to see than a plane
    "modular_reach": {"backend": "fem", "robot_options": {"body": "solid"}},  # superelements are drawn as bars
}
"""Options of environments for their films."""


def draw_robot(name: str) -> np.ndarray:
    """Draw a robot at rest and actuated, side by side."""
    robot = make_robot(name, **ROBOT_OPTIONS.get(name, {}))
    count = len(robot.actuators)
    command = robot.upper * np.array(COMMANDS.get(name, (0.5,) * count)[:count])
    renderer = ImageRenderer(robot, (WIDTH // 2, HEIGHT))
    try:
        return np.concatenate([renderer.render_body(), renderer.render_body(command=command)], axis=1)
    finally:
        renderer.close()


def draw_film(name: str, path: Path) -> None:
    """Write a small film of one episode of an environment."""
    identifier = environment_pages()[name]
    options = {"backend": None, **OPTIONS.get(name, {})}
    env = gymnasium.make(identifier, render_mode="rgb_array", render_size=FILM_SIZE, **options)
    observation, _ = env.reset(seed=1)
    unwrapped: Any = env.unwrapped
    act = make_agent(FILM_AGENTS.get(name, "qp"))
    steps = FILM_STEPS.get(name, unwrapped.task.horizon if unwrapped.task.horizon > 1 else 30)
    shown = set(np.linspace(0, steps, min(steps + 1, FILM_FRAMES)).astype(int).tolist())
    frames, step, ended = [np.asarray(env.render())], 0, False
    while step < steps and not ended:
        observation, _, terminated, truncated, _ = env.step(act(observation, unwrapped))
        step, ended = step + 1, terminated or truncated
        if step in shown or ended:
            frames.append(np.asarray(env.render()))
    env.close()
    write_video(path, frames + [frames[-1]] * 6, fps=10.0)


def draw_episodes(path: Path) -> None:
    """Write the films of `SHOWN` side by side, the shorter ones with their last image held."""
    films = []
    for name in SHOWN:
        with Image.open(DOCS / "images" / f"{name}.webp") as film:
            images = [np.asarray(image.convert("RGB").resize((288, 240))) for image in ImageSequence.Iterator(film)]
            films.append(images)
    length = max(map(len, films))
    write_video(path, [np.concatenate([f[min(k, len(f) - 1)] for f in films], axis=1) for k in range(length)], fps=8.0)


def draw_walkers(path: Path) -> None:
    """Write a film of the quadrupeds of `WALKERS`, one above the other."""
    strips, speeds = [], []
    for agent in WALKERS.values():
        environment = Policy(agent).environment
        env = environment.make()
        observation, _ = env.reset(seed=0)
        unwrapped: Any = env.unwrapped
        unwrapped.robot.view = replace(unwrapped.robot.view, way=WALKED)
        act, renderer = make_agent(agent), ImageRenderer(unwrapped.robot, STRIP, source=unwrapped.backend)
        images, steps = [], unwrapped.task.max_episode_steps
        for step in range(steps + 1):
            if step % 2 == 0:
                place = unwrapped.state.effector
                text = f"{step * unwrapped.backend.steps.control_step:.1f} s"
                images.append(renderer.render(unwrapped.design, unwrapped.state, place, place[0], text=text))
            if step < steps:
                observation, *_, info = env.step(act(observation, unwrapped))
        renderer.close()
        strips.append(images)
        speeds.append(1e3 * float(info["speed"]))
    print(*(f"{name}: {speed:.0f} mm/s" for name, speed in zip(WALKERS, speeds, strict=True)), sep="\n")
    frames = [np.concatenate(pair, axis=0) for pair in zip(*strips, strict=True)]
    write_video(path, frames + [frames[-1]] * 8, fps=10.0)


def draw_grasp() -> np.ndarray:
    """Draw the two-finger gripper before and after it lifts the bar."""
    robot = make_robot("two_finger_friction_gripper")
    backend, renderer = make_backend("fem", robot), ImageRenderer(robot, (WIDTH // 2, HEIGHT))
    baseline, goals = robot.design_space.baseline, robot.effector_rest[None]
    try:
        pictures = [renderer.render(baseline, backend.state, goals, goals[0], text="at rest")]
        for pull in np.linspace(0.0, 0.007, 15)[1:]:
            state = backend.step(np.full(4, pull))
        pictures.append(renderer.render(baseline, state, goals, goals[0], text="all cables pulled by 7 mm"))
    finally:
        renderer.close()
    return np.concatenate(pictures, axis=1)


def draw_modules() -> np.ndarray:
    """Draw all compliant modules at rest and with their far port moved the way in which they are soft."""
    import pyvista

    plotter = pyvista.Plotter(shape=(1, len(MODULE_MOTIONS)), off_screen=True, window_size=(1200, 360), border=False)
    for column, (name, (component, motion)) in enumerate(MODULE_MOTIONS.items()):
        module = MODULES[name]()
        model, triangles = module.model(), module.body().surface()
        modes = ["displacement" if k == component else "effort" for k in range(6)]
        moved = Statics(model).solve(np.where(np.arange(6) == component, motion, 0.0), modes).x
        faces = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
        plotter.subplot(0, column)
        plotter.set_background("white")
        corners = int(triangles.max()) + 1
        plotter.add_mesh(pyvista.PolyData(model.nodes[:corners], faces), color="#c9d3de", opacity=0.25)
        plotter.add_mesh(
            pyvista.PolyData(moved[:corners], faces), color="#10776d", show_edges=True, edge_color="#0b5750"
        )
        plotter.add_text(name, position="lower_edge", font_size=9, color="black")
        plotter.view_vector((1.0, -1.6, 0.5), viewup=(0.0, 0.0, 1.0))
        plotter.camera.zoom(1.15)
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return np.asarray(image)


def draw_arm() -> np.ndarray:
    """Return the picture that the tutorial on a robot of your own draws."""
    with tempfile.TemporaryDirectory() as folder:
        page = DOCS / "tutorials" / "own_robot.md"
        subprocess.run([sys.executable, str(DOCS / "run_page.py"), str(page), folder], check=True)
        return np.asarray(Image.open(Path(folder) / "arm.png"))


def draw_report() -> np.ndarray:
    """Take a screenshot of the report of a finished study (default ``results/demo``, or ``$STUDY``) with Chromium."""
    report = Path(os.environ.get("STUDY", "results/demo")).resolve() / "report.html"
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not report.is_file() or browser is None:
        raise SystemExit(f"the picture 'report' needs Chromium and '{report}' (make demo)")
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "report.png"
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1100,1150"]
        subprocess.run([browser, *options, f"--screenshot={picture}", report.as_uri()], check=True)
        return np.asarray(Image.open(picture).convert("RGB"))


def main(names: list[str]) -> None:
    """Draw the named pictures, or all but the report."""
    table: dict[str, Callable[[], np.ndarray]] = {"arm": draw_arm, "grasp": draw_grasp}
    table |= {"modules": draw_modules}
    table |= {"benchmark_regret": plots.draw_regret, "benchmark_winners": plots.draw_winners}
    table |= {name: partial(draw_robot, name) for name in ROBOTS if name not in WITHOUT_REST}
    films = [f"{name}.webp" for name in environment_pages()]
    films_of_more = {"episodes": draw_episodes, "walkers": draw_walkers}
    every = [*table, *films, *films_of_more]
    if unknown := [name for name in names if name not in (*every, "report")]:
        raise SystemExit(f"unknown pictures {', '.join(unknown)}; allowed: {', '.join(every)}, report")
    for name in names or every:
        path = DOCS / "images" / f"{name.removesuffix('.webp')}.png"
        if name in films_of_more:
            path = path.with_suffix(".webp")
            films_of_more[name](path)
        elif name.endswith(".webp"):
            path = path.with_suffix(".webp")
            draw_film(name.removesuffix(".webp"), path)
        else:
            draw = draw_report if name == "report" else table[name]
            Image.fromarray(draw()).save(path, optimize=True)
        print(f"wrote {path}, {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", metavar="NAME", nargs="*", help="of a picture; default: all")
    main(parser.parse_args().names)

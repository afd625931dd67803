"""Mount a soft finger on a rigid arm in MuJoCo, and compare its tip with finite elements.

Needs MuJoCo (pip install 'mujoco>=4'). With a file name, such as arm.webp, it also makes a film, for which MuJoCo must
draw off screen: MUJOCO_GL=egl on a machine without a display.
"""

import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from softgym_envs import make_robot
from softgym_envs.extensions.deployment import export_mjcf
from softgym_envs.mechanics import Statics

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <visual><headlight ambient="0.4 0.4 0.4" diffuse="0.6 0.6 0.6"/></visual>
  <asset><texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/></asset>
  <worldbody>
    <light pos="0.3 -0.5 1"/>
    <geom type="plane" size="0.8 0.8 0.01" rgba="0.93 0.94 0.96 1"/>
    <body name="base" pos="0 0 0.05">
      <joint name="turn" axis="0 0 1" damping="2"/>
      <geom type="cylinder" size="0.04 0.05" rgba="0.35 0.38 0.44 1"/>
      <body name="upper" pos="0 0 0.06">
        <joint name="shoulder" axis="0 1 0" damping="2"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.25" size="0.025" rgba="0.6 0.64 0.7 1"/>
        <body name="fore" pos="0 0 0.25">
          <joint name="elbow" axis="0 1 0" damping="2"/>
          <geom type="capsule" fromto="0 0 0 0.22 0 0" size="0.02" rgba="0.6 0.64 0.7 1"/>
          <site name="flange" pos="0.24 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="turn" kp="200"/><position joint="shoulder" kp="200"/><position joint="elbow" kp="200"/>
  </actuator>
</mujoco>
"""
POSE = np.array([0.6, 0.5, -0.4])  # of the arm [rad]
TENSIONS = ((0.0, 0.0), (2.0, 0.0), (5.0, 5.0))  # of the two cables [N]
FORCES = ((0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, -0.1, 0.2))  # at the tip, along the axes of the flange [N]


def mounted(finger: Path) -> mujoco.MjModel:
    arm = mujoco.MjSpec.from_string(ARM)
    arm.attach(mujoco.MjSpec.from_file(str(finger)), site=arm.site("flange"), prefix="finger/")
    model = arm.compile()
    model.opt.gravity[:] = 0.0  # the published finger has no weight
    return model


def place(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the flange as columns, and the tip in its frame [m]."""
    flange, tip = data.site("flange"), data.site("finger/tip")
    axes = flange.xmat.reshape(3, 3)
    return axes, axes.T @ (tip.xpos - flange.xpos)


def bend(model: mujoco.MjModel, tension: tuple[float, ...], force: tuple[float, ...]) -> np.ndarray:
    """Return the tip in the frame of the flange [m] after 8 s."""
    data = mujoco.MjData(model)
    data.qpos[:3] = data.ctrl[:3] = POSE
    data.ctrl[3:] = tension
    mujoco.mj_forward(model, data)
    tip = model.site("finger/tip")
    for _ in range(4000):
        data.qfrc_applied[:] = 0.0
        pull, at = place(data)[0] @ np.array(force), data.site_xpos[tip.id]
        mujoco.mj_applyFT(model, data, pull, np.zeros(3), at, tip.bodyid[0], data.qfrc_applied)
        mujoco.mj_step(model, data)
    return place(data)[1]


def film(model: mujoco.MjModel, path: Path) -> None:
    """Film the arm as it swings and the finger bends."""
    from PIL import Image

    data, frames = mujoco.MjData(model), []
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = [0.14, 0.0, 0.22], 0.75, 75.0, -12.0
    with mujoco.Renderer(model, 480, 640) as renderer:
        for k in range(120):
            phase = 2.0 * np.pi * k / 120
            data.ctrl[:3] = [0.6 * np.sin(phase), 0.2 - 0.2 * np.cos(phase), -0.2 * np.sin(phase)]
            data.ctrl[3:] = 5.0 * np.sin(2.0 * phase) ** 2
            for _ in range(25):
                mujoco.mj_step(model, data)
            renderer.update_scene(data, camera)
            frames.append(Image.fromarray(renderer.render()))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=50, loop=0)


def main() -> None:
    robot = make_robot("finger")
    with tempfile.TemporaryDirectory() as folder:
        model = mounted(export_mjcf(robot, Path(folder) / "finger.xml"))
    statics = Statics(robot.build())
    rest = statics.solve(np.zeros(2), "effort").condensed.delta.e
    worst = 0.0
    for tension in TENSIONS:
        for force in FORCES:
            exact = statics.solve(np.array(tension), "effort", effector_force=force).condensed.delta.e
            error = np.linalg.norm(bend(model, tension, force) - exact) / np.linalg.norm(exact - rest)
            worst = max(worst, error)
            print(f"tensions {tension} N, force {force} N: the tip is off by {100 * error:.1f} % of its way")
    assert worst < 0.05
    if len(sys.argv) > 1:
        film(model, Path(sys.argv[1]))
        print(f"wrote {sys.argv[1]}")


if __name__ == "__main__":
    main()

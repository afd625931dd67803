"""Draw two bodies under the same command, side by side: ``python examples/06_compare_bodies.py [file.png]``."""

import sys

import numpy as np
from PIL import Image

from softgym_envs import make_robot
from softgym_envs.viewer import render_bodies

robot = make_robot("finger")
designs = [{}, {"length": 0.03807, "height": 0.02161, "joint_height": 0.00745}]
image = render_bodies(robot, designs, np.array([0.020, 0.017]), (480, 480), texts=["baseline", "co-designed"])
path = sys.argv[1] if len(sys.argv) > 1 else "/tmp/bodies.png"
Image.fromarray(image).save(path)
print(f"wrote {path}, {image.shape[1]} x {image.shape[0]}")

"""A scene that several tests of contact share."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.extensions.beams.skins import box_skin
from softgym_envs.mechanics.builder import ModelBuilder
from tests.helpers import box_mesh


@pytest.fixture
def block_and_box():
    """A free soft block of 20 x 20 x 10 mm with a rigid box above, and the first row of the frame of the box."""
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.01), (3, 3, 2))
    builder = ModelBuilder(floating=True)
    builder.add_solid(
        nodes, tetrahedra, fixed=np.zeros(len(nodes), bool), young_modulus=1e6, poisson_ratio=0.3, element="linear"
    )
    frame = builder.add_frame([0.01, 0.012, 0.0199])
    builder.add_mass(frame, 0.01, 1e-6 * np.eye(3))
    model = builder.build()
    model.skins.append(box_skin(frame, (0.006, 0.005, 0.004), model.nodes))
    return model, frame

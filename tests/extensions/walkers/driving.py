"""Bodies that move, driven at random in compiled code."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from softgym_envs.backends.backend import State
from softgym_envs.backends.fem import FEMBackend


def bodies_in_motion(backend: FEMBackend) -> Iterator[State]:
    """Yield the state at rest of the baseline, of two opposite corners and of four bodies drawn from the box.

    After each, the body is driven by five random commands, which it must follow in compiled code.
    """
    robot, space, rng = backend.robot, backend.robot.design_space, np.random.default_rng(0)
    units = [-np.ones(len(space)), np.ones(len(space)), *rng.uniform(-1.0, 1.0, (4, len(space)))]
    for design in [space.baseline, *(space.from_unit(unit) for unit in units)]:
        rest = backend.reset(design)
        assert backend.not_compiled is None
        yield rest
        command = np.zeros(len(robot.actuators))
        for _ in range(5):
            command = np.clip(command + rng.uniform(-1.0, 1.0, command.shape) * robot.rates, robot.lower, robot.upper)
            state = backend.step(command)
        assert state.displacement == pytest.approx(command, abs=1e-15)
        assert state.trusted

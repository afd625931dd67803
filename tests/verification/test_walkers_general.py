"""Compiled walks in contact against the general solver: random bodies and gaits, from landing to walking."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.extensions.walkers.robots.quadruped import Quadruped
from softgym_envs.mechanics.solvers.dynamics import Dynamics

H, PARTS = 0.01, 5
"""Duration of a time step [s], and time steps of a control step."""


def walk(seed, compiled, *, elements=4, control_steps=40, standing=4):
    """Let a random quadruped stand, then trot at random; return rows (k, n, 3) and ``W`` after each control step."""
    rng = np.random.default_rng(seed)
    robot = Quadruped(elements=elements, friction=rng.uniform(0.3, 1.0))
    values = rng.uniform(size=len(robot.design_space))
    design = {v.name: v.low + u * (v.high - v.low) for v, u in zip(robot.design_space, values, strict=True)}
    rate, size, lift, ahead = rng.uniform((1.0, 5e-9, 0.0, 0.0), (3.0, 2e-8, 1.0, 6.28))
    solver = Dynamics(
        robot.build(design), step=H, stiffness_damping=0.01, tolerance=1e-11, compiled=compiled, max_iterations=60
    )
    phase = np.pi * np.array([0.0, 1.0, 1.0, 0.0])

    def command(time):
        if time <= standing * PARTS * H:
            return np.zeros(8)
        turn = 2.0 * np.pi * rate * (time - standing * PARTS * H) + phase
        swing, raised = np.sin(turn), lift * np.cos(turn + ahead)
        return size * np.stack([raised - swing, raised + swing], axis=1).ravel()

    rows, models, parts = [], [], 0
    for k in range(control_steps):
        for j in range(PARTS):
            motion = solver.advance(command((k * PARTS + j + 1) * H))
            parts = max(parts, motion.substeps, motion.equilibrium.increments)
        rows.append(motion.equilibrium.x)
        models.append(motion.equilibrium.condensed.compliance)
    return np.array(rows), np.array(models), parts


def compare(seed, **options):
    """Return the largest distance of rows that are places, that of ``W`` relative to it, and the way of the trunk."""
    (x, W, parts), (y, V, _) = (walk(seed, compiled, **options) for compiled in (True, False))
    places = np.arange(0, x.shape[1], 4)
    size = np.sqrt(np.einsum("kii->ki", V))
    return (
        np.abs(x - y)[:, places].max(axis=(1, 2)),
        (np.abs(W - V) / (size[:, :, None] * size[:, None])).max(axis=(1, 2)),
        float(np.linalg.norm(x[-1, 0] - x[0, 0])),
        parts,
    )


@pytest.mark.parametrize("seed", [0, 2])
def test_walks_are_those_of_the_general_solver(seed):
    """Of bodies and gaits without a time step that compiled code has to divide: divided ones are other steps.

    The general solver takes some of them in increments, between which springs of friction must not slide.
    """
    distance, compliance, way, parts = compare(seed, elements=2, control_steps=16)
    assert parts == 1
    assert distance.max() < 1e-6
    assert compliance.max() < 1e-6
    assert way > 1e-3

"""Errors of a learned model on one body, measured under random touches and commands."""

from __future__ import annotations

import warnings

import numpy as np

from softgym_envs.backends.backend import Backend, PointForce
from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.fitting.row_errors import RowErrors
from softgym_envs.extensions.sensing.loads import TouchGrid
from softgym_envs.mechanics.surfaces import CrossingWarning


def measured_errors(
    twin: SurrogateBackend, body: Backend, grid: TouchGrid, *, states: int = 80, seed: int = 0
) -> RowErrors:
    """Return the errors of a learned model on one body, for `LearnedEstimator`.

    A model that was learned for many bodies errs more from body to body than from state to state of one of them. On a
    device, do the same with volumes and effectors that were measured, and call `RowErrors.fit`.

    Args:
        twin: the learned model, for the same robot and design as ``body``.
        body: finite elements of the body, for example. Both backends end at rest.
        grid: any place of it may be touched, by any force that the model has learned.
        states: number of touches and commands; those without an equilibrium are left out.
        seed: of touches and commands.

    Raises:
        ValueError: if too few states have an equilibrium.
    """
    robot, model, rng = twin.robot, twin.model, np.random.default_rng(seed)
    space = model.robot.design_space
    values = np.array([[{**space.baseline, **body.design}[name] for name in space.names]])
    strongest = space["touch_force"].high * float(model.features.stiffness(values)[0, 0])
    shares, errors = [], []
    for _ in range(states):
        cell = (int(rng.integers(grid.cells[0])), int(rng.integers(grid.cells[1])))
        point = grid.inside(cell, rng.uniform(-1.0, 1.0, (1, 2)))[0]
        load = PointForce(point, rng.uniform(0.0, strongest) * np.array(grid.normal))
        share = rng.uniform(size=len(robot.actuators))
        try:
            rows = []
            for plant in (twin, body):
                plant.reset()
                plant.touch(load)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", CrossingWarning)  # walls do not touch in what was learned either
                    delta = plant.step(
                        robot.lower + share * (robot.upper - robot.lower), "displacement"
                    ).condensed.delta
                rows.append(np.concatenate([delta.e, delta.s]))
        except ConvergenceError:
            continue
        shares.append(float(share.mean()))
        errors.append(rows[0] - rows[1])
    for plant in (twin, body):
        plant.reset()
    return RowErrors.fit(np.array(shares), np.array(errors).reshape(len(shares), -1))

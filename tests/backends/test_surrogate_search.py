"""Learned models find the states that commands lead to, for bodies at the corners of their boxes as well."""

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.surrogate import rest_state, solve_displacements
from softgym_envs.surrogate.pretrained import pretrained_model, shipped_robots

# The coordinates of the contact finger are those of a segment in a chain, which takes no commands.
COMMANDED = {name: made for name, made in shipped_robots().items() if name != "contact_finger"}


def corners(rng, low, high, rows):
    """Points of a box, most of whose coordinates are at an end of their range."""
    unit = rng.random((rows, len(low)))
    return low + np.where(rng.random(unit.shape) < 0.6, np.round(unit), unit) * (high - low)


@pytest.mark.parametrize("name", sorted(COMMANDED))
def test_states_at_rest_and_under_commands_are_found_at_corners(name, rng):
    kind, options = COMMANDED[name]
    robot = make_robot(kind, **options)
    model = pretrained_model(robot)
    space = model.robot.design_space
    ends = np.array([(variable.low, variable.high) for variable in space])
    context = model.context(corners(rng, *ends.T, 500))
    rest = rest_state(model, context, robot.unilateral)
    assert rest.converged.all()
    command = corners(rng, *np.array([(a.low, a.high) for a in robot.actuators]).T, 500)
    found = solve_displacements(model, context, command, rest.displacement, robot.unilateral, rest.slack)
    assert found.converged.all()
    # Each state solves the complementarity problem, by the model's own effort at the displacement.
    effort, span = model.effort(context, found.displacement), model.span
    scale = np.abs(effort).max()
    beyond = robot.unilateral & (found.displacement > command + 1e-4 * span)
    np.testing.assert_allclose(np.where(beyond, 0.0, found.displacement - command), 0.0, atol=1e-4 * span.max())
    assert np.abs(np.where(beyond, effort, 0.0)).max() < 1e-3 * scale
    assert np.where(robot.unilateral, effort, 0.0).min() > -1e-3 * scale

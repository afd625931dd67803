"""Every ID on every backend: made, reset with a design and with drawn bodies, and in a batch; holes by name."""

from __future__ import annotations

import gymnasium
import pytest

import softgym_envs  # noqa: F401 - registers the IDs
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.errors import WeightsError

BACKENDS = ("fem", "surrogate", "hybrid")

GROUND = "no weights ship for 'quadruped', which touches something: use backend='fem'"
HOLES = {
    ("SoftGym/CrawlerWalk-v0", "surrogate"): GROUND.replace("quadruped", "crawler"),
    ("SoftGym/CrawlerWalk-v0", "hybrid"): GROUND.replace("quadruped", "crawler"),
    # Contact with the ground is not learned.
    ("SoftGym/QuadrupedClimb-v0", "surrogate"): GROUND,
    ("SoftGym/QuadrupedClimb-v0", "hybrid"): GROUND,
    ("SoftGym/QuadrupedFollow-v0", "surrogate"): GROUND,
    ("SoftGym/QuadrupedFollow-v0", "hybrid"): GROUND,
    ("SoftGym/QuadrupedWalk-v0", "surrogate"): GROUND,
    ("SoftGym/QuadrupedWalk-v0", "hybrid"): GROUND,
    # Nothing holds it, so it has no equilibria to learn.
    ("SoftGym/SwimmerSwim-v0", "surrogate"): "no weights ship for 'swimmer'",
    ("SoftGym/SwimmerSwim-v0", "hybrid"): "no weights ship for 'swimmer'",
    # Statics say nothing of a swing.
    ("SoftGym/WhipThrow-v0", "surrogate"): "robot 'whip': a surrogate drives actuators beyond their max_effort",
    ("SoftGym/WhipThrow-v0", "hybrid"): "no weights ship for 'whip'",
}
"""What a user is told who asks for what there is not, by ID and backend."""


def cases():
    for identifier in ENVIRONMENTS:
        for backend in BACKENDS:
            yield pytest.param(identifier, backend, id=f"{identifier.split('/')[1]}-{backend}")


def another_design(space) -> dict[str, float]:
    """A body that is not the baseline: the first variable that is a number, somewhat below its middle."""
    variable = next(v for v in space if not v.choices)
    return {variable.name: variable.low + 0.45 * (variable.high - variable.low)}


@pytest.mark.parametrize(("identifier", "backend"), list(cases()))
def test_every_id_runs_on_every_backend(identifier, backend):
    if (identifier, backend) in HOLES:
        with pytest.raises(WeightsError, match=HOLES[identifier, backend]):
            gymnasium.make(identifier, backend=backend)
        return
    env = gymnasium.make(identifier, backend=backend, disable_env_checker=True)
    env.reset(seed=0)
    env.reset(seed=0, options={"design": another_design(env.unwrapped.design_space)})
    env.step(0.0 * env.action_space.sample())
    drawn = gymnasium.make_vec(identifier, 2, backend=backend, sample_design=True)
    drawn.reset(seed=1)
    _, _, _, _, info = drawn.step(0.0 * drawn.action_space.sample())
    assert info["converged"].all()

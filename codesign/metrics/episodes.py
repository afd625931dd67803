"""Metrics of a body with its controller, and of the body alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.codesign.metrics.metric import metric
from softgym_envs.codesign.metrics.sources import Outcome
from softgym_envs.units import PERCENT

if TYPE_CHECKING:
    from softgym_envs.mechanics.model import MechanicalModel

SLOWEST = 1e-3
"""Speed that ratios to the speed have at least [m/s]."""


@metric(direction="maximize", shown=PERCENT)
def success_rate(outcome: Outcome) -> np.ndarray:
    """Return whether the effector reaches each goal."""
    return outcome.evaluation.successes


@metric("distance", label="Mean final distance")
def mean_distance(outcome: Outcome) -> np.ndarray:
    """Return the distance to the goal at the end of each episode."""
    return outcome.evaluation.distances


@metric(direction="maximize", over_path=True)
def mean_return(outcome: Outcome) -> np.ndarray:
    """Return the sum of the rewards of each episode."""
    return outcome.evaluation.returns


@metric("distance", over_path=True)
def mean_tracking_distance(outcome: Outcome) -> np.ndarray:
    """Return the mean distance to the goal over the steps of each episode."""
    return outcome.evaluation.tracking_distances


@metric("distance", over_path=True)
def mean_settled_distance(outcome: Outcome) -> np.ndarray | None:
    """Return the mean distance to the goal over the last 20 steps of each episode, about which a body may swing."""
    return outcome.evaluation.settled_distances


@metric("effort", label="Mean actuator effort", over_path=True)
def mean_effort(outcome: Outcome) -> np.ndarray:
    """Return the mean size of the efforts over actuators and steps of each episode."""
    return outcome.evaluation.efforts


@metric("effort", label="Largest actuator effort", worst=True)
def largest_effort(outcome: Outcome) -> np.ndarray | None:
    """Return the largest effort of any actuator in any step of any episode."""
    return outcome.evaluation.largest_efforts


@metric(shown=PERCENT, label="Largest strain of a drive", worst=True)
def largest_strain(outcome: Outcome) -> np.ndarray | None:
    """Return the largest displacement of a drive in any episode over its length or volume at rest."""
    where = "on finite elements, or for bodies made of beams, and not for servos"
    return _known(outcome.evaluation.largest_strains, "largest_strain", where)


@metric("N", label="Self-contact", worst=True)
def self_force(outcome: Outcome) -> np.ndarray | None:
    """Return the largest force in any episode with which surfaces of the body press on each other."""
    return _known(outcome.evaluation.self_forces, "self_force", "on finite elements, for bodies with self-contact")


def _known(values: np.ndarray | None, name: str, where: str) -> np.ndarray:
    if values is None or np.isnan(values).any():
        raise ValueError(f"metric '{name}' is known {where}; leave it out here")
    return values


@metric(shown=PERCENT, label="Share of untrusted states", over_path=True)
def untrusted_share(outcome: Outcome) -> np.ndarray | None:
    """Return the share of the steps of each episode in which the surrogate does not trust itself."""
    return outcome.evaluation.untrusted


def _tally(outcome: Outcome, name: str) -> np.ndarray:
    found = outcome.evaluation.tallies.get(name)
    if found is None:
        raise ValueError(f"this metric needs episodes of a task that counts '{name}', such as walk")
    return found


@metric("m/s", "maximize")
def forward_speed(outcome: Outcome) -> np.ndarray:
    """Return the speed ahead."""
    return _tally(outcome, "speed")


@metric()
def relative_drift(outcome: Outcome) -> np.ndarray:
    """Return the way sideways over the way ahead."""
    return _tally(outcome, "drift") / np.maximum(_tally(outcome, "speed"), SLOWEST)


@metric()
def relative_slip(outcome: Outcome) -> np.ndarray:
    """Return the way on which loaded points slip over the way ahead."""
    return _tally(outcome, "slip") / np.maximum(_tally(outcome, "speed"), SLOWEST)


@metric()
def cost_of_transport(outcome: Outcome) -> np.ndarray:
    """Return the work of the actuators over weight and way ahead."""
    weight = outcome.model.mass * float(np.linalg.norm(outcome.robot.gravity))
    if weight == 0.0:
        raise ValueError(f"cost_of_transport needs a robot with weight; '{outcome.robot.name}' has none (gravity = 0)")
    return _tally(outcome, "power") / (weight * np.maximum(_tally(outcome, "speed"), SLOWEST))


@metric("m", "maximize")
def throw_range(outcome: Outcome) -> np.ndarray:
    """Return how far ahead of the base a throw lands."""
    return _tally(outcome, "range")


@metric("m3", source="body")
def material_volume(model: MechanicalModel) -> float:
    """Return the volume of the solid."""
    return model.volume

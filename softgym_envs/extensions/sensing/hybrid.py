"""The hybrid backend of the sensorized finger: learned readings where they are trusted, elsewhere finite elements."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from softgym_envs.backends.surrogate import SurrogateBackend
from softgym_envs.extensions.paths.hybrid import PathHybridBackend
from softgym_envs.extensions.sensing.sensorized_finger import SensorizedFinger


class SensorizedHybridBackend(PathHybridBackend):
    """A learned sensorized finger where it is trusted, elsewhere finite elements.

    Finite elements follow the commands and touches of the episode; the learned model does not learn from them.

    Args:
        robot: the finger.
        design: first design; missing variables take their baseline.
        weights: folder of weights; default the shipped ones.
        members: how many members of the ensemble to use; default all.

    Raises:
        WeightsError: if the weights are missing, damaged or for another robot.
    """

    def __init__(
        self,
        robot: SensorizedFinger,
        design: Mapping[str, float] | None = None,
        weights: str | Path | None = None,
        members: int | None = None,
    ) -> None:
        self._start(robot, SurrogateBackend(robot, design, weights, members))

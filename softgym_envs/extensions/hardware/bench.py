"""A robot on a bench: its device, how it is watched, and the rules of its loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError, model_validator

from softgym_envs.config import BesideConfig, Config, first_problem, load_config
from softgym_envs.extensions.hardware.device import (
    DEVICES,
    Clock,
    Device,
    LineTracker,
    SerialLine,
    Tracker,
)
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot


class TrackerConfig(Config):
    """Positions of the effectors as lines of text ``x y z ...`` in metres."""

    port: str = Field(description="serial port, or an address such as socket://localhost:7777")
    baud: int = Field(default=115_200, gt=0)


class BenchConfig(Config):
    """A robot on a bench.

    The settings of the device stand under its name: ``device: dynamixel`` with ``dynamixel: {port: ..., servos: ...}``.

    Attributes:
        robot: registered name, or path ``my_module:MyRobot``.
        robot_options: options of the robot.
        design: the body that was built; missing variables have their baseline.
        device: a name in `softgym_envs.extensions.hardware.device.DEVICES`.
        settings: of the device, of its class ``Config``.
        tracker: where positions of the effectors come from; None if nothing sees them.
        rate: control steps per second.
        watchdog: time of silence after which everything stops [s].
        slow: share of the actuators' rates at which the robot goes home.
    """

    robot: str
    robot_options: Annotated[dict[str, Any], BesideConfig()] = Field(default_factory=dict)
    design: dict[str, float] = Field(default_factory=dict)
    device: str
    settings: Any = None
    tracker: TrackerConfig | None = None
    rate: float = Field(default=50.0, gt=0.0, le=1000.0)
    watchdog: float = Field(default=0.08, ge=0.02, le=2.5)
    slow: float = Field(default=0.2, gt=0.0, le=1.0)

    @model_validator(mode="before")
    @classmethod
    def _settings_of_device(cls, data: Any) -> Any:
        """Make the settings from the section with the device's name."""
        if not isinstance(data, dict) or not isinstance(data.get("device"), str):
            return data
        name = data["device"]
        kind = DEVICES.find(name).Config
        if isinstance(data.get("settings"), kind):
            return data
        try:
            settings = kind.model_validate(data.get(name, {}))
        except ValidationError as error:
            raise ValueError(f"{name}: {first_problem(error)}") from None
        return {**{key: value for key, value in data.items() if key != name}, "settings": settings}

    @model_validator(mode="after")
    def _in_time(self) -> BenchConfig:
        if self.watchdog < 2.0 / self.rate:
            raise ValueError(
                f"watchdog = {self.watchdog:g} s must be at least two steps of rate = {self.rate:g} per second"
            )
        return self

    def make_robot(self) -> Robot:
        """Return the robot."""
        return make_robot(self.robot, **self.robot_options)


@dataclass
class Bench:
    """A robot on a bench, connected.

    Attributes:
        robot: the family of its body.
        design: the body; missing variables have their baseline.
        device: its drives.
        tracker: where its effectors are seen, or None.
        clock: the time.
        rate: control steps per second.
        watchdog: time of silence after which everything stops [s].
        slow: share of the actuators' rates at which the robot goes home.
    """

    robot: Robot
    design: dict[str, float]
    device: Device
    tracker: Tracker | None = None
    clock: Clock = field(default_factory=Clock)
    rate: float = 50.0
    watchdog: float = 0.08
    slow: float = 0.2

    @classmethod
    def open(cls, config: str | Path | BenchConfig, overrides: Sequence[str] = ()) -> Bench:
        """Connect to the bench of a configuration, or of its file.

        Raises:
            ConfigError: for a malformed configuration.
            HardwareError: if the device cannot be reached.
        """
        if not isinstance(config, BenchConfig):
            config = load_config(config, BenchConfig, overrides)
        robot, clock = config.make_robot(), Clock()
        device = DEVICES.find(config.device)(config.settings, robot, clock)
        tracker = None
        if config.tracker is not None:
            line = SerialLine(config.tracker.port, config.tracker.baud, clock)
            tracker = LineTracker(line, len(robot.effectors), clock)
        return cls(robot, config.design, device, tracker, clock, config.rate, config.watchdog, config.slow)

    def close(self) -> None:
        """Take the power from the device and close all lines."""
        self.device.stop()
        self.device.close()
        if self.tracker is not None:
            self.tracker.close()

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass
class Timing:
    """How well a loop kept its time.

    Attributes:
        rate: wanted control steps per second.
        steps: number of control steps.
        lost: readings that did not arrive in time, or arrived damaged.
        unseen: steps without a new position from the tracker.
        missed: beginnings of steps that passed while the step before was still at work.
        late: how much later than planned each step ended [s].
    """

    rate: float
    steps: int = 0
    lost: int = 0
    unseen: int = 0
    missed: int = 0
    late: list[float] = field(default_factory=list, repr=False)

    @property
    def jitter(self) -> dict[str, float]:
        """Quantiles of `late` [s]: median, 99 % and the largest."""
        late = np.array(self.late or [0.0])
        return {"median": float(np.median(late)), "99 %": float(np.quantile(late, 0.99)), "largest": float(late.max())}

    def text(self) -> str:
        """Return one line for people."""
        jitter = ", ".join(f"{name} {1e3 * value:.2f}" for name, value in self.jitter.items())
        return (
            f"{self.steps} steps at {self.rate:g}/s; late by {jitter} ms; {self.missed} missed, {self.lost} lost "
            f"readings, {self.unseen} without a position"
        )

    def to_json(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        counts = {name: getattr(self, name) for name in ("rate", "steps", "lost", "unseen", "missed")}
        return {**counts, "late_seconds": self.jitter}

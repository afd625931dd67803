"""A physical robot as a backend, in real time: whatever steps an environment drives the robot."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.backends.backend import Backend, State, check_command, refuse_force
from softgym_envs.backends.registry import make_backend
from softgym_envs.errors import DesignError
from softgym_envs.extensions.hardware.bench import Bench, Timing
from softgym_envs.extensions.hardware.device import HardwareError, Reading
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.robots.base import Robot

PATIENT = 0.9
"""Share of the watchdog's time after which the drives may have stopped by themselves and get power anew."""
ANSWER = 0.25
"""Share of a control step that the device has to answer; it is asked twice."""
ENCODER = 0.005
"""Share of a range that the step of an encoder may take a measured displacement beyond it."""
TINY = 1e-9
"""Share of a range by which rounding may take a command beyond its limits."""


class HardwareBackend(Backend):
    """A robot on a bench; a model that gets the same commands tells what nothing measures, and ``W``.

    A step sends the command, waits for the beginning of the next control step, and reads. `reset` moves the robot home
    at a part of its rates; the first one gives power to the drives, where they stand. Commands beyond the range or the
    rate of an actuator are refused before anything is sent. If the device does not answer for the time of the watchdog,
    reports a fault, or `stop` is called, the power is taken away and nothing is sent any more.

    Args:
        robot: the robot, as the environment made it.
        design: the body, which must be the one on the bench; default that.
        bench: the bench, or the file of its configuration.
        model: backend of the model: ``"surrogate"`` or ``"fem"``.
        log: CSV file that gets what was commanded and seen at each step, for `softgym calibrate`; it is extended.
        trial: name of this session in the log. The way home is part of it, since the play of drives remembers it.

    Attributes:
        bench: the bench.
        timing: how well the loop kept its time.
        stopped: why nothing is sent any more; empty while it runs.

    Raises:
        HardwareError: if the device cannot be reached.
        ValueError: for another robot than that on the bench.
    """

    def __init__(
        self,
        robot: Robot,
        design: Mapping[str, float] | None = None,
        *,
        bench: str | Bench,
        model: str = "surrogate",
        log: str | None = None,
        trial: str = "1",
    ) -> None:
        self.bench = bench if isinstance(bench, Bench) else Bench.open(bench)
        self.robot = robot
        if type(self.bench.robot) is not type(robot):
            raise ValueError(f"the robot on the bench is '{self.bench.robot.name}', not '{robot.name}'")
        space = robot.design_space
        self.design = space.complete(self.bench.design)
        if design is not None and not self._is_own(space.complete({**self.bench.design, **design})):
            raise DesignError(f"design = {dict(design)} is not the body on the bench: {dict(self.design)}")
        self.timing, self.stopped = Timing(self.bench.rate), ""
        self._model = make_backend(model, robot, self.design)
        self._log = None if log is None else _Log(Path(log), robot, self.bench.device.takes, trial)
        self._reading = self.bench.device.connect()
        self._seen: np.ndarray | None = None
        self._sent, self._sent_at, self._powered = np.zeros(len(robot.actuators)), -np.inf, False
        self._began, self._heard = 0.0, -np.inf
        self.state = self._model.step(self._sent)  # compiles what it needs, before the drives have power

    def _is_own(self, design: Mapping[str, float]) -> bool:
        return all(np.isclose(design[name], value, rtol=1e-9, atol=0.0) for name, value in self.design.items())

    # -- the loop ---------------------------------------------------------------------------------------------------

    def reset(self, design: Mapping[str, float] | None = None) -> State:
        if design is not None and not self._is_own(design):
            raise DesignError(f"design = {dict(design)} is not the body on the bench: {dict(self.design)}")
        self._check_running()
        slow = self.bench.slow * self.robot.rates
        with _StopsOnError(self):
            self._power()
            while (np.abs(self._sent) > 0.0).any():
                self._cycle(self._sent - np.clip(self._sent, -slow, slow))
        self._model.reset()
        self._cycle(np.zeros_like(self._sent))
        return self._update(self._sent)

    def step(self, command: np.ndarray, mode: str = "displacement", *, force: np.ndarray | None = None) -> State:
        refuse_force(force)
        self._check_running()
        command = check_command(self.robot, command, mode)
        if mode != "displacement" and self.bench.device.takes != mode:
            raise ValueError(f"mode = {mode!r} is not available on this bench; allowed: '{self.bench.device.takes}'")
        if mode == "displacement":
            self._check_limits(command)
        if not self._powered:
            raise HardwareError("the drives have no power: call reset first, which moves the robot home")
        with _StopsOnError(self):
            self._power()
            self._cycle(command, mode)
        return self._update(command, mode)

    def _check_running(self) -> None:
        if self.stopped:
            raise HardwareError(f"the robot was stopped: {self.stopped}")

    def _check_limits(self, command: np.ndarray) -> None:
        slack = TINY * (self.robot.upper - self.robot.lower)
        for k, actuator in enumerate(self.robot.actuators):
            value, change = float(command[k]), float(abs(command[k] - self._sent[k]))
            if not actuator.low - slack[k] <= value <= actuator.high + slack[k]:
                raise ValueError(
                    f"command = {value:g} {actuator.unit} of '{actuator.name}' is out of its range; allowed: "
                    f"{actuator.low:g} to {actuator.high:g} {actuator.unit}"
                )
            if change > actuator.rate + slack[k]:
                raise ValueError(
                    f"command of '{actuator.name}' changes by {change:g} {actuator.unit} in a step; allowed: "
                    f"{actuator.rate:g} {actuator.unit}"
                )

    def _power(self) -> None:
        """Give power to the drives unless they have it: at first, and after a silence that their watchdog ended."""
        device, clock = self.bench.device, self.bench.clock
        if self._powered and clock.now() - self._sent_at < PATIENT * self.bench.watchdog:
            return
        device.start(self.bench.watchdog, self.robot.rates * self.bench.rate)
        self._began = self._heard = clock.now()
        if not self._powered and device.takes == "displacement":
            if (found := device.read(self._began + ANSWER * self.bench.watchdog)) is not None:
                self._sent = np.nan_to_num(found.displacement)  # where it stands; not known without encoders
        self._powered = True

    def _cycle(self, command: np.ndarray, mode: str = "displacement") -> None:
        """Send a command, wait for the next control step and read."""
        bench, period = self.bench, 1.0 / self.bench.rate
        sent = self._for_device(command, mode)
        bench.device.send(sent)
        self._sent_at = bench.clock.now()
        if mode == "displacement":
            self._sent = np.array(command)
        self._began += period
        if self._sent_at > self._began:  # the caller took longer than a step
            missed = int((self._sent_at - self._began) / period) + 1
            self.timing.missed += missed
            self._began += missed * period
        bench.clock.wait(self._began)
        self.timing.late.append(bench.clock.now() - self._began)
        self.timing.steps += 1
        self._read(period)
        seen = None if bench.tracker is None else bench.tracker()
        if bench.tracker is not None and seen is None:
            self.timing.unseen += 1
        if seen is not None:
            self._seen = seen
            if self._log is not None:
                self._log.write(sent, self._reading, seen)

    def _read(self, period: float) -> None:
        bench, lost = self.bench, self.bench.device.lost
        for _ in range(2):
            found = bench.device.read(bench.clock.now() + ANSWER * period)
            if found is not None:
                self._reading, self._heard = found, bench.clock.now()
                break
        else:
            silence = bench.clock.now() - self._heard
            if silence > bench.watchdog - period:  # the next step would be too late
                raise HardwareError(f"the device has not answered for {1e3 * silence:.0f} ms")
        self.timing.lost += bench.device.lost - lost

    def _for_device(self, command: np.ndarray, mode: str) -> np.ndarray:
        """Return what a device takes for a command: its efforts are those of the model under displacements."""
        if self.bench.device.takes == mode:
            return command
        return np.maximum(self._model.probe(command, mode).effort, np.where(self.robot.unilateral, 0.0, -np.inf))

    def _update(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return the state: what was measured, and what the model says where nothing was."""
        reading, where = self._reading, command
        if mode == "displacement":
            where = np.where(np.isnan(reading.displacement), command, reading.displacement)
        expected = self._model.step(where, mode)
        if mode == "effort":
            self._sent = expected.displacement  # from where the way home begins
        effector = expected.effector if self._seen is None else self._seen
        self.state = replace(
            expected,
            command=np.array(command),
            # Encoders do not see how far a slack cable hangs through.
            displacement=np.where(
                np.isnan(reading.displacement) | expected.slack, expected.displacement, reading.displacement
            ),
            effort=np.where(np.isnan(reading.effort), expected.effort, reading.effort),
            effector=effector,
            condensed=_moved(expected, effector - expected.effector),
        )
        return self.state

    # -- the end ----------------------------------------------------------------------------------------------------

    def stop(self, reason: str = "somebody called stop") -> None:
        """Take the power from the drives at once, from any thread; nothing is sent any more."""
        self.stopped = self.stopped or reason
        self.bench.device.stop()

    def close(self) -> None:
        """Take the power from the drives and close the bench and the log; better bring the robot home before."""
        self.stopped = self.stopped or "it was closed"
        self.bench.close()
        if self._log is not None:
            self._log.close()

    # -- what only models can do ------------------------------------------------------------------------------------

    def probe(self, command: np.ndarray, mode: str = "displacement") -> State:
        """Return what the model says of a command; the robot does not move."""
        return self._model.probe(command, mode)

    def restore(self, state: State) -> None:
        raise HardwareError("a physical robot cannot be put back into an earlier state")


class _StopsOnError:
    """Stops the robot if anything goes wrong in a block, an interrupt included."""

    def __init__(self, backend: HardwareBackend) -> None:
        self._backend = backend

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if error is not None:
            self._backend.stop(str(error) or type(error).__name__)


class _Log:
    """What drives did and where effectors were seen, as `softgym calibrate` reads it."""

    def __init__(self, path: Path, robot: Robot, takes: str, trial: str) -> None:
        from softgym_envs.extensions.design.measurements import columns_of

        displacement, effort, effector = columns_of(robot)
        self._robot, self._moves = robot, takes == "displacement"
        self._imposed, self._measured = (displacement, effort) if self._moves else (effort, [])
        self._effector, self._trial = effector, trial
        path.parent.mkdir(parents=True, exist_ok=True)
        self._new = not path.exists() or path.stat().st_size == 0
        self._stream = open(path, "a", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def write(self, sent: np.ndarray, reading: Reading, effector: np.ndarray) -> None:
        """Write one step: what the drives did where they measure it, else what was sent; efforts; what was seen."""
        did = reading.displacement if self._moves else reading.effort
        did = np.where(np.isnan(did), sent, did)
        if self._moves:  # a step of an encoder beyond the range is no motion beyond it
            low, high = self._robot.lower, self._robot.upper
            near = ENCODER * (high - low)
            did = np.where((did > low - near) & (did < high + near), np.clip(did, low, high), did)
        efforts = [] if np.isnan(reading.effort).any() or not self._moves else reading.effort.tolist()
        if self._new:
            names = self._measured if efforts else []
            self._writer.writerow(["trial", *self._imposed, *names, *self._effector])
            self._new = False
        self._writer.writerow([self._trial, *did.tolist(), *efforts, *effector.ravel().tolist()])

    def close(self) -> None:
        self._stream.close()


def _moved(state: State, by: np.ndarray) -> Callable[[], CondensedModel]:
    """Return the condensed model of a state whose effectors were seen elsewhere, by an offset (k, 3)."""

    def condensed() -> CondensedModel:
        model = state.condensed
        free = np.array(model.free)
        free[model.slices["e"]] += by.ravel()
        return replace(model, free=free)

    return condensed

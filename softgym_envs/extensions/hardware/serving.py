"""Emulated benches in a process of their own, behind pseudo-terminals that take the place of serial ports."""

from __future__ import annotations

import multiprocessing
import os
import select
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from softgym_envs.envs.plant import Plant
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.hardware.bench import BenchConfig
from softgym_envs.extensions.hardware.device import Clock, HardwareError
from softgym_envs.extensions.hardware.dynamixel import DynamixelConfig
from softgym_envs.extensions.hardware.emulation import (
    Emulated,
    EmulatedPressureBoard,
    EmulatedServoBus,
    Losses,
    SimulatedBody,
)
from softgym_envs.extensions.hardware.pressure_board import PressureBoardConfig

TRACKER_RATE = 100.0
"""Positions that are sent per second."""
PATIENCE = 600.0
"""Time that the process of an emulation has to start, the compilation of kernels included [s]."""


class PseudoTerminal:
    """A pseudo-terminal; ``path`` is opened like a serial port, and ``master`` is the other end."""

    def __init__(self) -> None:
        import tty

        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)  # nothing is echoed or translated
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)

    def write(self, data: bytes) -> None:
        """Write bytes; what nobody reads is lost, as on a serial line."""
        try:
            os.write(self.master, data)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Close both ends."""
        os.close(self.master)
        os.close(self._slave)


def make_emulated(config: BenchConfig, body: SimulatedBody, losses: Losses | None = None) -> Any:
    """Return the emulated device of a bench, which moves a body.

    Raises:
        ConfigError: for a device of which there is no emulation.
    """
    settings = config.settings
    if isinstance(settings, DynamixelConfig):
        return EmulatedServoBus(body, settings, losses)
    if isinstance(settings, PressureBoardConfig):
        channels = [settings.channels[actuator.name] for actuator in body.robot.actuators]
        return EmulatedPressureBoard(body, channels, max(channels) + 1, settings.max_pressure, losses)
    raise ConfigError(f"device '{config.device}' has no emulation; allowed: dynamixel, pressure_board")


def serve(config: BenchConfig, options: dict[str, Any], pipe: Connection) -> None:
    """Serve an emulated bench until the other end of a pipe is closed; sends the paths of its ports first."""
    body = SimulatedBody(
        config.make_robot(),
        config.design,
        backend=options.get("backend", "surrogate"),
        plant=Plant(**options.get("plant", {})),
        latency=options.get("latency", 0.0),
    )
    device: Emulated = make_emulated(config, body, Losses(**options.get("losses", {})))
    line, tracker, clock = PseudoTerminal(), PseudoTerminal(), Clock()
    device.move(clock.now())  # compiles what it needs
    pipe.send((line.path, tracker.path))
    next_position = clock.now()
    try:
        while not pipe.poll():
            select.select([line.master, pipe.fileno()], [], [], max(next_position - clock.now(), 0.0))
            try:
                data = os.read(line.master, 4096)
            except BlockingIOError:
                data = b""
            if answer := device.feed(clock.now(), data):
                line.write(answer)
            if clock.now() >= next_position:
                next_position = max(next_position + 1.0 / TRACKER_RATE, clock.now())
                positions = " ".join(f"{value:.7f}" for value in body.seen(clock.now()).ravel().tolist())
                tracker.write(f"{positions}\n".encode())
    except (KeyboardInterrupt, EOFError):
        pass
    finally:
        line.close()
        tracker.close()


@contextmanager
def emulated(config: BenchConfig, **options: Any) -> Iterator[BenchConfig]:
    """Yield a bench whose ports are those of an emulation in another process, which ends with the block.

    Args:
        config: the bench that is emulated.
        **options: ``backend`` of the body, ``plant`` and ``losses`` as mappings, ``latency`` of the tracker [s].

    Raises:
        HardwareError: if the emulation does not start.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(config, options, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        try:
            if not ours.poll(PATIENCE):
                raise HardwareError(f"the emulation did not start within {PATIENCE:g} s")
            port, tracker = ours.recv()
        except EOFError:
            raise HardwareError("the emulation did not start; see the error above") from None
        settings = config.settings.model_copy(update={"port": port})
        seen = {} if config.tracker is None else {"tracker": config.tracker.model_copy(update={"port": tracker})}
        yield config.model_copy(update={"settings": settings, **seen})
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.terminate()

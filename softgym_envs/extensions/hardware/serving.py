"""Emulated benches in real time, behind pseudo-terminals that take the place of serial ports."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Mapping
from typing import Any

from softgym_envs.envs.plant import Plant
from softgym_envs.extensions.hardware.bench import BenchConfig
from softgym_envs.extensions.hardware.device import Clock
from softgym_envs.extensions.hardware.emulation import Emulated, Losses, SimulatedBody
from softgym_envs.extensions.hardware.simulated_time import make_emulated

TRACKER_RATE = 100.0
"""Positions that are sent per second."""


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


def serve(
    config: BenchConfig,
    ready: Callable[[str, str], None],
    *,
    backend: str = "surrogate",
    plant: Mapping[str, Any] | None = None,
    losses: Mapping[str, Any] | None = None,
    latency: float = 0.0,
) -> None:
    """Serve an emulated bench until Ctrl-C.

    Args:
        config: the bench that is emulated.
        ready: called with the paths of the device and of the tracker once they answer.
        backend: physics of the body.
        plant: how it differs from its model, arguments of `Plant`.
        losses: what the line does, arguments of `Losses`.
        latency: age of the positions that the tracker sends [s].
    """
    robot = config.make_robot()
    body = SimulatedBody(robot, config.design, backend=backend, plant=Plant(**(plant or {})), latency=latency)
    device: Emulated = make_emulated(config, body, Losses(**(losses or {})))
    line, tracker, clock = PseudoTerminal(), PseudoTerminal(), Clock()
    device.move(clock.now())  # compiles what it needs
    ready(line.path, tracker.path)
    next_position = clock.now()
    try:
        while True:
            select.select([line.master], [], [], max(next_position - clock.now(), 0.0))
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
    except KeyboardInterrupt:
        pass
    finally:
        line.close()
        tracker.close()

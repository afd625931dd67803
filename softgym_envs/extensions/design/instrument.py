"""How the numbers of a recording follow from those of a body: drives that do something else, and the sensor's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Instrument:
    """Drives and the frame of the sensor of a recording.

    Attributes:
        gain: what each drive does over what was recorded as its command, shape (n_a,).
        offset: what the recorded command reads besides, shape (n_a,).
        backlash: width of the play of each drive, shape (n_a,).
        compliance: how far each cable stretches per tension [m/N], shape (n_a,).
        friction: coefficient of friction of the cables.
        turn: angles by which the sensor's frame is turned, about the axes x, y and z in this order [rad], shape (3,).
        shift: where the body's origin is in the sensor's frame [m], shape (3,).
    """

    gain: np.ndarray
    offset: np.ndarray
    backlash: np.ndarray
    compliance: np.ndarray
    friction: float
    turn: np.ndarray
    shift: np.ndarray

    def driven(self, commands: np.ndarray, trial: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the drives did, with derivatives.

        Each trial begins at rest, where they are at zero.

        Args:
            commands: recorded, shape (N, n_a).
            trial: of each row, or empty for one trial; the rows of a trial follow each other in time.

        Returns:
            What they did, shape (N, n_a). From which row each took its command when it moved last, -1 for one that
            has not moved in its trial, shape (N, n_a); and on which side of its play it was then: the derivative with
            respect to its width, shape (N, n_a).
        """
        wanted = self.gain * commands - self.offset
        if not self.backlash.any():
            rows = np.arange(len(wanted))[:, None]
            return wanted, np.broadcast_to(rows, wanted.shape), np.zeros(wanted.shape)
        done, source, side = wanted.copy(), np.zeros(wanted.shape, dtype=np.int64), np.zeros(wanted.shape)
        still = np.zeros(wanted.shape[1]), np.full(wanted.shape[1], -1), np.zeros(wanted.shape[1])
        for i in range(len(wanted)):
            begins = i == 0 or (len(trial) and trial[i] != trial[i - 1])
            at, since, edge = still if begins else (done[i - 1], source[i - 1], side[i - 1])
            low, high = wanted[i] - 0.5 * self.backlash, wanted[i] + 0.5 * self.backlash
            done[i] = np.clip(at, low, high)
            moved = (at < low) | (at > high)
            source[i] = np.where(moved, i, since)
            side[i] = np.where(moved, np.where(at < low, -0.5, 0.5), edge)
        return done, source, side

    def rotation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation (3, 3) from the body's frame to the sensor's, and its derivatives (3, 3, 3) by `turn`."""
        parts, slopes = [], []
        for axis, angle in enumerate(self.turn):
            first, second = (axis + 1) % 3, (axis + 2) % 3
            part, slope = np.eye(3), np.zeros((3, 3))
            part[[first, second], [first, second]] = slope[second, first] = np.cos(angle)
            part[second, first] = np.sin(angle)
            part[first, second] = slope[[first, second], [first, second]] = -np.sin(angle)
            slope[first, second] = -np.cos(angle)
            parts.append(part)
            slopes.append(slope)
        x, y, z = parts
        dx, dy, dz = slopes
        return z @ y @ x, np.stack([z @ y @ dx, z @ dy @ x, dz @ y @ x])

    def seen(self, effector: np.ndarray) -> np.ndarray:
        """Return positions [m] (N, 3 k) of the body as the sensor shows them."""
        rotation, _ = self.rotation()
        return (effector.reshape(len(effector), -1, 3) @ rotation.T + self.shift).reshape(effector.shape)

    def plant(self, names: Sequence[str]) -> dict[str, dict[str, float] | float]:
        """Return the option ``plant`` of environments for drives with these names; what is exact is left out."""
        values = {"gain": self.gain, "offset": -self.offset, "backlash": self.backlash}
        values["cable_compliance"] = self.compliance
        found: dict[str, dict[str, float] | float] = {
            name: dict(zip(names, map(float, array), strict=True))
            for name, array in values.items()
            if (array != (1.0 if name == "gain" else 0.0)).any()
        }
        return found | ({"cable_friction": self.friction} if self.friction else {})

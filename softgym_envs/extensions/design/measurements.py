"""Measured states of a robot: read from a file, or simulated."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.registry import make_backend
from softgym_envs.errors import DataError, unknown_name
from softgym_envs.extensions.design.contact import Plane, step_towards_plane
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Measurements:
    """N states of one body. Columns that were not measured are NaN."""

    driven: Literal["displacement", "effort"]  # what was imposed on the actuators
    displacement: np.ndarray  # of the actuators [m, ...], shape (N, n_a)
    effort: np.ndarray  # of the actuators [N, ...], shape (N, n_a)
    effector: np.ndarray  # positions [m], shape (N, 3 k) for k effectors
    trial: tuple[str, ...] = ()  # name of the trial of each row; empty if there is one

    def __len__(self) -> int:
        return len(self.effector)

    @property
    def command(self) -> np.ndarray:
        """The imposed displacements or efforts, shape (N, n_a)."""
        return self.displacement if self.driven == "displacement" else self.effort

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of the trials in their order."""
        return tuple(dict.fromkeys(self.trial))

    def part(self, rows: np.ndarray) -> Measurements:
        """Return the rows of a mask (N,)."""
        trial = tuple(name for name, kept in zip(self.trial, rows, strict=bool(self.trial)) if kept)
        return Measurements(self.driven, self.displacement[rows], self.effort[rows], self.effector[rows], trial)

    def split(self, held_out: Sequence[str]) -> tuple[Measurements, Measurements]:
        """Return the rows to fit and those of the named trials.

        Raises:
            DataError: for a name that is no trial, or if nothing is left to fit.
        """
        for name in held_out:
            if name not in self.trial:
                raise DataError(unknown_name("trial", name, self.trials))
        kept = np.array([name not in held_out for name in self.trial]) if self.trial else np.ones(len(self), dtype=bool)
        if not kept.any():
            raise DataError("held_out names every trial: nothing is left to fit")
        return self.part(kept), self.part(~kept)

    def with_noise(self, relative: float, rng: np.random.Generator) -> Measurements:
        """Return a copy with Gaussian noise on the measured columns, not on the imposed ones.

        The standard deviation is relative to the root mean square of the efforts, and of the distances of the effectors
        from their mean.
        """
        away = self.effector - self.effector.mean(axis=0)
        spread = np.sqrt(np.nanmean(away**2)) if np.isfinite(away).any() else 0.0
        noisy = replace(self, effector=self.effector + rng.normal(0.0, relative * spread, self.effector.shape))
        if self.driven == "displacement":
            size = np.sqrt(np.mean(self.effort**2))
            noisy = replace(noisy, effort=self.effort + rng.normal(0.0, relative * size, self.effort.shape))
        return noisy


def columns_of(robot: Robot) -> tuple[list[str], list[str], list[str]]:
    """Return the names of the columns of displacements, efforts and effector coordinates."""
    return (
        [f"{actuator.name}_displacement" for actuator in robot.actuators],
        [f"{actuator.name}_effort" for actuator in robot.actuators],
        [f"{effector}_{axis}" for effector in robot.effectors for axis in AXES],
    )


def read_measurements(path: str | Path, robot: Robot) -> Measurements:
    """Return measured states from a file, in SI units: metres, newtons, cubic metres, pascals.

    A CSV file has a header; a JSON file is a list of records, or an object of columns. The columns are
    ``<actuator>_displacement`` or ``<actuator>_effort`` of every actuator, and those of ``<effector>_x``, ``_y`` and
    ``_z`` that were measured. With displacements and efforts, the displacements were imposed and the efforts measured.
    A column ``trial`` names the trial of each row; the rows of a trial follow each other in time.

    Args:
        path: file name that ends with .csv or .json.
        robot: the measured robot.

    Raises:
        DataError: if the file is missing or malformed; the message names the column, the row and what is allowed.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".json": _read_json}
    if path.suffix not in readers:
        raise DataError(f"measurements '{path}' must end with {' or '.join(readers)}")
    try:
        table = readers[path.suffix](path)
    except (OSError, UnicodeDecodeError, csv.Error, ValueError, RecursionError) as error:
        raise DataError(f"measurements '{path}' cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return _checked(path, table, robot)


def write_measurements(path: str | Path, robot: Robot, data: Measurements) -> None:
    """Write a CSV file for `read_measurements`. Columns of NaN are left out."""
    names = [name for group in columns_of(robot) for name in group]
    table = np.column_stack([data.displacement, data.effort, data.effector])
    if data.driven == "effort":  # a column of displacements would mean that they were imposed
        table[:, : data.displacement.shape[1]] = np.nan
    kept = ~np.isnan(table).any(axis=0)
    with atomic_write(path, "w") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        trial = [[name] for name in data.trial] or [[]] * len(data)
        writer.writerow([*(["trial"] if data.trial else []), *np.array(names)[kept]])
        writer.writerows(
            [*t, *(repr(float(value)) for value in row)] for t, row in zip(trial, table[:, kept], strict=True)
        )


def measure(
    robot: Robot,
    design: Mapping[str, float],
    commands: Sequence[Sequence[float]] | np.ndarray,
    *,
    driven: Literal["displacement", "effort"] = "displacement",
    backend: str = "fem",
    plane: Plane | None = None,
) -> Measurements:
    """Return simulated measurements.

    Args:
        robot: the robot.
        design: the body; missing variables take their baseline.
        commands: imposed displacements or efforts, shape (N, n_a).
        driven: whether displacements or efforts are imposed.
        backend: ``"fem"`` or ``"surrogate"``.
        plane: a plane in the way of the first effector, on FEM.

    Raises:
        ValueError: for a plane on a surrogate, another value of ``driven`` or no commands.
        InfeasibleDesign: if the geometry cannot exist.
        ConvergenceError: if an equilibrium is not found.
    """
    if driven not in ("displacement", "effort"):
        raise ValueError(f"driven = {driven!r} is unknown; allowed: 'displacement', 'effort'")
    if len(commands) == 0:
        raise ValueError("commands is empty; give one or more commands of the actuators")
    physics = make_backend(backend, robot, design=design)
    imposed = [np.asarray(command, dtype=float) for command in commands]
    if plane is None:
        states = [physics.step(command, driven) for command in imposed]
    elif isinstance(physics, FEMBackend):
        rest = physics.state.effector[0]
        states = [step_towards_plane(physics, command, driven, plane, rest) for command in imposed]
    else:
        raise ValueError(f"a plane needs backend 'fem', got '{backend}'")
    return Measurements(
        driven,
        # A slack cable does not reach the imposed displacement.
        displacement=np.array([s.command if driven == "displacement" else s.displacement for s in states]),
        effort=np.array([state.effort for state in states]),
        effector=np.array([state.effector.ravel() for state in states]),
    )


def _read_csv(path: Path) -> dict[str, list]:
    with open(path, newline="", encoding="utf-8-sig") as stream:
        rows = [row for row in csv.reader(stream) if row]
    if not rows:
        raise ValueError("it is empty")
    header = [name.strip() for name in rows[0]]
    if len(set(header)) != len(header):
        raise ValueError(f"its header has a column twice: {', '.join(header)}")
    for number, row in enumerate(rows[1:], start=1):
        if len(row) != len(header):
            raise ValueError(f"row {number} has {len(row)} values, the header {len(header)}")
    return {name: [row[k] for row in rows[1:]] for k, name in enumerate(header)}


def _read_json(path: Path) -> dict[str, list]:
    data = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(data, list) and all(isinstance(record, dict) for record in data):
        names = list(data[0]) if data else []
        for number, record in enumerate(data, start=1):
            if set(record) != set(names):
                raise ValueError(f"record {number} has {', '.join(record)}, the first {', '.join(names)}")
        return {name: [record[name] for record in data] for name in names}
    if isinstance(data, dict) and all(isinstance(column, list) for column in data.values()):
        if len({len(column) for column in data.values()}) > 1:
            raise ValueError(f"its columns differ in length: { {k: len(v) for k, v in data.items()} }")
        return data
    raise ValueError("it must be a list of records, or an object of columns")


def _checked(path: Path, table: dict[str, list], robot: Robot) -> Measurements:
    displacement, effort, effector = columns_of(robot)
    where = f"measurements '{path}'"
    trial = tuple(str(name) for name in table.pop("trial", ()))
    found = _numbers(where, table, [*displacement, *effort, *effector])
    driven: Literal["displacement", "effort"]
    if all(name in table for name in displacement):
        driven = "displacement"
    elif all(name in table for name in effort):
        driven = "effort"
    else:
        raise DataError(f"{where}: it needs the columns {', '.join(displacement)}, or {', '.join(effort)}")
    given = [name for name in (displacement if driven == "effort" else effort) if name in table]
    if given and (driven == "effort" or len(given) < len(effort)):
        raise DataError(f"{where}: column '{given[0]}' is present, but not the same column of every actuator")
    if not any(name in table for name in (*effector, *(effort if driven == "displacement" else ()))):
        raise DataError(f"{where}: nothing was measured; give some of {', '.join(effector)}")
    far = 10.0 * robot.size
    for name in effector:
        if name in table and np.abs(found[name]).max() > far:
            raise DataError(
                f"{where}: column '{name}' reaches {np.abs(found[name]).max():g} m, on a robot of {robot.size:g} m; "
                "did you mean metres?"
            )

    def block(names: list[str]) -> np.ndarray:
        return np.column_stack([found[name] for name in names])

    data = Measurements(driven, block(displacement), block(effort), block(effector), trial)
    _check_imposed(where, data, robot)
    return data


def _numbers(where: str, table: dict[str, list], known: list[str]) -> dict[str, np.ndarray]:
    """Return all known columns as numbers; those that the table lacks are NaN."""
    for name in table:
        if name not in known:
            raise DataError(f"{where}: {unknown_name('column', name, known)}")
    count = len(next(iter(table.values()), []))
    if count == 0:
        raise DataError(f"{where}: it contains no states")
    found = {name: np.full(count, np.nan) for name in known}
    for name, column in table.items():
        for k, entry in enumerate(column):
            try:
                value = math.nan if isinstance(entry, bool) else float(entry)
            except (TypeError, ValueError):
                value = math.nan
            if not math.isfinite(value):
                raise DataError(f"{where}: column '{name}', row {k + 1}: {entry!r} is not a finite number")
            found[name][k] = value
    return found


def _check_imposed(where: str, data: Measurements, robot: Robot) -> None:
    """Raise DataError for an imposed displacement or effort that its actuator cannot have."""
    for actuator, values in zip(robot.actuators, data.command.T, strict=True):
        if data.driven == "displacement":
            low, high, unit = actuator.low, actuator.high, f" {actuator.unit}"
            slack = 1e-6 * (high - low)
        else:
            low, high, unit = (0.0 if actuator.unilateral else -actuator.max_effort), actuator.max_effort, ""
            slack = 0.0
        outside = np.flatnonzero((values < low - slack) | (values > high + slack))
        if len(outside):
            raise DataError(
                f"{where}: {data.driven} {values[outside[0]]:g}{unit} of '{actuator.name}' in row {outside[0] + 1} is "
                f"out of bounds; allowed: {low:g} to {high:g}{unit}"
            )

"""The fitted quantities of a calibration as a point in [-1, 1]^p."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softgym_envs.extensions.design.box import Box
from softgym_envs.extensions.design.instrument import Instrument
from softgym_envs.extensions.design.measurements import columns_of
from softgym_envs.extensions.design.nuisance import ContactConfig, Nuisances, OffsetConfig, make_instrument
from softgym_envs.robots.base import Robot


@dataclass(frozen=True)
class Quantities:
    """What B points stand for, as tensors."""

    design: Tensor  # complete designs without robot options, shape (B, len(space))
    offsets: Tensor  # of the columns of displacements, efforts and effectors, shape (B, 2 n_a + n_e)
    distance: Tensor | None  # of the plane of contact [m], shape (B,)


class Parameters:
    """Fitted variables of a body and nuisance parameters, in coordinates in which the body changes evenly.

    Poisson's ratio nu has the coordinate ``-log(0.5 - nu)``, scaled: thesis, eq. 3.14, with ``nu_inf = 0.5`` instead of
    0.501. Close to 0.5, a body depends on ``1 - 2 nu`` over orders of magnitude. Other variables are scaled as in
    `softgym_envs.designs.DesignVariable.to_unit`, nuisance parameters linearly.
    """

    def __init__(self, robot: Robot, box: Box, nuisances: Nuisances | None = None) -> None:
        self.box = box
        self.robot = robot
        self.nuisances = dict(nuisances or {})
        self.names = (*box.names, *self.nuisances)
        columns = [name for group in columns_of(robot) for name in group]
        #: (name, index of its column) of each offset.
        self.offsets = [(n, columns.index(c.column)) for n, c in self.nuisances.items() if isinstance(c, OffsetConfig)]
        self._column_count = len(columns)
        contacts = [(name, c) for name, c in self.nuisances.items() if isinstance(c, ContactConfig)]
        self._contact = contacts[0][0] if contacts else None
        #: Direction towards the plane of contact, shape (3,), or None.
        self.normal = contacts[0][1].direction if contacts else None

    def __len__(self) -> int:
        return len(self.names)

    def first(self, start: Mapping[str, float]) -> np.ndarray:
        """Return the point (p,) of a start ``{name: value}``; missing values are the reference and the first values."""
        variables = {name: value for name, value in start.items() if name not in self.nuisances}
        values = {**self.box.reference, **self.box.check_start(variables)}
        values |= {name: start.get(name, nuisance.first) for name, nuisance in self.nuisances.items()}
        return np.clip(self.point(values), -1.0, 1.0)

    def point(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the point (p,) of the values of all parameters."""
        unit = self.box.unit(values)
        for k, name in enumerate(self.box.names):
            if name == "poisson_ratio":
                low, high = self._log_ratios()
                unit[k] = 2.0 * (-np.log(0.5 - values[name]) - low) / (high - low) - 1.0
        nuisances = [
            2.0 * (values[name] - nuisance.bounds[0]) / (nuisance.bounds[1] - nuisance.bounds[0]) - 1.0
            for name, nuisance in self.nuisances.items()
        ]
        return np.array([*unit, *nuisances])

    def values(self, point: np.ndarray) -> dict[str, float]:
        """Return the complete design, robot options and nuisance parameters of a point (p,)."""
        tensor = torch.as_tensor(np.asarray(point, dtype=float)[None])
        free = self.box.free.from_unit(np.asarray(point, dtype=float)[: len(self.box)])
        design = dict(zip(self.box.space.names, self.design(tensor)[0].tolist(), strict=True))
        return {**self.box.reference, **free, **design, **{n: float(v[0]) for n, v in self._nuisances(tensor).items()}}

    def design(self, point: Tensor) -> Tensor:
        """Return complete designs (B, len(space)) of points (B, p), with gradients."""
        values = self.box.values(point[:, : len(self.box)])
        if "poisson_ratio" not in self.box.names:
            return values
        low, high = self._log_ratios()
        k = self.box.names.index("poisson_ratio")
        ratio = 0.5 - torch.exp(-(low + 0.5 * (point[:, k] + 1.0) * (high - low)))
        column = self.box.space.names.index("poisson_ratio")
        return torch.cat([values[:, :column], ratio[:, None], values[:, column + 1 :]], dim=1)

    def quantities(self, point: Tensor) -> Quantities:
        """Return what points (B, p) stand for, with gradients."""
        nuisances = self._nuisances(point)
        columns = [torch.zeros(len(point), dtype=torch.float64)] * self._column_count
        for name, column in self.offsets:
            columns[column] = columns[column] + nuisances[name]
        distance = None if self._contact is None else nuisances[self._contact]
        return Quantities(self.design(point), torch.stack(columns, dim=1), distance)

    def slope(self, name: str) -> float:
        """Return the derivative of a nuisance parameter by its coordinate [its unit]."""
        low, high = self.nuisances[name].bounds
        return 0.5 * (high - low)

    def instrument(self, values: Mapping[str, float], driven: str) -> Instrument:
        """Return the drives and the sensor's frame for the values of all parameters; see `make_instrument`."""
        return make_instrument(values, self.nuisances, self.robot, driven)

    def _nuisances(self, point: Tensor) -> dict[str, Tensor]:
        return {
            name: c.bounds[0] + 0.5 * (point[:, len(self.box) + k] + 1.0) * (c.bounds[1] - c.bounds[0])
            for k, (name, c) in enumerate(self.nuisances.items())
        }

    def _log_ratios(self) -> tuple[float, float]:
        variable = self.box.free["poisson_ratio"]
        return float(-np.log(0.5 - variable.low)), float(-np.log(0.5 - variable.high))

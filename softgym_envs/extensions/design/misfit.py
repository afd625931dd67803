"""Residuals of a body against measured states, on a surrogate or on FEM (thesis, eq. 3.9)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import solve_displacements, solve_efforts
from softgym_envs.codesign.variables import split_values
from softgym_envs.errors import ConfigError, ConvergenceError, DataError
from softgym_envs.extensions.design.bodies import RobotMaker, learned_model
from softgym_envs.extensions.design.contact import Plane, step_towards_plane
from softgym_envs.extensions.design.instrument import Instrument
from softgym_envs.extensions.design.measurements import Measurements, columns_of
from softgym_envs.extensions.design.nuisance import ContactConfig, FrameConfig, FrictionConfig, OffsetConfig
from softgym_envs.extensions.design.parameters import Parameters
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.model import Context


class Misfit(ABC):
    """Residuals of a body against measurements, each relative to the size of what was measured.

    Effector coordinates are divided by the root mean square of their distances from their mean, efforts by their own
    root mean square. There are ``count`` residuals, which were computed ``evaluations`` times so far. One that
    does not fit, but predicts, takes any number of states.

    Raises:
        ConfigError: for an offset of a column that was not measured.
        DataError: if there are not more measured numbers than parameters, or they do not vary at all.
    """

    backend: str
    """Name of the backend that predicts."""

    def __init__(self, robot: Robot, parameters: Parameters, data: Measurements, *, fits: bool = True) -> None:
        self.robot, self.parameters, self.data = robot, parameters, data
        efforts = data.effort if data.driven == "displacement" else np.full_like(data.effort, np.nan)
        self._measured = np.column_stack([efforts, data.effector])
        self._columns = np.flatnonzero(~np.isnan(self._measured).any(axis=0))
        n = self._actuators = efforts.shape[1]
        self._check_offsets()
        kept, spread = self._columns, np.ones(self._measured.shape[1])
        if (group := kept[kept < n]).size:
            spread[:n] = np.sqrt(np.mean(self._measured[:, group] ** 2))
        if (group := kept[kept >= n]).size:
            away = self._measured[:, group] - self._measured[:, group].mean(axis=0)
            spread[n:] = np.sqrt(np.mean(away**2))
        self._scale = spread[kept]
        self.count = len(data) * len(kept)
        self.evaluations = 0
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        if not fits:
            self._scale = np.ones(len(kept))
        elif not (self._scale > 0.0).all():
            what = "there is only one measured state" if len(data) == 1 else "the measured states are all the same"
            raise DataError(f"{what}: nothing can be fitted")
        if fits and self.count <= len(parameters):
            raise DataError(
                f"{self.count} measured numbers cannot determine {len(parameters)} parameters and their error"
            )

    def _check_offsets(self) -> None:
        """Raise ConfigError for an offset of a column that is neither imposed nor measured."""
        n = self._actuators
        imposed = np.arange(n) + (0 if self.data.driven == "displacement" else n)
        known = {*imposed.tolist(), *(self._columns + n).tolist()}
        for name, column in self.parameters.offsets:
            if column not in known:
                raise ConfigError(f"nuisances: the column of '{name}' was neither imposed nor measured")

    @abstractmethod
    def readings(self, point: np.ndarray) -> np.ndarray:
        """Return the predicted readings of efforts and effectors at a point (p,), shape (N, n_a + n_e)."""

    @abstractmethod
    def jacobian(self, point: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals, shape (count, p)."""

    def residuals(self, point: np.ndarray) -> np.ndarray:
        """Return the residuals at a point (p,), shape (count,)."""
        if self._last is not None and np.array_equal(self._last[0], point):
            return self._last[1]
        self.evaluations += 1
        found = ((self.readings(point) - self._measured)[:, self._columns] / self._scale).ravel()
        self._last = np.array(point, dtype=float), found
        return found

    def cost(self, point: np.ndarray) -> float:
        """Return the sum of the squared residuals."""
        return float(np.sum(self.residuals(point) ** 2))

    def errors(self, point: np.ndarray) -> dict[str, float]:
        """Return the root mean square errors of ``effort`` [N, ...] and ``effector`` [m], if they were measured."""
        error = self.residuals(point).reshape(len(self.data), -1) * self._scale
        groups = {"effort": self._columns < self._actuators, "effector": self._columns >= self._actuators}
        return {name: float(np.sqrt(np.mean(error[:, g] ** 2))) for name, g in groups.items() if g.any()}


class LearnedMisfit(Misfit):
    """Residuals of a surrogate, with exact derivatives, also for actuators driven in effort and for slack cables.

    Raises:
        ConfigError: as for `Misfit`, and if the network of the weights has no exact derivatives.
    """

    def __init__(
        self,
        robot: Robot,
        parameters: Parameters,
        data: Measurements,
        weights: str | Path | None = None,
        *,
        fits: bool = True,
    ) -> None:
        super().__init__(robot, parameters, data, fits=fits)
        self.backend = "surrogate"
        self.net = learned_model(robot, weights)
        self._unilateral = robot.unilateral
        self._reached = np.zeros(data.command.shape)

    def readings(self, point: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return self._predict(torch.tensor(np.tile(point, (len(self.data), 1)), dtype=torch.float64)).numpy()

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        rows = torch.tensor(np.tile(point, (len(self.data), 1)), dtype=torch.float64, requires_grad=True)
        predicted = self._predict(rows)
        # Each row of the prediction depends on its own copy of the point alone: one backward pass per column.
        columns = [torch.autograd.grad(predicted[:, k].sum(), rows, retain_graph=True)[0] for k in self._columns]
        return (torch.stack(columns, dim=1).numpy() / self._scale[:, None]).reshape(self.count, -1)

    def _predict(self, points: Tensor) -> Tensor:
        """Return the readings (N, n_a + n_e) of N equal points (N, p), with gradients."""
        model, n = self.net.model, self._actuators
        quantities = self.parameters.quantities(points)
        imposed = quantities.offsets[:, :n] if self.data.driven == "displacement" else quantities.offsets[:, n : 2 * n]
        command = torch.as_tensor(self.data.command) - imposed
        given = command.detach().numpy()
        context = Context.shared(model.context(quantities.design[:1].detach().numpy()), len(self.data))
        if self.data.driven == "effort":
            settled = solve_efforts(model, context, given, self._reached)
            free, target = np.ones(given.shape, dtype=bool), command
        else:
            settled = solve_displacements(model, context, given, self._reached, self._unilateral)
            free, target = settled.slack, torch.zeros_like(command)
        if not settled.converged.all():
            raise ConvergenceError("the surrogate finds no state for some of the measured commands")
        self._reached = settled.displacement
        displacement = torch.as_tensor(settled.displacement)
        if self.data.driven == "displacement":
            # Taut cables are exactly where they were commanded to be; the search only ends close to it.
            displacement = torch.where(torch.as_tensor(free), displacement, command)
        if free.any():
            # One more Newton step in double precision, then one that carries the derivatives of the actuators that are
            # driven in effort with respect to the design.
            with torch.no_grad():
                displacement = self._step(quantities.design, displacement, free, target)
            displacement = self._step(quantities.design, displacement, free, target)
        effort, effector, W = self.net(quantities.design, displacement)
        if quantities.distance is not None:
            effort, effector = self._touch(quantities.design, quantities.distance, effort, effector, W, free)
        return torch.cat([effort, effector], dim=1) + quantities.offsets[:, n:]

    def _step(self, design: Tensor, displacement: Tensor, free: np.ndarray, target: Tensor) -> Tensor:
        """Return displacements (N, n_a) after one Newton step of the ``free`` ones towards their efforts ``target``."""
        loose = torch.as_tensor(free)
        effort, _, W = self.net(design, displacement)
        n = effort.shape[1]
        K = torch.linalg.inv(W[:, :n, :n]).detach()
        A = torch.where(loose[:, :, None] & loose[:, None, :], K, torch.eye(n, dtype=torch.float64))
        return displacement - torch.linalg.solve(A, torch.where(loose, effort - target, 0.0))

    def _touch(
        self, design: Tensor, distance: Tensor, effort: Tensor, effector: Tensor, W: Tensor, free: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        """Return efforts and effectors with the force of the plane, from the tangent at the free state (eq. 4.16)."""
        n = effort.shape[1]
        normal = torch.as_tensor(self.parameters.normal)
        rest = self.net(design, torch.zeros_like(effort))[1][:, :3]
        held = torch.as_tensor(~free)
        W_an = W[:, :n, n : n + 3] @ normal
        A = torch.where(held[:, :, None] & held[:, None, :], W[:, :n, :n], torch.eye(n, dtype=torch.float64))
        reaction = torch.linalg.solve(A, torch.where(held, W_an, 0.0))  # efforts of held actuators per contact force
        moved = W[:, n:, n : n + 3] @ normal - (W[:, n:, :n] @ reaction[:, :, None])[:, :, 0]
        overlap = (effector[:, :3] - rest) @ normal - distance
        force = torch.relu(overlap) / (moved[:, :3] @ normal)
        return effort + force[:, None] * reaction, effector - force[:, None] * moved


class FEMMisfit(Misfit):
    """Residuals of finite elements.

    Derivatives by what drives and sensors do are exact, from ``W``; those by the body, its options, friction and the
    distance of a plane are finite differences.
    """

    difference = 1e-4  # in coordinates

    def __init__(
        self,
        robot: Robot,
        parameters: Parameters,
        data: Measurements,
        make_robot: RobotMaker | None = None,
        *,
        fits: bool = True,
    ) -> None:
        super().__init__(robot, parameters, data, fits=fits)
        self.backend = "fem"
        self._make_robot = make_robot
        self._options: dict[str, float] = {}
        self._solved: tuple[np.ndarray, _Solved] | None = None

    def readings(self, point: np.ndarray) -> np.ndarray:
        instrument, offsets = self._instrument(point)
        solved = self._solve(point)
        return np.column_stack([solved.effort, instrument.seen(solved.effector)]) + offsets

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        base = self.residuals(point)
        exact = self._exact(point)
        columns = []
        for k, (name, value) in enumerate(zip(self.parameters.names, point, strict=True)):
            if name in exact:
                columns.append((exact[name][:, self._columns] / self._scale).ravel() * self.parameters.slope(name))
                continue
            moved = np.array(point, dtype=float)
            moved[k] += self.difference if value < 0.0 else -self.difference
            columns.append((self.residuals(moved) - base) / (moved[k] - value))
        return np.stack(columns, axis=1)

    def _instrument(self, point: np.ndarray) -> tuple[Instrument, np.ndarray]:
        """Return drives and frame of the sensor, and the offsets of the measured columns (n_a + n_e,)."""
        values = self.parameters.values(point)
        quantities = self.parameters.quantities(torch.as_tensor(np.asarray(point, dtype=float)[None]))
        return self.parameters.instrument(values, self.data.driven), quantities.offsets[0].numpy()[self._actuators :]

    def _solve(self, point: np.ndarray) -> _Solved:
        """Return the states of the body at a point (p,)."""
        if self._solved is not None and np.array_equal(self._solved[0], point):
            return self._solved[1]
        values = self.parameters.values(point)
        instrument, _ = self._instrument(point)
        distance = self.parameters.quantities(torch.as_tensor(np.asarray(point, dtype=float)[None])).distance
        variables, options = split_values(values)
        if options != self._options:
            assert self._make_robot is not None
            self.robot, self._options = self._make_robot(options), options
        design = {name: variables[name] for name in self.parameters.box.space.names}
        backend = FEMBackend(self.robot, design, cable_friction=instrument.friction)
        # Set afterwards: the body at rest is that without a stretch of its cables.
        backend.cable_compliance = instrument.compliance
        rest = backend.state.effector[0]
        commands, source, side = instrument.driven(self.data.command, self.data.trial)
        states = []
        for command in commands:
            if distance is None:
                states.append(backend.step(command, self.data.driven))
            else:
                assert self.parameters.normal is not None
                plane = Plane(float(distance), self.parameters.normal)
                states.append(step_towards_plane(backend, command, self.data.driven, plane, rest))
        n = self._actuators
        slopes = np.zeros((len(states), n + states[0].effector.size, n))
        for slope, state in zip(slopes, states, strict=True):
            W = state.condensed.W
            if self.data.driven == "effort":
                slope[:n], slope[n:] = np.eye(n), W.ea
                continue
            taut = np.flatnonzero(~state.slack)
            held = np.linalg.inv(W.aa[taut[:, None], taut] + np.diag(instrument.compliance[taut]))
            slope[taut[:, None], taut] = held
            slope[n:, taut] = W.ea[:, taut] @ held
        solved = _Solved(
            effort=np.array([state.effort for state in states]),
            effector=np.array([state.effector.ravel() for state in states]),
            slopes=slopes,
            source=source,
            side=side,
        )
        self._solved = np.array(point, dtype=float), solved
        return solved

    def _exact(self, point: np.ndarray) -> dict[str, np.ndarray]:
        """Return the exact derivatives of the readings (N, n_a + n_e) by name of a nuisance parameter."""
        names = columns_of(self.robot)
        imposed = names[0 if self.data.driven == "displacement" else 1]
        measured = [*names[1], *names[2]]
        solved, (instrument, _) = self._solve(point), self._instrument(point)
        n, count = self._actuators, len(self.data)
        rotation, turned = instrument.rotation()
        bodies = solved.effector.reshape(count, -1, 3)

        driven = solved.source >= 0

        def through(change: np.ndarray) -> np.ndarray:
            """Return the change of the readings for a change of what the drives do (N, n_a)."""
            moved = np.einsum("nij,nj->ni", solved.slopes, change)
            moved[:, n:] = (moved[:, n:].reshape(count, -1, 3) @ rotation.T).reshape(count, -1)
            return moved

        found: dict[str, np.ndarray] = {}
        touched = self.parameters.normal is not None
        for name, nuisance in self.parameters.nuisances.items():
            change = np.zeros((count, n))
            if isinstance(nuisance, FrameConfig):
                kind, axis = nuisance.part.split("_")
                k = "xyz".index(axis)
                slope = bodies @ turned[k].T if kind == "turn" else np.broadcast_to(np.eye(3)[k], bodies.shape)
                found[name] = np.column_stack([np.zeros((count, n)), slope.reshape(count, -1)])
            elif isinstance(nuisance, OffsetConfig) and nuisance.column not in imposed:
                found[name] = np.zeros((count, len(measured)))
                found[name][:, measured.index(nuisance.column)] = 1.0
            elif touched or isinstance(nuisance, ContactConfig | FrictionConfig):
                continue
            elif isinstance(nuisance, OffsetConfig):
                at = [imposed.index(nuisance.column)]
                change[:, at] = -driven[:, at].astype(float)
                found[name] = through(change)
            else:
                at = [imposed.index(column) for column in nuisance.columns]
                if nuisance.kind == "gain":
                    recorded = np.take_along_axis(self.data.command, np.maximum(solved.source, 0), axis=0)
                    change[:, at] = (recorded * driven)[:, at]
                elif nuisance.kind == "backlash":
                    change[:, at] = solved.side[:, at]
                else:
                    change[:, at] = -solved.effort[:, at]
                found[name] = through(change)
        return found


@dataclass(frozen=True)
class _Solved:
    """States of a body under what its drives do.

    Attributes:
        effort: shape (N, n_a).
        effector: in the body's frame [m], shape (N, n_e).
        slopes: derivatives of both by what the drives do, shape (N, n_a + n_e, n_a).
        source: see `Instrument.driven`.
        side: see there.
    """

    effort: np.ndarray
    effector: np.ndarray
    slopes: np.ndarray
    source: np.ndarray
    side: np.ndarray

"""Calibration: the design variables that best explain measured states (thesis 3.4.5 and 4.5.3)."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.tools.bodies import Box, learned_model
from codesign.tools.config import CalibrationConfig
from codesign.tools.folder import run_folder
from codesign.tools.measurements import Measurements, read_measurements
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.backends.surrogate import released, settle
from softgym_envs.config import provenance
from softgym_envs.errors import ConfigError, ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.robots.base import Robot
from softgym_envs.storage import write_json
from softgym_envs.surrogate.model import Context

__all__ = ["Fit", "Misfit", "calibrate", "fit_gradient", "fit_tpe", "profile_interval"]


class Coordinates:
    """The fitted variables as numbers in [-1, 1] in which a body changes evenly.

    Poisson's ratio is ``-log(0.5 - nu)``, scaled: eq. 3.14 with ``nu_inf = 0.5`` instead of 0.501. Near 0.5 a body
    depends on ``1 - 2 nu``, over orders of magnitude. Others are scaled as `DesignVariable.to_unit` does.

    Args:
        box: fitted variables within their bounds.
    """

    def __init__(self, box: Box) -> None:
        self.box = box

    def point(self, design: dict[str, float]) -> np.ndarray:
        """Return the coordinates of a design, shape (p,)."""
        unit = self.box.unit(design)
        for k, name in enumerate(self.box.names):
            if name == "poisson_ratio":
                low, high = self._ends(name)
                unit[k] = 2.0 * (-np.log(0.5 - design[name]) - low) / (high - low) - 1.0
        return unit

    def values(self, point: Tensor) -> Tensor:
        """Return complete designs (B, len(space)) of points (B, p), with gradients."""
        values = self.box.values(point)
        if "poisson_ratio" not in self.box.names:
            return values
        low, high = self._ends("poisson_ratio")
        k = self.box.names.index("poisson_ratio")
        ratio = 0.5 - torch.exp(-(low + 0.5 * (point[:, k] + 1.0) * (high - low)))
        column = self.box.space.names.index("poisson_ratio")
        return torch.cat([values[:, :column], ratio[:, None], values[:, column + 1 :]], dim=1)

    def design(self, point: np.ndarray) -> dict[str, float]:
        """Return the complete design of a point (p,)."""
        row = self.values(torch.as_tensor(np.asarray(point, dtype=float)[None]))[0]
        return dict(zip(self.box.space.names, row.tolist(), strict=True))

    def _ends(self, name: str) -> tuple[float, float]:
        variable = self.box.free[name]
        return float(-np.log(0.5 - variable.low)), float(-np.log(0.5 - variable.high))


class Misfit(ABC):
    """Residuals of a body against measurements, each relative to the size of what was measured.

    Effector coordinates are divided by the root mean square of their distances from their mean, efforts by their own
    root mean square.

    Args:
        robot: the family of bodies.
        box: fitted variables within their bounds.
        data: measured states.

    Raises:
        DataError: if there are no more measured numbers than variables, or they do not vary at all.

    Attributes:
        count: number of residuals.
        evaluations: of the residuals so far.
    """

    def __init__(self, robot: Robot, box: Box, data: Measurements) -> None:
        self.robot, self.data = robot, data
        self.coordinates = Coordinates(box)
        efforts = data.effort if data.driven == "displacement" else np.full_like(data.effort, np.nan)
        self._measured = np.column_stack([efforts, data.effector])
        self._columns = np.flatnonzero(~np.isnan(self._measured).any(axis=0))
        n = efforts.shape[1]
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
        if not (self._scale > 0.0).all():
            what = "one measured state is too little" if len(data) == 1 else "the measured states are all the same"
            raise DataError(f"{what}: nothing can be fitted to them")
        if self.count <= len(box):
            raise DataError(f"{self.count} measured numbers cannot determine {len(box)} variables and their error")

    @abstractmethod
    def predict(self, values: Tensor) -> Tensor:
        """Return efforts and effectors (N, n_a + n_e) of one complete design given as N equal rows."""

    def residuals(self, point: np.ndarray) -> np.ndarray:
        """Return the residuals at a point in coordinates (p,), shape (count,)."""
        if self._last is not None and np.array_equal(self._last[0], point):
            return self._last[1]
        self.evaluations += 1
        with torch.no_grad():
            values = self.coordinates.values(torch.as_tensor(np.asarray(point, dtype=float)[None]))
            predicted = self.predict(values.expand(len(self.data), -1)).numpy()
        found = ((predicted - self._measured)[:, self._columns] / self._scale).ravel()
        self._last = np.array(point, dtype=float), found
        return found

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals, shape (count, p)."""
        rows = torch.tensor(np.tile(point, (len(self.data), 1)), dtype=torch.float64, requires_grad=True)
        predicted = self.predict(self.coordinates.values(rows))
        # A row of the prediction depends on its own copy of the point alone: one backward pass for each column.
        columns = [torch.autograd.grad(predicted[:, k].sum(), rows, retain_graph=True)[0] for k in self._columns]
        return (torch.stack(columns, dim=1).numpy() / self._scale[:, None]).reshape(self.count, -1)

    def errors(self, point: np.ndarray) -> dict[str, float]:
        """Return the root mean square errors, of ``effector`` [m] and ``effort`` [N, ...], where they were measured."""
        error = self.residuals(point).reshape(len(self.data), -1) * self._scale
        n = self.data.effort.shape[1]
        groups = {"effort": self._columns < n, "effector": self._columns >= n}
        return {name: float(np.sqrt(np.mean(error[:, g] ** 2))) for name, g in groups.items() if g.any()}


class LearnedMisfit(Misfit):
    """Residuals of a surrogate, with exact derivatives, also where actuators are driven in effort or hang slack.

    Args:
        robot: the family of bodies.
        box: fitted variables within their bounds.
        data: measured states.
        weights: folder of the surrogate's weights; default the shipped ones.

    Raises:
        ConfigError: if the network of the weights has no exact derivatives.
        DataError: as for `Misfit`.
    """

    def __init__(self, robot: Robot, box: Box, data: Measurements, weights: str | Path | None = None) -> None:
        super().__init__(robot, box, data)
        self.net = learned_model(robot, weights)
        self._unilateral = robot.unilateral
        self._reached = np.zeros(data.command.shape)

    def predict(self, values: Tensor) -> Tensor:
        model, count = self.net.model, len(self.data)
        context = Context.shared(model.context(values[:1].detach().numpy()), count)
        if self.data.driven == "effort":
            settled = released(model, context, self.data.effort, self._reached)
            free, target = np.ones(self.data.effort.shape, dtype=bool), self.data.effort
        else:
            settled = settle(model, context, self.data.displacement, self._reached, self._unilateral)
            free, target = settled.slack, np.zeros(self.data.effort.shape)
        if not settled.converged.all():
            raise ConvergenceError("the surrogate finds no state for some of the measured commands")
        self._reached = settled.displacement
        displacement = torch.as_tensor(settled.displacement)
        if self.data.driven == "displacement":
            # What is taut is where it was commanded to be; the search only ends near it.
            displacement = torch.where(torch.as_tensor(free), displacement, torch.as_tensor(self.data.displacement))
        if free.any():
            # Newton's method once more in double precision, then a step that carries the derivatives: what is driven
            # in effort moves with the design as it must.
            with torch.no_grad():
                displacement = self._step(values, displacement, free, target)
            displacement = self._step(values, displacement, free, target)
        effort, effector, _ = self.net(values, displacement)
        return torch.cat([effort, effector], dim=1)

    def _step(self, values: Tensor, displacement: Tensor, free: np.ndarray, target: np.ndarray) -> Tensor:
        """One Newton step of the ``free`` displacements (N, n_a) towards their efforts ``target``."""
        loose = torch.as_tensor(free)
        effort, _, W = self.net(values, displacement)
        n = effort.shape[1]
        K = torch.linalg.inv(W[:, :n, :n]).detach()
        A = torch.where(loose[:, :, None] & loose[:, None, :], K, torch.eye(n, dtype=torch.float64))
        return displacement - torch.linalg.solve(A, torch.where(loose, effort - torch.as_tensor(target), 0.0))


class FEMMisfit(Misfit):
    """Residuals of the finite elements; derivatives are differences."""

    step = 1e-4  # of the differences, in coordinates

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        base, columns = self.residuals(point), []
        for k, value in enumerate(point):
            moved = np.array(point, dtype=float)
            moved[k] += self.step if value < 0.0 else -self.step
            columns.append((self.residuals(moved) - base) / (moved[k] - value))
        return np.stack(columns, axis=1)

    def predict(self, values: Tensor) -> Tensor:
        design = dict(zip(self.coordinates.box.space.names, values[0].tolist(), strict=True))
        backend = FEMBackend(self.robot, design)
        states = [backend.step(command, self.data.driven) for command in self.data.command]
        rows = [np.concatenate([state.effort, state.effector.ravel()]) for state in states]
        return torch.as_tensor(np.array(rows))


@dataclass(frozen=True)
class Fit:
    """One fit.

    Attributes:
        start: fitted variables at the start [SI].
        found: and at the end [SI].
        cost: sum of the squared relative residuals at the end.
        history: cost, and the fitted variables, of the best point after each evaluation.
        evaluations: of the residuals.
        seconds: it took.
    """

    start: dict[str, float]
    found: dict[str, float]
    cost: float
    evaluations: int
    seconds: float
    history: list[dict[str, float]] = field(repr=False, default_factory=list)


def _watched(misfit: Misfit) -> tuple[Callable[[np.ndarray], np.ndarray], list[dict[str, float]]]:
    """Residuals, and the list that gets the best point after each evaluation of them."""
    history: list[dict[str, float]] = []
    names = misfit.coordinates.box.names

    def residuals(point: np.ndarray) -> np.ndarray:
        found = misfit.residuals(point)
        cost = float(found @ found)
        if not history or cost < history[-1]["cost"]:
            design = misfit.coordinates.design(point)
            history.append({"cost": cost, **{name: design[name] for name in names}})
        else:
            history.append(history[-1])
        return found

    return residuals, history


def _solve(misfit: Misfit, residuals: Callable, start: np.ndarray, free: np.ndarray, tolerance: float = 1e-8) -> Any:
    """Least squares over the components ``free`` of a point, the others as in ``start``; returns SciPy's result."""
    from scipy.optimize import least_squares

    def full(x: np.ndarray) -> np.ndarray:
        point = start.copy()
        point[free] = x
        return point

    return least_squares(
        lambda x: residuals(full(x)),
        start[free],
        jac=lambda x: misfit.jacobian(full(x))[:, free],
        bounds=(-1.0, 1.0),
        xtol=tolerance,
        ftol=tolerance,
        gtol=1e-2 * tolerance,
    )


def fit_gradient(misfit: Misfit, start: dict[str, float]) -> Fit:
    """Fit by least squares within the bounds (trust-region reflective), from one start.

    Args:
        misfit: residuals.
        start: complete design.

    Raises:
        ConfigError: for a variable that changes nothing that was measured.
        ConvergenceError: if a body on the way has no equilibrium.
    """
    began, before = time.perf_counter(), misfit.evaluations
    coordinates = misfit.coordinates
    first = np.clip(coordinates.point(start), -1.0, 1.0)
    residuals, history = _watched(misfit)
    found = _solve(misfit, residuals, first, np.ones(len(first), dtype=bool))
    for name, column in zip(coordinates.box.names, found.jac.T, strict=True):
        if np.linalg.norm(column) < 1e-7:
            raise ConfigError(
                f"'{name}' changes nothing that was measured; impose efforts or measure them, or do not fit it"
            )
    design = coordinates.design(found.x)
    names = coordinates.box.names
    return Fit(
        start={name: start[name] for name in names},
        found={name: design[name] for name in names},
        cost=float(2.0 * found.cost),
        evaluations=misfit.evaluations - before,
        seconds=time.perf_counter() - began,
        history=history,
    )


def fit_tpe(misfit: Misfit, start: dict[str, float], *, trials: int = 250, seed: int = 0) -> Fit:
    """Fit by the tree-structured Parzen estimator, as the thesis does where there are no gradients (3.4.5).

    Args:
        misfit: residuals.
        start: complete design, evaluated first.
        trials: evaluations. Those that cannot be built or have no equilibrium count.
        seed: of the sampler.

    Raises:
        ConvergenceError: if no trial had an equilibrium.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    began = time.perf_counter()
    coordinates, names = misfit.coordinates, misfit.coordinates.box.names
    residuals, history = _watched(misfit)

    def cost(trial: optuna.Trial) -> float:
        found = residuals(np.array([trial.suggest_float(name, -1.0, 1.0) for name in names]))
        return float(found @ found)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    first = np.clip(coordinates.point(start), -1.0, 1.0)
    study.enqueue_trial(dict(zip(names, first.tolist(), strict=True)))
    study.optimize(cost, n_trials=trials, catch=(ConvergenceError, InfeasibleDesign))
    if not history:
        raise ConvergenceError(f"none of {trials} trials has an equilibrium under the measured commands")
    design = coordinates.design(np.array([study.best_params[name] for name in names]))
    return Fit(
        start={name: start[name] for name in names},
        found={name: design[name] for name in names},
        cost=study.best_value,
        evaluations=trials,
        seconds=time.perf_counter() - began,
        history=history,
    )


def profile_interval(misfit: Misfit, design: dict[str, float], name: str, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of one variable by its profile likelihood (Bates and Watts 1988, section 6.1).

    With noise of one unknown size, the interval holds the values for which the least sum of squares over the other
    variables is at most ``S (1 + F(1, m - p; level) / (m - p))``, with S at the optimum, m residuals and p variables.
    It ends at a bound of the variable where that is reached first. Errors of the model count as noise.

    Args:
        misfit: residuals.
        design: the optimum, a complete design.
        name: a fitted variable.
        level: probability that the interval covers the truth.

    Returns:
        Both ends [SI].
    """
    from scipy.optimize import brentq
    from scipy.stats import f

    coordinates = misfit.coordinates
    k = coordinates.box.names.index(name)
    free = np.arange(len(coordinates.box)) != k
    best = np.clip(coordinates.point(design), -1.0, 1.0)
    least = float(np.sum(misfit.residuals(best) ** 2))
    freedom = misfit.count - len(best)
    allowed = least * float(f.ppf(level, 1, freedom)) / freedom
    # The linear theory says where the ends about are, and how the other variables follow.
    J = misfit.jacobian(best)
    covariance = np.linalg.inv(J.T @ J)
    width = max(float(np.sqrt(allowed * covariance[k, k])), 1e-5)  # residuals may be zero
    follow = covariance[:, k] / covariance[k, k]

    known = {best[k]: -np.sqrt(allowed)}

    def excess(x: float) -> float:
        """Root of the loss of fit, which grows about in proportion to the distance, over what is allowed."""
        if x not in known:
            point = np.clip(best + follow * (x - best[k]), -1.0, 1.0)
            if free.any():
                point[free] = _solve(misfit, misfit.residuals, point, free, tolerance=1e-4).x
            known[x] = np.sqrt(max(float(np.sum(misfit.residuals(point) ** 2)) - least, 0.0)) - np.sqrt(allowed)
        return known[x]

    ends = []
    for bound in (-1.0, 1.0):
        inside = outside = best[k]
        reach = 1.1 * width
        while outside != bound:
            outside = float(np.clip(best[k] + bound * reach, -1.0, 1.0))
            if excess(outside) > 0.0:
                outside = brentq(excess, inside, outside, xtol=2e-2 * width)
                break
            inside, reach = outside, 2.0 * reach
        end = best.copy()
        end[k] = outside
        ends.append(coordinates.design(end)[name])
    return min(ends), max(ends)


def make_misfit(config: CalibrationConfig, data: Measurements, backend: str) -> Misfit:
    """Return the residuals of a configuration on a backend.

    Raises:
        ConfigError: for weights whose network has no derivatives.
        DataError: for too few measured numbers.
    """
    if backend == "fem":
        return FEMMisfit(config.make_robot(), config.box(), data)
    return LearnedMisfit(config.make_robot(), config.box(), data, config.weights)


def calibrate(
    config: CalibrationConfig, folder: str | Path | None = None, *, data: Measurements | None = None
) -> dict[str, Any]:
    """Fit design variables to measurements, from every start, with an interval about the best fit.

    Args:
        config: what is fitted to what.
        folder: where ``result.json``, the resolved configuration and a picture go, or None.
        data: measurements, instead of those of the configuration's file.

    Returns:
        ``design`` (complete), ``fits`` (one per start), ``refined`` (the fit on FEM, or None), ``interval``
        (``{name: [low, high]}``), ``at_bound`` (names), ``errors`` (root mean square, SI) and ``seconds``.

    Raises:
        ConfigError: for a variable that changes nothing that was measured; if the folder holds something else or
            another process is at it, see `codesign.tools.folder.run_folder`.
        DataError: for a malformed file of measurements.
        ConvergenceError: if a body on the way has no equilibrium.
    """
    if folder is None:
        return _calibrate(config, data)[0]
    from codesign.tools.plots import draw_calibration

    folder = Path(folder)
    with run_folder(folder, config, "a calibration"):
        result, fits, refined = _calibrate(config, data)
        write_json(folder / "result.json", {**provenance(), **result})
        draw_calibration(folder / "calibration.png", config.box(), fits, result["interval"], refined)
    return result


def _calibrate(config: CalibrationConfig, data: Measurements | None) -> tuple[dict[str, Any], list[Fit], Fit | None]:
    """Return what `calibrate` does, the fits and the one on FEM."""
    began = time.perf_counter()
    if data is None:
        data = read_measurements(config.data, config.make_robot())
    misfit = make_misfit(config, data, config.backend)
    box = misfit.coordinates.box
    starts = [{**box.reference, **box.free.complete(start)} for start in config.starts or ({},)]
    if config.method == "tpe":
        fits = [fit_tpe(misfit, start, trials=config.trials, seed=config.seed) for start in starts]
    else:
        fits = [fit_gradient(misfit, start) for start in starts]
    best, refined = min(fits, key=lambda fit: fit.cost), None
    if config.refine:
        misfit = make_misfit(config, data, "fem")
        best = refined = fit_gradient(misfit, {**box.reference, **best.found})
    design = {**box.reference, **best.found}
    interval = None
    if config.level is not None:
        interval = {name: list(profile_interval(misfit, design, name, config.level)) for name in box.names}
    result: dict[str, Any] = {
        "design": design,
        "interval": interval,
        "level": config.level,
        "at_bound": [name for name, unit in zip(box.names, box.unit(design), strict=True) if abs(unit) > 1.0 - 1e-6],
        "errors": misfit.errors(misfit.coordinates.point(design)),
        "fits": [asdict(fit) for fit in fits],
        "refined": None if refined is None else asdict(refined),
        "measured_states": len(data),
        "seconds": time.perf_counter() - began,
    }
    return result, fits, refined

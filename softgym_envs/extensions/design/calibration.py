"""Calibration: the parameters that best explain measured states (thesis, sec. 3.4.5 and 4.5.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import ConfigError, ConvergenceError, InfeasibleDesign
from softgym_envs.extensions.design.config import CalibrationConfig
from softgym_envs.extensions.design.fit_page import calibration_page, write_page
from softgym_envs.extensions.design.measurements import Measurements, read_measurements
from softgym_envs.extensions.design.misfit import FEMMisfit, LearnedMisfit, Misfit
from softgym_envs.extensions.design.parameters import Parameters
from softgym_envs.extensions.design.plots import draw_calibration
from softgym_envs.extensions.design.records import CalibrationResult, Fit
from softgym_envs.runs import RunFolder, provenance
from softgym_envs.storage import write_signed
from softgym_envs.wording import counted

MIN_SENSITIVITY = 1e-7
"""Smallest norm of the derivatives of all relative residuals with respect to a parameter that can be fitted."""


def calibrate(
    config: CalibrationConfig, folder: str | Path | None = None, *, data: Measurements | None = None
) -> CalibrationResult:
    """Fit design variables, robot options and nuisance parameters to measurements, from every start.

    Args:
        config: what to fit.
        folder: where ``result.json``, ``report.html``, the resolved configuration and a picture go; None to write
            nothing.
        data: measurements, instead of those of the configuration's file.

    Raises:
        ConfigError: for a parameter that changes nothing that was measured; if the folder holds results of another
            configuration or tool, or another process uses it.
        DataError: for a malformed file of measurements.
        ConvergenceError: if a body has no equilibrium under a measured command.
    """
    if data is None:  # before anything is written
        data = read_measurements(config.data, config.make_robot())
    if folder is None:
        return _calibrate(config, data)
    with RunFolder(folder, CalibrationConfig, "a calibration").reserve(config) as place:
        result = _calibrate(config, data)
        write_signed(place / "result.json", {**provenance(), **result.to_json()})
        draw_calibration(place / "calibration.png", fitted_units(config), result)
        titles = ("fitted states", "held-out trials")
        parts = [
            (title, part, predicted(config, result, part))
            for title, part in zip(titles, data.split(config.held_out), strict=True)
        ]
        write_page(place / "report.html", calibration_page(config.name, result, fitted_units(config), parts))
    return result


def fitted_units(config: CalibrationConfig) -> dict[str, str]:
    """Return the SI unit of each fitted parameter by name."""
    units = {name: variable.unit for name, variable in config.box().free.variables.items()}
    return units | {name: nuisance.unit for name, nuisance in config.nuisances.items()}


def predicted(config: CalibrationConfig, result: CalibrationResult, data: Measurements) -> np.ndarray:
    """Return the readings (N, n_a + n_e) that a result predicts for the commands of some states."""
    if not len(data):
        return np.zeros((0, data.effort.shape[1] + data.effector.shape[1]))
    backend = "fem" if result.refined is not None else config.backend
    misfit = make_misfit(config, data, backend, fits=False)
    return misfit.readings(misfit.parameters.point({**result.design, **result.nuisances}))


def _calibrate(config: CalibrationConfig, data: Measurements) -> CalibrationResult:
    began = time.perf_counter()
    data, held_out = data.split(config.held_out)
    misfit = make_misfit(config, data, config.backend)
    parameters = misfit.parameters
    if config.method == "tpe":
        fits = [fit_tpe(misfit, start, trials=config.trials, seed=config.seed) for start in config.starts]
    else:
        fits = [fit_gradient(misfit, start) for start in config.starts]
    best, refined = min(fits, key=lambda fit: fit.cost), None
    if config.refine:
        misfit = make_misfit(config, data, "fem")
        best = refined = fit_gradient(misfit, best.found)
    values = {**parameters.box.reference, **best.found}
    point = parameters.point(values)
    theory = linear_theory(misfit, values, config.level or 0.95)
    intervals = None
    if config.level is not None and config.intervals == "linear":
        intervals = theory.intervals
    elif config.level is not None:
        intervals = {name: profile_interval(misfit, values, name, config.level) for name in config.fit}
    return CalibrationResult(
        design={name: value for name, value in values.items() if name not in config.nuisances},
        nuisances={name: values[name] for name in config.nuisances},
        intervals=intervals,
        level=config.level,
        at_bound=[name for name, unit in zip(parameters.names, point, strict=True) if abs(unit) > 1.0 - 1e-6],
        errors=misfit.errors(point),
        fits=fits,
        refined=refined,
        measured_states=len(data),
        seconds=time.perf_counter() - began,
        correlations=theory.correlations,
        held_out_states=len(held_out),
        held_out_errors=make_misfit(config, held_out, misfit.backend, fits=False).errors(point)
        if len(held_out)
        else {},
        plant=parameters.instrument(values, data.driven).plant([a.name for a in misfit.robot.actuators]),
        notes=theory.notes,
    )


def _errors(config: CalibrationConfig, data: Measurements, backend: str, point: np.ndarray) -> dict[str, float]:
    """Return the errors of states that were not fitted, as `Misfit.errors`."""
    return make_misfit(config, data, backend, fits=False).errors(point) if len(data) else {}


def make_misfit(config: CalibrationConfig, data: Measurements, backend: str, *, fits: bool = True) -> Misfit:
    """Return the residuals of a configuration on a backend; raises and arguments as `Misfit`."""
    robot = config.make_robot()
    parameters = Parameters(robot, config.box(), config.nuisances)
    if backend == "fem":
        return FEMMisfit(robot, parameters, data, config.make_robot, fits=fits)
    return LearnedMisfit(robot, parameters, data, config.weights, fits=fits)


def fit_gradient(misfit: Misfit, start: Mapping[str, float]) -> Fit:
    """Return the least-squares fit within the bounds (trust-region reflective); raises as `calibrate`.

    Values that the start ``{name: value}`` lacks are those of the reference.
    """
    began, before = time.perf_counter(), misfit.evaluations
    parameters = misfit.parameters
    first = parameters.first(start)
    residuals, history = _recorded(misfit)
    found = _solve(misfit, residuals, first, np.ones(len(first), dtype=bool))
    for name, column in zip(parameters.names, found.jac.T, strict=True):
        if np.linalg.norm(column) < MIN_SENSITIVITY:
            raise ConfigError(
                f"'{name}' changes nothing that was measured; impose efforts or measure them, or do not fit it"
            )
    return Fit(
        start=_named(parameters, first),
        found=_named(parameters, found.x),
        cost=float(2.0 * found.cost),
        evaluations=misfit.evaluations - before,
        seconds=time.perf_counter() - began,
        history=history,
    )


def fit_tpe(misfit: Misfit, start: Mapping[str, float], *, trials: int = 250, seed: int = 0) -> Fit:
    """Return the best of many trials of the tree-structured Parzen estimator (thesis, sec. 3.4.5).

    The start ``{name: value}`` is the first trial; values that it lacks are those of the reference. Designs that cannot
    be built or have no equilibrium count as trials.

    Raises:
        ConvergenceError: if no trial had an equilibrium.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    began, parameters = time.perf_counter(), misfit.parameters
    residuals, history = _recorded(misfit)

    def cost(trial: optuna.Trial) -> float:
        found = residuals(np.array([trial.suggest_float(name, -1.0, 1.0) for name in parameters.names]))
        return float(found @ found)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    first = parameters.first(start)
    study.enqueue_trial(dict(zip(parameters.names, first.tolist(), strict=True)))
    study.optimize(cost, n_trials=trials, catch=(ConvergenceError, InfeasibleDesign))
    if not history:
        raise ConvergenceError(f"none of {counted(trials, 'trial')} has an equilibrium under the measured commands")
    return Fit(
        start=_named(parameters, first),
        found=_named(parameters, np.array([study.best_params[name] for name in parameters.names])),
        cost=study.best_value,
        evaluations=trials,
        seconds=time.perf_counter() - began,
        history=history,
    )


def profile_interval(misfit: Misfit, values: Mapping[str, float], name: str, level: float) -> tuple[float, float]:
    """Return the confidence interval [SI] of one parameter by its profile likelihood (Bates and Watts 1988, sec. 6.1).

    For noise of one unknown size, the interval contains the values for which the least sum of squares over all other
    parameters, nuisance parameters included, is at most ``S (1 + F(1, m - p; level) / (m - p))``, with S at the
    optimum, m residuals and p parameters. It ends at a bound of the parameter if that is reached first. Errors of the
    model count as noise. ``values`` are those of all parameters at the optimum.
    """
    from scipy.optimize import brentq
    from scipy.stats import f

    parameters = misfit.parameters
    k = parameters.names.index(name)
    free = np.arange(len(parameters)) != k
    best = np.clip(parameters.point(values), -1.0, 1.0)
    least = misfit.cost(best)
    freedom = misfit.count - len(best)
    allowed = least * float(f.ppf(level, 1, freedom)) / freedom
    # The linear theory predicts roughly where the ends are, and how the other parameters follow.
    J = misfit.jacobian(best)
    covariance = np.linalg.inv(J.T @ J)
    width = max(float(np.sqrt(allowed * covariance[k, k])), 1e-5)  # residuals may be zero
    follow = covariance[:, k] / covariance[k, k]

    known = {best[k]: -np.sqrt(allowed)}

    def excess(x: float) -> float:
        """Return the root of the loss of fit, roughly proportional to the distance, minus the allowed root."""
        if x not in known:
            point = np.clip(best + follow * (x - best[k]), -1.0, 1.0)
            if free.any():
                point[free] = _solve(misfit, misfit.residuals, point, free, tolerance=1e-4).x
            known[x] = np.sqrt(max(misfit.cost(point) - least, 0.0)) - np.sqrt(allowed)
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
        ends.append(parameters.values(end)[name])
    return min(ends), max(ends)


CORRELATED, OPEN = 0.95, 0.5
"""Correlation of two parameters above which only their combination is known; half-width of an interval over that of the
bounds above which a parameter is not known."""


@dataclass(frozen=True)
class LinearTheory:
    """What the derivatives at the optimum say about the parameters.

    Attributes:
        intervals: by name [SI], within the bounds.
        correlations: of their errors, by both names; None if a parameter, or a combination, changes nothing.
        notes: which parameters these data do not determine, in sentences.
    """

    intervals: dict[str, tuple[float, float]]
    correlations: dict[str, dict[str, float]] | None
    notes: list[str]


def linear_theory(misfit: Misfit, values: Mapping[str, float], level: float) -> LinearTheory:
    """Return intervals, correlations and what is not determined, from the derivatives at ``values``.

    For noise of one unknown size, independent in all measured numbers; errors of the model count as noise.
    """
    from scipy.stats import t

    parameters = misfit.parameters
    names, best = parameters.names, np.clip(parameters.point(values), -1.0, 1.0)
    J = misfit.jacobian(best)
    freedom = misfit.count - len(best)
    _, sizes, directions = np.linalg.svd(J, full_matrices=False)
    if not sizes[-1] > 1e-8 * sizes[0]:
        least = directions[-1]
        part = [name for name, share in zip(names, least, strict=True) if abs(share) > 0.1]
        note = f"a combination of {', '.join(part)} changes nothing that was measured"
        return LinearTheory({name: _ends(parameters, best, k, 2.0) for k, name in enumerate(names)}, None, [note])
    covariance = np.linalg.inv(J.T @ J) * misfit.cost(best) / freedom
    errors = np.sqrt(np.diag(covariance))
    width = float(t.ppf(0.5 + 0.5 * level, freedom)) * errors
    correlation = covariance / np.outer(np.maximum(errors, 1e-300), np.maximum(errors, 1e-300))
    notes = [
        f"these data hardly determine {name}: its {100 * level:g} % interval is {100 * w:.0f} % of its range"
        for name, w in zip(names, width, strict=True)
        if w > OPEN
    ]
    notes += [
        f"{names[i]} and {names[k]} are known together rather than each alone: correlation {correlation[i, k]:.2f}"
        for i in range(len(names))
        for k in range(i)
        if abs(correlation[i, k]) > CORRELATED
    ]
    table = {a: {b: float(correlation[i, k]) for k, b in enumerate(names)} for i, a in enumerate(names)}
    intervals = {name: _ends(parameters, best, k, width[k]) for k, name in enumerate(names)}
    return LinearTheory(intervals, table, notes)


def _ends(parameters: Parameters, best: np.ndarray, k: int, width: float) -> tuple[float, float]:
    """Return the ends [SI] of an interval of parameter ``k`` with a half-width in coordinates, within the bounds."""
    ends = []
    for sign in (-1.0, 1.0):
        end = best.copy()
        end[k] = np.clip(best[k] + sign * width, -1.0, 1.0)
        ends.append(parameters.values(end)[parameters.names[k]])
    return min(ends), max(ends)


def _named(parameters: Parameters, point: np.ndarray) -> dict[str, float]:
    values = parameters.values(point)
    return {name: values[name] for name in parameters.names}


def _recorded(misfit: Misfit) -> tuple[Callable[[np.ndarray], np.ndarray], list[dict[str, float]]]:
    """Return the residuals, and a list that gets the best point after each evaluation of them."""
    history: list[dict[str, float]] = []

    def residuals(point: np.ndarray) -> np.ndarray:
        found = misfit.residuals(point)
        cost = float(found @ found)
        if not history or cost < history[-1]["cost"]:
            history.append({"cost": cost, **_named(misfit.parameters, point)})
        else:
            history.append(history[-1])
        return found

    return residuals, history


def _solve(misfit: Misfit, residuals: Callable, start: np.ndarray, free: np.ndarray, tolerance: float = 1e-8) -> Any:
    """Return SciPy's least-squares result over the components ``free`` of a point, the others as in ``start``."""
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

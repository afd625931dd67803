"""Estimation of a touch on a learned model, which evaluates every place of a cell at once.

The model has force and place of a touch among its inputs (`LearnedTouch`). So the equilibrium at each place and
force is its own, not extrapolated from another place: at each place, Gauss-Newton finds the most probable errors of the
actuators and force. The answer to the actuators is the learned ``W``; the answer to the force is the change of the
model under held actuators, after which ``W`` puts slack ones back to no effort. The sum over places is that of
`Mixture`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import chi2

from softgym_envs.backends.surrogate import TOLERANCE
from softgym_envs.errors import ConvergenceError, WeightsError
from softgym_envs.extensions.fitting.row_errors import RowErrors
from softgym_envs.extensions.sensing.estimator import IMPROBABLE
from softgym_envs.extensions.sensing.loads import Touch, cell_nodes
from softgym_envs.extensions.sensing.places import Mixture, Moments, Places
from softgym_envs.extensions.sensing.posterior import Gaussian
from softgym_envs.extensions.sensing.readings import (
    Noise,
    Readings,
    check_settings,
    checked_command,
    checked_readings,
    checked_volumes,
    explains,
)
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.constraints.cavity import Cavity
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import OUTSIDE, UNEXPLAINED
from softgym_envs.surrogate.model import Context, SurrogateModel
from softgym_envs.surrogate.pretrained import pretrained_model

PLACES = 4
"""Places along each edge of a cell: the response is nearly quadratic in a cell, which four describe."""

STEP = 0.02
"""Difference of forces at the baseline's stiffness by which the answer to a force is found [N]."""


@dataclass(frozen=True)
class LearnedEstimate:
    """Where the body is and what touches it: means over all that explains the readings.

    Attributes:
        displacement: of the actuators [m], shape (n_a,).
        load: force [N] and place in the cell (-1 to 1), shape (3,); empty without a touch.
        load_covariance: shape (3, 3).
        effector: positions [m], shape (n_e,).
        effector_covariance: [m2], shape (n_e, n_e).
        misfit: sum of the squared residuals at the most probable place, in standard deviations of the readings.
        condensed: model of actuators, effectors and sensors at the most probable place.
        slack: which actuators hang slack there, shape (n_a,).
        distrust: why the estimate is not trusted, 0 if it is: a sum of numbers in `domain.DISTRUST_REASONS`.
    """

    displacement: np.ndarray
    load: np.ndarray
    load_covariance: np.ndarray
    effector: np.ndarray
    effector_covariance: np.ndarray
    misfit: float
    condensed: CondensedModel
    slack: np.ndarray
    distrust: int

    @property
    def trusted(self) -> bool:
        """Whether the model may be trusted here and explains the readings."""
        return self.distrust == 0


@dataclass(frozen=True)
class _Responses:
    """States of q bodies: sensors (q, k) and effectors (q, n_e), their derivatives by actuators and force."""

    context: Context
    sensors: np.ndarray
    sensor_slopes: np.ndarray
    effectors: np.ndarray
    effector_slopes: np.ndarray
    condensed: CondensedModel
    displacement: np.ndarray
    effort: np.ndarray
    slack: np.ndarray


@dataclass(frozen=True)
class _Known:
    """What the readings of a touch have told so far.

    Attributes:
        before: distribution before the readings under the present command.
        after: distribution after them; None before the first reading of the touch.
        command: the present command (n_a,); None before the first reading.
        count: number of readings under it.
        mean: of their volumes, relative to those at rest, shape (n_s,).
        at: errors and forces at all places from which the next search starts, shape (q, n_a + 1).
        tried: whether a search from the largest force has been tried under this command.
    """

    before: Mixture
    after: Mixture | None = None
    command: np.ndarray | None = None
    count: int = 0
    mean: np.ndarray = field(default_factory=lambda: np.zeros(0))
    at: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tried: bool = False


class LearnedEstimator:
    """Finds the shape of a body and a touch on it from a stream of readings, on its learned model.

    Readings in a row under one command are explained together by their mean. What they tell about the errors of the
    actuators stays known when the command or the touch changes. The errors of learned volumes and effectors depend on
    the command. Their means are subtracted; their deviations do not become smaller with the number of readings, so they
    are added to the noise of the mean.

    An estimate says whether it may be trusted, as states of the surrogate do. Readings under a command outside the
    learned box, and readings that nothing explains, do not change what the estimator knows.

    Args:
        robot: the body, whose touch is learned; its cavities are sensors.
        design: missing variables take their baseline.
        load: the touch; None while nothing is touched.
        noise: of sensors and actuators; loads do not drift, and efforts are not read.
        model: the learned model of ``robot.learning.touch.variant()``; default the shipped one.
        exact: whether the body is the learned model itself, so that its errors do not count.
        errors: of the model on this body, from `measured_errors`, for effectors and then sensors; default those on the
            many bodies that the weights were validated on.
        steps: largest number of Gauss-Newton steps of the first reading under a command or touch; later ones take one.
        accuracy: a step ends the search that moves no place by more than this part of its standard deviation.

    Attributes:
        rest_volumes: of the cavities at rest [m3], shape (n_s,).
        errors: of the robot's own effectors [m] and then its sensors [m3].

    Raises:
        DesignError: for a malformed design.
        WeightsError: if there are no weights, or their card does not tell the errors.
        ValueError: for a robot whose touch is not learned, or noise that is not supported.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        design: Mapping[str, float] | None = None,
        load: Touch | None = None,
        noise: Noise | None = None,
        model: SurrogateModel | None = None,
        exact: bool = False,
        errors: RowErrors | None = None,
        steps: int = 5,
        accuracy: float = 0.2,
    ) -> None:
        check_settings(steps=steps, accuracy=accuracy)
        self.robot, self.noise = robot, noise or Noise()
        self.steps, self.accuracy = steps, accuracy
        if self.noise.drift or self.noise.effort is not None:
            raise ValueError(f"the estimator on a learned model supports neither drift nor efforts, got {self.noise}")
        touch = robot.learning.touch
        if touch is None:
            raise ValueError(f"no touch of robot '{robot.name}' is learned; use Estimator")
        self.model = model or pretrained_model(touch.variant())
        self._touched_design = touch.design
        self.design = robot.design_space.complete(design)
        space = self.model.robot.design_space
        self._body = np.array([{**space.baseline, **self.design}[name] for name in space.names])
        # The first load variable is the force, which the others do not depend on.
        self._loads = self.model.robot.learning.loads
        self._columns = [space.names.index(name) for name in self._loads]
        cavities = robot.build(self.design).constraints["s"]
        self.rest_volumes = np.array([row.rest_volume for row in cavities if isinstance(row, Cavity)])
        self._own = 3 * len(robot.effectors)
        rows = self._own + len(self.rest_volumes)
        if exact:
            errors = RowErrors.none(rows)
        elif errors is None:
            if "errors" not in self.model.card:
                raise WeightsError(
                    f"the card of the weights of '{self.model.robot.learning.weights}' has no 'errors': fit them "
                    "again, or pass errors=measured_errors(...)"
                )
            # Of the rows of the model, those of touched points are left out.
            own, touched = np.arange(self._own), self.model.effectors - self._own
            sensors = np.arange(self._own, rows) + touched
            errors = RowErrors.from_card(self.model.card["errors"]).rows(np.r_[own, sensors])
        if errors.mean.shape[1] != rows:
            raise ValueError(f"errors must have {rows} rows (effectors, then sensors), got {errors.mean.shape[1]}")
        self.errors = errors
        n_a = self.model.count
        self._actuators = np.zeros(n_a), self.noise.displacement**2 * np.eye(n_a)
        self._known: _Known | None = None
        self.touch(load)

    def touch(self, load: Touch | None) -> None:
        """Replace the touch; the errors of actuators stay known.

        Raises:
            ValueError: for another load than a touch, or a cell that its grid does not have.
        """
        if load is not None and not isinstance(load, Touch):
            raise ValueError(f"load = {load!r} must be a Touch or None on a learned model; use Estimator")
        if self._known is not None and self._known.after is not None:
            self._actuators = _actuators_of(self._known.after)
        self.load = load
        mean, covariance = self._actuators
        unlimited = np.full(len(mean), np.inf)
        known = Gaussian(mean, covariance, -unlimited, unlimited)
        if load is None:
            # A single place with a force that is as good as zero.
            self._places, size = Places(np.empty((1, 0)), np.zeros((1, 0)), np.ones(1)), 1e-9
        else:
            coordinates, shares = cell_nodes(PLACES)
            self._places, size = Places(coordinates, np.zeros((len(shares), 0)), shares), load.expected_force
            points, normal = load.grid.inside(load.cell, coordinates), np.array(load.grid.normal)
            touches = [self._touched_design(self.design, point, normal) for point in points]
            self._touches = np.array([[touch[name] for name in self._loads] for touch in touches])
        self._known = _Known(Mixture.before_readings(self._places, known, size))

    def reading(self, command: np.ndarray, change: np.ndarray) -> Readings:
        """Return the readings for values of the sensor rows of the condensed model, ``delta.s`` (n_s,)."""
        return Readings(command, self.rest_volumes + checked_readings("change", change, len(self.rest_volumes)))

    def update(self, readings: Readings) -> LearnedEstimate:
        """Return the estimate after one more reading.

        After an error the estimator knows what it knew before.

        Raises:
            ValueError: if readings have a wrong shape, are not finite (a lost sensor) or are impossible (a wrong unit),
                or have efforts.
            ConvergenceError: if the model finds no equilibrium.
        """
        if readings.efforts is not None:
            raise ValueError("the estimator on a learned model does not read efforts; leave them out, or use Estimator")
        command = checked_command(self.robot, readings.command)
        volumes = checked_volumes(readings.volumes, self.rest_volumes) - self.rest_volumes
        known = self._known
        assert known is not None
        if known.command is None or (command != known.command).any():
            before = known.before if known.after is None else known.after
            known = _Known(before, None, command, 0, np.zeros_like(volumes), self._limited(before.means))
        count, steps = known.count + 1, self.steps if known.count == 0 else 1
        mean = known.mean + (volumes - known.mean) / count
        bias, deviation = self.errors.at(self._share(command))
        spread = np.hypot(self.noise.volume / np.sqrt(count), deviation[self._own :])
        measured, tried = mean + bias[self._own :], known.tried
        found, response, at = self._search(known.before, measured, spread, command, known.at, steps)
        expected, best = _expected(found, response, at)
        misfit = float((((measured - expected) / spread) ** 2).sum())
        if not tried and self.load is not None and misfit > chi2.ppf(IMPROBABLE, len(spread)):
            # Beyond a slack cable there may be a better explanation, which steps from small forces do not reach.
            tried, strong = True, at.copy()
            strong[:, -1] = self.largest_force
            other = self._search(known.before, measured, spread, command, strong, self.steps)
            if np.logaddexp.reduce(_logarithms(other[0])) > np.logaddexp.reduce(_logarithms(found)):
                found, response, at = other
                expected, best = _expected(found, response, at)
                misfit = float((((measured - expected) / spread) ** 2).sum())
        distrust = self._distrust(command, found, response, best)
        one = np.hypot(self.noise.volume, deviation[self._own :])
        if not explains((volumes + bias[self._own :] - expected) / one):
            distrust |= UNEXPLAINED
        elif self._has_learned(command):
            after = replace(known, after=found, count=count, mean=mean, at=self._limited(found.means), tried=tried)
            self._known = after
        tips = response.effectors - bias[: self._own] - np.einsum("qon,qn->qo", response.effector_slopes, at)
        moments = found.moments(tips, response.effector_slopes)
        return self._estimate(command, moments, misfit, response, best, deviation[: self._own], distrust)

    def _has_learned(self, command: np.ndarray) -> bool:
        """Return whether a command (n_a,) lies in the box of the training states."""
        return bool(((self.model.domain.low <= command) & (command <= self.model.domain.high)).all())

    def _distrust(self, command: np.ndarray, found: Mixture, response: _Responses, best: int) -> int:
        """Return why the model is not trusted at the most probable place, 0 if it is."""
        row = slice(best, best + 1)
        context, displacement = response.context.rows(np.array([best])), response.displacement[row]
        spread = self.model.effector(context, displacement)[1]
        distrust = int(self.model.distrust(context, displacement, spread, command[None])[1][0])
        force = found.means[best, -1] if self.load is not None else 0.0
        inside = self._has_learned(command) and force <= self.largest_force
        return distrust if inside else distrust | OUTSIDE

    def _share(self, command: np.ndarray) -> float:
        """Return how far the actuators are commanded, as a mean share of their ranges."""
        robot = self.robot
        return float(np.mean((command - robot.lower) / (robot.upper - robot.lower)))

    def _search(
        self,
        before: Mixture,
        measured: np.ndarray,
        spread: np.ndarray,
        command: np.ndarray,
        start: np.ndarray,
        steps: int,
    ) -> tuple[Mixture, _Responses, np.ndarray]:
        """Return the distribution after Gauss-Newton steps at all places, the last responses, and where they were."""
        now = start
        assert steps > 0
        for _ in range(steps):
            at, response = now, self.respond(command, now)
            base = response.sensors - np.einsum("qkn,qn->qk", response.sensor_slopes, at)
            found = before.after(measured, spread, base, response.sensor_slopes)
            now = self._limited(found.means)
            deviation = np.sqrt(np.einsum("qnn->qn", found.covariances))
            likely = _logarithms(found) > _logarithms(found).max() - 8.0
            if (np.abs(now - at) <= self.accuracy * deviation)[likely].all():
                break
        return found, response, at

    def _estimate(
        self,
        command: np.ndarray,
        moments: Moments,
        misfit: float,
        response: _Responses,
        best: int,
        deviation: np.ndarray,
        distrust: int,
    ) -> LearnedEstimate:
        loaded = slice(0, None if self.load is not None else 0)
        every, size = response.condensed, self.model.size
        kept = np.r_[0 : self.model.count + 3 * len(self.robot.effectors), size - self.model.sensors : size]
        W = every.compliance[best][np.ix_(kept, kept)]
        delta = every.delta.array[best][kept]
        effort = np.concatenate([response.effort[best], np.zeros(len(kept) - self.model.count)])
        roles = tuple((r, 3 * len(self.robot.effectors) if r == "e" else size) for r, size in every.roles)
        return LearnedEstimate(
            displacement=command + moments.displacement,
            load=moments.load[loaded],
            load_covariance=moments.load_covariance[loaded, loaded],
            effector=moments.outputs,
            effector_covariance=moments.output_covariance + np.diag(deviation**2),
            misfit=misfit,
            condensed=CondensedModel(W, delta - W @ effort, effort, roles, tuple(every.rows[k] for k in kept)),
            slack=response.slack[best],
            distrust=distrust,
        )

    def _limited(self, parameters: np.ndarray) -> np.ndarray:
        """Return errors and forces (q, n_a + 1) at which the model is evaluated: forces that it has learned."""
        found = parameters.copy()
        found[:, -1] = np.clip(found[:, -1], 0.0, self.largest_force)
        return found

    @property
    def knows_body(self) -> bool:
        """Whether the body lies in the box of those that the model has learned."""
        return bool(self.model.context(self._body[None]).arrays["known"][0])

    @property
    def largest_force(self) -> float:
        """The largest force that the model has learned, for this body [N]."""
        return self.model.robot.design_space["touch_force"].high * self.stiffness

    @property
    def stiffness(self) -> float:
        """Young's modulus over that of the baseline."""
        return float(self.model.features.stiffness(self._body[None])[0, 0])

    def respond(self, command: np.ndarray, parameters: np.ndarray) -> _Responses:
        """Return the states at all places, for errors of the actuators and forces there (q, n_a + 1).

        Raises:
            ConvergenceError: if the model does not find one of them.
        """
        model, n = self.model, self.model.count
        designs = np.tile(self._body, (len(parameters), 1))
        if self.load is not None:
            designs[:, self._columns] = self._touches
            designs[:, self._columns[0]] *= parameters[:, -1]
        # Forces of which each place has a second one, by whose difference the answer to the force is found.
        more = designs.copy()
        more[:, self._columns[0]] += STEP
        step, places = STEP * self.stiffness, len(designs)
        context = model.context(np.vstack([designs, more]))
        here, there = (context.rows(np.arange(places) + first) for first in (0, places))
        target, unilateral = command + parameters[:, :-1], self.robot.unilateral
        displacement, effort, found = model.search(here, target, target, unilateral, TOLERANCE, 25)
        if not found.all():
            raise ConvergenceError(f"the learned model finds no equilibrium under displacements {command.tolist()}")
        slack = unilateral & (displacement > target + 10.0 * TOLERANCE * model.span)
        effort = np.where(slack, 0.0, effort)
        condensed = model.condensed(here, displacement)
        delta, W, held = condensed.delta.array, condensed.compliance, condensed.lambda_.a
        taut = ~slack
        both = taut[:, :, None] & taut[:, None, :]
        K = np.linalg.inv(np.where(both, W[:, :n, :n], np.eye(n))) * both
        # More force changes efforts and passive rows of held actuators. Slack ones then move until they have no effort.
        passive = np.concatenate([model.effector(there, displacement)[0], model.sensed(there, displacement)], axis=1)
        change = np.where(slack, held - model.effort(there, displacement), 0.0)
        change -= np.einsum("qij,qjk,qk->qi", K, W[:, :n, :n], change)
        by_force = np.einsum("qij,qj->qi", W[:, :, :n], change)
        by_force[:, n:] += passive - delta[:, n:]
        slopes = np.concatenate([np.matmul(W[:, :, :n], K), by_force[:, :, None] / step], axis=2)
        own, sensors = slice(n, n + 3 * len(self.robot.effectors)), slice(n + model.effectors, None)
        return _Responses(
            context=here,
            sensors=delta[:, sensors],
            sensor_slopes=slopes[:, sensors],
            effectors=delta[:, own],
            effector_slopes=slopes[:, own],
            condensed=condensed,
            displacement=displacement,
            effort=effort,
            slack=slack,
        )


def _expected(found: Mixture, response: _Responses, at: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the changes of volumes (n_s,) that are expected at the most probable place, and its number."""
    best = int(np.argmax(_logarithms(found)))
    return response.sensors[best] + response.sensor_slopes[best] @ (found.means[best] - at[best]), best


def _logarithms(mixture: Mixture) -> np.ndarray:
    """Return the logarithms of the unnormalised weights of the places, without forces below 0, shape (q,)."""
    return mixture.logarithms + log_ndtr(mixture.means[:, -1] / np.sqrt(mixture.covariances[:, -1, -1]))


def _actuators_of(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (n_a,) and covariance (n_a, n_a) of the errors of the actuators in a mixture."""
    logarithms = _logarithms(mixture)
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    mean = weights @ mixture.means[:, :-1]
    away = mixture.means[:, :-1] - mean
    covariance = np.einsum("q,qij->ij", weights, mixture.covariances[:, :-1, :-1])
    return mean, covariance + np.einsum("q,qi,qj->ij", weights, away, away)

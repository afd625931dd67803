"""Where a body is and what acts on it, from its sensors: a recursive maximum a posteriori estimate (thesis 3.3.6).

Unknown are the true displacements of the actuators, which differ from the commanded ones, and the parameters of a load.
With the actuators held, ``W`` gives the exact derivative of every row by both (`held_response`), so the
condensed model of one equilibrium explains all readings near it. The equilibrium is sought at the most probable
parameters; near it, the estimate is the mean over all sizes and places of the load (`Mixture`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from softgym_envs.errors import ConvergenceError
from softgym_envs.extensions.sensing.loads import Load
from softgym_envs.extensions.sensing.places import Bend, Mixture, Moments, joint_moments
from softgym_envs.extensions.sensing.posterior import Gaussian, Posterior, most_probable
from softgym_envs.extensions.sensing.readings import (
    Noise,
    Readings,
    check_settings,
    checked_command,
    checked_pressures,
    checked_readings,
    checked_volumes,
    explains,
)
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.constraints.cavity import Cavity, SealedAir
from softgym_envs.mechanics.solvers.equilibrium import Equilibrium
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.base import Robot
from softgym_envs.surrogate.domain import UNEXPLAINED

IMPROBABLE = 0.999
"""Probability of a smaller misfit from which on an estimate is also sought with slack cables."""

UNSURE = 1e-3
"""Probability that a cable is slack in place of tight, or vice versa, from which on both cases count."""

ACCURATE = 0.1
"""Deviation of effectors from lines, in standard deviations of the best known direction, from which on it counts."""

SMALLEST = 1e-6
"""Smallest variance of effectors that is not zero, as a part of the largest."""


@dataclass(frozen=True)
class Estimate:
    """Where the body is and what acts on it.

    All values are means over what explains the readings; for a load that drifts, they are the most probable ones.

    Attributes:
        displacement: of the actuators [m], shape (n_a,).
        load: parameters of the load, shape (m,).
        load_covariance: shape (m, m).
        effector: positions [m], shape (n_e,).
        effector_covariance: [m2], shape (n_e, n_e).
        parameters: normal distribution of the errors of the actuators and of the load near the most probable ones,
            shape (n_a + m,).
        misfit: sum of the squared residuals of the mean reading in its standard deviations; about the number of sensors
            or less while the model explains them.
        converged: whether Gauss-Newton converged, within the accuracy of its last equilibrium.
        equilibria: how many were computed for this reading.
        near: the equilibrium near which the estimate lies, with its condensed model.
        distrust: why the estimate is not trusted, 0 if it is: a number in `domain.DISTRUST_REASONS`.
    """

    displacement: np.ndarray
    load: np.ndarray
    load_covariance: np.ndarray
    effector: np.ndarray
    effector_covariance: np.ndarray
    parameters: Gaussian
    misfit: float
    converged: bool
    equilibria: int
    near: Linearised
    distrust: int

    @property
    def trusted(self) -> bool:
        """Whether the model explains the readings."""
        return self.distrust == 0

    @property
    def condensed(self) -> CondensedModel:
        """The condensed model near which the estimate lies."""
        return self.near.state.condensed

    @property
    def slack(self) -> np.ndarray:
        """Which actuators hang slack there, shape (n_a,)."""
        return self.near.state.slack


def held_response(condensed: CondensedModel, slack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of all displacements and of the actuators' efforts with held actuators.

    Args:
        condensed: model of n rows, n_a of them actuators, n_f effectors and contacts.
        slack: which actuators hang slack, shape (n_a,).

    Returns:
        Derivatives of the displacements (n, n_a + n_f) and efforts (n_a, n_a + n_f) by the displacements of the
        actuators and the forces on effectors and contacts.
    """
    W, sizes = condensed.compliance, dict(condensed.roles)
    n_a, n_f = sizes.get("a", 0), sizes.get("e", 0) + sizes.get("c", 0)
    held = np.flatnonzero(~slack)
    forces = np.arange(n_a, n_a + n_f)
    efforts = np.zeros((n_a, n_a + n_f))
    if len(held):
        change = np.hstack([np.eye(n_a)[held], -W[np.ix_(held, forces)]])
        efforts[held] = np.linalg.solve(W[np.ix_(held, held)], change)
    displacements = W[:, :n_a] @ efforts
    displacements[:, n_a:] += W[:, forces]
    return displacements, efforts


@dataclass(frozen=True)
class Linearised:
    """A body near one equilibrium: its condensed model, at which displacements, load and forces."""

    displacement: np.ndarray
    load: np.ndarray
    forces: np.ndarray
    state: Equilibrium

    def rows(self, displacement: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all displacements (n,) and the actuators' efforts (n_a,) for other commands and forces nearby."""
        by_displacement, by_effort = self.response
        change = np.concatenate([displacement - self.displacement, forces - self.forces])
        n_a = len(displacement)
        return self.state.condensed.delta.array + by_displacement @ change, self.state.effort[:n_a] + by_effort @ change

    @cached_property
    def response(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of displacements and efforts, see `held_response`."""
        return held_response(self.state.condensed, self.state.slack)


@dataclass(frozen=True)
class _Evidence:
    """Readings under one command, and what was known before them.

    Attributes:
        command: the command (n_a,).
        last: the last reading (k,).
        measured: mean of the readings (k,).
        noise: standard deviations of one reading (k,).
        count: number of readings.
        prior: distribution of the parameters before the readings.
        mixture: the same at each place of the load, if it is a sum over places.
    """

    command: np.ndarray
    last: np.ndarray
    measured: np.ndarray
    noise: np.ndarray
    count: int
    prior: Gaussian
    mixture: Mixture | None

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the mean (k,)."""
        return self.noise / np.sqrt(self.count)

    def own_residuals(self, residuals: np.ndarray) -> np.ndarray:
        """Return the residuals of the last reading (k,) for those of the mean, each in its own deviations."""
        return (self.last - self.measured) / self.noise + residuals / np.sqrt(self.count)


@dataclass(frozen=True)
class _Found:
    """An explanation of a reading: the equilibrium near which it lies, whether near enough, and how many were tried."""

    near: Linearised
    posterior: Posterior
    close: bool
    solved: int


@dataclass(frozen=True)
class _Branch:
    """Explanations of a reading with the same cables slack.

    Attributes:
        mixture: errors of actuators and size of the load at each place.
        base: effectors without errors and load, shape (n_e,).
        slopes: their derivatives by errors and size at each place, shape (q, n_e, n_a + 1).
        unilateral: which actuators may be slack, shape (n_a,).
        margins: without errors and load, tension of each tight cable and how far a slack one reaches beyond its
            command, shape (n_a,): consistent if at least 0.
        margin_slopes: their derivatives at each place, shape (q, n_a, n_a + 1).
    """

    mixture: Mixture
    base: np.ndarray
    slopes: np.ndarray
    unilateral: np.ndarray
    margins: np.ndarray
    margin_slopes: np.ndarray

    @property
    def unsure(self) -> np.ndarray:
        """Which cables are slack in place of tight, or vice versa, with a probability of `UNSURE` or more, (n_a,)."""
        total = np.logaddexp.reduce(self.mixture.logarithms)
        unsure = np.zeros(len(self.unilateral), dtype=bool)
        for k in np.flatnonzero(self.unilateral):
            inside = self.mixture.cut(self.margins[k], self.margin_slopes[:, k]).logarithms
            unsure[k] = np.logaddexp.reduce(inside) < total + np.log(1.0 - UNSURE)
        return unsure

    def consistent(self, cables: np.ndarray) -> _Branch:
        """Return the explanations with which some cables (n_a,) are tight or slack as assumed."""
        mixture = self.mixture
        for k in np.flatnonzero(cables):
            mixture = mixture.cut(self.margins[k], self.margin_slopes[:, k])
        return replace(self, mixture=mixture)


class Estimator:
    """Finds the shape of a body and the load on it from a stream of readings.

    Each reading is explained by the condensed model near the last equilibrium. Where the explanation moves away from
    that equilibrium by more than `accuracy`, a new one is computed there and the reading is explained again. A reading
    that is improbable with tight cables is also explained with slack ones, and the more probable explanation counts.

    Readings in a row under one command, of a load that does not drift, are explained together by their mean. Explained
    one after the other, each near another equilibrium, they would seem to tell force and place of a touch apart where
    their product alone is known.

    Readings that nothing explains give an estimate that is not trusted, and do not change what the estimator knows.

    Args:
        robot: the body; its cavities are sensors: of volume if they are open, of pressure if they are sealed.
        design: missing variables take their baseline.
        load: what may act on the body, e.g. `Touch` or `Payload`; None for a body without load.
        noise: of sensors and actuators.
        radius: over which a touch acts around each corner of its cell [m].
        equilibria: largest number of equilibria per reading.
        accuracy: distance from an equilibrium at which a new one is computed, in standard deviations of the estimate.

    Raises:
        DesignError: for a malformed design.
        InfeasibleDesign: if the body cannot exist.
        ValueError: if a touched point lies outside the body, or for a robot without sensors or settings out of bounds.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        design: Mapping[str, float] | None = None,
        load: Load | None = None,
        noise: Noise | None = None,
        radius: float = 2.5e-3,
        equilibria: int = 10,
        accuracy: float = 0.1,
    ) -> None:
        check_settings(radius=radius, equilibria=equilibria, accuracy=accuracy)
        self.robot, self.design, self.radius = robot, design, radius
        self.noise = noise or Noise()
        self.equilibria, self.accuracy = equilibria, accuracy
        self.belief: Gaussian | None = None
        self.touch(load)

    def touch(self, load: Load | None) -> None:
        """Replace the load, e.g. when another cell of the grid is touched; the errors of actuators stay known."""
        model = self.robot.build(self.design)
        for number, point in enumerate(np.empty((0, 3)) if load is None else load.points):
            model.add_contact(f"touch_{number}", point, radius=self.radius)
        self._statics, self._solved = Statics(model), 0
        self._near: Linearised | None = None
        self._other: Linearised | None = None  # with other cables slack
        self._bent: tuple[Linearised, Bend | None] | None = None
        self._evidence: _Evidence | None = None
        sizes = dict(model.roles)
        self._counts = sizes.get("a", 0), sizes.get("e", 0), sizes.get("c", 0)
        n_a = self._counts[0]
        sensors = model.constraints["s"]
        if not sensors and self.noise.effort is None:
            raise ValueError(f"robot '{self.robot.name}' has no sensors: no cavities and no Noise(effort=...)")
        self.rest_volumes = np.array([c.rest_volume for c in sensors if isinstance(c, Cavity)])
        self._sealed = np.array([isinstance(c, SealedAir) for c in sensors], dtype=bool)
        self._rest = np.zeros(len(sensors))  # readings of the undeformed body; pressures are relative to ambient
        self._rest[~self._sealed] = self.rest_volumes
        self._ambient = np.array([c.ambient for c in sensors if isinstance(c, SealedAir)])
        unlimited = np.full(n_a, np.inf)
        actuators = Gaussian(np.zeros(n_a), self.noise.displacement**2 * np.eye(n_a), -unlimited, unlimited)
        if self.belief is not None:
            covariance = self.belief.covariance[:n_a, :n_a]
            actuators = replace(actuators, mean=self.belief.mean[:n_a], covariance=covariance)
        self.load = load
        self.belief = actuators if load is None else actuators.joined_with(load.prior)
        self._drift = np.zeros(len(self.belief.mean))
        self._drift[n_a:] = self.noise.drift * np.sqrt(np.diag(self.belief.covariance))[n_a:]
        self._mixture: Mixture | None = None
        if load is not None and not self._drift.any():
            size = float(np.sqrt(load.prior.covariance[0, 0]))
            self._mixture = Mixture.before_readings(load.places(self._counts[1]), actuators, size)

    def reading(self, command: np.ndarray, change: np.ndarray, efforts: np.ndarray | None = None) -> Readings:
        """Return the readings for values of the sensor rows of the condensed model, ``delta.s`` (n_s,)."""
        values = self._rest + checked_readings("change", change, len(self._rest))
        return Readings(command, values[~self._sealed], efforts, values[self._sealed])

    def forces(self, load: np.ndarray) -> np.ndarray:
        """Return the forces on effectors and touched points for parameters of the load (m,) [N]."""
        _, n_e, n_c = self._counts
        return np.zeros(n_e + n_c) if self.load is None else self.load.forces(load, n_e)

    def linearise(self, displacement: np.ndarray, load: np.ndarray) -> Linearised:
        """Return the body near the equilibrium for displacements (n_a,) and parameters of the load (m,).

        Raises:
            ConvergenceError: if there is no equilibrium.
        """
        n_e, forces = self._counts[1], self.forces(load)
        self._solved += 1
        state = self._statics.solve(displacement, effector_force=forces[:n_e], contact=forces[n_e:])
        return Linearised(displacement, load, forces, state)

    def predict(self, near: Linearised, displacement: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the readings without noise (k,) that a condensed model predicts, and their derivative (k, n_a + m)."""
        delta, effort = near.rows(displacement, self.forces(load))
        by_displacement, by_effort = near.response
        cavities = near.state.condensed.slices.get("s", slice(0, 0))
        values, slope = self._rest + delta[cavities], by_displacement[cavities]
        if self.noise.effort is not None:
            values, slope = np.concatenate([values, effort]), np.vstack([slope, by_effort])
        return values, slope @ self._parameters_to_rows(load)

    def _parameters_to_rows(self, load: np.ndarray) -> np.ndarray:
        """Derivative of the displacements and forces (n_a + n_f,) by the parameters (n_a + m,)."""
        n_a, n_e, n_c = self._counts
        forces = np.zeros((n_e + n_c, 0)) if self.load is None else self.load.jacobian(load, n_e)
        combined = np.zeros((n_a + n_e + n_c, n_a + forces.shape[1]))
        combined[:n_a, :n_a], combined[n_a:, n_a:] = np.eye(n_a), forces
        return combined

    def _joined(self, readings: Readings) -> _Evidence:
        """Return a reading together with those before it under the same command."""
        n_a = self._counts[0]
        assert self.belief is not None
        command = checked_command(self.robot, readings.command)
        sealed = self._sealed
        cavities = np.zeros(len(sealed))
        cavities[~sealed] = checked_volumes(readings.volumes, self._rest[~sealed])
        cavities[sealed] = checked_pressures(readings.pressures, self._ambient)
        parts, noise = [cavities], [np.where(sealed, self.noise.pressure, self.noise.volume)]
        if self.noise.effort is not None:
            parts.append(checked_readings("efforts", readings.efforts, n_a))
            noise.append(np.full(n_a, self.noise.effort))
        elif readings.efforts is not None:
            raise ValueError("readings have efforts, whose noise is unknown; use Noise(effort=...) or leave them out")
        last, before = np.concatenate(parts), self._evidence
        if before is None or self._drift.any() or (command != before.command).any():
            prior = replace(self.belief, covariance=self.belief.covariance + np.diag(self._drift**2))
            return _Evidence(command, last, last, np.concatenate(noise), 1, prior, self._mixture)
        count = before.count + 1
        return replace(before, last=last, measured=before.measured + (last - before.measured) / count, count=count)

    def _explain(self, near: Linearised, evidence: _Evidence, start: np.ndarray | None) -> Posterior:
        n_a = self._counts[0]
        return most_probable(
            lambda parameters: self.predict(near, evidence.command + parameters[:n_a], parameters[n_a:]),
            evidence.measured,
            evidence.spread,
            evidence.prior,
            start=start,
        )

    def update(self, readings: Readings) -> Estimate:
        """Return the estimate after one more reading.

        After an error the estimator knows what it knew before.

        Raises:
            ValueError: if readings have a wrong shape, are not finite (a lost sensor) or are impossible (a wrong unit),
                or have efforts although the noise does not.
            ConvergenceError: if the body has no equilibrium under the command, at the most probable load before it.
        """
        n_a, self._solved = self._counts[0], 0
        assert self.belief is not None
        evidence = self._joined(readings)
        command = evidence.command
        near, solved = self._near, 0
        if near is None:
            likely = np.clip(self.belief.mean, self.belief.low, self.belief.high)
            near, solved = self.linearise(command + likely[:n_a], likely[n_a:]), 1
        found = self._search(near, evidence, solved)
        tight = self._statics.unilateral & ~found.near.state.slack
        if tight.any() and found.posterior.misfit > chi2.ppf(IMPROBABLE, len(found.posterior.residuals)):
            # The load may have slackened cables: readings have a most probable explanation with them and one without.
            mode = found.posterior.mode
            released = self._with_slack(command + mode[:n_a], mode[n_a:], self._statics.unilateral)
            slack = self._search(released, evidence, found.solved + 1)
            if slack.posterior.cost < found.posterior.cost:
                found = slack
            else:
                found = replace(found, solved=slack.solved)
        parameters, converged = found.posterior.parameters, found.posterior.converged and found.close
        displacement, load = command + found.posterior.mode[:n_a], found.posterior.mode[n_a:]
        effectors = found.near.state.condensed.slices["e"]
        covariance = parameters.covariance
        slope = (found.near.response[0] @ self._parameters_to_rows(load))[effectors]
        unexplained = not explains(evidence.own_residuals(found.posterior.residuals))
        estimate = Estimate(
            displacement=displacement,
            load=load,
            load_covariance=covariance[n_a:, n_a:],
            effector=found.near.rows(displacement, self.forces(load))[0][effectors],
            effector_covariance=slope @ covariance @ slope.T,
            parameters=parameters,
            misfit=found.posterior.misfit,
            converged=converged,
            equilibria=self._solved,
            near=found.near,
            distrust=UNEXPLAINED if unexplained else 0,
        )
        mixture = evidence.mixture
        if mixture is not None:
            estimate, mixture = self._mean(estimate, mixture, evidence)
        # A search that has not ended goes on from here with the next reading.
        if not (unexplained and converged):
            self._near, self._evidence, self.belief, self._mixture = found.near, evidence, parameters, mixture
        return estimate

    def _mean(self, estimate: Estimate, before: Mixture, evidence: _Evidence) -> tuple[Estimate, Mixture]:
        """Replace the most probable values of an estimate by means over all that explains the readings.

        These are all sizes and places of the load and, where it is not certain which cables are slack, both cases.

        Returns:
            The estimate, and the distribution after the readings.
        """
        branch = self._branch(estimate.near, before, evidence)
        branches, unsure = [branch], branch.unsure
        if unsure.any() and (other := self._turned(estimate, evidence, unsure)) is not None:
            branches = [each.consistent(unsure) for each in (branch, self._branch(other, before, evidence))]
        mixture = branches[0].mixture
        for each in branches[1:]:
            mixture = mixture.joined_with(each.mixture)
        parts = [(each.mixture, each.base, each.slopes) for each in branches]
        moments = joint_moments(parts)
        if (bend := self._bend(estimate, moments)) is not None:
            moments = joint_moments(parts, bend)
        mean = replace(
            estimate,
            displacement=evidence.command + moments.displacement,
            load=moments.load,
            load_covariance=moments.load_covariance,
            effector=moments.outputs,
            effector_covariance=moments.output_covariance,
            equilibria=self._solved,
        )
        return mean, mixture

    def _branch(self, near: Linearised, before: Mixture, evidence: _Evidence) -> _Branch:
        """Return what readings tell if the body stays near an equilibrium, with the same cables slack."""
        n_a, unilateral = self._counts[0], self._statics.unilateral
        delta, effort = near.rows(evidence.command, np.zeros(len(near.forces)))
        by_displacement, by_effort = near.response
        directions = before.places.directions.T

        def at_places(response: np.ndarray) -> np.ndarray:
            """Derivatives by the errors of actuators and the size of the load at each place, (q, rows, n_a + 1)."""
            by_size = (response[:, n_a:] @ directions).T[:, :, None]
            return np.concatenate([np.tile(response[:, :n_a], (len(by_size), 1, 1)), by_size], axis=2)

        slices = near.state.condensed.slices
        cavities, effectors = slices.get("s", slice(0, 0)), slices["e"]
        base, response = self._rest + delta[cavities], by_displacement[cavities]
        if self.noise.effort is not None:
            base, response = np.concatenate([base, effort]), np.vstack([response, by_effort])
        mixture = before.after(evidence.measured, evidence.spread, base, at_places(response))
        # A tight cable pulls; a slack one reaches further than its command.
        beyond = by_displacement[:n_a].copy()
        beyond[:, :n_a] -= np.eye(n_a)
        slack = near.state.slack
        margins = np.where(slack, delta[:n_a] - evidence.command, effort)
        slopes = at_places(np.where(slack[:, None], beyond, by_effort))
        return _Branch(mixture, delta[effectors], at_places(by_displacement[effectors]), unilateral, margins, slopes)

    def _turned(self, estimate: Estimate, evidence: _Evidence, turned: np.ndarray) -> Linearised | None:
        """Return the body near its most probable state if some cables (n_a,) are slack in place of tight or vice versa.

        None if there is no such equilibrium.
        """
        n_a, near, slack = self._counts[0], estimate.near, estimate.near.state.slack ^ turned
        other, displacement, load = self._other, near.displacement, near.load
        try:
            for _ in range(3):
                if other is None or (other.state.slack != slack).any():
                    other = self._with_slack(displacement, load, slack)
                mode = self._explain(other, evidence, None).mode
                displacement, load = evidence.command + mode[:n_a], mode[n_a:]
                if self._close(other, displacement, load, estimate.parameters):
                    break
                self._other, other = other, None
        except ConvergenceError:
            return None
        self._other = other or self._other
        return self._other

    def _bend(self, estimate: Estimate, moments: Moments) -> Bend | None:
        """Return how effectors deviate from lines as the load grows, where that matters; kept for one equilibrium."""
        near = estimate.near
        if self._bent is not None and self._bent[0] is near:
            return self._bent[1]
        variances = np.linalg.eigvalsh(moments.output_covariance)
        known = variances[variances > SMALLEST * variances[-1]]
        size = float(np.sqrt(moments.load_covariance[0, 0]))
        # Bodies bend by angles of about the motion over their size.
        if variances[-1] / self.robot.size < ACCURATE * np.sqrt(known[0]) or not size > 0.0:
            return None
        bend, effectors = None, near.state.condensed.slices["e"]
        more = near.load.copy()
        more[0] += size
        try:
            further = self._with_slack(near.displacement, more, near.state.slack)
        except ConvergenceError:
            further = None
        if further is not None:
            origin = near.state.condensed.delta.array[effectors]
            straight = near.rows(near.displacement, self.forces(more))[0][effectors]
            length = float(np.linalg.norm(straight - origin))
            deviation = further.state.condensed.delta.array[effectors] - straight
            if length > 0.0:
                bend = Bend(origin, (straight - origin) / length, 2.0 * deviation / length**2)
        self._bent = near, bend
        return bend

    def _search(self, near: Linearised, evidence: _Evidence, solved: int) -> _Found:
        """Explain readings by the body near an equilibrium, and near those that follow, until they hardly change."""
        n_a, most, start = self._counts[0], solved + self.equilibria - 1, None
        while True:
            posterior = self._explain(near, evidence, start)
            start = posterior.mode
            displacement, load = evidence.command + start[:n_a], start[n_a:]
            close = self._close(near, displacement, load, posterior.parameters)
            if close or solved >= most:
                return _Found(near, posterior, close, solved)
            nearer, solved = self._towards(near, displacement, load), solved + 1
            if nearer is None:
                return _Found(near, posterior, False, solved)
            near = nearer

    def _towards(self, near: Linearised, displacement: np.ndarray, load: np.ndarray) -> Linearised | None:
        """Return the body at an estimate or, where it buckles before, on the way there; None if it does at once."""
        for share in (1.0, 0.5, 0.25, 0.125):
            try:
                return self.linearise(
                    near.displacement + share * (displacement - near.displacement),
                    near.load + share * (load - near.load),
                )
            except ConvergenceError:
                continue
        return None

    def _with_slack(self, displacement: np.ndarray, load: np.ndarray, slack: np.ndarray) -> Linearised:
        """Return the body near the equilibrium with certain cables slack (n_a,), whether that is consistent or not.

        Raises:
            ConvergenceError: if there is none.
        """
        statics, n_e, forces = self._statics, self._counts[1], self.forces(load)
        self._solved += 1
        kept, statics.unilateral = statics.unilateral, np.zeros_like(slack)
        try:
            modes = ["effort" if free else "displacement" for free in slack]
            target = np.where(slack, 0.0, displacement)
            state = statics.solve(target, modes, effector_force=forces[:n_e], contact=forces[n_e:])
        finally:
            statics.unilateral = kept
        return Linearised(displacement, load, forces, replace(state, slack=slack))

    def _close(self, near: Linearised, displacement: np.ndarray, load: np.ndarray, found: Gaussian) -> bool:
        """Whether an estimate is within the accuracy of the equilibrium near which it was found."""
        spread = self._parameters_to_rows(load) @ np.linalg.cholesky(found.covariance)
        allowed = self.accuracy * np.linalg.norm(spread, axis=1)
        moved = np.concatenate([displacement - near.displacement, self.forces(load) - near.forces])
        return bool((np.abs(moved) <= allowed + 1e-9).all())

"""Calibration of what a model says about its own errors, on FEM equilibria under given commands.

Split conformal prediction (Vovk et al. 2005; Angelopoulos & Bates 2023, arXiv:2107.07511), in strata (Mondrian): the
factors of `Calibration` are such that in each stratum of the calibration states the uncertainty bounds 95 % of the
errors. The network is not trained again.

A state is trusted if its uncertainty is below a limit. The limit is at most the robot's goal tolerance, and lower if a
search for the worst trusted states, in which finite elements judge states that gradients of the spread propose, finds
errors above the tolerance. A search proposes states just below the limit, so nothing has been searched below a lower
one: searches are repeated, each below the limit that the last one left, until one finds no error above the tolerance.

Some commands have no equilibrium. An error exists only where there is one, so coverage is that of the other states; how
many commands have none is reported for each stratum. The members of an ensemble may agree there, so the spread does not
tell them. The stiffness does: where an equilibrium is nearly lost, the actuators are several times softer than at rest.
A calibration that meets such commands therefore limits the growth of trusted states (see `Domain`), and lowers this
limit, too, where that costs fewer states than a lower limit of the uncertainty.
"""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import WeightsError
from softgym_envs.extensions.fitting.data.sampling import pushed
from softgym_envs.extensions.fitting.data.strata import (
    Commands,
    StratifiedStates,
    draw_commands,
    solve_commands,
    strata_of,
)
from softgym_envs.extensions.fitting.predictions import Predictions, StratumReport, predict, reached, report
from softgym_envs.robots.base import Robot
from softgym_envs.storage import write_json
from softgym_envs.surrogate.domain import Calibration
from softgym_envs.surrogate.features import learned_variables
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.weight_files import load_model

COVERAGE = 0.95
SAFETY = 0.8
"""The limit of trust, relative to the smallest uncertainty with which an error above the tolerance was found."""

FACTOR_OF = {
    "inside": "inside",
    "faces": "faces",
    "corners": "corners",
    "slack corners": "slack_corners",
    "near buckling": "buckling",
}
"""Entry of `Calibration` that is fitted to a stratum."""

LOST = 0.01
"""If more than this share of the commands has no equilibrium, the growth of trusted states is limited."""

USUAL = 0.98
"""Share of the states inside whose growth is not above its limit."""

GROWTHS = np.linspace(0.7, 0.98, 15)
"""Shares of the states inside from whose growth the limit of the growth is chosen."""

SEARCHES = 6
"""Most searches of a calibration."""

ROUNDING = 1e-4
"""Relative change of a limit that may be rounding: networks in single precision give batches of other sizes slightly
other values."""

FORCES, FLOORS, POWERS = (0.0, 0.5, 1.0, 2.0), (0.1, 0.3, 1.0, 3.0), (0.5, 0.75, 1.0, 1.25)
"""Weights of the disagreement about forces, floors [median spread inside] and powers that a calibration tries."""

ROUNDS = 4
POOL = 8
"""Candidate designs and commands of the adversarial search."""


# -- states --------------------------------------------------------------------------------------------------------


def judged_states(
    model: SurrogateModel,
    bodies: int,
    states: int,
    seed: int,
    folder: str | Path | None = None,
    kept_only: bool = False,
    workers: int = 1,
) -> StratifiedStates:
    """Return FEM states of all strata of a model's robot.

    Args:
        model: predicts which states are near buckling.
        bodies: in each stratum.
        states: commands of each body.
        seed: of the bodies and commands.
        folder: where the states of each body are kept; an interrupted run continues with the next body.
        kept_only: take what the folder holds, without solving the rest.
        workers: number of processes that solve bodies.
    """
    parts = [
        _drawn(model, stratum, bodies, states, seed, folder, kept_only, workers)
        for stratum in strata_of(model.robot, buckles=model.domain.limits_growth)
    ]
    return StratifiedStates.join(parts)


def _drawn(
    model: SurrogateModel, stratum: str, bodies: int, states: int, seed: int,
    folder: str | Path | None, kept_only: bool, workers: int,
) -> StratifiedStates:  # fmt: skip
    """Return FEM states of one stratum."""
    commands = draw_commands(model.robot, stratum, bodies, states, seed, softness(model), learned_bounds(model))
    return solve_commands(model.robot, commands, folder=folder, kept_only=kept_only, workers=workers)


def learned_bounds(model: SurrogateModel) -> dict[str, tuple[float, float]]:
    """Return the bounds of design variables whose training data have narrower ones than the robot."""
    bounds = model.card.get("config", {}).get("data", {}).get("bounds", {})
    return {name: (low, high) for name, (low, high) in bounds.items()}


def softness(model: SurrogateModel) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the function that predicts the growth (N,) of bodies (N, d) under commands (N, n_a)."""

    def growth(designs: np.ndarray, commands: np.ndarray) -> np.ndarray:
        context = model.context(designs)
        displacement, found = reached(model, context, commands)
        return np.where(found, np.nan_to_num(model.softening_ratio(context, displacement), posinf=0.0), 0.0)

    return growth


# -- calibration ---------------------------------------------------------------------------------------------------


def with_domain(model: SurrogateModel, **entries: Any) -> SurrogateModel:
    """Return a model with other entries of its card's domain."""
    domain = {**model.card.get("domain", {}), **entries}
    return type(model)(model.robot, model.tensors, {**model.card, "domain": domain})


def conformal_quantile(scores: np.ndarray) -> float:
    """Return the smallest bound that covers a new score with a probability of at least `COVERAGE`."""
    rank = min(int(np.ceil((len(scores) + 1) * COVERAGE)), len(scores))
    return float(np.sort(scores)[rank - 1])


def fit_calibration(model: SurrogateModel, states: StratifiedStates) -> Calibration:
    """Return the calibration of a model on judged states.

    Weight of the forces, floor and power are those with the least pinball loss of the logarithmic errors, all strata
    being equally important.
    """
    model = _calibrated(model, Calibration())
    plain = predict(model, states)
    states, kept = states.rows(plain.found), plain.found
    error, place, growth = plain.error[kept], plain.spread[kept], plain.growth[kept]
    context = model.context(states.design)
    displacement, _ = reached(model, context, states.command)
    force = model.force_spread(context, displacement)
    rows = {name: states.stratum == name for name in FACTOR_OF if (states.stratum == name).any()}
    at_bounds, bare = model.domain.at_bounds(states.design), copy.copy(model)

    def ratios(calibration: Calibration) -> np.ndarray:
        """Return the errors relative to the uncertainty."""
        spread = np.hypot(place, calibration.forces * force)
        bare.domain = replace(model.domain, inflation=1.0, limit=np.inf, calibration=calibration)
        factors = calibration.body_factors(at_bounds, len(model.domain.columns))
        context.arrays["factor"], context.arrays["corner"] = (f[context.slot] for f in factors)
        return error / bare.trust(context, displacement, spread, states.command)[0]

    soft = float(np.quantile(growth[rows["near buckling"]], 0.1)) if "near buckling" in rows else np.inf
    best, least = Calibration(), np.inf
    for forces, share, power in itertools.product(FORCES, FLOORS, POWERS):
        typical = float(np.median(np.hypot(place, forces * force)[rows["inside"]]))
        found = Calibration(forces=forces, floor=share * typical, power=power, soft=soft)
        # Each factor mainly acts on its own stratum.
        for _ in range(20):
            ratio = ratios(found)
            quantile = {name: conformal_quantile(ratio[which]) for name, which in rows.items()}
            scaled = {FACTOR_OF[s]: getattr(found, FACTOR_OF[s]) * quantile[s] for s in rows}
            found = replace(found, **scaled)
            if "slack corners" not in rows:
                found = replace(found, slack_corners=found.corners)
            if all(abs(np.log(q)) < 1e-3 for q in quantile.values()):
                break
        beyond = np.log(ratios(found))
        pinball = np.maximum(COVERAGE * beyond, (COVERAGE - 1.0) * beyond)
        loss = float(np.mean([pinball[which].mean() for which in rows.values()]))
        if loss < least:
            best, least = found, loss
    return best


def _calibrated(
    model: SurrogateModel, calibration: Calibration, limit: float = np.inf, growth: float = np.inf
) -> SurrogateModel:
    entries: dict[str, Any] = {k: v for k, v in asdict(calibration).items() if np.isfinite(v)}
    softest = {"growth": growth} if np.isfinite(growth) else {}
    return with_domain(model, inflation=1.0, limit=limit, calibration=entries, **softest)


def usual_growth(model: SurrogateModel, states: StratifiedStates) -> float | None:
    """Return the largest growth to be trusted, or None if nearly all commands of judged states have an equilibrium.

    It is a bound on `USUAL` of the states inside that have one.
    """
    if (~states.found).mean() <= LOST:
        return None
    usual = states.rows(states.found & (states.stratum == "inside"))
    return float(np.quantile(softness(model)(usual.design, usual.command), USUAL))


def safe_limit(judged: Predictions, tolerance: float) -> float:
    """Return the largest uncertainty to be trusted: at most the tolerance [m], below that of all wrong states.

    A state is wrong if its error is above the tolerance or if it has no equilibrium on FEM. It does not count if it is
    not trusted for another reason than its uncertainty.

    Args:
        judged: by a model without a limit.
        tolerance: largest error of a trusted state [m].
    """
    wrong = judged.trusted & (~judged.found | (judged.error > tolerance))
    return min(tolerance, SAFETY * float(judged.uncertainty[wrong].min(initial=np.inf)))


def safe_bounds(
    judged: Predictions, stratum: np.ndarray, tolerance: float, growth: float, limit: float
) -> tuple[float, float]:
    """Return the largest growth and uncertainty to be trusted, below both of which no judged state is wrong.

    Commands without an equilibrium are soft, and the spread hardly tells them. With the growth limited a little more,
    they need not lower the limit of the uncertainty. Of the pairs that leave no wrong state, this is the one with the
    largest share of trusted states in the strata.

    Args:
        judged: by a model without a limit.
        stratum: of these states, shape (N,).
        tolerance: largest error of a trusted state [m].
        growth: largest growth to be considered, infinite for a robot that does not buckle.
        limit: likewise of the uncertainty [m].
    """
    drawn, best, most = stratum != "adversarial", (growth, 0.0), -1.0
    candidates = [growth]
    if np.isfinite(growth):
        inside = judged.growth[(stratum == "inside") & judged.found]
        candidates += [float(g) for g in np.quantile(inside, GROWTHS) if g < growth]
    for softest in candidates:
        kept = replace(judged, trusted=judged.trusted & (judged.growth <= softest))
        lowest = min(limit, safe_limit(kept, tolerance))
        share = float((kept.trusted & (kept.uncertainty <= lowest))[drawn].mean())
        if share > most:
            best, most = (softest, lowest), share
    return best


def calibrate(
    folder: str | Path, robot: Robot, *, bodies: int = 64, states: int = 5, adversarial_states: int = 500,
    seed: int = 11, state_folder: str | Path | None = None, kept_only: bool = False, workers: int = 1,
) -> dict[str, StratumReport]:  # fmt: skip
    """Calibrate the weights of a folder and write the result to their card.

    Args:
        folder: the weights.
        robot: their robot.
        bodies: bodies of each stratum.
        states: commands of each body.
        adversarial_states: states of each search for the worst trusted ones; 0 for no search.
        seed: of all random numbers.
        state_folder: where the FEM states are kept, so that an interrupted run continues.
        kept_only: calibrate on the states that the folder holds, without solving the rest; only those of the search
            for the worst trusted ones are solved.
        workers: number of processes that solve bodies.

    Returns:
        How the calibrated model does on the calibration states, by stratum; ``adversarial`` for those of the search.

    Raises:
        WeightsError: if the weights are not an ensemble.
    """
    model = load_model(folder, robot)
    if model.members < 2:
        raise WeightsError(
            f"'{folder}': only an ensemble of two or more members can be calibrated; "
            f"these weights have one member of kind '{model.network}'"
        )
    last = model.card.get("calibration", {})
    if last.get("limits_growth"):  # the last calibration did, not the training
        model = with_domain(model, growth=np.inf)
    elif last.get("growths"):  # the last calibration lowered that of the training
        model = with_domain(model, growth=last["trained_growth"])
    known = judged_states(model, bodies, states, seed, state_folder, kept_only, workers)
    limits_growth = False
    if not model.domain.limits_growth and (growth := usual_growth(model, known)) is not None:
        limits_growth, model = True, with_domain(model, growth=growth)
        softest = _drawn(model, "near buckling", bodies, states, seed, state_folder, kept_only, workers)
        known = StratifiedStates.join([known, softest])
    calibration = fit_calibration(model, known)
    unlimited, everything = _calibrated(model, calibration), known
    limits: list[float] = []  # below which searches were made
    growths: list[float] = []
    tolerance = robot.goal_tolerance
    growth, limit = safe_bounds(predict(unlimited, known), known.stratum, tolerance, model.domain.growth, tolerance)
    while adversarial_states and len(limits) < SEARCHES:
        if limits and limit >= (1.0 - ROUNDING) * limits[-1] and growth >= (1.0 - ROUNDING) * growths[-1]:
            break
        limits.append(limit)
        growths.append(growth)
        limited = _calibrated(model, calibration, limit, growth)
        found_states = adversarial_search(limited, adversarial_states, states, seed, state_folder, len(limits), workers)
        everything = StratifiedStates.join([everything, found_states])
        growth, limit = safe_bounds(predict(unlimited, everything), everything.stratum, tolerance, growth, limit)
    model = _calibrated(model, calibration, limit, growth)
    found = report(model, everything)
    card_path = Path(folder) / "model.json"
    card = json.loads(card_path.read_text())
    entries = {k: v for k, v in asdict(calibration).items() if np.isfinite(v)}
    card["domain"] |= {"inflation": 1.0, "limit": limit, "calibration": entries}
    card["domain"].pop("growth", None)
    if model.domain.limits_growth:
        card["domain"]["growth"] = model.domain.growth
    card["calibration"] = {
        "bodies": bodies, "states": states, "adversarial_states": adversarial_states, "seed": seed,
        "kept_only": kept_only, "limits": limits, "limits_growth": limits_growth,
        **({"growths": growths, "trained_growth": unlimited.domain.growth} if model.domain.limits_growth else {}),
        "strata": {name: asdict(row) for name, row in found.items()},
    }  # fmt: skip
    write_json(card_path, card)
    return found


def tested(
    folder: str | Path, robot: Robot, *, bodies: int = 16, states: int = 5, adversarial_states: int = 500,
    seed: int = 12, state_folder: str | Path | None = None, kept_only: bool = False, workers: int = 1,
) -> dict[str, StratumReport]:  # fmt: skip
    """Return how calibrated weights do on states that their calibration has not seen; their card stays as it is.

    Args: as for `calibrate`.

    Raises:
        ValueError: for the seed of the calibration.
    """
    model = load_model(folder, robot)
    if model.card.get("calibration", {}).get("seed") == seed:
        raise ValueError(f"seed = {seed} is that of the calibration of '{folder}': choose another one")
    parts = [judged_states(model, bodies, states, seed, state_folder, kept_only, workers)]
    if adversarial_states:
        parts.append(adversarial_search(model, adversarial_states, states, seed, state_folder, workers=workers))
    return report(model, StratifiedStates.join(parts))


def calibration_states(model: SurrogateModel, folder: str | Path) -> StratifiedStates:
    """Return the states by which a calibrated model was calibrated, those of the search included.

    Args:
        model: the model.
        folder: where `calibrate` kept them; missing ones are solved.
    """
    made = model.card["calibration"]
    sizes = made["states"], made["seed"], folder
    known = judged_states(model, made["bodies"], *sizes, made.get("kept_only", False))
    if not made["adversarial_states"]:
        return known
    if "limits" not in made:  # calibrated before searches were repeated
        made = {**made, "limits": [model.robot.goal_tolerance], "first": 0}
    softest = made.get("growths", [model.domain.growth] * len(made["limits"]))
    searched = [
        adversarial_search(_calibrated(model, model.domain.calibration, *bounds), made["adversarial_states"], *sizes, n)
        for n, bounds in enumerate(zip(made["limits"], softest, strict=True), start=made.get("first", 1))
    ]
    return StratifiedStates.join([known, *searched])


# -- the worst trusted states --------------------------------------------------------------------------------------


def adversarial_search(
    model: SurrogateModel, count: int, states: int, seed: int,
    folder: str | Path | None = None, number: int = 0, workers: int = 1,
) -> StratifiedStates:  # fmt: skip
    """Search for trusted states with large errors; return all that were judged, in the stratum ``adversarial``.

    In each of `ROUNDS` rounds, gradients of the spread move bodies and commands from anywhere in the box of trust to
    where the spread is largest, and each body keeps the trusted commands with the largest uncertainty. From the second
    round on, half of the bodies start near those with the largest errors on FEM so far.

    Args:
        model: a calibrated model.
        count: number of states.
        states: commands of each body.
        seed: of the random numbers.
        folder: where the states of each body are kept; an interrupted search continues with the next body.
        number: of the search: each has random numbers of its own.
        workers: number of processes that solve bodies.
    """
    rng = np.random.default_rng([seed, 99 + number])
    robot = model.robot
    d, n, bodies = len(learned_variables(robot)), len(robot.actuators), max(1, count // (ROUNDS * states))
    parts: list[StratifiedStates] = []
    origin: list[tuple[np.ndarray, np.ndarray]] = []
    scores: list[np.ndarray] = []
    for _ in range(ROUNDS):
        x = pushed(rng.random((POOL * bodies, d)), rng)
        c = pushed(rng.random((POOL * bodies * states, n)), rng).reshape(-1, states, n)
        x, c = _choose(model, *_climb(model, x, c), rng, bodies)
        if parts:
            # The worst bodies so far, a little changed.
            old_x, old_c = (np.concatenate(column) for column in zip(*origin, strict=True))
            order = np.argsort(-np.concatenate(scores))[: max(1, bodies // 4)]
            parents = rng.choice(order, POOL * bodies)
            near_x = np.clip(old_x[parents] + 0.08 * rng.standard_normal((len(parents), d)), 0.0, 1.0)
            near_c = np.clip(old_c[parents] + 0.08 * rng.standard_normal(old_c[parents].shape), 0.0, 1.0)
            near_x, near_c = _choose(model, near_x, near_c, rng, bodies)
            half = bodies // 2
            x, c = (
                np.concatenate([x[: bodies - half], near_x[:half]]),
                np.concatenate([c[: bodies - half], near_c[:half]]),
            )
        designs = _designs(model, x)
        command = robot.displacements(c.reshape(-1, n)).reshape(c.shape)
        searched = Commands(np.full(len(x), "adversarial"), designs, command)
        found = solve_commands(robot, searched, folder=folder, workers=workers)
        parts.append(found)
        judged = predict(model, found)
        error = np.where(judged.found & judged.trusted, judged.error, 0.0)
        origin.append((x, c))
        scores.append(_worst_of_bodies(designs, command, found, error))
    return StratifiedStates.join(parts)


def _worst_of_bodies(
    designs: np.ndarray, command: np.ndarray, found: StratifiedStates, error: np.ndarray
) -> np.ndarray:
    """Return the largest error (B,) of each body's states; 0 for a body that could not be built.

    Several bodies may share a design, above all at vertices of the box, under different commands.

    Args:
        designs: bodies, shape (B, len(space)).
        command: their commands, shape (B, S, n).
        found: states of the bodies that could be built.
        error: of these states, shape (N,).
    """
    errors: dict[tuple[bytes, bytes], float] = {}
    for design, wanted, value in zip(found.design, found.command, error, strict=True):
        errors[design.tobytes(), wanted.tobytes()] = float(value)
    return np.array(
        [max(errors.get((x.tobytes(), c.tobytes()), 0.0) for c in row) for x, row in zip(designs, command, strict=True)]
    )


def _designs(model: SurrogateModel, x: np.ndarray) -> np.ndarray:
    """Return designs (B, len(space)) of points x (B, d) of the unit cube, which spans the box of trust.

    A search in the whole design box would not get to the bounds of a narrower box of trust: steps beyond end there.
    """
    space, names = model.robot.design_space.within(learned_bounds(model)), learned_variables(model.robot)
    designs = np.tile(space.complete(None).array, (len(x), 1))
    for k, name in enumerate(names):
        column = space.names.index(name)
        low = max(space[name].low, model.domain.design_low[column])
        high = min(space[name].high, model.domain.design_high[column])
        designs[:, column] = np.clip(low + x[:, k] * (high - low), low, high)
    return designs


def _judge_points(model: SurrogateModel, x: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Judge bodies x (B, d) under commands c (B, S, n), both in the unit cube.

    Returns:
        Uncertainty (B, S), whether it is trusted (B, S), and the reached displacements (B * S, n).
    """
    robot, (B, S, n) = model.robot, c.shape
    command = robot.displacements(c.reshape(-1, n))
    context = model.context(_designs(model, x)).rows(np.repeat(np.arange(B), S))
    displacement, found = reached(model, context, command)
    _, spread = model.effector(context, displacement)
    uncertainty, trusted = model.trust(context, displacement, spread, command)
    return uncertainty.reshape(B, S), (trusted & found).reshape(B, S), displacement


def _choose(
    model: SurrogateModel, x: np.ndarray, c: np.ndarray, rng: np.random.Generator, bodies: int
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the bodies with the largest uncertainties that are still trusted, with trusted commands where possible."""
    uncertainty, trusted, _ = _judge_points(model, x, c)
    score = np.where(trusted, uncertainty, 0.0)
    chosen = np.argsort(-np.sort(score, axis=1)[:, c.shape[1] // 2])[:bodies]
    x, c, score = x[chosen], c[chosen], score[chosen]
    # Untrusted commands are drawn towards the best trusted one, or to rest.
    best = np.take_along_axis(c, score.argmax(axis=1)[:, None, None], axis=1)
    lost = (score == 0.0)[:, :, None]
    part = rng.random((*c.shape[:2], 1))
    return x, np.where(lost, best + 0.3 * part * (c - best), c)


def _climb(
    model: SurrogateModel, x: np.ndarray, c: np.ndarray, steps: int = 8, size: float = 0.06
) -> tuple[np.ndarray, np.ndarray]:
    """Move bodies x (B, d) and commands c (B, S, n) up the gradient of the spread, as long as they are trusted."""
    import torch

    from softgym_envs.extensions.fitting.torch_potential import PotentialEnsemble
    from softgym_envs.surrogate.potential.model import Model

    assert isinstance(model, Model)
    ensemble = PotentialEnsemble.of_model(model, dtype=torch.float32)
    robot, (B, S, n) = model.robot, c.shape
    columns = [robot.design_space.names.index(name) for name in learned_variables(robot)]
    zero = torch.tensor(-model.middle / model.half_range, dtype=torch.float32)
    _, trusted, displacement = _judge_points(model, x, c)
    for _ in range(steps):
        values = torch.tensor(_designs(model, x), requires_grad=True)
        u = torch.tensor((displacement - model.middle) / model.half_range, dtype=torch.float32, requires_grad=True)
        features = model.features.design(values).to(torch.float32).repeat_interleave(S, dim=0)
        bodies = ensemble.coefficients(features)
        members = ensemble.effectors(bodies, u)[..., : model.effectors]
        spread = ((members - members.mean(dim=0)) ** 2).mean(dim=0).sum(dim=1)
        if weight := model.domain.calibration.forces:
            efforts, lever = ensemble.gradients(bodies, u), ensemble.lever(bodies, zero.expand_as(u)).detach()
            shifts = lever[:, : model.effectors] @ (efforts - efforts.mean(dim=0))[..., None]
            spread = spread + weight**2 * (shifts[..., 0] ** 2).mean(dim=0).sum(dim=1)
        # Only trusted states count, so that no body leaves the region of trust altogether.
        torch.log(spread)[torch.as_tensor(trusted.ravel())].sum().backward()
        assert values.grad is not None and u.grad is not None
        new_x = np.clip(x + size * np.sign(values.grad.numpy()[:, columns]), 0.0, 1.0)
        new_c = np.clip(c + size * np.sign(u.grad.numpy()).reshape(B, S, n), 0.0, 1.0)
        _, kept, moved = _judge_points(model, new_x, new_c)
        better = kept.sum(axis=1) >= trusted.sum(axis=1)
        x = np.where(better[:, None], new_x, x)
        c = np.where(better[:, None, None], new_c, c)
        trusted = np.where(better[:, None], kept, trusted)
        displacement = np.where(np.repeat(better, S)[:, None], moved, displacement)
    return x, c

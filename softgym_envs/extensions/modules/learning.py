"""How superelements are learned: least squares on gradients and Hessians of the energy from finite elements.

``python -m softgym_envs.extensions.modules.learning leaf_spring`` learns one again and writes it to the current folder.

The residuals are what a user sees: the error of the strains under the load of a state, relative to the largest of the
module, and the error of the stiffness relative to that of the state. Both weigh soft and stiff motions alike. The
derivatives of the residuals are exact, and Levenberg and Marquardt's method finds the minimum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from softgym_envs.extensions.modules.base import Module
from softgym_envs.extensions.modules.energy import volume_terms
from softgym_envs.extensions.modules.learned import LearnedModule, polynomials
from softgym_envs.extensions.modules.registry import MODULES
from softgym_envs.extensions.modules.states import ModuleStates, solve_states

RIDGE = 1e-5
"""Weight of the squares of the weights of corrections, against overfitting."""

GUESS_RIDGE = 1e-4
"""Relative weight of the same squares in the first guess."""

MARGIN = 1.1
"""Bodies are drawn from a box that is wider by this factor than the one that users may use."""

CONFIDENCE, FOLDS = 0.95, 5
"""Share of the errors of strains that are within their bounds, and parts of the bodies that calibrate these."""

_ROWS, _COLUMNS = np.triu_indices(6)


@dataclass(frozen=True)
class Recipe:
    """What is learned of a module.

    Attributes:
        box: bounds of each dimension [m].
        rotation: defines the largest load; see `solve_states` [rad].
        bodies: number of bodies to learn from, under loads.
        unloaded: number of further bodies, only at rest.
        corners: whether the corners of the wider box (`MARGIN`) are learned too, under as many loads.
        rays: number of random directions of load for each body.
        degrees: of the polynomials of stiffness and corrections; the first needs many bodies.
        order: of the corrections; see `softgym_envs.extensions.modules.energy.terms`.
    """

    box: Mapping[str, tuple[float, float]]
    rotation: float
    _: KW_ONLY
    bodies: int = 20
    unloaded: int = 32
    rays: int = 3
    degrees: tuple[int, int] = (3, 1)
    order: int = 3
    corners: bool = False


RECIPES = {
    # With corrections of first degree in the dimensions, thin and long leaves are off by twice as much.
    "leaf_spring": Recipe(
        {"leaf_length": (0.010, 0.025), "width": (0.008, 0.020), "thickness": (0.001, 0.0025)},
        0.6,
        bodies=32,
        rays=2,
        degrees=(3, 2),
        order=5,
        corners=True,
    ),
    "solid_block": Recipe({"length": (0.010, 0.030), "width": (0.008, 0.020), "depth": (0.008, 0.020)}, 0.3),
    "notch_hinge": Recipe(
        {"radius": (0.003, 0.006), "width": (0.008, 0.014), "neck": (0.0018, 0.0035)}, 0.3, bodies=16, rays=2
    ),
    "torsion_tube": Recipe(
        {"length": (0.015, 0.040), "radius": (0.006, 0.010), "wall": (0.0015, 0.003)},
        0.3,
        bodies=30,
        unloaded=40,
        rays=2,
    ),
    "bellows": Recipe(
        {"pitch": (0.007, 0.010), "radius": (0.007, 0.010), "amplitude": (0.0012, 0.0024)},
        0.3,
        bodies=28,
        unloaded=24,
        rays=2,
        degrees=(2, 1),
    ),
    # Stiffer rotations carry several times the load that turns the softest one. Without the corners, or with
    # corrections of first degree in the dimensions, bodies near corners are up to 4 % too soft at rest.
    "accordion": Recipe(
        {"pitch": (0.006, 0.010), "width": (0.008, 0.014), "amplitude": (0.003, 0.006)},
        0.9,
        bodies=16,
        rays=2,
        degrees=(3, 2),
        order=5,
        corners=True,
    ),
    "crossed_leaves": Recipe(
        {"leaf_length": (0.012, 0.020), "width": (0.012, 0.018), "thickness": (0.001, 0.0018)},
        0.3,
        bodies=16,
        unloaded=16,
        rays=2,
        degrees=(2, 1),
    ),
}
"""What is learned, by the name of the module."""


class _Products(NamedTuple):
    """Products of strains at states: values (n, m), first (n, m, 6) and second derivatives (n, m, 6, 6)."""

    value: np.ndarray
    first: np.ndarray
    second: np.ndarray


def _products(strain: np.ndarray, terms: np.ndarray) -> _Products:
    n, m = len(strain), len(terms)
    value, first, second = np.ones((n, m)), np.zeros((n, m, 6)), np.zeros((n, m, 6, 6))
    padded = np.column_stack([strain, np.ones(n)])
    for t, (_, *factors) in enumerate(terms):
        value[:, t] = padded[:, factors].prod(axis=1)
        present = [p for p, f in enumerate(factors) if f >= 0]
        for p in present:
            others = [f for k, f in enumerate(factors) if k != p]
            first[:, t, factors[p]] += padded[:, others].prod(axis=1)
            for q in present:
                if q != p:
                    left = [f for k, f in enumerate(factors) if k not in (p, q)]
                    second[:, t, factors[p], factors[q]] += padded[:, left].prod(axis=1)
    return _Products(value, first, second)


class _Corrected(NamedTuple):
    """Corrected strains of states (n, 6) with derivatives (n, 6, 6) and (n, 6, 6, 6), and ``k`` (n, 6)."""

    value: np.ndarray
    first: np.ndarray
    second: np.ndarray
    k: np.ndarray

    def gradient(self) -> np.ndarray:
        return np.einsum("ni,ni,nip->np", self.k, self.value, self.first)

    def hessian(self) -> np.ndarray:
        squares = np.einsum("ni,nip,niq->npq", self.k, self.first, self.first)
        return squares + np.einsum("ni,ni,nipq->npq", self.k, self.value, self.second)


def _corrected(model: LearnedModule, states: ModuleStates, products: _Products) -> _Corrected:
    unit = model.unit(states.designs)
    c = polynomials(unit, model.degrees[1]) @ model.corrections
    n = len(states)
    value, first = states.strain.copy(), np.tile(np.eye(6), (n, 1, 1))
    second = np.zeros((n, 6, 6, 6))
    for t, target in enumerate(model.terms[:, 0]):
        value[:, target] += c[:, t] * products.value[:, t]
        first[:, target] += c[:, t, None] * products.first[:, t]
        second[:, target] += c[:, t, None, None] * products.second[:, t]
    return _Corrected(value, first, second, np.exp(polynomials(unit, model.degrees[0]) @ model.stiffness))


class _Weights(NamedTuple):
    """How errors of gradient and Hessian are weighed, by state: strains per load (n, 6, 6), inverse roots (n, 6, 6)."""

    compliance: np.ndarray
    root: np.ndarray


def _weights(states: ModuleStates, rotation: float) -> _Weights:
    compliance = np.linalg.inv(states.hessian)
    return _Weights(compliance / rotation, np.linalg.inv(np.linalg.cholesky(states.hessian)))


def _residuals(gradient: np.ndarray, hessian: np.ndarray, weights: _Weights) -> np.ndarray:
    """Weigh errors of gradient (n, ..., 6) and Hessian (n, ..., 6, 6): shape (n, ..., 27)."""
    strain = np.einsum("nij,n...j->n...i", weights.compliance, gradient)
    relative = np.einsum("nip,n...pq,njq->n...ij", weights.root, hessian, weights.root, optimize=True)
    return np.concatenate([strain, 0.1 * relative[..., _ROWS, _COLUMNS]], axis=-1)


def _guess(model: LearnedModule, states: ModuleStates, products: _Products, Q: np.ndarray) -> np.ndarray:
    """Return a model's corrections with others of second degree near its own, which fit the forces better.

    The gradient of the energy is ``G^T (k g)``. With ``G`` of the present corrections, this gives the corrected strains
    ``g`` that each state needs, and they are linear in the corrections. Newton's method would not find the way from no
    corrections at all: a leaf that bends without becoming shorter has a thousand times the energy.
    """
    state = _corrected(model, states, products)
    wanted = np.linalg.solve(np.swapaxes(state.first, 1, 2), states.gradient[:, :, None])[:, :, 0] / state.k
    terms = model.terms
    quadratic = (terms[:, 2] >= 0) & (terms[:, 3] < 0)
    found = np.where(terms[:, 2] < 0, model.corrections, 0.0)
    missing = wanted - states.strain
    for t in np.flatnonzero(terms[:, 2] < 0):
        missing[:, terms[t, 0]] -= (Q @ found[:, t]) * products.value[:, t]
    for strain in range(6):
        own = np.flatnonzero((terms[:, 0] == strain) & quadratic)
        columns = np.einsum("nt,nq->nqt", products.value[:, own], Q).reshape(len(states), -1)
        ridge = GUESS_RIDGE * np.eye(columns.shape[1]) * (columns**2).sum(axis=0).mean()
        solution = np.linalg.solve(columns.T @ columns + ridge, columns.T @ missing[:, strain])
        found[:, own] = solution.reshape(-1, len(own))
    return found


def _guess_at_rest(model: LearnedModule, states: ModuleStates, P: np.ndarray, Q: np.ndarray) -> LearnedModule:
    """Return a model whose stiffness at rest fits that of the states; ``P`` and ``Q`` are their polynomials.

    At rest the stiffness is ``L D L^T``: ``D`` is k, and a correction of first degree is an entry of ``L``.
    """
    rest = (states.strain == 0.0).all(axis=1)
    lower = np.linalg.cholesky(states.hessian[rest])
    root = np.einsum("nii->ni", lower)
    terms = model.terms
    corrections = np.zeros((Q.shape[1], len(terms)))
    for t in np.flatnonzero(terms[:, 2] < 0):
        i, j = terms[t, :2]
        corrections[:, t] = np.linalg.lstsq(Q[rest], lower[:, j, i] / root[:, i], rcond=None)[0]
    stiffness = np.linalg.lstsq(P[rest], 2.0 * np.log(root), rcond=None)[0]
    return replace(model, stiffness=stiffness, corrections=corrections)


def _slopes(
    model: LearnedModule, state: _Corrected, products: _Products, weights: _Weights, P: np.ndarray, Q: np.ndarray
) -> np.ndarray:
    """Return the derivatives of all residuals by the numbers of a model: stiffness, then corrections.

    ``P`` and ``Q`` are the polynomials of stiffness and corrections at the states.
    """
    target = model.terms[:, 0]
    k, g, G = state.k, state.value, state.first
    kt, gt, Gt, St = k[:, target], g[:, target], G[:, target], state.second[:, target]
    by_c = kt[:, :, None] * (products.value[:, :, None] * Gt + gt[:, :, None] * products.first)
    cross = np.einsum("ntp,ntq->ntpq", products.first, Gt)
    curved = products.value[:, :, None, None] * St + gt[:, :, None, None] * products.second
    by_c2 = kt[:, :, None, None] * (cross + np.swapaxes(cross, 2, 3) + curved)
    by_k = (k * g)[:, :, None] * G
    by_k2 = k[:, :, None, None] * (np.einsum("nip,niq->nipq", G, G) + g[:, :, None, None] * state.second)
    slopes_k = np.swapaxes(_residuals(by_k, by_k2, weights), 1, 2)
    slopes_c = np.swapaxes(_residuals(by_c, by_c2, weights), 1, 2)
    rows = slopes_k.shape[0] * slopes_k.shape[1]
    return np.concatenate(
        [
            np.einsum("nri,np->nrpi", slopes_k, P).reshape(rows, -1),
            np.einsum("nrt,nq->nrqt", slopes_c, Q).reshape(rows, -1),
        ],
        axis=1,
    )


def fit(
    recipe: Recipe,
    module: str,
    states: ModuleStates,
    others: Mapping[str, float],
    steps: int = 30,
) -> LearnedModule:
    """Return the superelement that fits states best.

    Args:
        recipe: what was learned.
        module: name in `MODULES`.
        states: to learn from.
        others: the values of the variables that were not varied.
        steps: largest number of steps of the search.
    """
    model = LearnedModule(
        module,
        dict(recipe.box),
        dict(others),
        recipe.rotation,
        np.empty((0, 6)),
        np.empty((0, 0)),
        np.abs(states.strain).max(axis=0),
        {},
        {},
        recipe.degrees,
        order=recipe.order,
    )
    unit = model.unit(states.designs)
    P, Q = polynomials(unit, recipe.degrees[0]), polynomials(unit, recipe.degrees[1])
    products, weights = _products(states.strain, model.terms), _weights(states, recipe.rotation)

    def errors_of(trial: LearnedModule) -> tuple[_Corrected, np.ndarray]:
        found = _corrected(trial, states, products)
        return found, _residuals(found.gradient() - states.gradient, found.hessian() - states.hessian, weights)

    def cost_of(trial: LearnedModule, residual: np.ndarray) -> float:
        return float((residual**2).sum() + RIDGE * (trial.corrections**2).sum())

    # The guesses do not always come closer: the search begins at the best of them.
    trials = [_guess_at_rest(model, states, P, Q)]
    for _ in range(5):
        trials.append(replace(trials[0], corrections=_guess(trials[-1], states, products, Q)))
    model = min(trials, key=lambda trial: cost_of(trial, errors_of(trial)[1]))
    state, residual = errors_of(model)
    cost, damping = cost_of(model, residual), 1e-3
    for _ in range(steps):
        jacobian = _slopes(model, state, products, weights, P, Q)
        ridge = np.concatenate([np.zeros(model.stiffness.size), np.full(model.corrections.size, RIDGE)])
        numbers = np.concatenate([model.stiffness.ravel(), model.corrections.ravel()])
        normal = jacobian.T @ jacobian + np.diag(ridge)
        slope = jacobian.T @ residual.ravel() + ridge * numbers
        improved = False
        for _ in range(8):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -slope)
            new = numbers + step
            trial = replace(
                model,
                stiffness=new[: model.stiffness.size].reshape(model.stiffness.shape),
                corrections=new[model.stiffness.size :].reshape(model.corrections.shape),
            )
            trial_state, trial_residual = errors_of(trial)
            trial_cost = cost_of(trial, trial_residual)
            if trial_cost < cost:
                improved = True
                break
            damping *= 4.0
        if not improved:
            break
        gain, damping = 1.0 - trial_cost / cost, 0.25 * damping
        model, state, residual, cost = trial, trial_state, trial_residual, trial_cost
        if gain < 1e-4:
            break
    return model


def strain_errors(model: LearnedModule, states: ModuleStates) -> np.ndarray:
    """Return the errors of the strains of states under their loads, to first order, shape (n, 6)."""
    found = _corrected(model, states, _products(states.strain, model.terms))
    return np.einsum("nij,nj->ni", np.linalg.inv(states.hessian), found.gradient() - states.gradient)


def stiffness_errors(model: LearnedModule, states: ModuleStates) -> np.ndarray:
    """Return the largest relative errors of the stiffness of states over all directions of motion, shape (n,)."""
    found = _corrected(model, states, _products(states.strain, model.terms))
    root = _weights(states, 1.0).root
    relative = root @ (found.hessian() - states.hessian) @ np.swapaxes(root, 1, 2)
    return np.abs(np.linalg.eigvalsh(relative)).max(axis=1)


def errors(model: LearnedModule, states: ModuleStates) -> dict[str, float]:
    """Return the errors on states: those of strains under load and of the stiffness.

    Returns:
        ``strain_mean`` and ``strain_max``: error of the strains under the load of a state over the largest strain of
        the states, to first order; ``stiffness_mean`` and ``stiffness_max``: largest relative error of the stiffness
        over all directions of motion; ``loaded``: the number of states under load, and ``covered``: the share of
        the six errors of their strains that are within the bounds of `LearnedModule.error_bounds`.
    """
    wrong, stiffness = np.linalg.norm(strain_errors(model, states), axis=1), stiffness_errors(model, states)
    sizes = np.linalg.norm(states.strain, axis=1)
    values = {"strain_mean": wrong.mean() / sizes.max(), "strain_max": wrong.max() / sizes.max()}
    values |= {"stiffness_mean": stiffness.mean(), "stiffness_max": stiffness.max()}
    bounds = model.error_bounds(model.unit(states.designs)) * sizes[:, None]
    within = np.abs(strain_errors(model, states)) <= bounds
    values |= {"loaded": (sizes > 0.0).sum(), "covered": within[sizes > 0.0].mean()}
    return {name: float(value) for name, value in values.items()}


def folds(states: ModuleStates) -> np.ndarray:
    """Return the part of the bodies to which the body of each state belongs, 0 to `FOLDS` - 1, shape (n,)."""
    bodies, number = np.unique(states.designs, axis=0, return_inverse=True)
    return (np.random.default_rng(0).permutation(len(bodies)) % FOLDS)[number]


def calibrated(model: LearnedModule, recipe: Recipe, states: ModuleStates) -> LearnedModule:
    """Return a model with bounds on the errors of its strains, from models that each leave a part of the bodies out.

    Each part of the bodies is left out once, and a model that learned the others predicts their states under load. The
    logarithm of the error, relative to the size of the strains, is taken as a line over the share of dimensions at the
    bounds of the box (`LearnedModule.error_bounds`). For each strain the line is raised until `CONFIDENCE` of the
    errors are below it (conformal prediction over folds). States of one body are not independent, so the share of
    errors within the bounds holds only about.
    """
    fold = folds(states)
    moved = (states.strain != 0.0).any(axis=1)
    wrong = np.empty((len(states), 6))
    for part in range(FOLDS):
        other = fit(recipe, model.module, states.rows(fold != part), model.others)
        wrong[fold == part] = strain_errors(other, states.rows(fold == part))
    wrong = wrong[moved] / np.linalg.norm(states.strain[moved], axis=1)[:, None]
    share = model.edge_share(model.unit(states.designs))[moved]
    slope = max(float(np.polyfit(share, np.log(np.linalg.norm(wrong, axis=1)), 1)[0]), 0.0)
    above = np.sort(np.abs(wrong) * np.exp(-slope * share)[:, None], axis=0)
    level = above[min(int(np.ceil(CONFIDENCE * (len(above) + 1))), len(above)) - 1]
    return replace(model, bounds={"inside": level, "corners": level * np.exp(slope)})


def with_cavity(model: LearnedModule, states: ModuleStates) -> LearnedModule:
    """Return a model of a closed module with the volume of its cavity, by least squares; other models unchanged."""
    P = polynomials(model.unit(states.designs), model.degrees[0])
    module: type[Module] = MODULES[model.module]
    if not module.closed:
        return model
    slopes = _products(states.strain, np.insert(volume_terms(model.symmetry), 0, 0, axis=1)).first
    columns = np.einsum("nti,np->nipt", slopes, P)
    shape = columns.shape
    columns = columns.reshape(shape[0] * shape[1], -1)
    ridge = RIDGE * np.sqrt((columns**2).mean()) * np.eye(columns.shape[1])
    wanted = np.concatenate([states.swelling.ravel(), np.zeros(len(ridge))])
    swelling = np.linalg.lstsq(np.vstack([columns, ridge]), wanted, rcond=None)[0].reshape(shape[2:])
    return replace(model, swelling=swelling, bulge=np.linalg.lstsq(P, np.log(states.bulge), rcond=None)[0])


def _solved(module: str, recipe: Recipe, unit: np.ndarray, rays: int, seed: int) -> ModuleStates:
    """Return states of bodies (n, v) in [-1, 1], which is the box."""
    made, names = MODULES[module](), tuple(recipe.box)
    low, high = np.log(np.array(list(recipe.box.values()))).T
    found = np.exp(0.5 * (low + high) + 0.5 * unit * (high - low))
    bounds = np.array([[made.design_space[name].low, made.design_space[name].high] for name in names])
    designs = np.clip(found, bounds[:, 0], bounds[:, 1])
    rng = np.random.default_rng(seed)
    return solve_states(made, designs, names, rotation=recipe.rotation, rays=rays, rng=rng)


def _drawn(number: int, variables: int, seed: int) -> np.ndarray:
    return 2.0 * qmc.Sobol(variables, seed=seed).random(number) - 1.0


def tested(model: LearnedModule) -> LearnedModule:
    """Return a model with its `errors` on four corners of the box and on two bodies inside, which are not learned."""
    recipe = Recipe(model.box, model.rotation)
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)[:, : len(model.box)]
    states = {
        "corners": _solved(model.module, recipe, corners, 1, 3),
        "inside": _solved(model.module, recipe, _drawn(2, len(model.box), 4), 1, 4),
    }
    return replace(model, errors={place: errors(model, each) for place, each in states.items()})


def training_states(module: str, recipe: Recipe) -> ModuleStates:
    """Return the states from which a module is learned; this takes up to some minutes of finite elements."""
    variables = len(recipe.box)
    states = _solved(module, recipe, MARGIN * _drawn(recipe.unloaded, variables, 2), 0, 2)
    states = states.joined(_solved(module, recipe, MARGIN * _drawn(recipe.bodies, variables, 1), recipe.rays, 1))
    if recipe.corners:
        corners = np.array(list(product((-1.0, 1.0), repeat=variables)))
        states = states.joined(_solved(module, recipe, MARGIN * corners, recipe.rays, 5))
    return states


def learn_module(module: str, recipe: Recipe | None = None) -> LearnedModule:
    """Return the superelement of a module, learned from finite elements; this takes some minutes.

    Raises:
        KeyError: for a module without a recipe, if none is given.
        ValueError: for an unknown module.
    """
    recipe = RECIPES[module] if recipe is None else recipe
    made, states = MODULES[module](), training_states(module, recipe)
    others = {v.name: v.baseline for v in made.design_space if v.name not in recipe.box and v.name != "young_modulus"}
    model = with_cavity(fit(recipe, module, states, others), states)
    return tested(calibrated(model, recipe, states))


if __name__ == "__main__":
    import sys

    for name in sys.argv[1:]:
        learned = learn_module(name)
        learned.save(f"{name}.json")
        print(f"wrote {name}.json: bounds {learned.bounds}, errors {learned.errors}")

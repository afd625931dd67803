"""Learned modules: exact derivatives, symmetry and errors against finite elements."""

import json
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.extensions.modules import MODULES, learned_module, learning
from softgym_envs.extensions.modules.energy import MIRRORED, ModuleEnergy, reflections, terms
from softgym_envs.extensions.modules.learned import load_module, polynomials
from softgym_envs.extensions.modules.learning import RECIPES, Recipe, calibrated, errors, fit
from softgym_envs.extensions.modules.states import ModuleStates, solve_states

SYMMETRIES = (MIRRORED, ("y", "xz"))
ORDERS = (3, 5)


@pytest.fixture(scope="module", params=SYMMETRIES)
def symmetry(request):
    return request.param


@pytest.fixture(scope="module", params=ORDERS)
def energy(symmetry, request):
    corrections = np.random.default_rng(0).normal(size=len(terms(symmetry, request.param)))
    return ModuleEnergy(0.03, [2.0, 3.0, 40.0, 0.5, 0.3, 0.2], corrections, symmetry, request.param)


STRAINS = np.array([0.003, -0.002, -0.001, 0.2, -0.4, 0.3])


def test_gradient_and_hessian_are_the_derivatives_of_the_energy(energy):
    _, gradient, hessian = energy.evaluate(STRAINS)
    for k, step in enumerate([1e-8] * 3 + [1e-6] * 3):
        move = step * np.eye(6)[k]
        (up, up_gradient, _), (down, down_gradient, _) = (energy.evaluate(STRAINS + s * move) for s in (1.0, -1.0))
        assert (up - down) / (2.0 * step) == pytest.approx(gradient[k], rel=1e-6, abs=1e-7 * abs(gradient).max())
        slope = (up_gradient - down_gradient) / (2.0 * step)
        np.testing.assert_allclose(slope, hessian[k], rtol=1e-6, atol=1e-7 * abs(hessian[k]).max())


def test_the_energy_has_the_reflections_of_the_module_and_no_others(energy, symmetry):
    value = energy.evaluate(STRAINS)[0]
    for signs in reflections(symmetry):
        assert energy.evaluate(signs * STRAINS)[0] == pytest.approx(value, rel=1e-12)
    others = [-np.ones(6), *([reflections(["x"])[0]] if "x" not in symmetry else [])]
    for signs in others:
        assert energy.evaluate(signs * STRAINS)[0] != pytest.approx(value, rel=1e-3)


def test_any_energy_is_stable_at_rest_and_couples_only_strains_of_a_class(energy, symmetry):
    hessian = energy.evaluate(np.zeros(6))[2]
    assert np.linalg.eigvalsh(hessian)[0] > 0.0
    coupled = {(int(i), int(j)) for i, j in np.argwhere(np.triu(hessian, 1) != 0.0)}
    assert coupled == (set() if symmetry == MIRRORED else {(0, 2), (3, 5)})


@pytest.mark.parametrize("name", MODULES)
def test_modules_have_the_symmetry_that_they_state(name):
    """Compliance at rest, in the strains of a superelement; the mesh is not quite symmetric."""
    module = MODULES[name]()
    strained = strain_compliance(module, {})
    scale = np.sqrt(np.outer(np.diag(strained), np.diag(strained)))
    for signs in reflections(module.symmetry):
        np.testing.assert_allclose(signs[:, None] * strained * signs / scale, strained / scale, atol=0.01)


def strain_compliance(module, design):
    """Compliance of a body at rest over the strains of a superelement."""
    length = module.length(module.design_space.complete(design))
    shift = np.eye(6)  # from the motion of the far port to strains
    shift[0, 4], shift[1, 3] = -0.5 * length, 0.5 * length
    return shift @ module.compliance(design) @ shift.T


def made_states(name, order, count, seed):
    """States of a known energy, a tenth of them at rest; those that are not stable are left out."""
    symmetry = MODULES[name].symmetry
    rng = np.random.default_rng(seed)
    designs = rng.uniform(0.01, 0.03, size=(count, 1))
    k = np.array([2.0, 3.0, 4.0, 0.5, 0.3, 0.2])
    c = 0.3 * np.random.default_rng(1).normal(size=len(terms(symmetry, order)))
    strain = 0.05 * rng.normal(size=(count, 6))
    strain[: count // 10] = 0.0
    rows = [ModuleEnergy(1.0, k * d[0], c, symmetry, order).evaluate(e) for d, e in zip(designs, strain, strict=True)]
    gradient, hessian = np.array([r[1] for r in rows]), np.array([r[2] for r in rows])
    states = ModuleStates(designs, strain, gradient, hessian, np.zeros((count, 6)), np.zeros(count))
    return states.rows(np.linalg.eigvalsh(states.hessian)[:, 0] > 0.0)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", ["solid_block", "crossed_leaves"])
def test_a_fit_finds_the_energy_that_made_the_states(name, order):
    states = made_states(name, order, 120, 1)
    found = fit(Recipe({"length": (0.01, 0.03)}, 0.5, order=order), name, states, {})
    error = errors(found, states)["stiffness_mean"]
    linear = errors(replace(found, corrections=0.0 * found.corrections), states)["stiffness_mean"]
    assert error < 0.02 < 0.2 * linear


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", ["solid_block", "crossed_leaves"])
def test_the_slopes_of_a_fit_are_the_derivatives_of_its_residuals(name, order):
    """By numbers that are drawn at random, at an energy that is not yet fitted."""
    recipe, states = Recipe({"length": (0.01, 0.03)}, 0.5, order=order), made_states(name, order, 12, 1)
    model, rng = fit(recipe, name, states, {}, steps=0), np.random.default_rng(2)
    P, Q = (polynomials(model.unit(states.designs), degree) for degree in recipe.degrees)
    products, weights = learning._products(states.strain, model.terms), learning._weights(states, recipe.rotation)
    start = np.concatenate([model.stiffness.ravel(), rng.normal(size=model.corrections.size)])

    def at(numbers):
        k, c = np.split(numbers, [model.stiffness.size])
        return replace(model, stiffness=k.reshape(-1, 6), corrections=c.reshape(model.corrections.shape))

    def residuals(numbers):
        found = learning._corrected(at(numbers), states, products)
        return learning._residuals(found.gradient(), found.hessian(), weights).ravel()

    slopes = learning._slopes(at(start), learning._corrected(at(start), states, products), products, weights, P, Q)
    step = 1e-5
    for column in rng.choice(len(start), 40, replace=False):
        move = step * np.eye(len(start))[column]
        expected = (residuals(start + move) - residuals(start - move)) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, column], expected, atol=1e-6 * max(abs(expected).max(), 1e-3))


def test_bounds_cover_states_that_were_neither_learned_nor_used_to_calibrate():
    """With noisy forces, whose size bounds must find; the numbers are those of fixed seeds."""
    learned, others = (made_states("solid_block", 3, count, seed) for count, seed in ((200, 2), (600, 3)))
    rng = np.random.default_rng(4)
    for states in (learned, others):
        noise = 0.02 * rng.normal(size=(len(states), 6)) * np.linalg.norm(states.strain, axis=1)[:, None]
        states.gradient[:] += np.einsum("nij,nj->ni", states.hessian, noise)
    recipe = Recipe({"length": (0.01, 0.03)}, 0.5, degrees=(1, 0))
    model = calibrated(fit(recipe, "solid_block", learned, {}), recipe, learned)
    found = errors(model, others)
    assert 0.9 < found["covered"] < 0.99
    halved = replace(model, bounds={place: 0.5 * bound for place, bound in model.bounds.items()})
    assert errors(halved, others)["covered"] < 0.8


@pytest.mark.parametrize("name", RECIPES)
def test_a_learned_module_has_the_compliance_of_finite_elements(name):
    learned, module = learned_module(name), MODULES[name]()
    design = {each: 0.4 * low + 0.6 * high for each, (low, high) in learned.box.items()} | {"young_modulus": 3e7}
    strained = strain_compliance(module, design)
    found = np.linalg.inv(learned.energy(design).evaluate(np.zeros(6))[2])
    np.testing.assert_allclose(np.diag(found), np.diag(strained), rtol=0.04)


@pytest.mark.parametrize("name", RECIPES)
def test_a_learned_module_follows_finite_elements_under_a_load(name):
    learned, module = learned_module(name), MODULES[name]()
    design = np.array([[0.5 * (low + high) for low, high in learned.box.values()]])
    rng = np.random.default_rng(5)
    states = solve_states(module, design, tuple(learned.box), rotation=learned.rotation, rays=1, rng=rng)
    assert len(states) > 1
    assert errors(learned, states)["strain_max"] < 0.03


def test_bodies_are_drawn_from_the_box_in_any_order_of_its_dimensions(monkeypatch):
    """Bounds that the module has for a dimension are not those of another one."""
    drawn = []

    def record(module, designs, names, **_):
        drawn.append(dict(zip(names, designs.T, strict=True)))
        raise InterruptedError

    monkeypatch.setattr(learning, "solve_states", record)
    with pytest.raises(InterruptedError):
        box = {"width": (0.008, 0.014), "amplitude": (0.003, 0.0079)}
        learning.learn_module("accordion", Recipe(box, 0.3, bodies=16))
    for name, low, high in (("width", 0.008, 0.014), ("amplitude", 0.003, 0.0079)):
        assert 0.9 * low < drawn[0][name].min() < 1.1 * low < 0.9 * high < drawn[0][name].max() < 1.1 * high


@pytest.mark.parametrize("name", RECIPES)
def test_learned_modules_know_how_wrong_they_may_be(name):
    """Nothing at rest, where the force is exactly zero; more at the corners of the box, and for larger strains."""
    learned, module = learned_module(name), MODULES[name]()
    middle = {each: (low * high) ** 0.5 for each, (low, high) in learned.box.items()}
    corner = {each: high for each, (_, high) in learned.box.items()}
    inside, outside = (learned.energy({**design, "young_modulus": 1e7}) for design in (middle, corner))
    np.testing.assert_allclose(inside.error_bounds, learned.bounds["inside"])
    np.testing.assert_allclose(outside.error_bounds, learned.bounds["corners"])
    assert (0.0 < inside.error_bounds).all() and (inside.error_bounds <= outside.error_bounds).all()
    assert outside.error_bounds.max() < 0.1
    scale = np.array([module.length(module.design_space.complete(middle))] * 3 + [1.0] * 3)
    strains = 0.3 * scale * learned.largest_strains * np.sign(np.arange(6) - 2.5)
    assert not inside.possible_errors(np.zeros(6)).any()
    compliance = np.linalg.inv(inside.evaluate(strains)[2])
    off = np.array([compliance @ row / scale for row in inside.possible_errors(strains)])
    np.testing.assert_allclose(off, np.linalg.norm(strains / scale) * np.diag(inside.error_bounds), atol=1e-9)


def test_strains_that_were_not_learned_are_not_known():
    """The first three count over the length; the load has its own limit."""
    stiffness, corrections = [2.0, 3.0, 40.0, 0.5, 0.3, 0.2], np.zeros(len(terms()))
    strained = ModuleEnergy(0.03, stiffness, corrections, largest_strains=np.array([0.1, 0.1, 0.01, 0.2, 0.2, 0.3]))
    loaded = ModuleEnergy(0.03, stiffness, corrections, rotation=0.3)
    for strains in ([0.0031, 0, 0, 0, 0, 0], [0, 0, -0.00031, 0, 0, 0], [0, 0, 0, 0, 0.21, 0]):
        assert strained.knows(0.95 * np.array(strains)) and not strained.knows(np.array(strains))
    assert loaded.knows(np.array([0, 0, 0, 0, 0, 0.29])) and not loaded.knows(np.array([0, 0, 0, 0, 0, 0.31]))


def test_strains_at_which_the_hessian_is_indefinite_are_not_known():
    """The second strain falls with the square of the first, which makes the energy -2 x^2 y^2 among others."""
    corrections = np.zeros(len(terms()))
    row = next(i for i, term in enumerate(terms().tolist()) if term == [2, 4, 4, -1])
    corrections[row] = 1.0
    energy = ModuleEnergy(1.0, np.ones(6), corrections)
    assert energy.knows(np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0]))
    indefinite = np.array([0.0, 0.0, -0.6, 0.0, 0.0, 0.0])
    assert np.linalg.eigvalsh(energy.evaluate(indefinite)[2])[0] < 0.0
    assert not energy.knows(indefinite)


def test_bodies_that_were_not_learned_are_named():
    with pytest.raises(DesignError, match="'solid_block' was learned for length from 0.01 to 0.03 m"):
        learned_module("solid_block").energy({"length": 0.05})
    with pytest.raises(DesignError, match="poisson_ratio = 0.4 only"):
        learned_module("solid_block").energy({"poisson_ratio": 0.3})


def test_files_that_are_not_learned_modules_are_named(tmp_path):
    with pytest.raises(WeightsError, match="does not exist"):
        load_module(tmp_path / "leaf.json")
    learned_module("solid_block").save(tmp_path / "block.json")
    np.testing.assert_array_equal(
        load_module(tmp_path / "block.json").stiffness, learned_module("solid_block").stiffness
    )
    record = json.loads((tmp_path / "block.json").read_text())
    (tmp_path / "block.json").write_text(json.dumps(record | {"format": 0}))
    with pytest.raises(WeightsError, match="format"):
        load_module(tmp_path / "block.json")

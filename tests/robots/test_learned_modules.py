"""Learned modules: exact derivatives, symmetry and errors against finite elements."""

import json
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs.errors import DesignError, WeightsError
from softgym_envs.robots.modules import MODULES, learned_module
from softgym_envs.robots.modules.energy import LARGEST_SPREAD, TERMS, ModuleEnergy
from softgym_envs.robots.modules.learned import load_module
from softgym_envs.robots.modules.learning import RECIPES, Recipe, errors, fit
from softgym_envs.robots.modules.states import ModuleStates, solve_states


@pytest.fixture(scope="module")
def energy():
    return ModuleEnergy(0.03, [2.0, 3.0, 40.0, 0.5, 0.3, 0.2], np.random.default_rng(0).normal(size=len(TERMS)))


STRAINS = np.array([0.003, -0.002, -0.001, 0.2, -0.4, 0.3])


def test_gradient_and_hessian_are_the_derivatives_of_the_energy(energy):
    _, gradient, hessian = energy.evaluate(STRAINS)
    for k, step in enumerate([1e-8] * 3 + [1e-6] * 3):
        move = step * np.eye(6)[k]
        (up, up_gradient, _), (down, down_gradient, _) = (energy.evaluate(STRAINS + s * move) for s in (1.0, -1.0))
        assert (up - down) / (2.0 * step) == pytest.approx(gradient[k], rel=1e-6, abs=1e-7 * abs(gradient).max())
        slope = (up_gradient - down_gradient) / (2.0 * step)
        np.testing.assert_allclose(slope, hessian[k], rtol=1e-6, atol=1e-7 * abs(hessian[k]).max())


@pytest.mark.parametrize("signs", [[-1, 1, 1, 1, -1, -1], [1, -1, 1, -1, 1, -1], [-1, -1, 1, 1, 1, -1]])
def test_the_energy_has_the_reflections_of_the_module(energy, signs):
    assert energy.evaluate(signs * STRAINS)[0] == pytest.approx(energy.evaluate(STRAINS)[0], rel=1e-12)
    assert energy.evaluate(-STRAINS)[0] != pytest.approx(energy.evaluate(STRAINS)[0], rel=1e-3)


def test_a_fit_finds_the_energy_that_made_the_states():
    rng, box = np.random.default_rng(1), {"length": (0.01, 0.03)}
    designs = rng.uniform(0.01, 0.03, size=(120, 1))
    k, c = np.array([2.0, 3.0, 4.0, 0.5, 0.3, 0.2]), 0.3 * rng.normal(size=len(TERMS))
    strain = 0.05 * rng.normal(size=(120, 6))
    strain[:12] = 0.0
    rows = [ModuleEnergy(1.0, k * d[0], c).evaluate(e) for d, e in zip(designs, strain, strict=True)]
    states = ModuleStates(designs, strain, np.array([r[1] for r in rows]), np.array([r[2] for r in rows]))
    stable = np.linalg.eigvalsh(states.hessian)[:, 0] > 0.0
    found = fit(Recipe(box, 0.5), "solid_block", states.rows(stable), {})
    error = errors(found, states.rows(stable))["stiffness_mean"]
    linear = errors(replace(found, corrections=0.0 * found.corrections), states.rows(stable))["stiffness_mean"]
    assert error < 0.02 < 0.2 * linear


@pytest.mark.parametrize("name", RECIPES)
def test_a_learned_module_has_the_compliance_of_finite_elements(name):
    learned, module = learned_module(name), MODULES[name]()
    design = {each: 0.4 * low + 0.6 * high for each, (low, high) in learned.box.items()} | {"young_modulus": 3e7}
    length = module.length(module.design_space.complete(design))
    shift = np.eye(6)  # from the motion of the far port to strains
    shift[0, 4], shift[1, 3] = -0.5 * length, 0.5 * length
    strained = shift @ module.compliance(design) @ shift.T
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


def test_members_differ_where_nothing_was_learned():
    """Beyond the loads and the dimensions that were learned. Errors there are of the size of the spread."""
    tube = learned_module("torsion_tube")
    middle = {name: 0.5 * (low + high) for name, (low, high) in tube.box.items()}
    strains = np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.1])
    energy = tube.energy(middle)
    assert energy.spread(0.0 * strains) == 0.0
    assert energy.spread(strains) < LARGEST_SPREAD < energy.spread(4.0 * strains)
    far = {"length": 0.012, "radius": 0.014, "wall": 0.0012}
    outside = tube.energy(far, beyond=True)
    gentle = 0.9 / outside.load(strains) * strains
    assert outside.load(gentle) < 1.0
    assert not outside.knows(gentle)
    with pytest.raises(DesignError, match="'torsion_tube' was learned for length"):
        tube.energy(far)
    with pytest.raises(DesignError, match="'solid_block' was learned for length"):
        learned_module("solid_block").energy({"length": 0.05}, beyond=True)  # it has no members


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

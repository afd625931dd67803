"""Learned inertia: its representation, its fit to finite elements, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from softgym_envs.errors import WeightsError
from softgym_envs.extensions.fitting.inertia_training import fit_inertia
from softgym_envs.extensions.fitting.reduction import reduce_motion
from softgym_envs.extensions.motion.inertia import (
    FILE,
    LearnedInertia,
    Polynomials,
    from_entries,
    half_stiffness,
    read_inertia,
    to_entries,
    write_inertia,
)
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.pretrained import pretrained_folder


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_entries_stand_for_positive_definite_matrices(seed, order):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(4, order, order)) * 10.0 ** rng.uniform(-3, 3, size=(4, order, 1))
    matrices = factor @ factor.swapaxes(1, 2) + 1e-6 * np.trace(factor, axis1=1, axis2=2)[:, None, None] ** 2 * np.eye(
        order
    )
    np.testing.assert_allclose(
        from_entries(to_entries(matrices)), matrices, rtol=1e-6, atol=1e-9 * np.abs(matrices).max()
    )
    anything = from_entries(rng.normal(size=(4, order * (order + 1) // 2)))
    assert (np.linalg.eigvalsh(anything) > 0.0).all()


def test_monomials():
    x = np.array([[2.0, 3.0]])
    np.testing.assert_array_equal(Polynomials(2, 3)(x), [[1, 2, 3, 4, 6, 9, 8, 12, 18, 27]])
    assert Polynomials(2, 3).count == 10 and Polynomials(5, 1).count == 6


@pytest.mark.parametrize(("name", "limit"), [("finger", 0.03), ("diamond", 0.06)])
def test_shipped_inertia_gives_the_swings_of_the_body(name, limit):
    """The two lowest frequencies of the baseline at rest, with held actuators, and of a body twice as stiff."""
    robot = make_robot(name)
    inertia = read_inertia(pretrained_folder(robot), robot)
    space = robot.design_space
    for stiffer in (1.0, 2.0):
        design = space.complete({"young_modulus": stiffer * space["young_modulus"].baseline})
        statics = Statics(robot.build(design))
        statics.solve(np.zeros(len(robot.actuators)))
        reduced = reduce_motion(statics, inner=True)
        n = len(reduced.mass) // 2
        scale = np.eye(2 * n)
        scale[:n, :n] = half_stiffness(np.linalg.inv(reduced.stiffness[:n, :n]), inertia.sizes)
        periods = inertia.periods(inertia.body(design.array[None]), np.zeros((1, len(robot.actuators))))[0]
        mass = scale @ periods @ scale.T
        held = slice(len(robot.actuators), None)
        K = reduced.stiffness[held, held]
        true, found = (
            eigh(K, m[held, held], eigvals_only=True, subset_by_index=[0, 1]) ** 0.5 for m in (reduced.mass, mass)
        )
        np.testing.assert_allclose(found, true, rtol=limit)


def test_fit_recovers_a_robot_and_its_file(tmp_path):
    """Few bodies and a linear model; the file gives the same matrices, and another robot is refused."""
    robot = make_robot("finger")
    inertia = fit_inertia(robot, bodies=48, states=1, degree=1)
    assert inertia.card["mean_frequency_error"] < 0.06
    write_inertia(inertia, tmp_path)
    again = read_inertia(tmp_path, robot)
    body, place = inertia.body(robot.design_space.baseline.array[None]), np.array([[0.004, 0.0]])
    np.testing.assert_allclose(again.periods(body, place), inertia.periods(body, place), rtol=1e-4, atol=1e-9)
    with pytest.raises(WeightsError, match="learned for another robot"):
        read_inertia(tmp_path, make_robot("diamond"))


def test_missing_and_damaged_files(tmp_path):
    robot = make_robot("finger")
    with pytest.raises(WeightsError, match="softgym fit-inertia"):
        read_inertia(tmp_path, robot)
    (tmp_path / FILE).write_bytes((pretrained_folder(robot) / FILE).read_bytes())
    with pytest.raises(WeightsError, match=r"trained for length = \[0.038, 0.042, 'm'\], which does not contain"):
        read_inertia(tmp_path, make_robot("finger", design_box="wide"))
    (tmp_path / FILE).write_bytes((pretrained_folder(robot) / FILE).read_bytes()[:200])
    with pytest.raises(WeightsError, match="is damaged"):
        read_inertia(tmp_path, robot)
    with pytest.raises(ValueError, match="have shape"):
        LearnedInertia(robot, np.zeros((3, 3)), 2, {})
    with pytest.raises(ValueError, match="degree = 3 needs at least"):
        fit_inertia(robot, bodies=8, states=1)

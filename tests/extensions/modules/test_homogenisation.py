"""Stiffness of periodic cells: solids, laminates, lattices, resolved bars, and invalid cells."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.extensions.modules.homogenisation import Cell, homogenise, lattice
from softgym_envs.mechanics.materials import lame_parameters
from tests.verification import infill


def test_a_solid_cell_is_its_material():
    mu, lame = lame_parameters(3.0, 0.4)
    expected = np.diag([2.0 * mu] * 3 + [mu] * 3)
    expected[:3, :3] += lame
    found = homogenise(lattice(1.0, 0.0, boxes=2), young_modulus=3.0, poisson_ratio=0.4)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_parallel_walls_are_plates():
    """Along the walls: Young's modulus times their share, and plane shear; across them nothing."""
    cell = lattice(0.3, 0.0)
    assert cell.density == pytest.approx(0.3)
    stiffness, mu = homogenise(cell, poisson_ratio=0.3), lame_parameters(1.0, 0.3)[0]
    compliance = np.linalg.inv(stiffness[1:3, 1:3])
    np.testing.assert_allclose(1.0 / np.diag(compliance), 0.3, rtol=1e-4)
    assert stiffness[3, 3] == pytest.approx(0.3 * mu, rel=1e-4)
    np.testing.assert_allclose(stiffness[[0, 4, 5]], 0.0, atol=1e-6)


def test_a_lattice_along_its_walls_and_between_its_bounds():
    """Along z the lattice has its density; across, more than its walls alone and less than Voigt's bound; symmetric."""
    cell = lattice(0.2, 0.4)
    assert cell.density == pytest.approx(1.0 - 0.8 * 0.6)
    stiffness = homogenise(cell, poisson_ratio=0.35)
    compliance = np.linalg.inv(stiffness)
    young = 1.0 / np.diag(compliance)[:3]
    assert young[2] == pytest.approx(cell.density, rel=1e-6)
    assert 0.4 < young[0] < cell.density and 0.2 < young[1] < cell.density
    assert np.linalg.eigvalsh(stiffness).min() > 0.0
    # Its tetrahedra are not quite as symmetric as the cell.
    np.testing.assert_allclose(stiffness[3:, :3], 0.0, atol=1e-3 * stiffness[2, 2])
    # Exchanged walls exchange the axes, and the pitch does not matter.
    other = homogenise(lattice(0.4, 0.2, pitch=0.003), poisson_ratio=0.35)
    order = [1, 0, 2, 4, 3, 5]
    np.testing.assert_allclose(other, stiffness[np.ix_(order, order)], atol=2e-3)


def test_a_bar_of_many_cells_approaches_the_homogeneous_one(monkeypatch):
    monkeypatch.setattr(infill, "CELLS", (1, 3))
    monkeypatch.setattr(infill, "WALLS", {"walls": (0.3, 0.3)})
    found = infill.compliances()
    for load, limit in (("tension", 0.01), ("shear", 0.10), ("bending", 0.15)):
        few, many = (abs(found[f"walls: {count} cells: {load}, compliance over resolved"] - 1.0) for count in (1, 3))
        assert many < limit and many < 0.5 * few


def test_invalid_cells():
    with pytest.raises(ValueError, match="wall_y = 1.2 is out of bounds"):
        lattice(0.1, 1.2)
    with pytest.raises(ValueError, match="not both walls 0"):
        lattice(0.0, 0.0)
    axis = np.array([0.0, 1.0])
    with pytest.raises(ValueError, match="not empty"):
        Cell((axis, axis, axis), np.zeros((1, 1, 1), dtype=bool))
    with pytest.raises(ValueError, match="must rise"):
        Cell((axis[::-1], axis, axis), np.ones((1, 1, 1), dtype=bool))

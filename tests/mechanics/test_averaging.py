"""Points averaged over a ball: exact for affine fields, the same map on every mesh, finite compliance."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.mechanics.elements.quadratic import add_midside_nodes
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from tests.helpers import box_mesh, clamped_solid

PLACES = np.array([[0.01, 0.01, 0.015], [0.004, 0.012, 0.03], [0.02, 0.0, 0.01]])
"""In the middle, on the top face and on an edge of the block of `clamped_solid` [m]."""


@pytest.mark.parametrize("element", ["linear", "averaged", "quadratic"])
def test_exact_for_affine_fields(element):
    model = clamped_solid(element)
    points = model.embed(PLACES, radius=3e-3)
    assert np.allclose(points.weights.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)
    gradient, shift = np.array([[1.2, 0.3, -0.1], [0.2, 0.7, 0.4], [-0.5, 0.1, 0.9]]), np.array([0.1, -0.2, 0.3])
    moved = points.positions(model.nodes @ gradient.T + shift)
    assert np.allclose(moved, PLACES @ gradient.T + shift, rtol=0.0, atol=1e-12)


def test_the_map_does_not_depend_on_the_mesh():
    """A quadratic field, which quadratic elements of every size represent, has one average."""
    values = []
    for cells in ((2, 2, 3), (3, 4, 5)):
        nodes, tetrahedra = add_midside_nodes(*box_mesh((0.02, 0.02, 0.03), cells, jitter=0.2))
        model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 0] < 1e-9, element="quadratic")
        x, y, z = nodes.T
        field = np.column_stack([x * y, z**2 - 3.0 * x * z, y**2]) / 0.02
        values.append(model.embed(PLACES, radius=3e-3).positions(field))
    assert np.allclose(values[0], values[1], rtol=0.0, atol=1e-12)
    x, y, z = PLACES.T
    single = np.column_stack([x * y, z**2 - 3.0 * x * z, y**2]) / 0.02
    assert np.abs(values[0] - single).max() > 1e-5  # it is not the value at the point itself


def test_compliance_of_a_cable_converges_and_that_of_a_point_does_not():
    compliance = {}
    for radius in (0.0, 4e-3):
        for cells in (2, 4, 8):
            nodes, tetrahedra = box_mesh((0.02, 0.02, 0.02), (cells,) * 3)
            model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 2] == 0.0, element="linear")
            model.add_cable("cable", [[0.01, 0.01, 0.014]], [0.01, 0.01, 0.05], radius=radius)
            compliance[radius, cells] = float(Statics(model).solve([0.0]).condensed.W.aa[0, 0])
    growth = {
        radius: [compliance[radius, 2 * cells] / compliance[radius, cells] - 1.0 for cells in (2, 4)]
        for radius in (0.0, 4e-3)
    }
    # That of a point is proportional to the number of cells, in the limit: its growth does not end.
    assert growth[0.0][1] > 0.4
    # Linear elements have errors of second order: each refinement leaves about a quarter of them.
    assert growth[4e-3][1] < 0.5 * growth[4e-3][0]


def test_efforts_of_an_averaged_cable_agree_with_the_difference_of_equilibria():
    model = clamped_solid("quadratic", cells=(2, 2, 3))
    model.add_cable("cable", PLACES[:2], [0.01, 0.01, 0.06], radius=3e-3)
    model.add_effector("top", PLACES[1], radius=2e-3)
    statics = Statics(model)
    step = 2e-5
    low, middle, high = (statics.solve([0.002 + k * step]) for k in (-1, 0, 1))
    slope = (high.condensed.delta.e - low.condensed.delta.e) / (high.effort[0] - low.effort[0])
    assert np.allclose(slope, middle.condensed.W.ea[:, 0], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("point", "radius", "message"),
    [([0.01, 0.01, 0.04], 2e-3, "0 of 257 sample points"), ([0.01, 0.01, 0.02], -1e-3, "positive and finite")],
)
def test_errors_name_the_point_and_the_radius(point, radius, message):
    with pytest.raises(ValueError, match=message):
        clamped_solid().embed(point, radius=radius)

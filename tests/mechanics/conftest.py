"""Fixtures of the mechanics tests: one body of every kind of element, and derivatives by central differences."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation

from softgym_envs.mechanics.builder import SOLIDS, ModelBuilder
from softgym_envs.mechanics.elements.beams import Section
from softgym_envs.mechanics.materials import MATERIALS

SECTION = Section(6e-4, (2e-8, 5e-8), 3e-8, (0.8, 0.7))
"""A section without symmetry, so that no two stiffnesses can be mistaken for each other."""


def _full_tangent(model, values):
    """The symmetric matrix of lower-triangle values on the model's pattern."""
    indptr, indices = model.tangent_pattern
    lower = csc_matrix((values.copy(), indices, indptr), shape=2 * (len(indptr) - 1,)).toarray()
    assert np.allclose(np.triu(lower, 1), 0.0)
    return lower + np.tril(lower, -1).T


def _derivatives(model, x, effort):
    """Relative errors of residual and tangent at ``x`` (n, 3) against differences along warped steps.

    The tangent is compared with the symmetric part: spins of frames do not commute, and the tangent is the second
    derivative along exponentials. What bonds add to it is taken out.
    """
    residual, values, H, _ = model.assemble(x, effort)
    residual, tangent = residual.copy(), _full_tangent(model, values)
    bonds = sum(c.size for c in model.constraints["b"])
    if bonds:
        tangent -= model.bond_stiffness * H[:, -bonds:] @ H[:, -bonds:].T

    def potential(y):
        return model.energy(y) - sum(effort[rows] @ c.value(y) for c, rows in model.rows)

    count = model.equations
    slope, matrix, gradients = np.empty(count), np.empty((count, count)), np.empty_like(H)
    for k in range(count):
        step = np.zeros(count)
        # The round-off of the energy asks for larger steps [m] than that of the residual.
        for h, quantity in ((1e-6, "energy"), (1e-7, "residual")):
            step[k] = h / model.dof_scale[k]
            plus, minus = x + model.warp(x, step), x + model.warp(x, -step)
            if quantity == "energy":
                slope[k] = (potential(plus) - potential(minus)) / (2 * step[k])
            else:
                after, before = ([a.copy() for a in model.assemble(y, effort)] for y in (plus, minus))
                matrix[:, k] = (after[0] - before[0]) / (2 * step[k])
                gradients[k] = (after[3] - before[3]) / (2 * step[k])
    symmetric = 0.5 * (matrix + matrix.T)
    # Entries of spins and displacements differ in unit and size: each is measured on the scale of its row and column.
    unit = 1.0 / np.sqrt(np.abs(np.diag(symmetric)))
    scaled = unit[:, None] * np.abs(symmetric - tangent) * unit
    return SimpleNamespace(
        gradient=float((np.abs(slope - residual) / model.dof_scale).max() / np.abs(residual / model.dof_scale).max()),
        tangent=float(scaled.max()),
        constraints=float(np.abs(gradients - H).max(initial=0.0) / np.abs(H).max(initial=1.0)),
    )


@pytest.fixture(scope="session")
def full_tangent():
    return _full_tangent


@pytest.fixture(scope="session")
def derivatives():
    """Function ``derivatives(model, x, effort)``, see above."""
    return _derivatives


BODIES = [f"{element}-{material}" for element in SOLIDS for material in MATERIALS] + [
    f"beam-{order}-{shape}" for order in (1, 2) for shape in ("straight", "curved")
]


def _solid(box, element, material, cells=(2, 2, 2), **options):
    """A block of solid elements on an irregular mesh, clamped below: its model."""
    nodes, tetrahedra = box((0.02, 0.02, 0.03), cells, jitter=0.2)
    body = ModelBuilder()
    options = {"young_modulus": 2e5, "poisson_ratio": 0.45, "density": 1000.0, **options}
    body.add_solid(nodes, tetrahedra, fixed=nodes[:, 2] < 1e-9, element=element, material=material, **options)
    return body.build()


def _beam(order, shape, elements=3, **options):
    """A clamped beam, straight or along a helix: its model."""
    body = ModelBuilder()
    frames = []
    for k, t in enumerate(np.linspace(0.0, 1.0, order * elements + 1)):
        if shape == "straight":
            position, rotation = np.array([0.2 * t, 0.0, 0.0]), np.eye(3)
        else:
            position = 0.1 * np.array([np.sin(t), 1.0 - np.cos(t), 0.4 * t])
            tangent = np.array([np.cos(t), np.sin(t), 0.4]) / np.sqrt(1.16)
            # Sections that also turn about the axis.
            turn = Rotation.from_rotvec(0.5 * t * tangent)
            normal = turn.apply([-np.sin(t), np.cos(t), 0.0])
            rotation = np.column_stack([tangent, normal, np.cross(tangent, normal)])
        frames.append(body.add_frame(position, rotation, fixed=k == 0, fixed_spin=k == 0))
    young = 1e6 * (1.0 + np.arange(elements))
    body.add_beam(frames, section=SECTION, young_modulus=young, poisson_ratio=0.4, order=order, **options)
    return body.build()


@pytest.fixture(scope="session")
def make_solid(box):
    """Function ``make_solid(element, material, cells, **options) -> model``."""
    return lambda *arguments, **options: _solid(box, *arguments, **options)


@pytest.fixture(scope="session")
def make_beam():
    """Function ``make_beam(order, shape, elements, **options) -> model``."""
    return _beam


@pytest.fixture(params=BODIES)
def body(request, box):
    """The model of a small clamped body of every element block and material."""
    kind = request.param.split("-")
    return _beam(int(kind[1]), kind[2]) if kind[0] == "beam" else _solid(box, *kind)

"""Fixtures of the mechanics tests: one body of every kind of element, and derivatives by central differences."""

from __future__ import annotations

import pytest

from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.solids import SOLIDS
from tests.helpers import clamped_beam, clamped_solid, dense_tangent, derivative_errors
from tests.mechanics.superelements import clamped_superelements

BODIES = [f"{element}-{material}" for element in SOLIDS for material in MATERIALS] + [
    f"beam-{order}-{shape}" for order in (1, 2) for shape in ("straight", "curved")
]
BODIES.append("superelement")


@pytest.fixture(scope="session")
def full_tangent():
    """The function `dense_tangent`."""
    return dense_tangent


@pytest.fixture(scope="session")
def derivatives():
    """The function `derivative_errors`."""
    return derivative_errors


@pytest.fixture(scope="session")
def make_solid():
    """The function `clamped_solid`."""
    return clamped_solid


@pytest.fixture(scope="session")
def make_beam():
    """The function `clamped_beam`."""
    return clamped_beam


@pytest.fixture(params=BODIES)
def body(request):
    """The model of a small clamped body of every element block and material."""
    kind = request.param.split("-")
    if kind[0] == "superelement":
        return clamped_superelements()
    return clamped_beam(int(kind[1]), kind[2]) if kind[0] == "beam" else clamped_solid(*kind)

"""Fingers grown from examples: their meshes, and the objectives of one body."""

import numpy as np
import pytest

from benchmarks import grown_shapes as grown
from softgym_envs.errors import InfeasibleDesign


def area(side, triangles):
    a, b, c = (side[triangles[:, k]] for k in range(3))
    (u, v), (w, x) = (b - a).T, (c - a).T
    return 0.5 * np.abs(u * x - v * w)


def loops(triangles):
    """Edges of one triangle only, and how many meet at each node."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    return np.bincount(unique[count == 1].ravel())


def test_the_mesh_fills_the_side_view_and_its_outline_is_closed():
    side, triangles, _ = grown.side_mesh(grown.seven_parameters(grown.BASELINE))
    found = area(side, triangles)
    _, _, joint, _, _, _, slope = grown.BASELINE
    exact = 20.0 * grown.LENGTH - 2.0 * slope * (20.0 - joint) ** 2
    assert found.min() > 0.0
    assert found.sum() == pytest.approx(exact, rel=0.01)
    assert set(loops(triangles)) <= {0, 2}


@pytest.mark.parametrize("seed", range(6))
def test_examples_have_closed_outlines(seed):
    side, triangles, _ = grown.side_mesh(grown.example(np.random.default_rng(seed)))
    assert area(side, triangles).min() > 1e-3
    assert set(loops(triangles)) <= {0, 2}


def test_parts_that_touch_in_one_node_are_opened():
    """Two squares around a hole whose corner touches the outside: the triangles at that corner go."""
    y, s = np.meshgrid(np.arange(4.0), np.linspace(0.0, grown.LENGTH, 5), indexing="ij")
    points = np.column_stack([y.ravel(), s.ravel()])
    number = np.arange(20).reshape(4, 5)
    cells = [(i, j) for i in range(3) for j in range(4) if (i, j) not in ((1, 1), (2, 2))]
    corners = [(number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in cells]
    triangles = np.array([t for a, b, c, d in corners for t in ((a, b, c), (a, c, d))])
    assert loops(triangles).max() == 4
    found, kept = grown._one_piece(points, triangles)
    assert set(loops(kept)) <= {0, 2} and 0 < len(kept) < len(triangles)
    assert found[:, 1].min() == 0.0 and found[:, 1].max() == grown.LENGTH


def test_a_finger_in_two_pieces_is_refused():
    with pytest.raises(InfeasibleDesign, match="leads from the base to the tip"):
        grown.side_mesh(grown.notched(grown.bar(20.0, 20.0), 60.0, -4.0, 0.5, 2.0))


def test_a_finger_with_thinner_joints_is_softer_and_needs_less_effort():
    thin = grown.BASELINE.copy()
    thin[2:4] = 4.0
    first, second = (grown.judge(grown.seven_parameters(x)) for x in (grown.BASELINE, thin))
    assert second.stiffness < first.stiffness
    assert 0.0 < second.effort < first.effort


def test_leads_after_all_bodies_are_the_differences_of_the_searches():
    """After all bodies they are the differences of the other table."""
    rows = [line.split(" | ") for line in grown.grown_leads_table().splitlines()[2:]]
    found = [row.split(" | ")[3].strip() for row in grown.grown_shapes_table().splitlines()[2:]]
    assert [cell.strip(" |") for cell in rows[-1][1:]] == [cell.strip(" |") for cell in found]
    assert rows[0][1:] != rows[-1][1:]

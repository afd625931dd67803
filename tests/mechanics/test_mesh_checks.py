"""Meshes that are not the body that they look like, and clamps that do not hold one: found when the model is made."""

from __future__ import annotations

import numpy as np
import pytest

from softgym_envs.errors import InfeasibleDesign
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.bond import Bond
from softgym_envs.mechanics.elements.quadratic import add_midside_nodes
from softgym_envs.mechanics.mesh_checks import check_held, check_mesh, merge_nodes
from softgym_envs.mechanics.model import MechanicalModel
from tests.helpers import box_mesh

SIZE = (0.1, 0.02, 0.02)
BAR = box_mesh(SIZE, (4, 2, 2))


def joined(*parts, merged=True):
    """One mesh of several, with nodes at one place merged."""
    starts = np.cumsum([0] + [len(nodes) for nodes, _ in parts])
    tetrahedra = np.concatenate([part[1] + start for part, start in zip(parts, starts[:-1], strict=True)])
    nodes = np.concatenate([nodes for nodes, _ in parts])
    return merge_nodes(nodes, tetrahedra) if merged else (nodes, tetrahedra)


def moved(mesh, shift, factor=(1.0, 1.0, 1.0)):
    return mesh[0] * factor + shift, mesh[1]


def folded():
    nodes, tetrahedra = (np.array(part) for part in box_mesh(SIZE, (8, 2, 2)))
    nodes[np.isclose(nodes[:, 0], 0.0875), 0] = 0.105  # this layer passes the end: the last cells are inside out
    return nodes, tetrahedra


def waved(mesh):
    """A mesh whose section at x = 0.1 is no plane."""
    nodes = mesh[0].copy()
    at = np.isclose(nodes[:, 0], 0.1)
    nodes[at, 0] += 1e-3 * np.sin(700 * nodes[at, 1] + 900 * nodes[at, 2])
    return nodes, mesh[1]


def crowded():
    """Three tetrahedra on one face."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0.3, 0.3, 1.5]], dtype=float)
    return 0.01 * nodes, np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 1, 2, 5]])


OTHER_DIAGONAL = joined(BAR, moved(BAR, (0.1, 0.02, 0.0), (1, -1, 1)))
FINER = moved(box_mesh(SIZE, (4, 3, 3)), (0.1, 0.0, 0.0))
NO_BODIES = {
    "elements twice": ((BAR[0], np.vstack([BAR[1], BAR[1][::-1]])), "96 of 192 tetrahedra repeat others, the first"),
    "one element twice": ((BAR[0], np.vstack([BAR[1], BAR[1][5:6, [2, 0, 1, 3]]])), "1 of 97 tetrahedra repeat"),
    "folded": (folded(), r"folded onto itself at 8 faces, the first near \[0.1"),
    "three on a face": (crowded(), "1 faces belong to more than two tetrahedra"),
    "not merged": (joined(BAR, moved(BAR, (0.1, 0, 0)), merged=False), r"9 pairs of nodes coincide .* \[0.1, .*merge_"),
    "a copy on itself": (joined(BAR, BAR, merged=False), "45 pairs of nodes coincide"),
    "parts that cross": (joined(BAR, moved(BAR, (0.05, 0.003, 0.002)), merged=False), "overlap near"),
    "a shifted copy": (joined(BAR, moved(BAR, (1e-4, 0, 0)), merged=False), "tetrahedra .* and .* overlap near"),
    "a part within a part": (
        joined(BAR, moved(BAR, (0.02, 0.005, 0.006), (0.3, 0.3, 0.3)), merged=False),
        "tetrahedra .* and .* overlap near",
    ),
    "a needle through a wall": (
        joined(BAR, moved(box_mesh((0.06, 1e-4, 1e-4), (1, 1, 1)), (0.07, 0.0071, 0.0063)), merged=False),
        "overlap near",
    ),
    "the other diagonal": (OTHER_DIAGONAL, r"faces of tetrahedra lie on each other near \[0.1, .*the other diagonal"),
    "the other diagonal, not plane": (waved(OTHER_DIAGONAL), "lie on each other near|overlap near"),
    "meshed differently": (joined(BAR, FINER), r"faces of tetrahedra lie on each other near \[0.1, "),
    "flat": ((BAR[0] * [1, 1, 0], BAR[1]), r"96 degenerate tetrahedra, the first at index 0 near \["),
}


@pytest.mark.parametrize("kind", NO_BODIES)
def test_a_mesh_that_is_no_body_is_refused_with_the_place(kind):
    (nodes, tetrahedra), message = NO_BODIES[kind]
    with pytest.raises(ValueError, match=message):
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=nodes[:, 0] < 1e-9)
    with pytest.raises(ValueError, match=message):
        ModelBuilder().add_solid(nodes, tetrahedra, fixed=nodes[:, 0] < 1e-9)


def test_one_wrong_tetrahedron_against_the_other_diagonal_of_a_skew_quadrilateral():
    """Two pairs of tetrahedra that leave a hole of no element between them: nothing overlaps."""
    quad = np.array([[0, 0, 0], [1, 0, 0.1], [1, 1, 0], [0, 1, 0.1]], dtype=float)
    nodes = 0.01 * np.vstack([quad, [[0.5, 0.5, 1.0], [0.5, 0.5, -1.0]]])
    upper = [[0, 1, 3, 4], [1, 2, 3, 4]]  # along 13, which lies higher
    lower = [[0, 2, 1, 5], [0, 3, 2, 5]]  # along 02
    with pytest.raises(ValueError, match="the other diagonal of a quadrilateral"):
        check_mesh(nodes, np.array(upper + lower))
    check_mesh(nodes, np.array([*upper, [0, 3, 1, 5], [1, 3, 2, 5]]))


@pytest.mark.parametrize(
    "mesh",
    [
        BAR,
        box_mesh(SIZE, (6, 3, 3), jitter=0.25),
        joined(BAR, moved(BAR, (0.1, 0, 0))),
        waved(joined(BAR, moved(BAR, (0.1, 0, 0)))),
        joined(BAR, moved(BAR, (0.0, 0.0, 0.0), (-1, 1, 1))),
        (BAR[0].astype(np.float32).astype(float) * 1e3, BAR[1]),
        joined(BAR, moved(BAR, (0.1 + 1e-4, 0, 0))),
    ],
    ids=["box", "irregular", "merged", "curved seam", "mirrored", "single precision", "two parts with a gap"],
)
def test_a_body_passes(mesh):
    check_mesh(*mesh)


def test_a_cut_that_is_meant():
    nodes, tetrahedra = joined(BAR, moved(BAR, (0.1, 0, 0)), merged=False)
    fixed = (nodes[:, 0] < 1e-9) | (nodes[:, 0] > 0.2 - 1e-9)
    model = MechanicalModel.from_mesh(nodes, tetrahedra, fixed=fixed, check=False)
    assert model.volume == pytest.approx(8e-5)


@pytest.mark.parametrize(
    ("shift", "overlaps"),
    [((0.09, 0.0, 0.0), True), ((0.0, 0.0, 0.019), True), ((0.03, 0.0113, 0.0), True), ((0.1, 0.0, 0.0), False)],
)
def test_solids_of_a_builder_do_not_overlap(shift, overlaps):
    builder = ModelBuilder()
    for mesh in (BAR, moved(BAR, shift)):
        builder.add_solid(*mesh, fixed=mesh[0][:, 0] == mesh[0][:, 0].min(), element="linear")
    if overlaps:
        with pytest.raises(InfeasibleDesign, match=r"solids 0 and 1 of the model overlap near \[.* m.*check=False"):
            builder.build()
    else:
        builder.build()


def test_an_overlap_that_is_meant():
    builder = ModelBuilder()
    builder.add_solid(*BAR, fixed=BAR[0][:, 0] == 0.0, element="linear")
    builder.add_solid(*BAR, fixed=BAR[0][:, 0] == 0.0, element="linear", check=False)
    assert builder.build().volume == pytest.approx(8e-5)


def test_merging_nodes_keeps_order_and_second_order():
    nodes, tetrahedra = joined(BAR, moved(BAR, (0.1, 0, 0)), merged=False)
    found, elements = merge_nodes(np.vstack([[[9.0, 9, 9]], nodes]), tetrahedra + 1)
    assert len(found) == len(nodes) - 9
    np.testing.assert_array_equal(found[: len(BAR[0])], BAR[0])
    np.testing.assert_allclose(found[elements], nodes[tetrahedra], atol=1e-12)


# -- what holds a body ----------------------------------------------------------------------------------------------


def ends(nodes):
    return nodes[:, 0] == 0.0


HINGE = joined(BAR, moved(BAR, (0.1, 0.02, 0.0)))
POINT = joined(BAR, moved(BAR, (0.1, 0.02, 0.02)))
LOOSE = {
    "one node": (BAR, lambda x: [0], r"the body is held at one point only, \[0.0, 0.0, 0.0\] m, and can rotate"),
    "a line": (
        BAR,
        lambda x: (x[:, 0] == 0.0) & (x[:, 1] == 0.0),
        r"the body is a mechanism: it can rotate about a line along \[0.0, 0.0, 1.0\] near \[0.0, 0.0, 0.01\] m",
    ),
    "a slope": (
        BAR,
        lambda x: (x[:, 0] == 0.0) & np.isclose(x[:, 1], x[:, 2]),
        r"rotate about a line along \[0.0, 0.707, 0.707\]",
    ),
    "a slide": (
        BAR,
        lambda x: np.column_stack([x[:, 0] > 1.0, x[:, 1] == 0.0, x[:, 2] == 0.0]),
        r"the body is a mechanism: it can slide along \[1.0, 0.0, 0.0\]",
    ),
    "a hinge of parts": (
        HINGE,
        ends,
        r"a part of 96 tetrahedra near \[0.15, 0.03, 0.01\] m is a mechanism: it can rot",
    ),
    "parts that share a node": (POINT, ends, r"a part of 96 .* is held at one point only, \[0.1, 0.02, 0.02\] m"),
    "a loose part": (
        joined(BAR, moved(BAR, (0.2, 0, 0))),
        ends,
        r"a part of 96 tetrahedra near \[0.25, 0.01, 0.01\] m is not connected to anything that is held",
    ),
    "only nodes without elements": (
        (np.vstack([BAR[0], [[1.0, 0, 0]]]), BAR[1]),
        lambda x: [len(x) - 1],
        "a part of 96 .* is not connected to anything that is held",
    ),
    "all nodes": (BAR, lambda x: np.ones(len(x), dtype=bool), "every node is clamped, so that nothing can move"),
}


@pytest.mark.parametrize("kind", LOOSE)
@pytest.mark.parametrize("element", ["averaged", "quadratic"])
def test_a_body_that_is_not_held_is_refused(kind, element):
    (nodes, tetrahedra), fixed, message = LOOSE[kind]
    with pytest.raises(ValueError, match=message):
        MechanicalModel.from_mesh(nodes, tetrahedra, fixed=fixed, element=element)


def test_many_parts_at_nodes_only():
    """A chain of tetrahedra that share corners."""
    one = np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [1, 0, 0]])
    nodes = 0.01 * np.vstack([one[:3] + [k, 0, 0] for k in range(120)] + [[[120.0, 0, 0]]])
    cells = np.array([[3 * k, 3 * k + 1, 3 * k + 2, 3 * k + 3] for k in range(120)])
    with pytest.raises(ValueError, match="the mesh falls into 120 parts that share no face"):
        MechanicalModel.from_mesh(nodes, cells, fixed=[0, 1, 2])


def test_three_nodes_hold_a_body_and_so_do_walls_along_all_axes():
    nodes, tetrahedra = BAR
    check_held(nodes, _mask(nodes, [0, 1, 5]), [tetrahedra])
    check_held(nodes, np.isclose(nodes, 0.0), [tetrahedra])
    hinges = joined(BAR, moved(BAR, (0.1, 0.02, 0.0)), moved(BAR, (0.0, 0.04, 0.0)))
    for fixed in (ends, lambda x: (x[:, 0] == 0.0) & (x[:, 1] < 0.03)):
        held = _mask(hinges[0], fixed(hinges[0]))
        if fixed is ends:
            check_held(hinges[0], held, [hinges[1]])  # hinges at both corners: the middle part cannot turn
        else:
            with pytest.raises(ValueError, match="a part of 96 tetrahedra .* is a mechanism"):
                check_held(hinges[0], held, [hinges[1]])


def _mask(nodes, chosen):
    mask = np.zeros((len(nodes), 3), dtype=bool)
    mask[chosen] = True
    return mask


def test_bonds_and_frames_hold_parts_of_a_builder():
    def body(bonds, *, floating=False):
        builder = ModelBuilder(floating=floating)
        builder.add_solid(*BAR, fixed=[])
        wall = builder.add_frame([0.0, 0.0, 0.0], fixed=True, fixed_spin=True)
        model = builder.build()
        for k in range(bonds):
            at = BAR[0][[0, 1, 3][k]]
            model.add("b", Bond(str(k), model.embed(at), at))
        assert wall == len(add_midside_nodes(*BAR)[0])
        return model.assembly

    assert body(3).size == 9
    with pytest.raises(ValueError, match="is a mechanism: it can rotate about a line"):
        body(2)
    with pytest.raises(ValueError, match="the body is a mechanism: it can rotate"):
        body(1)
    assert body(1, floating=True).size == 3

"""Contact between surfaces: derivatives, steps without collisions, friction within an increment."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softgym_envs.mechanics.contact.self_contact import SelfContact, SelfContactMemory, load_ipctk
from softgym_envs.mechanics.elements.tetrahedra import boundary_triangles
from tests.helpers import box_mesh

DISTANCE, STIFFNESS = 5e-4, 1e6
GAP = 2e-4


def cuboid(size, cells, origin):
    """Vertices and triangles of the surface of a box."""
    nodes, tetrahedra = box_mesh(size, cells)
    used, triangles = np.unique(boundary_triangles(tetrahedra), return_inverse=True)
    return nodes[used] + np.asarray(origin), triangles.reshape(-1, 3)


def pile(cells=2):
    """A small block a gap above a larger one: vertices, triangles and which vertices are the small block's."""
    below, first = cuboid((0.01, 0.01, 0.004), (cells, cells, 1), (0.0, 0.0, 0.0))
    above, second = cuboid((0.006, 0.006, 0.004), (cells, cells, 1), (0.0021, 0.0017, 0.004 + GAP))
    small = np.repeat([False, True], [len(below), len(above)])
    return np.concatenate([below, above]), np.concatenate([first, second + len(below)]), small


def contact(**options):
    rest, faces, _ = pile()
    return SelfContact(rest, faces, **{"distance": DISTANCE, "stiffness": STIFFNESS, **options})


def shaken(amplitude, seed=0):
    rest = pile()[0]
    return rest + amplitude * np.random.default_rng(seed).normal(size=rest.shape)


# -- energy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pairs", ["IPC", "IMPROVED_MAX_APPROX"])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_derivatives(pairs, friction):
    surfaces = contact(pairs=pairs, friction=friction)
    start, v = shaken(1e-5), shaken(1e-5) + 4e-6 * np.random.default_rng(2).normal(size=pile()[0].shape)
    surfaces.begin_increment(start)
    gradient, hessian = surfaces.derivatives(v)
    assert abs(hessian - hessian.T).max() < 1e-12 * abs(hessian).max()
    for seed in range(4):
        step = np.random.default_rng(10 + seed).normal(size=v.shape)
        h = 1e-9
        slope = (surfaces.energy(v + h * step) - surfaces.energy(v - h * step)) / (2 * h)
        assert slope == pytest.approx(np.vdot(gradient, step), rel=1e-6)
        change = (surfaces.gradient(v + h * step) - surfaces.gradient(v - h * step)).ravel() / (2 * h)
        expected = hessian @ step.ravel()
        assert np.abs(change - expected).max() < 1e-6 * np.abs(expected).max()


def test_forces_balance_and_push_apart():
    surfaces, small = contact(), pile()[2]
    v = shaken(1e-5)
    forces = surfaces.forces(v)
    np.testing.assert_array_equal(forces, -surfaces.gradient(v))
    moments = np.cross(v, forces)
    assert forces[small, 2].sum() > 1.0
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-10)
    np.testing.assert_allclose(moments.sum(axis=0), 0.0, atol=1e-12)


def test_the_energy_of_a_corner_above_a_face():
    gap = 2e-4
    floor = np.array([[-0.05, -0.05, 0.0], [0.05, -0.05, 0.0], [0.0, 0.08, 0.0]])
    corner = np.array([[0.0, 0.0, 0.0], [0.002, 0.0, 0.002], [-0.001, 0.002, 0.002], [-0.001, -0.002, 0.002]])
    corner += [0.001, 0.002, gap]
    sides = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3]])
    a, b, c = corner[sides].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 6.0
    faces = np.concatenate([[[0, 1, 2]], 3 + sides, [[4, 5, 6]]])
    v = np.concatenate([floor, corner])
    surfaces = SelfContact(v, faces, distance=DISTANCE, stiffness=STIFFNESS)
    s = (gap / DISTANCE) ** 2
    slope = -2.0 * gap / DISTANCE * (2.0 * (s - 1.0) * np.log(s) + (s - 1.0) ** 2 / s)
    # Each pair has a quarter of the area: pairs of both surfaces and of their edges share a face.
    weight = 0.25 * STIFFNESS * area
    assert surfaces.energy(v) == pytest.approx(-weight * DISTANCE * (s - 1.0) ** 2 * np.log(s), rel=1e-12)
    np.testing.assert_allclose(surfaces.forces(v)[3], [0.0, 0.0, -weight * slope], rtol=1e-12)


def test_a_projected_hessian_is_positive_semidefinite():
    surfaces, v = contact(), shaken(1e-5)
    exact = np.linalg.eigvalsh(surfaces.derivatives(v)[1].toarray())
    projected = np.linalg.eigvalsh(surfaces.derivatives(v, project=True)[1].toarray())
    assert exact.min() < -1e-3 * exact.max()
    assert projected.min() > -1e-12 * projected.max()
    assert projected.max() >= exact.max()


def test_surfaces_that_are_far_apart_do_not_act():
    surfaces, small = contact(), pile()[2]
    v = pile()[0] + 0.01 * small[:, None] * np.array([0.0, 0.0, 1.0])
    gradient, hessian = surfaces.derivatives(v)
    assert surfaces.energy(v) == 0.0
    assert (gradient == 0.0).all()
    assert hessian.shape == (v.size, v.size) and hessian.nnz == 0
    assert surfaces.minimum_distance(v) == np.inf


def test_kept_pairs_miss_nothing():
    """A long random walk gives the energy that a new object finds at each of its points."""
    rest, faces, small = pile()
    kept = contact(friction=0.5)
    rng = np.random.default_rng(3)
    v, met = rest.copy(), 0
    for _ in range(60):
        move = rng.uniform(-3e-4, 3e-4, 3) * small[:, None] + 2e-5 * rng.normal(size=v.shape)
        v = v + 0.9 * kept.max_step(v, v + move) * move
        fresh = SelfContact(rest, faces, distance=DISTANCE, stiffness=STIFFNESS)
        assert kept.energy(v) == pytest.approx(fresh.energy(v), rel=1e-12)
        assert kept.minimum_distance(v) == pytest.approx(fresh.minimum_distance(v), rel=1e-12)
        met += fresh.energy(v) > 0.0
    assert met > 20


# -- steps --------------------------------------------------------------------------------------------------------


def test_the_minimum_distance():
    surfaces, rest = contact(), pile()[0]
    assert surfaces.minimum_distance(rest) == pytest.approx(GAP, rel=1e-9)


def test_a_step_ends_before_the_surfaces_meet():
    surfaces, rest, small = contact(), pile()[0], pile()[2]
    down = np.array([0.0, 0.0, -1.0]) * small[:, None]
    assert surfaces.max_step(rest, rest + 0.5 * GAP * down) == 1.0
    for length in (2.0 * GAP, 0.002, 0.05):  # within the reach of the kept pairs, beyond it, through the other block
        step = surfaces.max_step(rest, rest + length * down)
        assert 0.8 * GAP < step * length < GAP
    # They meet in one of the later pieces of a long way, also just after such a piece has begun.
    for gap in (0.0101, 0.0124, 0.0151):
        apart = rest - (gap - GAP) * down
        assert 0.8 * gap < surfaces.max_step(apart, apart + 0.05 * down) * 0.05 < gap
    assert surfaces.max_step(rest, rest - 0.05 * down) == 1.0
    assert surfaces.max_step(rest, rest + np.array([0.05, 0.0, 0.0])) == 1.0  # all together


@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 1e-2))
@settings(max_examples=40)
def test_no_step_leads_to_an_intersection(seed, size):
    rest, _, small = pile()
    surfaces = contact()
    rng = np.random.default_rng(seed)
    v = rest
    for _ in range(3):
        move = size * (rng.uniform(-1.0, 1.0, 3) * small[:, None] + 0.2 * rng.normal(size=v.shape))
        step = surfaces.max_step(v, v + move)
        assert 0.0 <= step <= 1.0
        for part in (0.5, 1.0):
            assert not surfaces.intersects(v + part * step * move)
        v = v + step * move


def test_intersections_are_found():
    surfaces, rest, small = contact(), pile()[0], pile()[2]
    assert not surfaces.intersects(rest)
    assert surfaces.intersects(rest - 2.0 * GAP * np.array([0.0, 0.0, 1.0]) * small[:, None])


def test_pairs_within_a_distance():
    surfaces, rest, small = contact(), pile()[0], pile()[2]
    assert surfaces.pairs(rest, 0.5 * GAP).shape == (0, 4)
    ids = surfaces.pairs(rest, 2.0 * GAP)
    sides = [set(small[pair[pair >= 0]]) for pair in ids]
    assert len(ids) > 3 and all(side == {False, True} for side in sides)
    # The Hessian has entries at these pairs only.
    hessian = surfaces.derivatives(rest)[1].tocoo()
    within = surfaces.pairs(rest, DISTANCE)
    entries = {(a, b) for pair in within for a in pair[pair >= 0] for b in pair[pair >= 0]}
    assert {(int(r) // 3, int(c) // 3) for r, c in zip(hessian.row, hessian.col, strict=True)} <= entries


def test_vertices_of_one_group_do_not_touch():
    _, _, small = pile()
    rest = pile()[0]
    assert contact(groups=np.zeros(len(rest), dtype=int)).energy(rest) == 0.0
    assert contact(groups=small.astype(int)).energy(rest) == contact().energy(rest) > 0.0
    assert contact(groups=np.where(small, -1, 0)).energy(rest) == contact().energy(rest)


# -- friction -----------------------------------------------------------------------------------------------------


def test_friction_opposes_sliding_with_its_share_of_the_normal_force():
    surfaces, rest, small = contact(friction=0.4, smoothing=1e-6), pile()[0], pile()[2]
    normal = contact(pairs="IPC").forces(rest)
    surfaces.begin_increment(rest)
    np.testing.assert_array_equal(surfaces.forces(rest), normal)  # at rest, friction does not act
    slide = 1e-5 * np.array([1.0, 0.0, 0.0]) * small[:, None]
    friction = surfaces.forces(rest + slide) - contact().forces(rest + slide)
    total = friction[small].sum(axis=0)
    np.testing.assert_allclose(friction.sum(axis=0), 0.0, atol=1e-10)
    # Pairs that are not right above each other have inclined tangent planes.
    assert total[0] == pytest.approx(-0.4 * normal[small, 2].sum(), rel=0.15)
    # The direction, and the size for half of the smoothing distance: f(y) = 2 y - y^2.
    back = surfaces.forces(rest - slide) - contact().forces(rest - slide)
    assert back[small].sum(axis=0)[0] == pytest.approx(-total[0], rel=1e-9)
    half = 5e-7 * np.array([1.0, 0.0, 0.0]) * small[:, None]
    part = surfaces.forces(rest + half) - contact().forces(rest + half)
    assert part[small].sum(axis=0)[0] == pytest.approx(0.75 * total[0], rel=0.05)


def test_the_memory_restores_friction():
    surfaces = contact(friction=0.4)
    assert surfaces.memory.start is None
    first, v = shaken(1e-5), shaken(1.1e-5)
    surfaces.begin_increment(first)
    memory, expected = surfaces.memory, surfaces.forces(v)
    surfaces.begin_increment(v)
    assert not np.allclose(surfaces.forces(v), expected)
    surfaces.memory = memory
    np.testing.assert_array_equal(surfaces.forces(v), expected)
    surfaces.memory = SelfContactMemory()
    np.testing.assert_array_equal(surfaces.forces(v), contact().forces(v))


def test_the_memory_does_not_change_with_the_positions_it_was_taken_from():
    surfaces, v = contact(friction=0.4), shaken(1e-5)
    start = v.copy()
    surfaces.begin_increment(start)
    start[:] = 0.0
    np.testing.assert_array_equal(surfaces.memory.start, v)


def test_vertices_of_obstacles_have_their_own_friction():
    rest, _, small = pile()
    slide = rest + 1e-5 * np.array([1.0, 0.0, 0.0]) * small[:, None]
    expected, found = contact(friction=0.4), contact(friction=0.9, obstacle_friction=np.where(small, np.nan, 0.4))
    for surfaces in (expected, found):
        surfaces.begin_increment(rest)
    np.testing.assert_allclose(found.forces(slide), expected.forces(slide), rtol=1e-12, atol=1e-12)
    smooth = contact(friction=0.9, obstacle_friction=np.where(small, 0.0, np.nan))
    smooth.begin_increment(rest)
    np.testing.assert_array_equal(smooth.forces(slide), contact().forces(slide))


# -- wrong inputs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance": 0.0}, "distance must be a positive number, got 0.0"),
        ({"stiffness": np.nan}, "stiffness must be a positive number, got nan"),
        ({"smoothing": -1.0}, "smoothing must be a positive number, got -1.0"),
        ({"friction": -0.1}, "friction must be a number >= 0, got -0.1"),
        ({"reach": 1e-4}, "reach must be more than half of distance 0.0005, got 0.0001"),
        ({"pairs": "OGC"}, "pairs must be one of IPC, IMPROVED_MAX_APPROX, got 'OGC'"),
        ({"groups": np.zeros(3)}, r"groups must have shape \(.*,\), got \(3,\)"),
        ({"obstacle_friction": np.zeros(3)}, "obstacle_friction must be NaN or a number >= 0 per vertex"),
        ({"edges": np.array([[0, 999]])}, "edges must be vertex numbers from 0 to .*, got 0 to 999"),
        ({"edges": np.array([[0.0, 1.0]])}, r"edges must be integers of shape \(n, 2\)"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=f"self-contact: {message}"):
        contact(**options)


def test_wrong_surfaces():
    rest, faces, _ = pile()
    options = {"distance": DISTANCE, "stiffness": STIFFNESS}
    with pytest.raises(ValueError, match=r"rest must be finite numbers of shape \(m, 3\)"):
        SelfContact(rest[:, :2], faces, **options)
    with pytest.raises(ValueError, match="faces must be vertex numbers"):
        SelfContact(rest, faces + len(rest), **options)


def test_a_missing_ipctk_is_named(monkeypatch):
    import_module = builtins.__import__

    def without_ipctk(name, *args, **options):
        if name == "ipctk":
            raise ImportError("No module named 'ipctk'")
        return import_module(name, *args, **options)

    load_ipctk.cache_clear()
    monkeypatch.setattr(builtins, "__import__", without_ipctk)
    with pytest.raises(ImportError, match=r"contact between surfaces needs ipctk \(.*\): pip install ipctk"):
        contact()

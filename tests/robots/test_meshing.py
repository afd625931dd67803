"""Meshing by gmsh: infeasible shapes, time limit, cache."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from softgym_envs.errors import DataError, InfeasibleDesign, MeshingError
from softgym_envs.mechanics import gmsh_process
from softgym_envs.robots.geometry import meshing
from softgym_envs.robots.geometry.finger_shape import draw_finger
from softgym_envs.robots.geometry.meshing import BodyMesh, mesh_geometry
from softgym_envs.robots.soft_finger import BELLOWS

COARSE = 0.02
GOOD = {"length": 40.0, "height": 20.0, "joint_height": 6.0, "slope": 0.5, **BELLOWS}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "meshes"


@pytest.fixture
def count_runs(monkeypatch):
    """Count how often gmsh is started."""
    runs, run = [], gmsh_process.subprocess.run

    def counted(*args, **options):
        runs.append(1)
        return run(*args, **options)

    monkeypatch.setattr(gmsh_process.subprocess, "run", counted)
    return runs


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 60.0, "joint_height": 5.0, "slope": 0.8}, "the notches meet"),
        ({"joint_height": 20.0}, "cannot be meshed"),
        ({"length": -40.0}, "cannot be meshed"),
        ({"height": float("nan")}, "cannot be meshed"),
    ],
    ids=["notches meet", "no notch", "negative", "NaN"],
)
def test_impossible_shapes_are_infeasible(cache, change, message):
    with pytest.raises(InfeasibleDesign, match=message):
        mesh_geometry(draw_finger, GOOD | change, mesh_size=COARSE)
    assert not cache.exists()


def test_a_bug_in_a_drawing_is_not_an_infeasible_design(cache):
    with pytest.raises(MeshingError, match=r"(?s)draw_finger failed for .*Traceback.*TypeError.*'thickness'"):
        mesh_geometry(draw_finger, GOOD | {"thickness": 3.0}, mesh_size=COARSE)
    assert not cache.exists()


def draw_two_volumes():
    """Draw more than one body."""
    import gmsh

    for x in (0.0, 10.0):
        gmsh.model.occ.addBox(x, 0, 0, 1, 1, 1)


def draw_nonsense():
    """Draw a shape that gmsh rejects."""
    import gmsh

    gmsh.model.occ.addBox(0, 0, 0, 0, 1, 1)


@pytest.mark.parametrize(
    ("draw", "message"), [(draw_two_volumes, "has 2 volumes, expected one"), (draw_nonsense, "cannot be meshed")]
)
def test_shapes_that_gmsh_rejects_are_infeasible(cache, draw, message):
    with pytest.raises(InfeasibleDesign, match=message):
        mesh_geometry(draw, {}, mesh_size=COARSE)


def test_too_slow_is_infeasible(cache):
    """Loading gmsh alone takes longer than this limit."""
    with pytest.raises(InfeasibleDesign, match=r"meshing took longer than .* = 0\.01 s of CPU time for .*length"):
        mesh_geometry(draw_finger, GOOD, mesh_size=COARSE, time_limit=0.01)
    assert not cache.exists()


def test_meshes_are_cached_and_damaged_ones_are_reproduced_bit_for_bit(cache, count_runs):
    first = mesh_geometry(draw_finger, GOOD, mesh_size=COARSE)
    assert len(count_runs) == 1
    (path,) = cache.glob("*.npz")
    content = path.read_bytes()
    cached = mesh_geometry(draw_finger, dict(reversed(GOOD.items())), mesh_size=COARSE)
    assert len(count_runs) == 1
    path.write_bytes(content[: len(content) // 2])
    again = mesh_geometry(draw_finger, GOOD, mesh_size=COARSE)
    assert len(count_runs) == 2
    for other in (cached, again):
        for field in dataclasses.fields(BodyMesh):
            np.testing.assert_array_equal(getattr(first, field.name), getattr(other, field.name))
    assert [p.name for p in cache.iterdir()] == [path.name]
    assert BodyMesh.load(path).nodes.shape == first.nodes.shape
    # Whole meshes in metres: closed boundary, all nodes used.
    assert np.ptp(first.nodes[:, 2]) == pytest.approx(0.120, abs=1e-9)
    assert set(np.unique(first.tetrahedra)) == set(range(len(first.nodes)))
    edges = np.sort(first.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_every_parameter_and_the_mesh_size_are_part_of_the_key(cache, monkeypatch):
    commands = []

    def stop(command, **_):
        commands.append(command)
        raise gmsh_process.subprocess.TimeoutExpired(command, 0.0)

    monkeypatch.setattr(gmsh_process.subprocess, "run", stop)
    mesh = BodyMesh(np.zeros((4, 3)), np.array([[0, 1, 2, 3]]), np.array([[0, 1, 2]]), np.array([1]))
    saved = []
    monkeypatch.setattr(BodyMesh, "load", classmethod(lambda cls, path: saved.append(path.name) or mesh))
    monkeypatch.setattr(meshing.Path, "exists", lambda self: self.suffix == ".npz")
    for change in ({}, {"length": 41.0}, {"height": 21.0}, {"joint_height": 5.0}, {"slope": 0.6}):
        mesh_geometry(draw_finger, GOOD | change, mesh_size=COARSE)
    mesh_geometry(draw_finger, GOOD, mesh_size=0.021)
    mesh_geometry(draw_finger, GOOD, mesh_size=COARSE)
    assert not commands
    assert len(set(saved)) == 6
    assert saved[0] == saved[-1]


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "text", "other file", "old format"])
def test_unreadable_meshes(tmp_path, damage):
    path = tmp_path / "mesh.npz"
    mesh = BodyMesh(np.zeros((4, 3)), np.array([[0, 1, 2, 3]]), np.array([[0, 1, 2]]), np.array([1]))
    mesh.save(path)
    assert BodyMesh.load(path).surfaces.tolist() == [1]
    if damage == "missing":
        path.unlink()
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-40])
    elif damage == "text":
        path.write_text("not a mesh")
    elif damage == "other file":
        np.savez(path, nodes=np.zeros(3))
    else:
        with np.load(path) as data:
            np.savez(path, **{**data, "format": 0})
    with pytest.raises(DataError, match=r"mesh\.npz"):
        BodyMesh.load(path)


def test_a_missing_gmsh_is_not_an_infeasible_design(cache, monkeypatch, tmp_path):
    """Otherwise, an optimiser would treat every design as infeasible."""
    (tmp_path / "gmsh.py").write_text("raise ImportError('libGLU.so.1: cannot open shared object file')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MeshingError, match="libGLU"):
        mesh_geometry(draw_finger, GOOD, mesh_size=COARSE)

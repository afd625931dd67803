"""Time series for ParaView hold the states of a rollout."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.recordings.paraview import ParaviewWriter, _volume
from softgym_envs.mechanics import MechanicalModel
from softgym_envs.robots import Actuator, Robot
from softgym_envs.viewer import scene
from softgym_envs.viewer.moment import watch_rollout
from tests.helpers import box_mesh

pyvista = pytest.importorskip("pyvista")


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paraview") / "series"
    env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem")
    states = []

    def agent(observation, body):
        states.append(body.state)
        return np.array([1.0, -0.2])

    with ParaviewWriter(env.unwrapped, folder) as writer:
        watch_rollout(env, agent, [writer], seed=0, steps=2)
    states.append(env.unwrapped.state)
    env.close()
    return folder, states


def test_series_are_read_with_their_fields(series):
    folder, states = series
    assert sorted(path.name for path in folder.glob("*.pvd")) == ["cables.pvd", "points.pvd", "skin.pvd", "volume.pvd"]
    reader = pyvista.get_reader(folder / "volume.pvd")
    assert list(reader.time_values) == [0.0, 1.0, 2.0]
    reader.set_active_time_value(2.0)
    (volume,) = reader.read()
    assert np.abs(volume.points - states[-1].nodes).max() < 1e-7  # stored in single precision
    assert np.abs(volume["displacement"]).max() > 1e-4
    cables = pyvista.read(folder / "cables" / "0002.vtp")
    np.testing.assert_allclose(cables.cell_data["effort"], states[-1].effort)
    points = pyvista.read(folder / "points" / "0002.vtp")
    np.testing.assert_allclose(points.points[0], states[-1].effector[0], atol=1e-7)
    assert points["kind"].tolist() == [0, 1]


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_cells_have_the_volume_of_the_body(element):
    nodes, tetrahedra = box_mesh((0.02, 0.02, 0.06), (2, 2, 4), jitter=0.2)
    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=nodes[:, 2] < 1e-9, element=element, young_modulus=1e6, poisson_ratio=0.3
    )
    mesh = _volume(model, model.nodes)
    # The volume of quadratic cells is that of their own subdivision: it fails for a wrong order of midside nodes.
    assert mesh.compute_cell_sizes()["Volume"].sum() == pytest.approx(model.volume, rel=1e-6)


def test_a_folder_with_files_is_refused(series):
    folder, _ = series
    with pytest.raises(ConfigError, match="is not empty"):
        ParaviewWriter(gymnasium.make("SoftGym/FingerReach-v0").unwrapped, folder)


class Balloon(Robot):
    """A cube with a hole, into which air is pumped."""

    name, effectors, size = "balloon", ("top",), 0.03
    design_space = DesignSpace(DesignVariable("young_modulus", 1e5, 5e5, 2e5, "Pa", "stiffness"))
    actuators = (Actuator("air", 0.0, 5e-8, 5e-8, unit="m3"),)
    effector_rest, effort_scale = np.array([0.015, 0.015, 0.03]), np.array([1e4])

    def assemble(self, design):
        nodes, tetrahedra = box_mesh((0.03, 0.03, 0.03), (3, 3, 3))
        hole = (np.abs(nodes[tetrahedra].mean(axis=1) - 0.015) < 0.005).all(axis=1)
        fixed = nodes[:, 2] < 1e-9
        model = MechanicalModel.from_mesh(nodes, tetrahedra[~hole], fixed=fixed, element="quadratic", **design)
        model.add_cavity("air", inside=[0.015, 0.015, 0.015])
        model.add_effector("top", [0.015, 0.015, 0.03])
        return model


def test_chambers_carry_their_pressure_and_are_seen(tmp_path, monkeypatch):
    env = gymnasium.make("SoftGym/Reach-v0", robot=Balloon, backend="fem", render_mode="rgb_array")
    with ParaviewWriter(env.unwrapped, tmp_path / "series") as writer:
        watch_rollout(env, lambda observation, body: np.ones(1), [writer], seed=0, steps=1)
    state = env.unwrapped.state
    walls = pyvista.read(tmp_path / "series" / "chambers" / "0001.vtp")
    np.testing.assert_allclose(walls["pressure"], state.effort[0])
    assert state.effort[0] > 0.0
    assert walls.volume == pytest.approx(1e-6 + 5e-8, rel=0.01)  # flat triangles in place of quadratic ones
    seen = env.render().astype(int)
    monkeypatch.setattr(scene, "chamber_skins", lambda model, x: {})
    unseen = env.render().astype(int)
    env.close()
    assert (np.abs(seen - unseen).max(axis=2) > 10).mean() > 0.02  # the chamber shines through the skin

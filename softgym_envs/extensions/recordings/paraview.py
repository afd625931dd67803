"""Rollouts as files of ParaView: a time series of the body's volume, its skin, its cables and its points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.errors import ConfigError
from softgym_envs.extras import require
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.storage import atomic_write
from softgym_envs.viewer.moment import Moment
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines, chamber_skins, surface_kinds

if TYPE_CHECKING:
    import pyvista

    from softgym_envs.envs.env import SoftRobotEnv

PARTS = {"volume": "vtu", "skin": "vtp", "cables": "vtp", "chambers": "vtp", "points": "vtp", "contacts": "vtp"}
"""Series of a folder, with the kind of their files; a part that a robot does not have is left out."""


class ParaviewWriter:
    """Writes the states of one rollout to a folder: ``PART.pvd``, to be opened, and ``PART/0000.vtu``, one each step.

    All lengths are in metres; the time of a state is its control step. Parts:

    * ``volume``: the solids, deformed, with ``displacement`` [m] from the mesh as built and number of the ``solid``;
    * ``skin``: surface of solids, beams and rigid parts, with ``kind``: 0 body, 1 clamped, 2 rigid object;
    * ``cables``: with ``effort`` [N], ``displacement`` [m] and ``slack`` of each;
    * ``chambers``: walls of the cavities, each with its ``pressure`` [Pa]; NaN where it is not known;
    * ``points``: effectors (``kind`` 0) and goal (1), with the field data ``effort``, ``displacement``, ``reward``;
    * ``contacts``: where obstacles press, with ``force`` [N] and ``gap`` [m].

    Use it as a context manager: the ``.pvd`` files are written at the end of the block.

    Args:
        env: the environment.
        folder: new or empty folder.

    Raises:
        ConfigError: if the folder holds files.
    """

    def __init__(self, env: SoftRobotEnv, folder: str | Path) -> None:
        require("viewer")
        self.robot = env.robot
        self.folder = Path(folder)
        if self.folder.exists() and any(self.folder.iterdir()):
            raise ConfigError(f"folder '{self.folder}' of the series is not empty; name a new one")
        self._shapes = ShapeFinder(env.robot)
        self._model: MechanicalModel | None = None
        self._steps: dict[str, list[tuple[int, str]]] = {}

    def __enter__(self) -> ParaviewWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for part, files in self._steps.items():
            rows = "\n".join(f'    <DataSet timestep="{step}" part="0" file="{name}"/>' for step, name in files)
            text = f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n{rows}\n'
            with atomic_write(self.folder / f"{part}.pvd", "w") as stream:
                stream.write(f"{text}  </Collection>\n</VTKFile>\n")

    def log(self, moment: Moment, /) -> None:
        """Write one state."""
        step, design, state = moment.step, moment.design, moment.state
        model = self._shapes.load(design)
        x = self._shapes.nodes(design, state)
        if model is not self._model:
            self._model, self._surface = model, BodySurface(model)
        if model.solids:
            self._write("volume", step, _volume(model, x))
        self._write("skin", step, self._skin(x))
        if lines := cable_lines(model, x, state, stub=0.0):
            self._write("cables", step, _cables(lines, state))
        if chambers := chamber_skins(model, x):
            self._write("chambers", step, self._chambers(chambers, state))
        self._write("points", step, _points(state, moment.goal, moment.reward))
        if state.contacts is not None:
            touch = state.contacts
            self._write("contacts", step, _cloud(touch.point, force=touch.force, gap=touch.gap))

    def _write(self, part: str, step: int, mesh: pyvista.DataSet) -> None:
        name = f"{part}/{step:04d}.{PARTS[part]}"
        path = self.folder / name
        with atomic_write(path, "w") as stream:
            stream.write(_text(mesh))
        self._steps.setdefault(part, []).append((step, name))

    def _skin(self, x: np.ndarray) -> pyvista.PolyData:
        import pyvista

        mesh = pyvista.PolyData.from_regular_faces(self._surface.points(x), self._surface.triangles)
        mesh.cell_data["kind"] = surface_kinds(self._surface)
        return mesh

    def _chambers(self, skins: Mapping[str, tuple[np.ndarray, np.ndarray]], state: State) -> pyvista.PolyData:
        import pyvista

        efforts = {actuator.name: effort for actuator, effort in zip(self.robot.actuators, state.effort, strict=True)}
        parts = []
        for name, skin in skins.items():
            mesh = pyvista.PolyData.from_regular_faces(*skin)
            mesh.cell_data["pressure"] = np.full(mesh.n_cells, efforts.get(name, np.nan))
            parts.append(mesh)
        return parts[0].append_polydata(*parts[1:])


def _text(mesh: pyvista.DataSet) -> str:
    """Return a mesh as an XML file; VTK itself leaves files incomplete, without a word, where the disk is full."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    writer = vtkXMLPolyDataWriter() if isinstance(mesh, pyvista.PolyData) else vtkXMLUnstructuredGridWriter()
    writer.SetInputData(mesh)
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString())


def _volume(model: MechanicalModel, x: np.ndarray) -> pyvista.UnstructuredGrid:
    import pyvista

    parts = []
    for number, block in enumerate(model.solids):
        nodes, cells = np.unique(block.connectivity, return_inverse=True)
        cells = cells.reshape(block.connectivity.shape)
        # VTK numbers the midside nodes of a quadratic tetrahedron as `EDGES` does.
        kind = pyvista.CellType.TETRA if len(cells[0]) == 4 else pyvista.CellType.QUADRATIC_TETRA
        grid = pyvista.UnstructuredGrid({kind: cells}, x[nodes])
        grid.point_data["displacement"] = x[nodes] - model.nodes[nodes]
        grid.cell_data["solid"] = np.full(len(cells), number)
        parts.append(grid)
    return parts[0] if len(parts) == 1 else pyvista.merge(parts, merge_points=False)


def _cables(lines: Mapping[int, np.ndarray], state: State) -> pyvista.PolyData:
    import pyvista

    starts = np.cumsum([0, *(len(line) for line in lines.values())])
    cells = [[len(line), *range(start, start + len(line))] for line, start in zip(lines.values(), starts, strict=False)]
    mesh = pyvista.PolyData(np.vstack(list(lines.values())), lines=np.concatenate(cells))
    rows = list(lines)
    for name, values in (("effort", state.effort), ("displacement", state.displacement), ("slack", state.slack)):
        mesh.cell_data[name] = np.asarray(values)[rows].astype(float)
    return mesh


def _points(state: State, goal: np.ndarray, reward: float | None) -> pyvista.PolyData:
    places = np.vstack([state.effector, np.asarray(goal, dtype=float).reshape(-1, 3)])
    mesh = _cloud(places, kind=(np.arange(len(places)) >= len(state.effector)).astype(int))
    mesh.field_data["effort"] = state.effort
    mesh.field_data["displacement"] = state.displacement
    mesh.field_data["reward"] = np.array([np.nan if reward is None else reward])
    return mesh


def _cloud(points: np.ndarray, **fields: np.ndarray) -> pyvista.PolyData:
    import pyvista

    if not len(points):
        return pyvista.PolyData()
    mesh = pyvista.PolyData(points)
    for name, values in fields.items():
        mesh.point_data[name] = values
    return mesh

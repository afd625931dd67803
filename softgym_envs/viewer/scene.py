"""Off-screen scene of a robot: all its objects are created once and moved for every image."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from softgym_envs.backends.backend import State
from softgym_envs.extras import require
from softgym_envs.mechanics.contact.obstacles import Plane
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.robots.base import Robot
from softgym_envs.viewer.surface import BodySurface, cable_lines, cable_radius, chamber_skins, surface_kinds

if TYPE_CHECKING:
    import pyvista


Color = tuple[int, int, int]

COLORS: dict[str, Color] = {
    "background": (245, 246, 249),
    "grid": (196, 203, 214),
    "shadow": (225, 229, 237),
    "body": (246, 216, 190),
    "clamp": (92, 99, 112),
    "object": (150, 172, 205),
    "edge": (120, 84, 60),
    "ghost": (120, 140, 180),
    "cable low": (245, 166, 35),
    "cable high": (205, 30, 45),
    "cable slack": (98, 106, 122),
    "chamber low": (190, 205, 225),
    "chamber high": (70, 60, 170),
    "effector": (35, 95, 205),
    "goal": (20, 165, 90),
    "text": (75, 82, 95),
}
"""Colours of all objects, 0 to 255, in images and recordings."""

# Directions from the body to the camera and to the lights. Bodies bend in the y-z plane, so the camera looks along x.
_CAMERA = np.array([1.0, 0.45, 0.28])
_LIGHT = np.array([1.0, -0.20, 0.50])
_FILL = np.array([0.3, 1.0, 0.4])
_VIEW_ANGLE = np.radians(18.0)

STUB = 0.06
"""Visible length of an unpulled cable outside the body, relative to the size of the robot."""


def check_display() -> None:
    """Check that a window can be opened.

    Raises:
        ValueError: on Linux without a display.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ValueError(
            "render_mode = 'human' needs a display, but neither DISPLAY nor WAYLAND_DISPLAY is set; use 'rgb_array', "
            "or softgym rollout --video FILE"
        )


def effort_color(part: str, share: float) -> Color:
    """Return the colour of a taut ``"cable"`` or of a ``"chamber"`` whose effort is ``share`` of its scale."""
    share = float(np.clip(share, 0.0, 1.0))
    red, green, blue = (
        round((1.0 - share) * low + share * high)
        for low, high in zip(COLORS[f"{part} low"], COLORS[f"{part} high"], strict=True)
    )
    return red, green, blue


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _fit(cloud: np.ndarray, backward: np.ndarray, angle: float, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position and focal point [m] of the nearest upright camera that sees a whole cloud of points (n, 3).

    Args:
        cloud: points [m].
        backward: unit vector from the scene to the camera.
        angle: vertical view angle [rad].
        aspect: width over height of the image.
    """
    right = _unit(np.cross([0.0, 0.0, 1.0], backward))
    up = np.cross(backward, right)
    depth = cloud @ backward
    place, distance = np.zeros(3), 0.0
    for axis, slope in ((right, aspect * np.tan(0.5 * angle)), (up, np.tan(0.5 * angle))):
        # A camera at (a, D) along (axis, backward) sees a point at (u, w) if |u - a| <= slope (D - w).
        across = cloud @ axis
        high, low = np.max(across + slope * depth), np.min(across - slope * depth)
        place += 0.5 * (high + low) * axis
        distance = max(distance, (high - low) / (2.0 * slope))
    return place + distance * backward, place + depth.mean() * backward


class _Part:
    """One mesh of the scene and, if ``faint`` > 0, its faint copy in the front layer."""

    def __init__(
        self,
        scene: Scene,
        color: str,
        *,
        back: bool = False,
        lit: bool = True,
        specular: float = 0.0,
        opacity: float = 1.0,
        line_width: float = 1.0,
        faint: float = 0.0,
        open_surface: bool = False,
    ) -> None:
        import pyvista

        self.mapper = pyvista.DataSetMapper()
        self.actors = []
        for renderer, alpha in ((scene.back if back else scene.middle, opacity), (scene.front, faint)):
            if alpha == 0.0:
                continue
            look = pyvista.Property(
                color=COLORS[color],
                interpolation="Phong",
                lighting=lit,
                ambient=0.22 if lit else 0.0,
                diffuse=0.95 if lit else 1.0,
                specular=specular,
                specular_power=25.0,
                opacity=alpha,
                line_width=line_width,
                # Draw only the near side of a translucent mesh, so that its far side does not shine through.
                culling="back" if alpha < 1.0 and lit and not open_surface else "none",
            )
            actor = pyvista.Actor(mapper=self.mapper, prop=look)
            actor.visibility = False
            renderer.AddActor(actor)
            self.actors.append(actor)

    def show(self, mesh: pyvista.PolyData | None, color: Color | None = None) -> None:
        """Show a mesh, or nothing for None."""
        visible = mesh is not None and mesh.n_points > 0
        if visible:
            self.mapper.dataset = mesh
        for actor in self.actors:
            actor.visibility = visible
            if color is not None:
                actor.prop.color = color


class Scene:
    """A robot in front of a wall with a grid, or on the ground with one.

    Args:
        robot: the robot.
        size: width and height [pixels].
        cloud: points that the camera must see [m], shape (n, 3).
        ground: what a robot that moves about stands on; the camera follows it once it leaves the picture.
        window: show the scene in a window, in place of off-screen images.

    Raises:
        ValueError: for a window without a display, or on one without OpenGL.
    """

    def __init__(
        self,
        robot: Robot,
        size: tuple[int, int],
        cloud: np.ndarray,
        *,
        ground: Plane | None = None,
        window: bool = False,
    ) -> None:
        if window:
            check_display()
        require("viewer")
        import pyvista

        self.robot = robot
        self._length = robot.size
        self._line = max(1.0, size[1] / 480.0)
        self._axes = robot.view.directions
        cloud = self._seen(cloud)
        self._open_window(size, window)
        self._place_camera(size, cloud)
        self._ground = ground
        if ground is None:
            self._normal, self._height = np.eye(3)[0], float(cloud[:, 0].min()) - 0.15 * self._length
        else:
            self._normal = self._seen(np.asarray(ground.normal))
            self._height = float(self._normal @ self._seen(np.asarray(ground.point)))
        self._draw_grid(size[0] / size[1], cloud)

        self._shadow = _Part(self, "shadow", back=True, lit=False)
        self._ghost = _Part(self, "ghost", back=True, opacity=0.55)
        self._body = _Part(self, "body", specular=0.25)
        self._obstacles = _Part(self, "object", back=True, opacity=0.55, open_surface=True)
        self._edges = _Part(self, "edge", lit=False, opacity=0.35, line_width=1.2 * self._line)
        self._cables: dict[int, _Part] = {}
        self._chambers: dict[str, _Part] = {}
        self._trail = _Part(self, "goal", lit=False, opacity=0.8, line_width=2.5 * self._line, faint=0.3)
        self._goal = _Part(self, "goal", specular=0.4, faint=0.5)
        self._effectors = _Part(self, "effector", specular=0.4, faint=0.5)
        self._ball = pyvista.Sphere(radius=1.0, theta_resolution=24, phi_resolution=16)
        self._model: MechanicalModel | None = None
        self._beyond = 0.0
        self._text: Any = None
        if size[1] >= 200:  # smaller captions would be illegible
            self._text = self._caption("", size, "left")
            self._caption(f"grid {1e3 * self._spacing:g} mm", size, "right")

    def _seen(self, points: np.ndarray) -> np.ndarray:
        """Return points [m] (n, 3) in the axes of the picture: towards the camera, to the right, up."""
        return points @ self._axes.T

    # -- set-up -----------------------------------------------------------------------------------------------------

    def _open_window(self, size: tuple[int, int], window: bool) -> None:
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
        from vtkmodules.vtkRenderingCore import vtkRenderer

        # Without a display, VTK prints an error before it falls back to an off-screen window.
        verbosity = vtkLogger.GetCurrentVerbosityCutoff()
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        try:
            self.plotter = pyvista.Plotter(
                off_screen=not window, window_size=list(size), lighting="none", theme=pyvista.themes.DocumentTheme()
            )
            self.plotter.background_color = pyvista.Color(COLORS["background"])
            self.plotter.enable_anti_aliasing("msaa", multi_samples=4)
            # Three layers with separate depth buffers: wall, shadow and ghost; the robot; the faint copies.
            self.back, self.middle, self.front = self.plotter.renderer, vtkRenderer(), vtkRenderer()
            self.window = cast(Any, self.plotter.render_window)
            for renderer in (self.middle, self.front):
                layer = self.window.GetNumberOfLayers()
                self.window.SetNumberOfLayers(layer + 1)
                renderer.SetLayer(layer)
                renderer.InteractiveOff()
                renderer.AutomaticLightCreationOff()
                renderer.SetActiveCamera(self.plotter.camera)
                self.window.AddRenderer(renderer)
            if window:
                if "X" not in self.window.GetClassName() and sys.platform == "linux":  # it fell back to memory
                    raise ValueError(
                        f"render_mode = 'human': display {os.environ.get('DISPLAY')!r} does not answer, or has no "
                        "OpenGL; use 'rgb_array', or softgym rollout --video FILE"
                    )
                self.plotter.show(interactive_update=True, auto_close=False, title=self.robot.name)
            self.window.Render()
        finally:
            vtkLogger.SetStderrVerbosity(verbosity)
        for direction, intensity in ((_LIGHT, 0.62), (_FILL, 0.30), (_CAMERA, 0.22)):
            light = pyvista.Light(position=tuple(direction), focal_point=(0.0, 0.0, 0.0), intensity=intensity)
            for renderer in (self.back, self.middle, self.front):
                renderer.AddLight(light)

    def _caption(self, text: str, size: tuple[int, int], side: str) -> Any:
        import pyvista

        scale = size[1] / 480.0
        caption = pyvista.Text(text, position=(10 * scale if side == "left" else size[0] - 10 * scale, 10 * scale))
        caption.prop.color, caption.prop.font_size = COLORS["text"], max(10, round(11 * scale))
        caption.prop.justification_horizontal = side
        self.middle.AddViewProp(caption)
        return caption

    def _place_camera(self, size: tuple[int, int], cloud: np.ndarray) -> None:
        margin = 0.1 * self._length * np.vstack([np.eye(3), -np.eye(3)])
        cloud = (cloud[:, None] + margin).reshape(-1, 3)
        position, focal = _fit(cloud, _unit(_CAMERA), _VIEW_ANGLE, size[0] / size[1])
        camera = self.plotter.camera
        camera.position, camera.focal_point, camera.up = position, focal, (0.0, 0.0, 1.0)
        camera.view_angle = np.degrees(_VIEW_ANGLE)
        distance = float(np.linalg.norm(position - focal))
        camera.clipping_range = (0.3 * distance, 3.0 * distance)
        self._side = _unit(np.cross([0.0, 0.0, 1.0], _CAMERA))

    def _draw_grid(self, aspect: float, cloud: np.ndarray) -> None:
        """Draw a grid on the wall behind the body, or on the ground, that fades into the background."""
        import pyvista

        normal = self._normal
        across = _unit(np.eye(3)[1] - normal[1] * normal)
        plane = np.stack([across, np.cross(normal, across)])
        self._spacing = 10.0 ** np.floor(np.log10(0.2 * self._length))
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        reach = 1.8 * self._length * max(1.0, aspect)
        if self._ground is not None:
            reach = max(reach, 0.8 * float(np.linalg.norm(high - low)))
        count = int(np.ceil(reach / self._spacing))
        centre = 0.5 * plane @ (low + high)
        steps = np.arange(-count, count + 1)
        y, z = np.meshgrid(*(np.round(centre / self._spacing)[:, None] + steps), indexing="ij")
        places = self._spacing * np.stack([y, z], axis=-1).reshape(-1, 2)
        points = self._height * normal + places @ plane
        index = np.arange(y.size).reshape(y.shape)
        ends = ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))
        lines = np.concatenate([np.stack(pair, axis=-1).reshape(-1, 2) for pair in ends])
        mesh = _line_mesh(points, lines)
        fade = np.clip(1.0 - np.linalg.norm(places - centre, axis=1) / reach, 0.0, 1.0)[:, None]
        back, front = np.array(COLORS["background"]), np.array(COLORS["grid"])
        mesh.point_data["rgb"] = np.round(back + (front - back) * fade**0.7).astype(np.uint8)
        self._grid = pyvista.Actor(mapper=pyvista.DataSetMapper(mesh))
        self._grid.mapper.set_scalars(mesh["rgb"], "rgb", rgb=True)
        self._grid.prop.lighting, self._grid.prop.line_width = False, 1.3 * self._line
        self.back.AddActor(self._grid)

    def _follow(self, model: MechanicalModel, x: np.ndarray) -> None:
        """Move the camera on with a robot that has gone out of the picture."""
        row = self.robot.view.follows
        if self._ground is None or row is None:
            return
        beyond = max(float(x[row, 0] - model.nodes[row, 0]) - self.robot.view.way * self._length, 0.0)
        ahead = self._seen(np.eye(3)[0])
        camera, move = self.plotter.camera, (beyond - self._beyond) * ahead
        camera.position, camera.focal_point = np.add(camera.position, move), np.add(camera.focal_point, move)
        self._beyond = beyond
        # The grid goes on by whole squares, so that it seems to stand still.
        self._grid.position = (
            np.floor(beyond / self._spacing) * self._spacing * (ahead - self._normal[1] * self._normal)
        )

    # -- moving objects ---------------------------------------------------------------------------------------------

    def set_body(self, model: MechanicalModel, x: np.ndarray) -> None:
        """Draw a body at node positions [m] (n, 3). The surface is rebuilt only if the model changes."""
        import pyvista

        if model is not self._model:
            self._model = model
            self._surface = BodySurface(model)
            self._thickness = cable_radius(model, 0.009 * self._length)
            self._skin = _surface_mesh(self._surface)
            kinds = [COLORS["body"], COLORS["clamp"], COLORS["object"]]
            colors = np.array(kinds, dtype=np.uint8)[surface_kinds(self._surface)]
            self._skin.cell_data["rgb"] = colors
            self._body.show(self._skin)
            self._body.mapper.set_scalars(colors, "rgb", rgb=True, preference="cell")
            self._flat = _surface_mesh(self._surface)
            self._shadow.show(self._flat)
            self._seams = _line_mesh(np.zeros_like(self._surface.shape(x)), self._surface.edges)
            self._edges.show(self._seams)
            others = obstacle_skins(model, self.robot, ground=self._ground)
            skins = [(self._seen(points), faces) for points, faces in others]
            parts = [pyvista.PolyData.from_regular_faces(*skin) for skin in skins]
            self._obstacles.show(pyvista.merge(parts) if parts else None)
        self._follow(model, x)
        points = self._seen(self._surface.points(x))
        _move(self._skin, points, self._surface.normals(points))
        # Slightly behind the grid, so that the grid stays visible.
        away = points @ self._normal - (self._height - 2e-3 * self._length)
        _move(self._flat, points - away[:, None] * _LIGHT / (_LIGHT @ self._normal))
        # Slightly in front of the skin, so that the edges stay visible.
        _move(self._seams, self._seen(self._surface.shape(x)) + 2e-3 * self._length * _unit(_CAMERA))

    def set_ghost(self, model: MechanicalModel | None, x: np.ndarray | None = None) -> None:
        """Draw another body at node positions [m] (n, 3) as a pale shape in the background, or no body for None."""
        if model is None or x is None:
            self._ghost.show(None)
            return
        surface = BodySurface(model)
        mesh = _surface_mesh(surface)
        points = self._seen(surface.points(x))
        _move(mesh, points, surface.normals(points))
        self._ghost.show(mesh)

    def set_state(self, x: np.ndarray, state: State) -> None:
        """Draw cables, chambers and effectors of the current body at node positions [m] (n, 3) in a state."""
        assert self._model is not None
        side = self._side @ self._axes
        lines = cable_lines(self._model, x, state, stub=STUB * self._length, side=tuple(side))
        for row in self._cables.keys() - lines.keys():
            self._cables[row].show(None)
        for row, line in lines.items():
            if row not in self._cables:
                self._cables[row] = _Part(self, "cable low", specular=0.3, faint=0.45)
            slack = bool(state.slack[row])
            share = state.effort[row] / self.robot.effort_scale[row]
            color = COLORS["cable slack"] if slack else effort_color("cable", share)
            radius = (0.67 if slack else 1.0) * self._thickness
            line = self._seen(line)
            tube = _polyline(line).tube(radius=radius, n_sides=12, capping=True)
            tube.point_data.active_normals = tube.point_data["TubeNormals"]
            bead = self._balls(line[:1], 2.0 * self._thickness)
            self._cables[row].show(tube.append_polydata(bead), color)
        self._draw_chambers(x, state)
        self._effectors.show(self._balls(self._seen(state.effector), 0.026 * self._length))

    def _draw_chambers(self, x: np.ndarray, state: State) -> None:
        """Let the walls of cavities shine through the body, the darker the higher their pressure."""
        import pyvista

        assert self._model is not None
        skins = chamber_skins(self._model, x)
        rows = {actuator.name: row for row, actuator in enumerate(self.robot.actuators)}
        for name in self._chambers.keys() - skins.keys():
            self._chambers[name].show(None)
        for name, (points, triangles) in skins.items():
            if name not in self._chambers:
                self._chambers[name] = _Part(self, "chamber low", opacity=0.0, faint=0.45)
            mesh = pyvista.PolyData.from_regular_faces(self._seen(points), triangles)
            mesh = mesh.compute_normals(cell_normals=False, split_vertices=True)
            row = rows.get(name)
            share = 0.0 if row is None else state.effort[row] / self.robot.effort_scale[row]
            self._chambers[name].show(mesh, effort_color("chamber", share))

    def set_goal(self, goal: np.ndarray | None, path: np.ndarray | None) -> None:
        """Draw the goal [m] (3,) and, if it moves, its path [m] (p, 3); None hides them."""
        self._goal.show(None if goal is None else self._balls(self._seen(goal[None]), 0.034 * self._length))
        self._trail.show(None if path is None or len(path) < 2 else _polyline(self._seen(path)))

    def set_text(self, text: str) -> None:
        """Write a caption in the lower left corner."""
        if self._text is not None:
            self._text.input = text

    def image(self) -> np.ndarray:
        """Return an image of the scene, shape (height, width, 3) uint8."""
        self.window.Render()
        return np.array(self.plotter.screenshot(return_img=True), dtype=np.uint8)

    def update(self) -> None:
        """Draw the scene in its window, and let the user move the camera."""
        self.window.Render()
        self.plotter.update()

    def close(self) -> None:
        """Close the window."""
        for renderer in (self.middle, self.front):
            self.window.RemoveRenderer(renderer)
        self.plotter.close()

    def _balls(self, centres: np.ndarray, radius: float) -> pyvista.PolyData:
        import pyvista

        ball = self._ball
        points = (centres[:, None] + radius * ball.points).reshape(-1, 3)
        faces: Any = np.asarray(ball.regular_faces)
        faces = (faces + ball.n_points * np.arange(len(centres))[:, None, None]).reshape(-1, 3)
        mesh = pyvista.PolyData.from_regular_faces(points, faces)
        mesh.point_data.active_normals = np.tile(ball.points, (len(centres), 1))
        return mesh


def _line_mesh(points: np.ndarray, lines: np.ndarray) -> pyvista.PolyData:
    """Mesh of separate lines, node pairs (s, 2)."""
    import pyvista

    return pyvista.PolyData(points, lines=np.insert(lines, 0, 2, axis=1).ravel())


def _polyline(points: np.ndarray) -> pyvista.PolyData:
    import pyvista

    return pyvista.PolyData(points, lines=[len(points), *range(len(points))])


def _surface_mesh(surface: BodySurface) -> pyvista.PolyData:
    import pyvista

    return pyvista.PolyData.from_regular_faces(np.zeros((len(surface.nodes), 3)), surface.triangles)


def ground_of(model: MechanicalModel, robot: Robot) -> Plane | None:
    """Return the plane on which a robot moves about; None for one that stays where it is, or that nothing carries."""
    if not robot.view.way or model.contact is None:
        return None
    return next((o for o in model.contact.obstacles if isinstance(o, Plane) and o.frame is None), None)


def obstacle_skins(
    model: MechanicalModel, robot: Robot, *, ground: Plane | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return vertices [m] and triangles of the obstacles that stand still; those that move are skins of the body.

    Args:
        model: body with its contacts.
        robot: an infinite obstacle is shown up to three quarters of its size to each side, and under its way.
        ground: an obstacle that is left out.
    """
    half = (0.75 + robot.view.way) * robot.size
    obstacles = model.contact.obstacles if model.contact else ()
    return [o.skin(half) for o in obstacles if o.frame is None and o != ground]


def _move(mesh: pyvista.PolyData, points: np.ndarray, normals: np.ndarray | None = None) -> None:
    mesh.points = points
    if normals is not None:
        mesh.point_data.active_normals = normals

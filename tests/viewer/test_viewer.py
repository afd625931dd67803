"""Pictures and recordings of the soft finger."""

import dataclasses

import gymnasium
import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.errors import ConvergenceError
from softgym_envs.viewer.image import ImageRenderer, render_bodies, render_body
from softgym_envs.viewer.scene import COLORS, effort_color
from softgym_envs.viewer.surface import BodySurface, ShapeFinder, cable_lines, slacken

SIZE = (160, 120)
GOAL = np.array([0.0, 0.06, -0.095])


@pytest.fixture(scope="module")
def backend():
    return FEMBackend(make_robot("finger"))


@pytest.fixture(scope="module")
def states(backend):
    rest = backend.reset()
    return {
        "rest": rest,
        "bent": backend.step(np.array([0.012, 0.012])),
        "slack": backend.step(np.array([0.012, 0.0])),
    }


@pytest.fixture(scope="module")
def renderer(backend):
    renderer = ImageRenderer(backend.robot, SIZE)
    yield renderer
    renderer.close()


def draw(renderer, state, goal=GOAL, path=None):
    return renderer.render({}, state, goal[None] if path is None else path, goal)


def green(image):
    """Pixels of the goal's colour: nothing else is green."""
    red, middle, blue = (image[..., c].astype(int) for c in range(3))
    return middle - np.maximum(red, blue) > 40


def alike(image, other):
    """Whether at most one pixel in a thousand differs visibly: rounding moves the edges of shapes a little."""
    return (np.abs(image.astype(int) - other).max(axis=-1) > 8).mean() <= 1e-3


class TestImage:
    def test_shape_and_content(self, renderer, states):
        image = draw(renderer, states["rest"])
        assert image.shape == (SIZE[1], SIZE[0], 3)
        assert image.dtype == np.uint8
        assert image.std() > 10

    def test_states_look_different(self, renderer, states):
        pictures = [draw(renderer, state).astype(int) for state in states.values()]
        for one, other in ((0, 1), (0, 2), (1, 2)):
            assert (np.abs(pictures[one] - pictures[other]).max(axis=2) > 30).mean() > 0.005

    def test_same_state_same_picture(self, renderer, states):
        first = draw(renderer, states["bent"])
        draw(renderer, states["slack"])
        np.testing.assert_array_equal(draw(renderer, states["bent"]), first)

    def test_goal_is_shown_where_it_is(self, renderer, states):
        first, second = (green(draw(renderer, states["rest"], goal)) for goal in (GOAL, GOAL + [0.0, 0.0, 0.04]))
        assert first.sum() > 10
        assert second.sum() > 10
        assert np.argwhere(second)[:, 0].mean() < np.argwhere(first)[:, 0].mean() - 10
        assert not green(renderer.render_body()).any()

    def test_path_is_shown(self, renderer, states):
        path = np.linspace(GOAL, GOAL + [0.0, 0.0, 0.07], 5)
        assert green(draw(renderer, states["rest"], path=path)).sum() > green(draw(renderer, states["rest"])).sum() + 20

    def test_goal_shines_through_the_body(self, renderer, states):
        assert green(draw(renderer, states["rest"], np.array([0.0, 0.01, -0.02]))).sum() > 10

    @pytest.mark.parametrize("name", ["rest", "bent", "slack"])
    def test_state_without_nodes(self, renderer, states, name):
        bare = dataclasses.replace(states[name], nodes=None)
        assert alike(draw(renderer, bare), draw(renderer, states[name]))
        assert not alike(draw(renderer, bare), draw(renderer, states["slack" if name == "bent" else "bent"]))

    def test_effort_driven_state_without_nodes(self, backend, renderer):
        state = backend.step(np.array([4.0, 6.0]), "effort")
        bare = dataclasses.replace(state, nodes=None)
        assert alike(draw(renderer, bare), draw(renderer, state))

    def test_design_changes_the_picture(self, backend, renderer, states):
        short = {"length": 0.038}
        picture = renderer.render_body(short)
        assert (np.abs(picture.astype(int) - renderer.render_body()) > 30).any()

    def test_size_is_checked(self, backend):
        with pytest.raises(ValueError, match="size"):
            ImageRenderer(backend.robot, (0, 10))

    def test_drawing_after_close(self, backend, states):
        renderer = ImageRenderer(backend.robot, (64, 48))
        first = draw(renderer, states["bent"])
        renderer.close()
        renderer.close()
        np.testing.assert_array_equal(draw(renderer, states["bent"]), first)
        renderer.close()

    def test_environment_renders(self):
        env = gymnasium.make("SoftGym/FingerReach-v0", backend="fem", render_mode="rgb_array", render_size=(96, 64))
        env.reset(seed=0)
        before = env.render()
        for _ in range(5):
            env.step(np.ones(2, dtype=np.float32))
        after = env.render()
        env.close()
        assert before.shape == after.shape == (64, 96, 3)
        assert (before != after).any()

    def test_bodies_side_by_side(self, backend):
        designs = [{}, {"joint_height": 0.008}]
        wide = render_bodies(backend.robot, designs, [0.01, 0.01], (64, 48), texts=["a", "b"])
        assert wide.shape == (48, 128, 3)
        assert (wide[:, :64] != wide[:, 64:]).any()
        np.testing.assert_array_equal(render_body(backend.robot, {}, [0.01, 0.01], (64, 48)), wide[:, :64])

    def test_ghost(self, renderer):
        plain = renderer.render_body({}, [0.01, 0.01])
        ghosted = renderer.render_body({}, [0.01, 0.01], ghost={"length": 0.042})
        assert (np.abs(ghosted.astype(int) - plain) > 10).any()
        np.testing.assert_array_equal(renderer.render_body({}, [0.01, 0.01]), plain)


class TestShape:
    def test_last_shape_where_nothing_converges(self, backend, states, monkeypatch):
        shapes = ShapeFinder(backend.robot)
        bare = {name: dataclasses.replace(state, nodes=None) for name, state in states.items()}
        bent = shapes.nodes({}, bare["bent"]).copy()

        def fail(*_):
            raise ConvergenceError("no equilibrium")

        monkeypatch.setattr(FEMBackend, "step", fail)
        np.testing.assert_array_equal(shapes.nodes({}, bare["slack"]), bent)

    def test_body_is_built_once_per_design(self, backend):
        shapes = ShapeFinder(backend.robot)
        model = shapes.load({})
        assert shapes.load(backend.design) is model
        assert shapes.load({"height": 0.021}) is not model

    def test_given_finite_elements_are_used_and_not_moved(self, backend, states):
        shapes, before = ShapeFinder(backend.robot, backend), backend.state
        assert shapes.load(backend.design) is backend.model
        np.testing.assert_array_equal(shapes.rest().nodes, ShapeFinder(backend.robot).rest().nodes)
        bare = dataclasses.replace(states["bent"], nodes=None)
        np.testing.assert_allclose(shapes.nodes({}, bare), states["bent"].nodes, atol=1e-6)
        assert backend.state is before
        assert shapes.load({"height": 0.021}) is not backend.model

    def test_surface_is_closed_and_faces_outwards(self, backend, states):
        surface = BodySurface(backend.model)
        points = surface.points(backend.model.nodes)
        corners = points[surface.triangles]
        volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        assert volume == pytest.approx(backend.model.volume)
        np.testing.assert_allclose(np.linalg.norm(surface.normals(points), axis=1), 1.0)
        assert surface.clamped.any()
        assert not surface.clamped.all()
        # A flat side of the bar is shaded flat, although its rim is sharp.
        side = np.isclose(corners[:, :, 0], corners[:, :, 0].max()).all(axis=1)
        normals = surface.normals(points)[surface.triangles[side]]
        np.testing.assert_allclose(normals, np.broadcast_to([1.0, 0.0, 0.0], normals.shape), atol=0.3)

    def test_cables(self, backend, states):
        state = states["slack"]
        taut, slack = cable_lines(backend.model, state.nodes, state, stub=0.01).values()
        assert len(taut) == 8
        assert len(slack) > 8
        # The pulled end of a cable is out by what was reeled in.
        assert np.linalg.norm(taut[0] - taut[1]) == pytest.approx(0.01 + state.displacement[0])
        assert np.linalg.norm(slack[0] - slack[1]) == pytest.approx(0.01)

    def test_slack_waves_have_the_length_of_the_cable(self):
        path = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.02], [0.0, 0.01, -0.05]])
        wave = slacken(path, 0.001, (1.0, 0.0, 0.0), count=40)
        length, taut = (np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in (wave, path))
        assert length - taut == pytest.approx(0.001, rel=0.1)
        np.testing.assert_array_equal(wave[[0, -1]], path[[0, -1]])

    def test_effort_color(self):
        assert effort_color("cable", -1.0) == COLORS["cable low"]
        assert effort_color("cable", 2.0) == COLORS["cable high"]


def test_pictures_are_framed_on_the_bodies_that_they_show():
    """The camera moves back for a body that is longer than the baseline."""
    robot = make_robot("finger", design_box="wide")
    alone = render_body(robot, size=(120, 120))
    both = render_bodies(robot, [None, {"length": 0.052}], size=(120, 120))
    assert both.shape == (120, 240, 3)
    assert not np.array_equal(both[:, :120], alone)

"""Learned chains: mechanics, contact, and what training needs. The chain of these tests obeys beam theory."""

import numpy as np
import pytest

from softgym_envs.errors import WeightsError
from softgym_envs.extensions.beams.contact_law import gap_of, table_of
from softgym_envs.extensions.beams.prism import RoundedPrism
from softgym_envs.extensions.grasping.chain import closings
from softgym_envs.extensions.grasping.chain.body import KINDS, FingerChain
from softgym_envs.extensions.grasping.chain.closings import Closings
from softgym_envs.extensions.grasping.chain.contact import ChainBatch, changes_along_z, rows_for
from softgym_envs.extensions.grasping.chain.kernels import assemble, bow, points_near, segment, turns
from softgym_envs.extensions.grasping.chain.model import ChainModel, load_chain, save_chain
from softgym_envs.extensions.grasping.chain.segments import OUTPUTS
from softgym_envs.mechanics.contact.obstacles import Cylinder, Plane, Sphere
from softgym_envs.mechanics.solvers.complementarity import solve_complementarity
from softgym_envs.robots.registry import make_robot


@pytest.fixture(scope="module")
def robot():
    return make_robot("contact_aided_finger")


@pytest.fixture(scope="module")
def beam(robot):
    """A chain whose networks return zero: beam theory."""
    return ChainModel(robot, untrained(robot, np.zeros), {})


def untrained(robot, fill, width=4, members=2):
    bodies = FingerChain(robot, rows=1).bodies(robot.design_space.baseline.array[None])
    tensors = {"depth": np.zeros(15)}
    for kind in KINDS:
        sizes = bodies.features[kind].shape[-1], width, width, OUTPUTS
        for k in range(3):
            tensors[f"{kind}.{k}.weight"] = fill((members, sizes[k + 1], sizes[k]))
            tensors[f"{kind}.{k}.bias"] = fill((members, sizes[k + 1]))
    return tensors


def body(robot, **values):
    return robot.design_space.complete({"e1": 0.010, "e2": 0.008, "e3": 0.006, **values}).array[None]


def wall(x=0.048, friction=0.0):
    return Plane((x, 0.0, 0.0), (-1.0, 0.0, 0.0), friction=friction)


def bar(x, y, friction=0.0, radius=0.004):
    return Cylinder((x, y, 0.0), (0.0, 0.0, 1.0), radius, friction=friction)


def closed(model, obstacles, degrees, steps, **options):
    batch = ChainBatch(model.prepare(body(model.robot)), [obstacles], **options)
    for k in range(1, steps + 1):
        states = batch.close(np.radians([degrees * k / steps]))
        assert states.found[0]
    return batch, states


def test_segment_derivatives():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    rest = rng.normal(size=2)
    length = float(np.linalg.norm(rest))
    fixed = (length, rest / length, root @ root.T, False)
    x = np.concatenate([rng.normal(size=2), [0.3], rng.normal(size=2) + 2.0, [-0.2]])

    def gradient(x):
        g, h = np.empty(6), np.empty((6, 6))
        return segment(x[:3], x[3:], *fixed, g, h), g, h

    step = 1e-6 * np.eye(6)
    energy, g, h = gradient(x)
    np.testing.assert_allclose(
        [(gradient(x + s)[0] - gradient(x - s)[0]) / 2e-6 for s in step], g, rtol=1e-7, atol=1e-7
    )
    slopes = [(gradient(x + s)[1] - gradient(x - s)[1]) / 2e-6 for s in step]
    np.testing.assert_allclose(np.transpose(slopes), h, rtol=1e-6, atol=1e-6)
    # A rotation of the whole segment costs nothing.
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    turned = np.concatenate([[0.0, 0.0, turn], [c * rest[0] - s * rest[1], s * rest[0] + c * rest[1], turn]])
    assert gradient(turned)[0] == pytest.approx(0.0, abs=1e-20 + 1e-14 * energy)


OBSTACLES = [
    wall(0.05),
    Sphere((0.05, 0.02, 0.003), 0.01),
    bar(0.06, 0.03),
    Cylinder((0.06, 0.03, 0.0), (0.3, 1.0, 0.2), 0.01),
    RoundedPrism.hexagonal(0.04, 0.05, 0.002, centre=(0.07, 0.05, 0.0)),
    RoundedPrism.box((0.02, 0.01, 0.03), 0.003, centre=(0.07, 0.05, 0.01)),
]


@pytest.mark.parametrize("obstacle", OBSTACLES, ids=lambda o: o.kind)
def test_compiled_obstacles_equal_those_of_the_mechanics(obstacle):
    (parameters,), (edges,) = table_of([obstacle])
    points = np.random.default_rng(1).uniform((0.0, 0.0, -0.02), (0.1, 0.1, 0.02), (50, 3))
    points = points[obstacle.gap(points) > 1e-4]
    gap, normal, curvature = obstacle.geometry(points)
    n, h = np.empty(3), np.empty((3, 3))
    for k, point in enumerate(points):
        assert gap_of(point, parameters, edges, n, h) == pytest.approx(gap[k], abs=1e-14)
        np.testing.assert_allclose(n, normal[k], atol=1e-12)
        np.testing.assert_allclose(h, curvature[k], atol=1e-8)


def test_obstacles_that_need_depth():
    flags = [changes_along_z(o, 0.02) for o in OBSTACLES]
    assert flags == [False, True, False, True, False, False]
    assert rows_for([[wall()], [OBSTACLES[1]]], 0.02) > rows_for([[wall()]], 0.02) == 1


@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_tangent_in_contact(beam, friction):
    """Central differences over all coordinates; with friction, some points slide and the tangent is unsymmetric."""
    batch, states = closed(beam, [wall(friction=friction), bar(0.052, 0.05, friction)], 20.0, 10)
    assert states.points[0] > 0
    assert (states.sliding[0] > 0) == (friction > 0.0)
    prepared = beam.prepare(body(beam.robot))
    _, length, along, stiffness = (part[0] for part in prepared.segments)
    nodes, shares, arms, heights, areas = prepared.skin
    skin = (nodes, shares, arms[0], heights, areas[0])
    table, edges = table_of([wall(friction=friction), bar(0.052, 0.05, friction)])
    memory = batch.memory
    law = np.array([5e-4, 3.62e5, 5.0 * 3.62e5 / 5e-4])
    count = len(memory.q[0])

    def gradient(q, blocks=False):
        g, d = np.empty((count, 3)), np.empty((count, 3, 3))
        u, lo = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3, 3))
        anchors = memory.before[0]
        limits = np.empty(anchors.shape[:2])
        assemble(q, length, along, stiffness, skin, table, edges, anchors, law, False, g, d, u, lo, limits)
        return (d, u, lo) if blocks else g

    diagonal, upper, lower = gradient(memory.q[0], blocks=True)
    tangent = np.zeros((count, 3, count, 3))
    for k in range(count):
        tangent[k, :, k] = diagonal[k]
    for k in range(count - 1):
        tangent[k, :, k + 1], tangent[k + 1, :, k] = upper[k], lower[k]
    tangent = tangent.reshape(3 * count, 3 * count)
    numbers = np.zeros_like(tangent)
    for i in range(3 * count):
        step = np.zeros(3 * count)
        step[i] = 2e-8
        step = step.reshape(count, 3)
        numbers[:, i] = (gradient(memory.q[0] + step) - gradient(memory.q[0] - step)).ravel() / 4e-8
    assert np.abs(numbers - tangent).max() < 1e-6 * np.abs(tangent).max()
    unsymmetric = np.abs(tangent - tangent.T).max() / np.abs(tangent).max()
    assert unsymmetric > 1e-6 if friction else unsymmetric < 1e-12


@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_compliance_in_contact(beam, friction):
    """W against differences of equilibria; with friction, of loading steps from the same memory."""
    batch = ChainBatch(beam.prepare(body(beam.robot)), [[wall(friction=friction)]])
    for degrees in range(1, 16):
        batch.close(np.radians([degrees]))
    kept, angle, step = batch.memory, np.radians(16.0), 1e-5

    def reached(target):
        batch.memory = kept
        states = batch.close(np.array([target]))
        return np.concatenate([states.tip[0], states.torque])

    slopes = (reached(angle + step) - reached(angle - step)) / (2 * step)
    reached(angle)
    W, stable = batch.compliance()
    assert stable[0]
    assert 1.0 / W[0, 0, 0] == pytest.approx(slopes[2], rel=1e-5)
    np.testing.assert_allclose(W[0, 1:3, 0] / W[0, 0, 0], slopes[:2], atol=1e-5 * np.abs(slopes[:2]).max())
    if not friction:
        np.testing.assert_allclose(W[0], W[0].T, atol=1e-12 * np.abs(W[0]).max())
        assert np.linalg.eigvalsh(W[0])[0] > 0.0


def test_contact_solves_the_complementarity_problem(beam):
    """As the distance of contact goes to zero, small motions obey Signorini's conditions with the chain's W."""
    robot = beam.robot
    angle = np.radians(0.5)
    row = body(robot)
    at_rest, free = beam.markers(row, np.zeros(1)), beam.markers(row, np.array([angle]))
    # Bars with their faces at the corners: the third one is too far away to be touched.
    corners = np.array([3, 6, 9])
    place, moved = at_rest.markers[0, corners], free.markers[0, corners]
    reach = (moved - place)[:, 0] * np.array([0.5, 0.32, 1.2])
    planes = [bar(x + r + 0.003, y, radius=0.003) for (x, y), r in zip(place, reach, strict=True)]
    _, states = closed(beam, planes, 0.5, 50, distance=1e-6, stiffness=3.62e7)
    rows = 2 * corners
    W = free.held[0][rows[:, None], rows]
    gap = reach - (moved - place)[:, 0]
    pushing = solve_complementarity(W[None], gap[None], np.ones(3, dtype=bool))[0]
    assert (pushing > 0.0).tolist() == [True, True, False]
    np.testing.assert_allclose(-states.force[0, :, 0], pushing, rtol=0.02, atol=1e-6)


def test_far_points_are_skipped_and_near_ones_are_not(beam):
    """Obstacles beside any one point of the skin are found."""
    prepared = beam.prepare(body(beam.robot))
    q, skin = prepared.at_rest[0], tuple(p[0] if k in (2, 4) else p for k, p in enumerate(prepared.skin))
    points = ChainBatch(prepared, [[]]).touching().points[0]
    for k in range(0, len(points), 7):
        x, y, _ = points[k]
        table, edges = table_of([bar(x + 0.0014, y, radius=0.001)])
        near = points_near(q, turns(q), skin, table, edges, 5e-4)
        distance = np.hypot(points[:, 0] - x - 0.0014, points[:, 1] - y) - 0.001
        assert near[k]
        assert near[distance < 5e-4].all()
        assert not near.all()


def test_a_bent_segment_is_longer_than_its_chord():
    """Against the length of a cubic with the slopes of both ends."""
    for first, last in ((0.1, 0.0), (0.05, -0.08), (0.06, 0.06)):
        x = np.linspace(0.0, 1.0, 20001)
        slope = first * (1.0 - 4.0 * x + 3.0 * x**2) + last * (3.0 * x**2 - 2.0 * x)
        longer = np.trapezoid(np.sqrt(1.0 + slope**2), x) - 1.0
        assert bow(0.03, first, last) == pytest.approx(0.03 * longer, rel=5e-3)


def test_folds(beam):
    """A body that has folded stays so until it opens again."""
    soft = body(beam.robot, e1=0.008, e2=0.005, e3=0.004)
    batch = ChainBatch(beam.prepare(soft), [[wall(0.0631, 0.85)]])
    angles, folded, clearance = np.radians(np.arange(2.0, 41.0, 2.0)), [], []
    for angle in angles:
        states = batch.close(np.array([angle]))
        folded.append(bool(states.folded[0]))
        clearance.append(float(states.clearance[0]))
    first = folded.index(True)
    assert not any(folded[:first]) and all(folded[first:])
    assert min(clearance[:first]) >= 1e-3 > clearance[first]
    assert not batch.close(angles[first - 1 : first]).folded[0]


def test_friction_obeys_coulomb(beam):
    batch, states = closed(beam, [wall(friction=0.05)], 25.0, 10)
    touch = batch.touching()
    near = touch.pressing[0, 0] > 0.0
    along = np.abs(touch.forces[0, 0, :, 1])
    limit = 0.05 * touch.pressing[0, 0]
    assert near.any()
    assert (along <= limit * (1.0 + 1e-9)).all()
    slides = near & touch.sliding[0, 0]
    assert slides.any()
    np.testing.assert_allclose(along[slides], limit[slides], rtol=1e-9)
    np.testing.assert_allclose(states.force[0, 0], touch.forces[0, 0].sum(axis=0))
    assert states.force[0, 0, 0] < 0.0 < states.gap[0]


def test_states_without_friction_do_not_depend_on_the_path(beam):
    coarse = closed(beam, [wall(), bar(0.05, 0.06)], 20.0, 2)[1]
    fine = closed(beam, [wall(), bar(0.05, 0.06)], 20.0, 20)[1]
    assert coarse.torque[0] == pytest.approx(fine.torque[0], rel=1e-7)
    np.testing.assert_allclose(coarse.tip, fine.tip, atol=1e-9)


def test_batches_equal_single_bodies(beam):
    robot = beam.robot
    designs = np.concatenate([body(robot), body(robot, d3=0.010), body(robot, e3=0.008)])
    scenes = [[wall(0.045)], [wall(0.05, 0.5), bar(0.05, 0.04)], [wall(0.045)]]
    batch = ChainBatch(beam.prepare(designs), scenes)
    for degrees in (5.0, 10.0, 15.0):
        many = batch.close(np.radians([degrees] * 3))
    for k, scene in enumerate(scenes):
        single = ChainBatch(beam.prepare(designs[k : k + 1]), [scene])
        for degrees in (5.0, 10.0, 15.0):
            one = single.close(np.radians([degrees]))
        np.testing.assert_array_equal(one.tip[0], many.tip[k])
        np.testing.assert_array_equal(one.force[0], many.force[k, : len(scene)])
    # Young's modulus scales forces and nothing else.
    double = ChainBatch(beam.prepare(body(robot, young_modulus=7.24e6)), [[wall(0.045)]])
    half = ChainBatch(beam.prepare(body(robot)), [[wall(0.045)]])
    for degrees in (5.0, 10.0):
        stiff, soft = double.close(np.radians([degrees])), half.close(np.radians([degrees]))
    np.testing.assert_allclose(stiff.torque, 2.0 * soft.torque)
    np.testing.assert_allclose(stiff.force, 2.0 * soft.force)
    np.testing.assert_allclose(stiff.tip, soft.tip)


def test_memory_and_reset(beam):
    batch, _ = closed(beam, [wall(friction=0.5)], 12.0, 6)
    kept = batch.memory
    first = batch.close(np.radians([14.0]))
    batch.memory = kept
    again = batch.close(np.radians([14.0]))
    np.testing.assert_array_equal(first.force, again.force)
    batch.reset()
    fresh = ChainBatch(beam.prepare(body(beam.robot)), [[wall(friction=0.5)]])
    np.testing.assert_array_equal(batch.close(np.radians([2.0])).tip, fresh.close(np.radians([2.0])).tip)


def test_rows_inside_an_obstacle_are_not_found(beam):
    batch = ChainBatch(beam.prepare(np.repeat(body(beam.robot), 2, axis=0)), [[wall(0.030)], [wall(0.050)]])
    assert batch.states.found.tolist() == [False, True]


def test_sphere_presses_on_the_middle_only(beam):
    prepared = beam.prepare(body(beam.robot), rows=11)
    batch = ChainBatch(prepared, [[Sphere((0.065, 0.06, 0.0), 0.02)]])
    for degrees in range(1, 16):
        states = batch.close(np.radians([degrees]))
    touch = batch.touching()
    pressed = np.abs(touch.points[0, touch.pressing[0, 0] > 0.0, 2])
    assert states.force[0, 0, 0] < 0.0
    assert pressed.max() < 0.008


def test_training_sees_the_same_compliance_as_the_solver(robot):
    torch = pytest.importorskip("torch")
    from softgym_envs.extensions.grasping.chain.torch import ChainNet, Frame

    torch.manual_seed(0)
    design = body(robot, d2=0.012, d7=0.026)
    chain = FingerChain(robot, rows=1)
    bodies = chain.bodies(design)
    net = ChainNet({kind: x.shape[-1] for kind, x in bodies.features.items()}, 5)
    with torch.no_grad():
        for kind in KINDS:
            net.get_submodule(kind)[2].weight *= 10.0
        found = [part.numpy() for part in net.frame_response(Frame.of_bodies(chain, bodies))]
    tensors = {name: value.detach().numpy()[None] for name, value in net.named_parameters()}
    model = ChainModel(robot, tensors | {"depth": np.zeros(15)}, {})
    expected = model.markers(design, np.zeros(1))
    for one, other in zip(found, (expected.held, expected.jacobian, expected.torsion), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10 * np.abs(other).max())


def test_weights_on_disk(robot, tmp_path):
    tensors = untrained(robot, lambda shape: np.random.default_rng(0).normal(size=shape))
    card = {"domain": {"design": {"e1": [0.004, 0.015]}, "limit": 10.0}}
    model = ChainModel(robot, tensors, card)
    save_chain(ChainModel(robot, {name: value for name, value in tensors.items() if name != "depth"}, card), tmp_path)
    with pytest.raises(WeightsError, match="do not fit network 'chain': depth"):
        load_chain(robot, tmp_path)
    save_chain(model, tmp_path)
    again = load_chain(robot, tmp_path)
    designs = np.concatenate([body(robot), body(robot, e1=0.002)])
    np.testing.assert_allclose(again.prepare(designs).stiffness, model.prepare(designs).stiffness, rtol=1e-4)
    assert again.prepare(designs).known.tolist() == [True, False]
    with pytest.raises(WeightsError, match="trained for another robot"):
        load_chain(make_robot("contact_aided_finger", mesh="published"), tmp_path)
    with pytest.raises(ValueError, match="not for 'diamond'"):
        FingerChain(make_robot("diamond"))


def test_closings_are_kept_for_bodies_and_seed(robot, tmp_path, monkeypatch):
    made = []

    def close(robot, bodies, seed):
        made.append(seed)
        count = len(bodies)
        return Closings(
            np.pad(bodies, ((0, 0), (0, 3))),
            *(np.full((count, 2, *rest), float(seed)) for rest in ((2,), (2,), (), ())),
        )

    monkeypatch.setattr(closings, "close_bodies", close)
    path = tmp_path / "closings.npz"
    bodies = np.concatenate([body(robot), body(robot, e1=0.012)])
    first = closings.kept_closings(path, robot, bodies, 1)
    again = closings.kept_closings(path, robot, bodies, 1)
    assert made == [1] and all(np.array_equal(*pair) for pair in zip(first, again, strict=True))
    assert closings.kept_closings(path, robot, bodies, 2).torque[0, 0] == 2.0  # other objects are drawn
    closings.kept_closings(path, robot, bodies[:1], 2)
    assert made == [1, 2, 2]
    path.write_bytes(path.read_bytes()[:100])
    closings.kept_closings(path, robot, bodies[:1], 2)
    assert made == [1, 2, 2, 2]


def test_stiffness_is_positive_definite_for_all_weights(robot):
    tensors = untrained(robot, lambda shape: np.random.default_rng(3).normal(size=shape))
    rng = np.random.default_rng(4)
    space = robot.design_space
    designs = np.array([[rng.uniform(v.low, v.high) for v in space] for _ in range(50)])
    prepared = ChainModel(robot, tensors, {}).prepare(designs)
    assert (np.linalg.eigvalsh(prepared.stiffness) > 0.0).all()


def test_shipped_weights(robot):
    model = load_chain(robot)
    prepared = model.prepare(np.concatenate([body(robot), body(robot, e3=0.001)]))
    assert not prepared.known[1]
    assert model.card["test"]["held_median"] < 0.01
    assert model.card["test"]["contact_force_median"] < 0.03
    batch = ChainBatch(model.prepare(body(robot)), [[wall(0.055, 0.5)]])
    for degrees in range(2, 21, 2):
        states = batch.close(np.radians([degrees]))
    W, stable = batch.compliance()
    assert states.found[0]
    assert states.force[0, 0, 0] < 0.0 < states.gap[0]
    assert stable[0]
    assert np.linalg.eigvalsh(0.5 * (W[0] + W[0].T))[0] > 0.0


def test_the_verbs_of_surrogates_know_the_configuration_of_the_chain(softgym, tmp_path):
    sizes = [f"data.{split}.groups=1" for split in ("train", "validation", "test")]
    mesh = "robot_options={mesh_size: 0.02, element: linear}"
    status, out, _ = softgym(
        "dataset", "--config", "contact_aided_finger", "--folder", tmp_path, *sizes, mesh, "workers=1"
    )
    assert status == 0
    assert out.splitlines() == [f"{split}: 1 state of 1 design" for split in ("train", "validation", "test")]
    status, _, err = softgym("fit", "--config", "contact_aided_finger", "--folder", tmp_path, "robot=finger")
    assert status == 2 and "robot: must be 'softgym_envs.extensions.grasping.chain.data:MarkedFinger'" in err

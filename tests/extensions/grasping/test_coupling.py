"""Coupled models: against the full saddle system, against rotated meshes, and against coupled equilibria."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.extensions.grasping.control.coupling import HeldObject, couple, rotate, tie_points
from softgym_envs.mechanics.condensation import CondensedModel
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.testing import random_condensed_model

TURN = np.diag([-1.0, -1.0, 1.0])  # half a turn about z
SHIFT = np.array([0.0, 0.08, 0.0])


def cube(models, rng=None, **options):
    contacts = np.concatenate([model.delta.c for model in models]).reshape(-1, 3)
    if rng is not None:
        contacts = contacts + 1e-4 * rng.standard_normal(contacts.shape)
    return HeldObject.around(contacts.mean(axis=0) + [0.001, 0.002, -0.001], contacts, **options)


# -- dense linear examples ------------------------------------------------------------------------------------------


def test_two_tied_points_follow_the_written_out_system(rng):
    """Minimise the complementary energy under the tie: one linear system, solved whole."""
    first, second = random_condensed_model(rng), random_condensed_model(rng, actuators=3)
    gap = np.array([0.0, 0.04, 0.001])
    C = tie_points([first, second], (0, "e", 0), (1, "e", 0))
    coupled = couple([first, second], C, gap)
    assert coupled.condensed.roles == (("a", 5), ("e", 3))
    effort = rng.uniform(0.0, 5.0, 5)
    # delta_e2 - delta_e1 = gap for the force m on the second tip, -m on the first.
    a1, a2 = effort[:2], effort[2:]
    m = np.linalg.solve(
        first.W.ee + second.W.ee,
        gap - (second.W.ea @ a2 + second.delta_free.e) + (first.W.ea @ a1 + first.delta_free.e),
    )
    tip = first.W.ea @ a1 - first.W.ee @ m + first.delta_free.e
    other = second.W.ea @ a2 + second.W.ee @ m + second.delta_free.e
    np.testing.assert_allclose(other - tip, gap, atol=1e-15)
    found = coupled.condensed.compliance[:, :5] @ effort + coupled.condensed.free
    np.testing.assert_allclose(found[5:], tip, atol=1e-14)
    np.testing.assert_allclose(found[:2], first.W.aa @ a1 - first.W.ae @ m + first.delta_free.a, atol=1e-14)
    np.testing.assert_allclose(found[2:5], second.W.aa @ a2 + second.W.ae @ m + second.delta_free.a, atol=1e-14)
    parts = coupled.efforts(effort)
    np.testing.assert_allclose(parts[0], np.concatenate([a1, -m]), rtol=1e-10)
    np.testing.assert_allclose(parts[1], np.concatenate([a2, m]), rtol=1e-10)
    np.testing.assert_allclose(coupled.condensed.lambda_.a, np.concatenate([first.lambda_.a, second.lambda_.a]))


@pytest.mark.parametrize("free", [(True,) * 6, (True, True, True, False, False, False), (False, True) + (False,) * 4])
def test_a_held_object_follows_the_written_out_system(rng, free):
    """Ties, balance of the object and guided motions, checked one by one, under random efforts and load."""
    models = [
        random_condensed_model(rng, contacts=9),
        random_condensed_model(rng, actuators=1, effectors=6, contacts=9),
        random_condensed_model(rng, actuators=3, contacts=6),
    ]
    load = np.array([0.1, -0.3, 0.2, 1e-3, -2e-3, 1e-3])
    body = cube(models, rng, load=load, free=free)
    coupled = couple(models, body=body, orientation=True)
    assert coupled.condensed.roles == (("a", 6), ("e", 6))
    effort = rng.uniform(0.0, 5.0, 6)
    parts, motion = coupled.efforts(effort), coupled.motion(effort)
    forces, contacts, shortening = [], [], []
    for model, every in zip(models, parts, strict=True):
        at, delta = model.slices, model.compliance @ every + model.free
        forces.append(every[at["c"]])
        contacts.append(delta[at["c"]])
        shortening.append(delta[at["a"]])
        np.testing.assert_array_equal(every[at["e"]], 0.0)
    forces = np.concatenate(forces)
    J = body.jacobian
    np.testing.assert_allclose(np.concatenate(contacts), body.contacts.ravel() + J @ motion, atol=1e-13)
    present = np.concatenate([model.lambda_.c for model in models])
    balance = J.T @ forces + body.stiffness(present) @ motion - load
    moving = np.array(free)
    np.testing.assert_allclose(balance[moving], 0.0, atol=1e-12)
    np.testing.assert_array_equal(motion[~moving], 0.0)
    found = coupled.condensed.compliance[:, :6] @ effort + coupled.condensed.free
    np.testing.assert_allclose(found[:6], np.concatenate(shortening), atol=1e-13)
    np.testing.assert_allclose(found[6:], np.concatenate([body.position, np.zeros(3)]) + motion, atol=1e-13)
    assert coupled.dropped == 0


def test_W_is_symmetric_and_its_object_rows_answer_loads(rng):
    models = [random_condensed_model(rng, contacts=9), random_condensed_model(rng, contacts=9)]
    body = cube(models)
    coupled = couple(models, body=body, orientation=True, effectors=[1])
    assert coupled.condensed.roles == (("a", 4), ("e", 9))
    W = coupled.condensed.compliance
    np.testing.assert_array_equal(W, W.T)
    effort = coupled.condensed.lambda_.a
    for i in range(6):
        pushed = couple(models, body=HeldObject(body.position, body.points, load=np.eye(6)[i]), orientation=True)
        response = pushed.condensed.delta.array - couple(models, body=body, orientation=True).condensed.delta.array
        np.testing.assert_allclose(response, W[:10, 4 + i], atol=1e-13)
    assert np.isfinite(coupled.efforts(effort)[0]).all()


def test_forces_on_rows_that_are_not_tied_are_kept(rng):
    first, second = random_condensed_model(rng), random_condensed_model(rng, effectors=6)
    second.effort[5:] = [0.1, 0.2, 0.3]  # a load on the second point
    C = tie_points([first, second], (0, "e", 0), (1, "e", 0))
    parts = couple([first, second], C, np.zeros(3)).efforts(np.ones(4))
    np.testing.assert_array_equal(parts[1][5:], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(parts[1][2:5], -parts[0][2:5])


def test_redundant_ties_change_nothing(rng):
    """The same tie three times: two directions of each coordinate are dropped, and the answer is that of one."""
    models = [random_condensed_model(rng), random_condensed_model(rng)]
    C, gap = tie_points(models, (0, "e", 0), (1, "e", 0)), np.array([0.0, 0.04, 0.0])
    once = couple(models, C, gap)
    thrice = couple(models, np.concatenate([C, 2.0 * C, C]), np.concatenate([gap, 2.0 * gap, gap]))
    assert (once.dropped, thrice.dropped) == (0, 6)
    np.testing.assert_allclose(thrice.condensed.compliance, once.condensed.compliance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(thrice.condensed.free, once.condensed.free, atol=1e-13)
    effort = np.ones(4)
    np.testing.assert_allclose(thrice.efforts(effort)[0], once.efforts(effort)[0], atol=1e-9)
    with pytest.raises(ValueError, match="redundant ties contradict"):
        couple(models, np.concatenate([C, C]), np.concatenate([gap, gap + 1e-3]))


@pytest.mark.parametrize("softness", [1e-4, 1e-8, 1e-12, 0.0])
def test_nearly_rigid_contact_triads_are_safe(rng, softness):
    """Three points that a part carries almost rigidly: W_cc has six modes, and three of ``softness`` times that.

    The limit is known: the part moves as one with the object.
    """
    models, bodies = [], []
    for _ in range(2):
        points = rng.standard_normal((3, 3)) * 0.002 + [0.0, 0.02, -0.1]
        frame = HeldObject.around(points.mean(axis=0), points)
        rigid = random_condensed_model(
            rng, actuators=2, effectors=0, contacts=6
        )  # its c rows: motion of a frame that carries the points
        scale = np.diag([1, 1, 1, 50.0, 50.0, 50.0])
        H = np.zeros((11, 8))
        H[:2, :2], H[2:, 2:] = np.eye(2), frame.jacobian @ scale
        strain = np.zeros((11, 11))
        half = rng.standard_normal((9, 9))
        strain[2:, 2:] = 1e-3 * softness * (half @ half.T + np.eye(9))
        free = np.concatenate([1e-3 * rng.standard_normal(2), points.ravel()])
        models.append(CondensedModel(H @ rigid.compliance @ H.T + strain, free, np.zeros(11), (("a", 2), ("c", 9))))
        bodies.append((H, rigid.compliance))
    body = HeldObject.around(np.array([0.0, 0.035, -0.095]), np.concatenate([m.delta_free.c for m in models]))
    coupled = couple(models, body=body, orientation=True)
    # The limit: both frames tied to the object by all six of their degrees of freedom.
    actuators, ties = np.zeros((16, 16)), np.zeros((12, 16))
    J = np.zeros((12, 6))
    for k, (H, W) in enumerate(bodies):
        actuators[8 * k : 8 * k + 8, 8 * k : 8 * k + 8] = W
        ties[6 * k : 6 * k + 6, 8 * k + 2 : 8 * k + 8] = np.eye(6)
        J[6 * k : 6 * k + 6] = np.linalg.lstsq(H[2:, 2:], body.jacobian[9 * k : 9 * k + 9], rcond=None)[0]
    G = ties @ actuators @ ties.T
    saddle = np.block([[G, -J], [-J.T, np.zeros((6, 6))]])
    rows = [0, 1, 8, 9]
    right = np.concatenate([-ties @ actuators[:, rows], np.zeros((6, 4))])
    limit = np.linalg.solve(saddle, right)[12:]
    found = coupled.condensed.W.ea
    error = np.abs(found - limit).max() / np.abs(limit).max()
    print(f"softness {softness:g}: condition {coupled.condition:.1e}, dropped {coupled.dropped}, error {error:.1e}")
    assert error < max(1e3 * softness, 1e-6)
    assert np.linalg.eigvalsh(coupled.condensed.compliance)[0] > -1e-12
    assert np.abs(np.concatenate(coupled.efforts(np.ones(4)))).max() < 1e3


@pytest.mark.parametrize("units", [1e3, 1e-3])
def test_the_answer_does_not_depend_on_units(rng, units):
    """Metres to millimetres and back, newtons kept: displacements scale, forces do not."""
    models = [random_condensed_model(rng, contacts=9), random_condensed_model(rng, contacts=9)]
    body = cube(models)
    scaled = [CondensedModel(units * m.compliance, units * m.free, m.effort, m.roles) for m in models]
    big = HeldObject(units * body.position, units * body.points)
    one, other = couple(models, body=body), couple(scaled, body=big)
    np.testing.assert_allclose(other.condensed.compliance, units * one.condensed.compliance, rtol=1e-8)
    np.testing.assert_allclose(other.efforts(np.ones(4))[0], one.efforts(np.ones(4))[0], rtol=1e-8)


# -- clear errors ---------------------------------------------------------------------------------------------------


def test_malformed_couplings_are_rejected(rng):
    models = [random_condensed_model(rng, contacts=3), random_condensed_model(rng, contacts=3)]
    C = tie_points(models, (0, "e", 0), (1, "e", 0))
    contacts = rng.standard_normal((2, 3))
    for expected, arguments, options in [
        ("nothing to couple", [models], {}),
        ("at least one model", [[]], {}),
        ("must be finite, of shapes", [models, C, np.zeros(2)], {}),
        ("must be finite, of shapes", [models, C, np.full(3, np.nan)], {}),
        ("actuator rows cannot be tied", [models, np.eye(16)[:1]], {}),
        ("1 points, but the parts have 6", [models], {"body": HeldObject.around(np.zeros(3), contacts[:1])}),
        # Two points leave a turn about their line.
        ("it can move freely", [models], {"body": HeldObject.around(np.zeros(3), contacts)}),
    ]:
        with pytest.raises(ValueError, match=expected):
            couple(*arguments, **options)
    for index in (1, -1):
        with pytest.raises(ValueError, match="has no point"):
            tie_points(models, (0, "e", index), (1, "e", 0))
    broken = CondensedModel(models[0].compliance, models[0].free * np.nan, models[0].effort, models[0].roles)
    with pytest.raises(ValueError, match="not finite"):
        couple([broken, models[1]], C)
    rigid = [CondensedModel(np.zeros((8, 8)), m.free, m.effort, m.roles) for m in models]
    with pytest.raises(ValueError, match="no compliance"):
        couple(rigid, C)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"position": [0.0, 0.0]}, "position of a rigid body must have shape"),
        ({"points": np.zeros((0, 3))}, "points of a rigid body must have shape"),
        ({"load": np.full(6, np.nan)}, "load of a rigid body must be finite"),
        ({"free": (False,) * 6}, "free must be six flags"),
    ],
    ids=str,
)
def test_malformed_bodies_are_rejected(options, expected):
    with pytest.raises(ValueError, match=expected):
        HeldObject(**{"position": np.zeros(3), "points": np.eye(3), **options})


# -- rotated robots -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def contact_finger():
    """A two-cable finger with three contact points, its statics and its mesh."""
    robot = make_robot("finger", contacts=True, unilateral=False)
    model = robot.build()
    return robot, model, Statics(model, tolerance=1e-12)


def test_contacts_are_an_option_that_changes_nothing_else(contact_finger):
    robot, model, _ = contact_finger
    plain = make_robot("finger", unilateral=False)
    assert robot.learning.weights == plain.learning.weights
    assert robot.mechanics_key == {**plain.mechanics_key, "contacts": True}
    assert model.roles == (("a", 2), ("e", 3), ("c", 9))
    assert [c.name for c in model.constraints["c"]] == ["contact_1", "contact_2", "contact_3"]
    points = np.array([c.value(model.nodes) for c in model.constraints["c"]])
    np.testing.assert_allclose(points.mean(axis=0), [0.0, 0.020, -0.1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - points.mean(axis=0), axis=1), 0.002)
    command = np.array([0.008, 0.005])
    one = Statics(model).solve(command).condensed
    two = Statics(plain.build()).solve(command).condensed
    np.testing.assert_allclose(one.compliance[:5, :5], two.compliance, rtol=1e-9)
    moved = robot.build({"length": 0.041, "height": 0.0215, "joint_height": 0.0055})
    centre = np.mean([c.value(moved.nodes) for c in moved.constraints["c"]], axis=0)
    np.testing.assert_allclose(centre, [0.0, 0.0215, -0.1025], atol=1e-12)


def test_rotate_is_the_model_of_the_rotated_mesh(contact_finger):
    robot, model, statics = contact_finger
    R, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.03, -0.02, 0.1])
    design = robot.design_space.baseline
    turned = MechanicalModel.from_mesh(
        model.nodes @ R.T + shift,
        model.blocks[0].connectivity,
        fixed=model.fixed,
        material=robot.material,
        young_modulus=design["young_modulus"],
        poisson_ratio=design["poisson_ratio"],
        element="linear",
    )
    for cable in model.constraints["a"]:
        turned.add_cable(
            cable.name, cable.embedding.points @ R.T + shift, cable.pull_point @ R.T + shift, unilateral=False
        )
    turned.add_effector("tip", model.constraints["e"][0].embedding.points[0] @ R.T + shift)
    for point in model.constraints["c"]:
        turned.add("c", type(point)(point.name, turned.embed(point.embedding.points @ R.T + shift)))
    command, force = np.array([0.009, 0.004]), np.array([0.02, -0.1, 0.05] * 3)
    statics.reset()
    here = statics.solve(command, contact=force).condensed
    there = Statics(turned, tolerance=1e-12).solve(command, contact=np.kron(np.eye(3), R) @ force).condensed
    found = rotate(here, R, shift)
    np.testing.assert_allclose(found.delta.array, there.delta.array, atol=1e-10)
    np.testing.assert_allclose(found.effort, there.effort, atol=1e-6)
    scale = np.abs(there.compliance).max()
    error = np.abs(found.compliance - there.compliance).max() / scale
    print(f"largest difference of W: {error:.1e} of its largest entry")
    assert error < 1e-8
    np.testing.assert_allclose(found.free, there.free, atol=1e-8)


def test_rotate_keeps_batches_and_rejects_invalid_input(rng):
    model = random_condensed_model(rng, contacts=3)
    R = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    batch = CondensedModel(*(np.stack([v, v]) for v in (model.compliance, model.free, model.effort)), model.roles)
    one, two = rotate(model, R, SHIFT), rotate(batch, R, SHIFT)
    np.testing.assert_allclose(two.compliance[1], one.compliance, rtol=1e-14)
    np.testing.assert_allclose(two.free[1], one.free, rtol=1e-14)
    np.testing.assert_allclose(rotate(one, R.T, -R.T @ SHIFT).compliance, model.compliance, atol=1e-16)
    for R_bad, shift in [(np.ones((3, 3)), SHIFT), (np.full((3, 3), np.nan), SHIFT), (np.eye(2), SHIFT)]:
        with pytest.raises(ValueError, match="orthogonal"):
            rotate(model, R_bad, shift)
    with pytest.raises(ValueError, match="three finite numbers"):
        rotate(model, R, [0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match="not a multiple of three"):
        rotate(model, R, points="a")


# -- fingers tied by Newton's method --------------------------------------------------------------------------------


def drive(finger, place, command, contacts, mode):
    """Condensed model, in world axes, of a rotated finger, its contact rows driven to world points (k, 3)."""
    R, shift = place
    local = (contacts.reshape(-1, 3) - shift) @ R
    part = finger.solve(command, mode, contact=local.ravel(), contact_mode="displacement")
    return rotate(part.condensed, R, shift)


class Pinch:
    """Two fingers, tips tied: the second is the first turned by half a turn about z and moved by 80 mm along y."""

    places = ((np.eye(3), np.zeros(3)), (TURN, SHIFT))

    def __init__(self, model):
        self.fingers = [Statics(model, tolerance=1e-12) for _ in self.places]
        tip = model.constraints["c"][0].value(model.nodes)
        self.tip = tip
        self.gap = TURN @ tip + SHIFT - tip

    def settle(self, command, mode="displacement"):
        """Coupled equilibrium: tips are driven along the tie until the forces on them balance."""
        for iteration in range(20):
            tips = [self.tip, self.tip + self.gap]
            models = [
                drive(self.fingers[k], self.places[k], command[2 * k : 2 * k + 2], tips[k], mode) for k in range(2)
            ]
            unbalanced = np.abs(models[0].lambda_.c + models[1].lambda_.c).max()
            coupled = couple(models, tie_points(models, (0, "c", 0), (1, "c", 0)), self.gap)
            if unbalanced < 1e-8:
                return coupled, iteration
            part = coupled.condensed
            effort = command if mode == "effort" else np.linalg.solve(part.W.aa, command - part.delta_free.a)
            every = coupled.efforts(effort)[0]
            self.tip = (models[0].compliance @ every + models[0].free)[models[0].slices["c"]]
        raise AssertionError(f"forces are still {unbalanced} N out of balance")


def test_pinch_W_is_the_derivative_of_the_coupled_equilibrium():
    """The tie of the thesis (offset 40 mm), found by Newton's method on the parts, then finite differences."""
    model = make_robot("finger", unilateral=False).build()
    # The tip as a contact point too, so that the tie can drive it.
    model.add("c", model.constraints["e"][0])
    pinch = Pinch(model)
    rest = pinch.gap
    command = np.array([0.010, 0.009, 0.007, 0.0085])
    for level in np.linspace(0.125, 1.0, 8):  # the tips are drawn together as the cables are pulled
        pinch.gap = rest - level * np.array([0.0, 0.02, 0.0])
        coupled, iterations = pinch.settle(level * command)
    np.testing.assert_allclose(pinch.gap, [0.0, 0.04, 0.0], atol=1e-12)
    effort = coupled.condensed.lambda_.a
    force = coupled.efforts(effort)[1][5:]
    print(f"{iterations} iterations, force in the bar {np.round(force, 3)} N, condition {coupled.condition:.1f}")
    h, columns = 0.02, []
    for i in range(4):
        ends = []
        for sign in (1, -1):
            end = pinch.settle(effort + sign * h * np.eye(4)[i], "effort")[0]
            ends.append(np.append(end.condensed.delta.a, pinch.tip))
        columns.append((ends[0] - ends[1]) / (2 * h))
    difference = np.array(columns).T
    W = coupled.condensed.compliance[:, :4]
    error = np.abs(W - difference).max() / np.abs(W).max()
    print(f"W against finite differences: {error:.1e} of its largest entry")
    assert error < 1e-5


class Grip:
    """Fingers around a cube, each with its contact points driven along with the cube until that is balanced."""

    places = ((np.eye(3), np.zeros(3)), (TURN, np.array([0.03, 0.07, 0.0])), (TURN, np.array([-0.03, 0.07, 0.0])))

    def __init__(self, model, body, count=3):
        self.places = self.places[:count]
        self.fingers = [Statics(model, tolerance=1e-12) for _ in self.places]
        self.body = body

    def settle(self, command, mode="displacement"):
        for iteration in range(20):
            contacts = self.body.contacts.reshape(-1, 9)
            models = [
                drive(finger, place, command[2 * k : 2 * k + 2], contacts[k], mode)
                for k, (finger, place) in enumerate(zip(self.fingers, self.places, strict=True))
            ]
            forces = np.concatenate([m.lambda_.c for m in models])
            unbalanced = np.abs(self.body.jacobian.T @ forces - self.body.load)[np.array(self.body.free)].max()
            coupled = couple(models, body=self.body, orientation=True)
            if unbalanced < 1e-8:
                return coupled, iteration
            part = coupled.condensed
            effort = command if mode == "effort" else np.linalg.solve(part.W.aa, command - part.delta_free.a)
            self.body = self.body.moved(coupled.motion(effort))
        raise AssertionError(f"forces are still {unbalanced} N out of balance")


def gripper(model, **options):
    """Three fingers of the thesis (sec. 4.3.2) and its cube, at rest."""
    rest = np.array([point.value(model.nodes) for point in model.constraints["c"]])
    contacts = np.concatenate([rest @ R.T + shift for R, shift in Grip.places])
    return HeldObject.around(np.array([0.0, 0.035, -0.095]), contacts, **options)


def test_gripper_W_is_the_derivative_of_the_coupled_equilibrium(contact_finger):
    """Three fingers and a free cube: W of actuators, centre and orientation, with the cube clearly rotated."""
    model = contact_finger[1]
    grip = Grip(model, gripper(model, load=np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0])))
    command = np.array([0.004, 0.001, 0.003, 0.000, 0.001, 0.005])
    for level in np.linspace(0.25, 1.0, 4):
        coupled, iterations = grip.settle(level * command)
    effort = coupled.condensed.lambda_.a
    turn = Rotation.from_matrix(grip.body.rotation).magnitude()
    print(
        f"{iterations} iterations, condition {coupled.condition:.1e}, cube moved by "
        f"{np.round(1e3 * (grip.body.position - [0, 0.035, -0.095]), 3)} mm and {np.degrees(turn):.2f} degrees, "
        f"largest contact force {max(np.abs(p[5:]).max() for p in coupled.efforts(effort)):.2f} N"
    )
    here, h, columns = grip.body, 0.02, []
    for i in range(6):
        ends = []
        for sign in (1, -1):
            end, _ = grip.settle(effort + sign * h * np.eye(6)[i], "effort")
            moved = Rotation.from_matrix(grip.body.rotation @ here.rotation.T).as_rotvec()
            ends.append(np.concatenate([end.condensed.delta.a, grip.body.position, moved]))
        columns.append((ends[0] - ends[1]) / (2 * h))
    difference = np.array(columns).T
    W = coupled.condensed.compliance[:, :6]
    for rows, name in ((slice(0, 9), "lengths"), (slice(9, 12), "rotation")):
        error = np.abs(W[rows] - difference[rows]).max() / np.abs(W[rows]).max()
        print(f"{name}: W against finite differences {error:.1e} of its largest entry")
        assert error < 1e-5

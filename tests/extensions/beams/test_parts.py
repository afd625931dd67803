"""Learned parts: derivatives, scale laws, symmetry, held legs, and the Tetrapod that consists of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softgym_envs import make_robot
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.beams.elements import PoseParts
from softgym_envs.extensions.beams.parts.backends import PartsBackend
from softgym_envs.extensions.beams.parts.energy import LegFunction
from softgym_envs.extensions.beams.parts.leg import VARIABLES, LegScale
from softgym_envs.extensions.beams.parts.weights import LearnedLeg
from softgym_envs.extensions.fitting.parts.held_leg import HeldLeg
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.domain import SOFT

SHAPE = np.array([0.05, 0.025, 0.3, -0.5, 0.6])


def poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    place = np.array([0.5, 0.0, -0.5]) + 0.1 * rng.standard_normal((count, 3))
    bend = Rotation.from_rotvec([0.0, 1.4, 0.0])
    turn = (bend * Rotation.from_rotvec(0.2 * rng.standard_normal((count, 3)))).as_matrix()
    return np.concatenate([place, turn.reshape(-1, 9), rng.standard_normal((count, 3))], axis=1)


@pytest.fixture(scope="module")
def function() -> LegFunction:
    import torch

    from softgym_envs.extensions.fitting.parts.network import LegNetwork

    torch.manual_seed(0)
    net = LegNetwork(16, 3)
    torch.nn.init.normal_(net.head.weight, std=0.3)
    return LegFunction({name: value.numpy() for name, value in net.state_dict().items()}, SHAPE)


def test_derivatives_are_those_of_differences(function):
    y, h = poses(3), 1e-5
    _, gradient, hessian = function.evaluate(y)
    for k in range(15):
        step = h * np.eye(15)[k]
        above, below = function.evaluate(y + step, second=False), function.evaluate(y - step, second=False)
        assert gradient[:, k] == pytest.approx((above[0] - below[0]) / (2.0 * h), abs=1e-6)
        assert hessian[:, k] == pytest.approx((above[1] - below[1]) / (2.0 * h), rel=1e-6, abs=1e-5)


def test_torch_and_numpy_agree(function):
    import torch

    from softgym_envs.extensions.fitting.parts.network import ErrorNetwork, LegNetwork

    torch.manual_seed(0)
    net = LegNetwork(16, 3)
    torch.nn.init.normal_(net.head.weight, std=0.3)
    y = torch.tensor(poses(4), requires_grad=True)
    energy = net.double()(y, torch.tensor(SHAPE).expand(4, 5))
    (slope,) = torch.autograd.grad(energy.sum(), y)
    value, gradient, _ = function.evaluate(y.detach().numpy(), second=False)
    assert value == pytest.approx(energy.detach().numpy(), abs=1e-12)
    assert gradient == pytest.approx(slope.numpy(), abs=1e-11)
    bound = ErrorNetwork(8).double()
    tensors = net.state_dict() | {f"errors.{name}": value for name, value in bound.state_dict().items()}
    expected = bound(y, torch.tensor(SHAPE).expand(4, 5)).exp().detach().numpy()
    arrays = {name: value.numpy() for name, value in tensors.items()}
    assert LegFunction(arrays, SHAPE).errors(poses(4)) == pytest.approx(expected, rel=1e-12)
    on_tensors = LegFunction(tensors, torch.tensor(SHAPE)).errors(torch.tensor(poses(4)))
    assert on_tensors.numpy() == pytest.approx(expected, rel=1e-12)


def test_the_mirror_image_has_the_same_energy(function):
    y = poses(5)
    mirror = np.array([1.0, -1.0, 1.0])
    image = y.copy()
    image[:, :3] *= mirror
    image[:, 3:12] = (mirror[:, None] * y[:, 3:12].reshape(-1, 3, 3) * mirror).reshape(-1, 9)
    image[:, 12:] *= mirror
    assert function.evaluate(image)[0] == pytest.approx(function.evaluate(y)[0], abs=1e-13)


@pytest.fixture(scope="module")
def held() -> tuple[HeldLeg, np.ndarray]:
    straight = np.array([0.05, 0.025, 0.0, 0.0, 0.0])
    turn = Rotation.from_rotvec([0.05, np.pi / 2, 0.1]).as_matrix()
    y = np.concatenate([[0.6, 0.03, -0.6], turn.ravel(), [0.5, 0.1, -0.4]])
    return HeldLeg(straight, 12), y


def follow(leg: HeldLeg, y: np.ndarray):
    return leg.follow(np.vstack([y[:3], y[3:12].reshape(3, 3).T])[None], y[None, 12:])


def test_held_legs_have_the_forces_of_their_energy(held):
    leg, y = held
    state = follow(leg, y)
    assert state.negative[0] == 0
    for k in [0, 1, 2, 12, 13, 14]:
        step = 1e-5 * np.eye(15)[k]
        slope = (follow(leg, y + step).energy[0] - follow(leg, y - step).energy[0]) / 2e-5
        expected = state.wrench[0, k] if k < 3 else -state.middle[0, k - 12]
        assert slope == pytest.approx(expected, abs=1e-6)


def test_the_compliance_of_a_held_leg_is_the_derivative_of_its_wrench(held):
    leg, y = held
    stiffness = np.linalg.inv(follow(leg, y).compliance[0])
    for k in range(3):
        step = 1e-5 * np.eye(15)[k]
        change = (follow(leg, y + step).wrench[0] - follow(leg, y - step).wrench[0]) / 2e-5
        assert change[:3] == pytest.approx(stiffness[:3, k], rel=1e-4, abs=1e-3)


def test_a_leg_bent_to_an_arc_carries_the_moment_of_its_curvature_alone():
    leg, targets = HeldLeg(np.array([0.02, 0.01, 0.0, 0.0, 0.0]), 24), []
    for angle in np.linspace(0.1, np.pi / 2, 16):
        place = np.array([np.sin(angle), 0.0, np.cos(angle) - 1.0]) / angle
        targets.append(np.vstack([place, Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix().T]))
    state = leg.follow(np.array(targets), np.zeros((16, 3)))
    assert state.wrench[-1] == pytest.approx([0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0], abs=2e-2)
    assert state.energy[-1] == pytest.approx(np.pi**2 / 8, rel=1e-3)


def test_scale_laws_are_exact():
    """Legs of other lengths and moduli are the same without dimensions: one wrench of finite elements gives both."""
    design = dict(zip(VARIABLES, (0.2, 0.01, 0.005, 2.0, -1.0, 3.0, 3e7), strict=True))
    double = {**design, "leg_length": 0.4, "leg_width": 0.02, "leg_thickness": 0.01, "young_modulus": 6e7}
    double |= {name: 0.5 * design[name] for name in VARIABLES if name.startswith("curvature")}
    one, two = LegScale.of(design), LegScale.of(double)
    assert two.shape == pytest.approx(one.shape)
    assert two.energy == pytest.approx(16.0 * one.energy)
    assert two.weight == pytest.approx(one.weight)  # rho g L^3 grows eightfold, E t^2 as well
    assert two.mass == pytest.approx(8.0 * one.mass)


@pytest.fixture(scope="module")
def tetrapod():
    return make_robot("tetrapod", mesh="accurate")


@pytest.fixture(scope="module")
def learned(tetrapod):
    return tetrapod.of_parts({"leg": LearnedLeg()})


def moved(statics: Statics, command: np.ndarray):
    for share in np.linspace(0.0, 1.0, 9)[1:]:
        found = statics.solve(share * command)
    return found


def test_forces_and_tangents_of_parts_are_those_of_differences(learned):
    model = learned.build()
    (parts,) = (block for block in model.blocks if isinstance(block, PoseParts))
    rng = np.random.default_rng(1)
    x = model.nodes + 1e-3 * rng.standard_normal(model.nodes.shape)
    rows = parts.nodes_used
    gradient = np.zeros_like(x)
    ((low, high),) = parts.stencils()
    size = x.size
    values = np.zeros(size * size)
    scatter = (low * size + high).astype(np.int64)
    parts.add(x, gradient, values, [scatter])
    tangent = values.reshape(size, size)
    tangent = tangent + tangent.T - np.diag(np.diag(tangent))
    for direction in rng.standard_normal((3, *x[rows].shape)):
        step = np.zeros_like(x)
        step[rows] = 1e-6 * direction
        above, below = np.zeros_like(x), np.zeros_like(x)
        change = parts.add(x + step, above, None, None)[0] - parts.add(x - step, below, None, None)[0]
        assert change / 2e-6 == pytest.approx(np.vdot(gradient, step) * 1e6, rel=1e-5)
        found = (tangent @ step.ravel()).reshape(x.shape) * 1e6
        assert (above - below) / 2e-6 == pytest.approx(found, rel=1e-4, abs=1e-4 * np.abs(found).max())


def test_the_stiffness_of_tips_is_the_derivative_of_their_wrenches(learned):
    model = learned.build()
    (parts,) = (block for block in model.blocks if isinstance(block, PoseParts))
    y = parts.coordinates(model.nodes)
    stiffness, _ = parts.tip_stiffness(y)

    def energy(motion: np.ndarray) -> float:
        turned = Rotation.from_rotvec(motion[3:]).as_matrix() @ y[0, 3:12].reshape(3, 3)
        one = np.concatenate([y[0, :3] + motion[:3], turned.ravel(), y[0, 12:]])
        found = parts.energies(one[None])
        assert found is not None
        return float(found.value[0])

    h = 1e-4
    for i, j in [(0, 0), (0, 4), (2, 4), (3, 3), (3, 5), (4, 4), (5, 5)]:
        a, b = h * np.eye(6)[i], h * np.eye(6)[j]
        second = (energy(a + b) - energy(a - b) - energy(b - a) + energy(-a - b)) / (4.0 * h * h)
        scale = np.sqrt(abs(stiffness[0, i, i] * stiffness[0, j, j]))
        assert second == pytest.approx(stiffness[0, i, j], abs=1e-4 * scale)


def test_a_tetrapod_of_learned_legs_is_near_finite_elements(tetrapod, learned):
    command = np.array([0.4, -0.3, 0.2, -0.1])
    true, found = (moved(Statics(robot.build()), command).condensed for robot in (tetrapod, learned))
    assert found.delta.e == pytest.approx(true.delta.e, abs=3e-4)
    assert found.lambda_.a == pytest.approx(true.lambda_.a, abs=0.05 * np.abs(true.lambda_.a).max())
    assert found.W.ea == pytest.approx(true.W.ea, abs=0.1 * np.abs(true.W.ea).max())


def test_W_is_the_exact_derivative(learned):
    statics = Statics(learned.build())
    command = np.array([0.4, -0.3, 0.2, -0.1])
    W = moved(statics, command).condensed.W
    jacobian = np.linalg.solve(W.aa, W.ae).T
    for k in range(4):
        step = 1e-4 * np.eye(4)[k]
        above, below = (statics.solve(command + s).condensed.delta.e for s in (step, -step))
        assert (above - below) / 2e-4 == pytest.approx(jacobian[:, k], abs=1e-5)


def test_what_was_soft_on_its_way_is_not_trusted_until_it_rests(tetrapod):
    backend = PartsBackend(tetrapod)
    command = np.array([0.1, -0.1, 0.1, 0.0])
    assert backend.step(command).trusted
    backend.restore(replace(backend.state, distrust=SOFT))
    assert backend.probe(1.1 * command).distrust == SOFT
    assert [backend.step(share * command).distrust for share in (1.1, 1.2)] == [SOFT, SOFT]
    assert backend.reset().trusted and backend.step(command).trusted


def test_other_folders_and_parts_are_refused(tmp_path):
    with pytest.raises(WeightsError, match="does not exist; train it with 'softgym fit --config tetrapod_leg'"):
        LearnedLeg(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"x")
    (tmp_path / "model.json").write_text('{"format": 1, "part": "wing"}')
    with pytest.raises(WeightsError, match="has part = 'wing', needed 'leg'"):
        LearnedLeg(tmp_path)

"""Learned models: structure that holds by construction, shipped accuracy, damaged files."""

import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from softgym_envs import make_robot
from softgym_envs.config import load_config, shipped_configs
from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extensions.fitting.correction import fit_correction
from softgym_envs.extensions.fitting.data.dataset import load_dataset
from softgym_envs.extensions.fitting.trainer import Trainer
from softgym_envs.extensions.fitting.training import NETWORKS, FitConfig, fit, generate_datasets
from softgym_envs.extensions.hybrid import online
from softgym_envs.extensions.networks import residual
from softgym_envs.storage import hash_of
from softgym_envs.surrogate.model import Context, SurrogateModel, definite, exceeds_softening
from softgym_envs.surrogate.potential import kernels
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model
from softgym_envs.surrogate.weight_files import load_model
from tests.helpers import random_states, untrained_potential

CABLES = (1, 2)


def untrained_residual(robot, seed=0):
    """A residual model with random weights: what it guarantees must not depend on training."""
    rng = np.random.default_rng(seed)
    n = len(robot.actuators) + 3
    entries = n * (n + 1) // 2
    count = len(robot.actuators)

    def layers(prefix, sizes):
        tensors = {}
        for k, (a, b) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            tensors[f"{prefix}.{k}.weight"] = rng.normal(size=(b, a)).astype(np.float32) / np.sqrt(a)
            tensors[f"{prefix}.{k}.bias"] = rng.normal(size=b).astype(np.float32)
        return tensors

    tensors = layers("rest", (5, 16, entries + 3)) | layers("state", (count + 5, 16, 16, n * count))
    tensors |= layers("compliance", (count + 5, 16, 16, entries))
    tensors |= {"rest_mean": rng.normal(size=entries + 3), "rest_scale": np.ones(entries + 3)}
    tensors |= {"state_scale": np.ones(n * count), "compliance_scale": np.ones(entries)}
    return residual.Model(robot, tensors, {})


@pytest.mark.parametrize("cables", CABLES)
def test_residual_network_is_exact_at_rest_and_positive_definite_untrained(cables):
    robot = make_robot("finger", cables=cables)
    model = untrained_residual(robot)
    designs, displacement = random_states(robot, 500)
    context = model.context(designs)
    W = model.compliance(context, displacement)
    assert (W == np.swapaxes(W, 1, 2)).all()
    np.linalg.cholesky(W)  # raises if one is not positive definite
    zero = np.zeros_like(displacement)
    effort, effector, _ = model.state(context, zero)
    assert (effort == 0.0).all()
    assert (effector == context.arrays["effector"]).all()
    C0 = context.arrays["C0"]
    W0 = model.compliance(context, zero)
    assert np.allclose(W0 * context.stiffness[:, :, None], C0 @ np.swapaxes(C0, 1, 2), rtol=1e-6, atol=1e-6)


ROBOTS_OF_NETWORKS = ("finger", "diamond", "trunk", "press_finger", "contact_finger")


@pytest.mark.parametrize("name", ROBOTS_OF_NETWORKS)
@pytest.mark.parametrize("rest", [True, False])
def test_potential_is_a_potential_whatever_its_weights(name, rest):
    """W is symmetric, positive definite if the robot is convex, and the derivative of its own state."""
    robot = make_robot(name)
    model, _ = untrained_potential(robot, rest=rest)
    designs, displacement = random_states(robot, 200)
    context = model.context(designs)
    W = model.compliance(context, displacement)
    assert (W == np.swapaxes(W, 1, 2)).all()
    n = model.count
    scale = np.sqrt(np.abs(np.einsum("bii->bi", W)).mean(axis=0))
    least = np.linalg.eigvalsh(W / scale[:, None] / scale)[:, 0]
    assert (least > 0.0).all() if robot.learning.convex else (least < 0.0).any()
    K = np.linalg.inv(W[:, :n, :n])
    J = np.swapaxes(np.linalg.solve(W[:, :n, :n], W[:, :n, n:]), 1, 2)
    h = 2e-3 * (robot.upper - robot.lower)
    for k in range(n):
        step = np.zeros_like(displacement)
        step[:, k] = h[k]
        up, down = model.state(context, displacement + step), model.state(context, displacement - step)
        slope, motion = (up[0] - down[0]) / (2 * h[k]), (up[1] - down[1]) / (2 * h[k])
        assert np.abs(slope - K[:, :, k]).max() < 2e-3 * np.abs(K).max()
        assert np.abs(motion - J[:, :, k]).max() < 2e-3 * np.abs(J).max()
    if rest:
        assert np.abs(model.state(context, np.zeros_like(displacement))[0]).max() < 1e-5 * np.abs(up[0]).max()


@pytest.mark.parametrize("name", ROBOTS_OF_NETWORKS)
def test_compiled_potential_agrees_with_torch(name):
    robot = make_robot(name)
    model, nets = untrained_potential(robot, members=3)
    designs, displacement = random_states(robot, 20)
    context = model.context(designs)
    effort, effector, spread = model.state(context, displacement)
    W = model.compliance(context, displacement)
    p = torch.as_tensor(model.features.design(designs))
    u = torch.as_tensor(model.features.actuation(displacement))
    with torch.no_grad():
        parts = [[part.numpy() for part in net.double()(p, u)] for net in nets]
    gradient, hessian, x, jacobian, _ = (np.mean([part[k] for part in parts], axis=0) for k in range(5))
    held = np.mean([part[4] @ np.swapaxes(part[4], 1, 2) for part in parts], axis=0)
    half, stiffness = 0.5 * (robot.upper - robot.lower), context.stiffness
    expected = gradient * 2.0 / half * stiffness
    assert np.abs(effort - expected).max() < 1e-4 * np.abs(expected).max()
    assert np.abs(effector - (0.03 * x + np.linspace(-0.1, 0.1, model.effectors))).max() < 1e-6
    K, J = 2.0 * hessian / half[:, None] / half, 0.03 * jacobian / half
    W_aa = np.linalg.inv(K)
    W_ea = J @ W_aa
    n = model.count
    blocks = {(0, 0): W_aa, (1, 0): W_ea, (1, 1): 1e-3 * held + W_ea @ np.swapaxes(J, 1, 2)}
    for (row, column), block in blocks.items():
        found = W[:, n * row : model.size if row else n, n * column : model.size if column else n]
        block = block / stiffness[:, :, None]
        assert np.abs(found - block).max() < 1e-4 * np.abs(block).max()
    positions = np.stack([0.03 * part[2] for part in parts])
    deviation = np.linalg.norm(positions - positions.mean(axis=0), axis=2)
    assert np.allclose(spread, np.sqrt((deviation**2).mean(axis=0)), rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("name", ["finger", "diamond", "trunk"])
def test_search_of_a_batch_equals_the_search_of_each_row(name):
    """Rows of a batch do not affect each other, even if some end early or have no state."""
    robot = make_robot(name)
    model = pretrained_model(robot)
    count, lost = 2 * kernels.ROWS_PER_BLOCK + 5, [3, kernels.ROWS_PER_BLOCK + 1]
    designs, target = random_states(robot, count)
    context = model.context(designs)
    guess = target + 0.1 * (random_states(robot, count, seed=1)[1] - target)
    target[0] = guess[0] = robot.upper  # taut
    guess[lost, 0] = np.nan
    unilateral = robot.unilateral
    for iterations in (0, 1, 12):
        found = model.search(context, target, guess, unilateral, 2e-4, iterations)
        assert not found[2][lost].any()
        for row in range(count):
            rows = slice(row, row + 1)
            alone = model.search(context.rows(np.array([row])), target[rows], guess[rows], unilateral, 2e-4, iterations)
            assert found[2][row] == alone[2][0]
            if found[2][row]:
                assert np.abs(found[0][row] - alone[0][0]).max() < 1e-4 * model.span.max()
    well = np.setdiff1d(np.arange(count), lost)
    assert found[2][well].all()
    # the same search in plain numpy
    expected = SurrogateModel.search(model, context.rows(well), target[well], guess[well], unilateral, 2e-4, 12)
    assert expected[2].all()
    assert np.abs(found[0][well] - expected[0]).max() < 1e-4 * model.span.max()
    assert np.abs(found[1][well] - expected[1]).max() < 1e-3 * np.abs(expected[1]).max()


def test_search_converges_where_members_disagree():
    """Steps with the curvature of one member do not converge if it is several times softer than the others."""
    robot = make_robot("cable_trunk")
    model = pretrained_model(robot)
    designs, target = random_states(robot, 40)
    context = model.context(designs)
    expected = model.search(context, target, target, robot.unilateral, 1e-6, 25)
    assert expected[2].all()
    context.arrays["first"] = 0.3 * context.arrays["first"]
    early = model.search(context, target, target, robot.unilateral, 1e-6, 4)  # with that curvature only
    assert early[2].mean() < 0.2
    found = model.search(context, target, target, robot.unilateral, 1e-6, 25)
    assert found[2].all()
    assert np.abs(found[0] - expected[0]).max() < 1e-4 * model.span.max()


def test_definite_matrices_are_recognised_in_any_units():
    """As of volumes in m3 and effectors in m: eigenvalues of such a W are round-off."""
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((20, 9, 9))
    units = np.repeat([1e-7, 6.0], [6, 3])
    sound = roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(9)
    broken = sound - 2.0 * np.linalg.eigvalsh(sound)[:, 0, None, None] * np.eye(9)
    for matrices, expected in ((sound, True), (broken, False)):
        assert (definite(matrices * units[:, None] * units) == expected).all()


@pytest.mark.parametrize("factor", [1.2, 2.0, 4.0])
def test_softer_states_are_those_whose_compliance_grew_by_more_than_the_factor(factor):
    rng = np.random.default_rng(6)
    roots = rng.normal(size=(40, 3, 3))
    unmoved = roots[:5] @ roots[:5].swapaxes(1, 2)
    slot = rng.integers(5, size=40)
    stiffness = unmoved[slot] * rng.uniform(0.1, 1.5, (40, 1, 1)) + 0.01 * roots @ roots.swapaxes(1, 2)
    growth = np.array(
        [max(np.linalg.eigvals(np.linalg.solve(K, unmoved[s])).real) for K, s in zip(stiffness, slot, strict=True)]
    )
    found = exceeds_softening(factor, stiffness, unmoved, slot)
    assert 0 < found.sum() < 40
    assert (found == (growth > factor)).all()
    assert exceeds_softening(
        factor, np.full((1, 3, 3), np.nan), unmoved, slot[:1]
    ).all()  # what is not known counts as soft


def test_a_row_without_a_definite_compliance_does_not_affect_others(monkeypatch):
    robot = make_robot("finger")
    model = untrained_residual(robot)
    designs, target = random_states(robot, 16)
    context = model.context(designs)
    unilateral = np.ones(2, dtype=bool)
    whole = model.search(context, target, target, unilateral, 1e-4, 25)
    assert whole[2].all() and (whole[1] == 0.0).any()
    searched = np.flatnonzero((whole[0] != target).any(axis=1))
    honest = model.stiffness

    def broken(part, displacement):
        K = honest(part, displacement)
        K[part.slot == searched[0]] = 0.0
        return K

    monkeypatch.setattr(model, "stiffness", broken)
    displacement, effort, found = model.search(context, target, target, unilateral, 1e-4, 25)
    others = np.arange(16) != searched[0]
    assert not found[searched[0]] and found[others].all()
    np.testing.assert_array_equal(displacement[others], whole[0][others])
    np.testing.assert_array_equal(effort[others], whole[1][others])


def test_members_of_an_ensemble():
    robot = make_robot("finger")
    model, _ = untrained_potential(robot, members=3)
    designs, displacement = random_states(robot, 5)
    assert np.isfinite(model.state(model.context(designs), displacement)[2]).all()
    for members in (1, 2):  # uncalibrated: their spread is smaller than that of all
        part = Model(robot, model.tensors, {}, members=members)
        assert part.members == members and np.isinf(part.state(part.context(designs), displacement)[2]).all()
    with pytest.raises(ValueError, match=r"members = 4.*1 to 3"):
        Model(robot, model.tensors, {}, members=4)
    with pytest.raises(ValueError, match="members = 2"):
        residual.Model(robot, untrained_residual(robot).tensors, {}, members=2)


def test_rows_of_a_context_share_bodies_until_overwritten():
    robot = make_robot("finger")
    model, _ = untrained_potential(robot)
    designs, displacement = random_states(robot, 6)
    own = model.context(designs)
    shared = Context.shared(model.context(designs[:1]), 6)
    first = model.state(shared, displacement)[1][0]
    assert first == pytest.approx(model.state(own, displacement)[1][0], abs=1e-6)
    shared.put(np.arange(6), own)
    for got, wanted in zip(model.state(shared, displacement), model.state(own, displacement), strict=True):
        assert (got == wanted).all()
    twice = own.rows(np.array([0, 0, 1, 2, 3, 4]))  # as many bodies as rows, and yet two share one
    twice.put(np.array([0]), own.rows(np.array([5])))
    assert (model.state(twice, displacement)[1][1] == model.state(own.rows(np.array([0])), displacement[1:2])[1]).all()
    shared.put(np.array([2]), own.rows(np.array([4])))
    index = np.array([5, 2])
    expected = model.state(own.rows(np.array([5, 4])), displacement[index])[1]
    assert (model.state(shared.rows(index), displacement[index])[1] == expected).all()


def test_trust_follows_domain_and_spread():
    robot = make_robot("finger")
    box = [[0.0, 0.01], [0.0, 0.01]]
    domain = {"displacement": box, "design": {"length": [0.039, 0.041]}, "inflation": 2.0, "limit": 1e-3}
    model, _ = untrained_potential(robot)
    model = Model(robot, model.tensors, {"domain": domain})
    designs = np.array([robot.design_space.complete({"length": v}).array for v in (0.040, 0.0415)])
    context = model.context(designs).rows(np.array([0, 0, 0, 1]))
    displacement = np.array([[0.005, 0.005], [0.005, 0.012], [0.005, 0.005], [0.005, 0.005]])
    uncertainty, trusted = model.trust(context, displacement, np.array([4e-4, 4e-4, 6e-4, 4e-4]))
    assert uncertainty == pytest.approx([8e-4, 8e-4, 1.2e-3, 8e-4])
    assert trusted.tolist() == [True, False, False, False]


def test_trust_ends_where_actuators_become_soft():
    robot = make_robot("diamond")
    model, _ = untrained_potential(robot)
    designs, displacement = random_states(robot, 200)
    context = model.context(designs)
    found = model.softening_ratio(context, displacement)
    zero = np.zeros_like(displacement)
    # A single member judges the growth.
    first = Model(robot, online._member(model.tensors, 0), {})
    W, unmoved = (
        first.compliance(first.context(designs), d)[:, : model.count, : model.count] for d in (displacement, zero)
    )
    ratio = np.linalg.eigvals(np.linalg.solve(unmoved, W)).real.max(axis=1)
    np.testing.assert_allclose(found, ratio, rtol=1e-4)
    np.testing.assert_allclose(model.softening_ratio(context, zero), 1.0, rtol=1e-6)
    limit = float(np.median(found))
    # Young's modulus differs between the rows and has no influence.
    limited = Model(robot, model.tensors, {"domain": {"growth": limit}})
    trusted = limited.trust(limited.context(designs), displacement, np.zeros(200))[1]
    assert trusted.tolist() == (found < limit).tolist()
    index = np.arange(50, 150)[::-1]
    some = limited.trust(limited.context(designs).rows(index), displacement[index], np.zeros(100))[1]
    assert some.tolist() == trusted[index].tolist()


@pytest.mark.parametrize("cables", CABLES)
def test_youngs_modulus_scales_exactly(cables):
    robot = make_robot("finger", cables=cables)
    model = pretrained_model(robot)
    designs, displacement = random_states(robot, 50)
    column = robot.design_space.names.index("young_modulus")
    soft, stiff = designs.copy(), designs.copy()
    soft[:, column], stiff[:, column] = 1.5e6, 6.0e6
    a, b = model.context(soft), model.context(stiff)
    (effort_a, effector_a, _), (effort_b, effector_b, _) = model.state(a, displacement), model.state(b, displacement)
    assert (effector_a == effector_b).all()
    assert np.allclose(4.0 * effort_a, effort_b, rtol=1e-12)
    assert np.allclose(model.compliance(a, displacement), 4.0 * model.compliance(b, displacement), rtol=1e-12)


@pytest.mark.parametrize("cables", CABLES)
def test_condensed_model_is_consistent(cables):
    robot = make_robot("finger", cables=cables)
    model = pretrained_model(robot)
    designs, displacement = random_states(robot, 20)
    condensed = model.condensed(model.context(designs), displacement)
    assert condensed.W.ea.shape == (20, 3, cables)
    assert np.allclose(condensed.delta.a, displacement, atol=1e-15)
    assert np.allclose(
        condensed.delta_free.a + np.einsum("bij,bj->bi", condensed.W.aa, condensed.lambda_.a), displacement
    )


@pytest.mark.parametrize("cables", CABLES)
def test_shipped_weights_keep_their_recorded_accuracy_on_fresh_fem_states(cables):
    """Designs from no dataset; the bounds are those that the project promises over the whole box."""
    from softgym_envs.backends.fem import FEMBackend
    from softgym_envs.backends.surrogate import SurrogateBackend

    robot = make_robot("finger", cables=cables)
    rng = np.random.default_rng(12345)
    errors, relative = [], []
    for _ in range(6):
        design = robot.design_space.sample(rng)
        fem, surrogate = FEMBackend(robot, design), SurrogateBackend(robot, design)
        for command in rng.uniform(robot.lower, robot.upper, (4, cables)):
            truth, guess = fem.step(command), surrogate.step(command)
            errors.append(np.linalg.norm(truth.effector - guess.effector))
            difference = truth.condensed.compliance - guess.condensed.compliance
            relative.append(np.linalg.norm(difference) / np.linalg.norm(truth.condensed.compliance))
    assert np.mean(errors) < 0.15e-3 and np.max(errors) < 1e-3
    assert np.median(relative) < 0.02


@pytest.mark.parametrize("cables", CABLES)
def test_card_records_the_origin_of_the_weights(cables):
    robot = make_robot("finger", cables=cables)
    card = json.loads((pretrained_folder(robot) / "model.json").read_text())
    assert card["network"] in NETWORKS
    assert card["test"]["positive_definite"] == 1.0
    assert card["states"]["test"] >= 500
    config = load_config(shipped_configs("surrogate")[robot.learning.weights], FitConfig)
    # How the data are generated does not count, and options that are newer than the weights had their defaults.
    known = FitConfig.model_validate({k: v for k, v in card["config"].items() if k != "workers"})
    apart = {"workers"}
    assert known.model_dump(exclude=apart) == config.model_dump(exclude=apart)


def test_effort_mode_inverts_displacement_mode():
    from softgym_envs.backends.surrogate import SurrogateBackend

    backend = SurrogateBackend(make_robot("finger"))
    driven = backend.step(np.array([0.010, 0.009]))
    backend.reset()
    forced = backend.step(driven.effort, mode="effort")
    assert np.abs(forced.displacement - driven.displacement).max() < 2e-6
    with pytest.raises(ValueError, match=r"magnetic.*displacement.*effort"):
        backend.step(driven.effort, mode="magnetic")


def test_slack_cables_have_no_effort_and_a_larger_displacement():
    from softgym_envs.backends.surrogate import SurrogateBackend

    backend = SurrogateBackend(make_robot("finger"))
    state = backend.step(np.array([0.015, 0.0]))
    assert state.slack.tolist() == [False, True]
    assert state.effort[1] == 0.0 and state.effort[0] > 0.0
    assert state.displacement[0] == pytest.approx(0.015, abs=1e-5) and state.displacement[1] > 0.005
    # The same state is found from another start.
    backend.step(np.array([0.02, 0.02]))
    again = backend.step(np.array([0.015, 0.0]))
    assert np.abs(again.displacement - state.displacement).max() < 5e-6
    bilateral = SurrogateBackend(make_robot("finger", unilateral=False)).step(np.array([0.010, 0.0075]))
    assert not bilateral.slack.any()


@pytest.fixture
def copied(tmp_path):
    robot = make_robot("finger")
    shutil.copytree(pretrained_folder(robot), tmp_path / "weights")
    return robot, tmp_path / "weights"


def test_truncated_weights(copied):
    robot, folder = copied
    path = folder / "model.safetensors"
    content = path.read_bytes()
    for keep in (0, 7, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:keep])
        with pytest.raises(WeightsError, match=r"model\.safetensors.*(damaged|truncated)"):
            load_model(folder, robot)


def test_weights_that_are_not_finite(copied):
    robot, folder = copied
    tensors = load_file(folder / "model.safetensors")
    tensors["effector"] = tensors["effector"].copy()
    tensors["effector"].flat[3] = np.nan
    save_file(tensors, folder / "model.safetensors")
    card = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**card, "sha256": hash_of(folder / "model.safetensors")}))
    with pytest.raises(WeightsError, match="not finite in effector"):
        load_model(folder, robot)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ([], "not a mapping"),
        ({"displacement": [[0.0, 0.01]]}, r"displacements of shape \(1, 2\), not \(2, 2\)"),
        ({"design": {"weight": [0.0, 1.0]}}, "unknown design variables: weight"),
    ],
)
def test_damaged_domains(copied, change, message):
    robot, folder = copied
    card = json.loads((folder / "model.json").read_text())
    card["domain"] = change if isinstance(change, list) else card["domain"] | change
    (folder / "model.json").write_text(json.dumps(card))
    with pytest.raises(WeightsError, match=message):
        load_model(folder, robot)


def test_missing_and_foreign_weights(copied):
    robot, folder = copied
    with pytest.raises(WeightsError, match=r"cables = 2, needed 1"):
        load_model(folder, make_robot("finger", cables=1))
    with pytest.raises(WeightsError, match="mesh_size"):
        load_model(folder, make_robot("finger", mesh_size=0.005))
    card = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**card, "network": "oracle"}))
    with pytest.raises(WeightsError, match=r"oracle.*residual"):
        load_model(folder, robot)
    (folder / "model.json").write_text(json.dumps({**card, "mechanics_key": None}))
    with pytest.raises(WeightsError, match=r"trained for another robot: cables = None, needed 2"):
        load_model(folder, robot)
    (folder / "model.json").write_text(json.dumps({**card, "format": 99}))
    with pytest.raises(WeightsError, match="format 2"):
        load_model(folder, robot)
    (folder / "model.json").write_text("{")
    with pytest.raises(WeightsError, match="JSON"):
        load_model(folder, robot)
    (folder / "model.json").unlink()
    with pytest.raises(WeightsError, match=r"model\.json.*does not exist"):
        load_model(folder, robot)


def test_weights_serve_every_box_inside_theirs(copied):
    robot, folder = copied
    narrow = make_robot("finger")
    narrow.design_space = narrow.design_space.within({"length": (0.039, 0.041)})
    whole, part = load_model(folder, robot), load_model(folder, narrow)
    design = robot.design_space.complete({"length": 0.0405}).array[None]
    displacement = np.array([[0.006, 0.009]])
    for a, b in zip(*(m.state(m.context(design), displacement) for m in (whole, part)), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(WeightsError, match=r"length = \[0.038, 0.042, 'm'\], which does not contain \[0.037"):
        load_model(folder, make_robot("finger", design_box="wide"))


def test_shipped_weights_belong_to_a_mesh():
    assert pretrained_folder(make_robot("finger")).name == "finger_2cables"
    assert pretrained_folder(make_robot("finger", mesh="reference")).name == "finger_2cables_reference"
    with pytest.raises(WeightsError, match="no weights ship for 'finger_2cables_reference'"):
        pretrained_model(make_robot("finger", mesh="reference"))


def splits(**changes):
    data = {name: {"groups": 2, "states": 4} for name in ("train", "validation", "test")}
    return {name: data[name] | changes.get(name, {}) for name in data}


def test_splits_have_different_states():
    data = FitConfig.model_validate({"robot": "finger", "data": splits()}).data
    assert [getattr(data, name).seed for name in splits()] == [0, 1, 2]
    robot = make_robot("finger")
    designs = [tuple(data.plan(name).designs(robot, 0, 1)[0].values()) for name in splits()]
    assert len(set(designs)) == 3
    with pytest.raises(ValueError, match=r"test would have the same points as train \(sequence 'random', seed 0\)"):
        FitConfig.model_validate({"robot": "finger", "data": splits(test={"seed": 0})})


def test_a_refused_run_does_not_change_the_configuration_of_the_data(tmp_path):
    config = {"robot": "finger", "robot_options": {"cables": 1}, "workers": 1}
    asked = [FitConfig.model_validate({**config, "data": splits(train={"states": states})}) for states in (4, 5)]
    generate_datasets(asked[0], tmp_path, progress=False)
    before = (tmp_path / "config.yaml").read_text()
    with pytest.raises(DataError, match="another dataset"):
        generate_datasets(asked[1], tmp_path, progress=False)
    assert (tmp_path / "config.yaml").read_text() == before


def test_a_damaged_part_is_trained_again(tmp_path, capsys):
    options = FitConfig.model_validate({"robot": "finger", "data": splits(), "network": {"kind": "potential"}}).network
    trainer = Trainer(options.model_copy(update={"steps": 3}), 0, tmp_path, "key")

    def trained():
        torch.manual_seed(0)
        net = torch.nn.Linear(2, 1)
        points = torch.arange(8.0).reshape(4, 2)
        trainer.optimise("line", net, lambda rows: (net(points if rows is None else points[rows]) ** 2).mean(), 4)
        return net.weight.detach().numpy().copy()

    first = trained()
    (part,) = tmp_path.glob("line-*.safetensors")
    part.write_bytes(part.read_bytes()[:20])
    np.testing.assert_array_equal(trained(), first)
    assert "renamed to 'line-key.corrupt'; training the part again" in capsys.readouterr().out
    np.testing.assert_array_equal(trained(), first)


@pytest.mark.parametrize("kind", sorted(NETWORKS))
def test_fit_end_to_end(kind, tmp_path, tmp_path_factory):
    """A tiny fit of each network learns something, writes a card, and can be loaded."""
    config = FitConfig.model_validate(
        {
            "robot": "finger",
            "robot_options": {"cables": 1},
            "data": {
                "train": {"groups": 10, "states": 6, "sequence": "halton", "seed": 0},
                "validation": {"groups": 2, "states": 4, "seed": 1},
                "test": {"groups": 2, "states": 4, "seed": 2},
            },
            "network": {"kind": kind} if kind == "rbf" else {"kind": kind, "width": 32, "steps": 400, "batch_size": 16},
            "workers": 1,
        }
    )
    shared = tmp_path_factory.getbasetemp() / "tiny_finger_data"
    errors = fit(config, tmp_path / "model", shared, progress=False)
    model = load_model(tmp_path / "model", make_robot("finger", cables=1))
    assert model.network == kind
    assert errors["states"] == 10
    assert errors["effector_mean"] < 0.02  # the tip moves by up to 0.1 m
    if kind in ("residual", "potential"):
        assert errors["positive_definite"] == 1.0 and errors["asymmetry_worst"] == 0.0
    history = np.load(tmp_path / "model" / "history.npz")
    assert all(np.isfinite(history[name]).all() for name in history.files)


def test_fit_of_three_fidelities(tmp_path):
    """Cheap states first, then those of the robot's mesh; efforts corrected by states on two other meshes."""
    fidelities = {
        "robot": "trunk",
        "robot_options": {"mesh": "accurate"},
        "data": splits(train={"groups": 6}, validation={"groups": 2}, test={"groups": 1})
        | {"more": {"groups": 2, "states": 1, "sequence": "vertices"}, "groups_per_shard": 2},
        "pretraining": {
            "robot_options": {"mesh": "published"},
            "train": {"groups": 20, "states": 8, "sequence": "halton"},
            "validation": {"groups": 3, "states": 4, "seed": 5},
            "steps": 200,
        },
        "correction": {
            "coarser": {"mesh": "published"},
            "finer": {"mesh": "reference"},
            "sizes": [4.0, 2.0, 1.0],
            "states": {"groups": 3, "states": 1, "seed": 7},
        },
        "network": {"kind": "potential", "width": 16, "body_width": 16, "members": 1, "steps": 50, "batch_size": 32},
        "workers": 1,
    }
    config = FitConfig.model_validate(fidelities)
    fit(config, tmp_path / "model", tmp_path / "data", progress=False)
    assert len(list((tmp_path / "data" / "train").glob("shard_*.npz"))) == 3
    levels = [load_dataset(tmp_path / "data" / "correction" / name) for name in ("coarser", "own", "finer")]
    for level in levels:  # equal bodies, equal commands
        np.testing.assert_array_equal(level["design"], levels[1]["design"])
    robot = make_robot("trunk", mesh="accurate")
    model = load_model(tmp_path / "model", robot)
    more = load_dataset(tmp_path / "data" / "more" / "train")
    train = load_dataset(tmp_path / "data" / "train")
    images = 1 + len(robot.learning.symmetries)
    assert model.card["states"]["train"] == images * (len(train["rest"]) + len(more["rest"]))
    assert model.card["states"]["pretraining/train"] > 150 and model.card["correction"]["states"] == 3
    features = model.features.design(levels[1]["design"])
    assert model.correction == fit_correction(levels, (4.0, 2.0, 1.0), features)
    # Converged beams are a little softer or stiffer, by what the order of their elements leaves.
    factor = model.correction.factor(features)
    assert (factor != 1.0).all() and np.abs(factor - 1.0).max() < 1e-3
    # The few states of the own mesh, learned in as few steps from random weights, teach less.
    alone = FitConfig.model_validate({k: v for k, v in fidelities.items() if k not in ("pretraining", "correction")})
    fit(alone, tmp_path / "alone", tmp_path / "data", progress=False)
    random = load_model(tmp_path / "alone", robot)
    assert model.card["best_validation"]["member 0"] < 0.5 * random.card["best_validation"]["member 0"]


def test_fidelities_that_do_not_fit_are_refused():
    split = {"groups": 2, "states": 2}
    first = {"robot_options": {}, "train": split, "validation": split, "steps": 10}
    with pytest.raises(ValueError, match="only networks of kind 'potential' can be pretrained, not 'rbf'"):
        FitConfig.model_validate(
            {"robot": "finger", "data": splits(), "pretraining": first, "network": {"kind": "rbf"}}
        )
    levels = {"coarser": {}, "finer": {}, "sizes": [1.0, 2.0, 0.5], "states": split}
    with pytest.raises(ValueError, match=r"sizes = \[1.0, 2.0, 0.5\] must decrease"):
        FitConfig.model_validate({"robot": "finger", "data": splits(), "correction": levels})

"""Online learning: what is learned, what is not forgotten, what stays unknown, and what is kept on disk."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extensions.fitting.data.dataset import COLUMNS
from softgym_envs.extensions.fitting.potential import stack_members, unstack_members
from softgym_envs.extensions.hybrid.online import StateStore, check_ensemble, fine_tune, is_tuned_from, rehearsal_states
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model
from softgym_envs.surrogate.weight_files import load_model, save_model
from tests.helpers import sample_states

LIMIT = 8e-3  # largest displacement in the training of `weights` [m]


@pytest.fixture(scope="module")
def model(robot, weights):
    """The ensemble with a limit of 0.2 mm, as the hybrid backend sets it."""
    given = load_model(weights, robot)
    return Model(robot, given.tensors, {**given.card, "domain": {**given.card["domain"], "limit": 2e-4}})


@pytest.fixture(scope="module")
def full(robot):
    """The whole range."""
    return sample_states(robot, 60, 5, limit=float(robot.upper[0]))


@pytest.fixture(scope="module")
def middle(robot):
    """States up to 14 mm, beyond the training data of the weights."""
    data = sample_states(robot, 40, 6, limit=14e-3)
    rows = (data["displacement"][:, 0] > LIMIT) | data["rest"]
    return {k: v[rows] for k, v in data.items()}


@pytest.fixture(scope="module")
def learned(model, middle):
    return fine_tune(model, middle, steps=250)


def judged(model, data, low, high):
    """Errors [m] and trust of a model on states whose displacement is in a range."""
    rows = (data["displacement"][:, 0] > low) & (data["displacement"][:, 0] <= high)
    context = model.context(data["design"][rows])
    _, effector, spread = model.state(context, data["displacement"][rows])
    uncertainty, trusted = model.trust(context, data["displacement"][rows], spread)
    return np.linalg.norm(effector - data["effector"][rows], axis=1), uncertainty, trusted


def test_stacking_members_inverts_unstacking(model):
    states, scales = unstack_members(model.tensors)
    again = stack_members(states, scales)
    assert again.keys() == model.tensors.keys()
    assert all(np.array_equal(again[k], model.tensors[k]) for k in again)


def test_members_in_torch_agree_with_the_kernel(model, robot):
    import torch

    from softgym_envs.extensions.fitting.torch_potential import PotentialNet

    states, scales = unstack_members(model.tensors)
    displacement = np.linspace(0.0, 0.02, 7)[:, None]
    designs = np.tile(list(robot.design_space.baseline.values()), (7, 1))
    effector = np.zeros((7, 3))
    for state in states:
        net = PotentialNet(1, 3, model.features.design_size, model.width, len(state["body.0.weight"]), state["rest"])
        net.load_state_dict({k: torch.tensor(v) for k, v in state.items()})
        inputs = (model.features.design(designs), model.features.actuation(displacement))
        effector += net(*(torch.tensor(x, dtype=torch.float32) for x in inputs))[2].detach().numpy() / len(states)
    found = model.state(model.context(designs), displacement)[1]
    np.testing.assert_allclose(effector * scales["effector"] + scales["effector_mean"], found, atol=1e-6)


def test_the_given_ensemble_flags_unknown_states(model, full):
    """The spread alone flags states outside, also those with an error above 1 mm; the box flags all of them."""
    error, uncertainty, trusted = judged(model, full, 1.01 * LIMIT, 1.0)
    bad = error > 1e-3
    assert bad.sum() > 10
    assert (uncertainty[bad] > 2e-4).mean() > 0.9
    assert not trusted.any()
    error, uncertainty, trusted = judged(model, full, -1.0, LIMIT)
    assert error.max() < 5e-4 and trusted.mean() > 0.9


def test_new_states_are_learned_and_old_ones_not_forgotten(model, learned, full):
    before, after = judged(model, full, LIMIT, 14e-3)[0], judged(learned, full, LIMIT, 14e-3)[0]
    assert after.mean() < 0.2 * before.mean() and after.max() < 1e-3
    old, uncertainty, trusted = judged(learned, full, -1.0, LIMIT)
    assert old.max() < 5e-4 and trusted.mean() > 0.9
    assert judged(learned, full, LIMIT, 13.5e-3)[2].mean() > 0.7


def test_unknown_states_are_not_trusted_even_inside_the_box(model, learned, middle, full):
    """A single state at 20 mm makes the box as large as the range; inside the box the spread still decides."""
    assert not judged(learned, full, 15e-3, 1.0)[2].any()  # by the box
    lonely = {k: np.concatenate([middle[k], v[[np.argmax(full["displacement"][:, 0])]]]) for k, v in full.items()}
    tuned = fine_tune(model, lonely, steps=250)
    assert tuned.card["domain"]["displacement"][0][1] > 19e-3
    error, _, trusted = judged(tuned, full, 15e-3, 19e-3)
    assert error[trusted].max(initial=0.0) < 1e-3
    wrong = error > 1e-3
    assert not trusted[wrong].any()


def test_the_domain_grows_and_its_limit_stays(model, learned, middle):
    old, new = model.card["domain"], learned.card["domain"]
    assert new["limit"] == old["limit"] and new["inflation"] >= old["inflation"]
    assert new["displacement"][0][0] == old["displacement"][0][0]
    assert new["displacement"][0][1] == middle["displacement"].max() > old["displacement"][0][1]
    assert new["design"] == old["design"]
    assert model.card["domain"] == old and "online" not in model.card
    assert learned.card["online"]["states"] == len(middle["rest"]) - 1
    assert learned.card["data_sha256"] != model.card.get("data_sha256")


def test_the_growth_rises_to_learned_states_and_not_to_left_out_ones(model, middle):
    rows = np.flatnonzero(~middle["rest"].astype(bool))
    strict = Model(model.robot, model.tensors, {**model.card, "domain": {**model.card["domain"], "growth": 0.1}})

    def growth(data):
        tuned = fine_tune(strict, data, steps=3)
        states = tuned.softening_ratio(tuned.context(data["design"]), data["displacement"])
        return tuned.card["domain"]["growth"], states

    found, states = growth(middle)
    assert found == pytest.approx(min(10.0, states.max()))
    # A state close to buckling: the compliance of its actuators is a hundred times that at rest.
    compliance = middle["compliance"].copy()
    compliance[rows[5], 0] *= 100.0 * compliance[0, 0] / compliance[rows[5], 0]
    found, states = growth({**middle, "compliance": compliance})
    assert found == pytest.approx(max(0.1, min(states[rows[5]], states.max())))
    assert not is_tuned_from(fine_tune(strict, middle, steps=3), model, middle, 3, 0)  # a parent of another domain


def test_learning_depends_on_states_and_seed_alone(model, middle):
    first, again, other = (fine_tune(model, middle, steps=3, seed=seed) for seed in (0, 0, 1))
    assert all(np.array_equal(first.tensors[k], again.tensors[k]) for k in first.tensors)
    assert not np.array_equal(first.tensors["energy1"], other.tensors["energy1"])


def test_rehearsed_states_lie_where_the_model_is_trusted(model):
    designs, displacement = rehearsal_states(model, 200)
    assert displacement.shape == (200, 1) and displacement.min() >= -1e-9 and displacement.max() <= LIMIT
    context = model.context(designs)
    assert model.trust(context, displacement, model.state(context, displacement)[2])[1].all()


def test_learned_weights_are_ordinary_weight_files(model, learned, middle, robot, tmp_path):
    save_model(learned, tmp_path)
    read = load_model(tmp_path, robot)
    context = read.context(middle["design"])
    for a, b in zip(*(m.state(context, middle["displacement"]) for m in (read, learned)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert read.card["domain"] == learned.card["domain"]
    assert is_tuned_from(read, model, middle, 250, 0)
    assert not is_tuned_from(read, model, middle, 250, 1) and not is_tuned_from(read, learned, middle, 250, 0)
    assert not is_tuned_from(model, model, middle, 250, 0)


def test_models_without_a_calibrated_ensemble_are_refused(robot, weights, middle, model):
    with pytest.raises(WeightsError, match="2 or more"):
        check_ensemble(load_model(weights, robot, members=1))
    with pytest.raises(WeightsError, match="needs all members of an ensemble of 2 or more.*got 2"):
        check_ensemble(load_model(weights, robot, members=2))
    with pytest.raises(WeightsError, match="where they are trusted"):
        check_ensemble(Model(robot, model.tensors, {}))
    touched = make_robot("sensorized_finger", touch=True, meshing="morph")
    with pytest.raises(WeightsError, match="does not know sensor rows, which robot 'sensorized_finger' has"):
        check_ensemble(pretrained_model(touched))
    unstable = {**middle, "compliance": -middle["compliance"]}
    with pytest.raises(DataError, match="stable"):
        fine_tune(model, unstable, steps=1)


# -- states on disk ------------------------------------------------------------------------------------------------


def test_states_are_read_again(robot, middle, tmp_path):
    store = StateStore(robot, tmp_path)
    assert store.count == 0
    store.add({k: v[:5] for k, v in middle.items()})
    store.add({k: v[[0, 5, 6]] for k, v in middle.items()})
    again = StateStore(robot, tmp_path)
    assert again.count == store.count == 6
    assert again.data.keys() == set(COLUMNS)
    assert all(np.array_equal(again.data[k], store.data[k]) for k in COLUMNS)
    for both in (again, store):  # file names are unique, also within one process
        both.add({k: v[:2] for k, v in middle.items()})
    assert StateStore(robot, tmp_path).count == 8
    assert StateStore(robot).count == 0


def test_states_of_another_robot_and_damaged_ones(robot, middle, tmp_path, capsys):
    store = StateStore(robot, tmp_path)
    store.add({k: v[:5] for k, v in middle.items()})
    store.add({k: v[:3] for k, v in middle.items()})
    with pytest.raises(DataError, match="another robot"):
        StateStore(make_robot("finger"), tmp_path)
    first = min(tmp_path.glob("*.npz"))
    first.write_bytes(first.read_bytes()[:100])
    assert StateStore(robot, tmp_path).count == 2
    assert first.with_suffix(".corrupt").exists() and "renamed to" in capsys.readouterr().out
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(DataError, match=r"manifest\.json.*cannot be read"):
        StateStore(robot, tmp_path)


def test_states_without_a_rest_or_of_a_wrong_shape_are_refused(robot, middle):
    store = StateStore(robot)
    with pytest.raises(DataError, match="rest"):
        store.add({k: v[1:3] for k, v in middle.items()})
    with pytest.raises(DataError, match="effector"):
        store.add({**middle, "effector": middle["effector"][:, :2]})
    with pytest.raises(DataError, match="effort"):
        store.add({**middle, "effort": np.full_like(middle["effort"], np.nan)})


def test_the_card_is_json(learned):
    json.dumps(learned.card)

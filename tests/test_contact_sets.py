"""The set network over contacts: its order of contacts, its features, and that it learns."""

import numpy as np
import pytest

from benchmarks import contact_sets
from benchmarks.contact_sets import FEATURES, MOST, SCALES, SetNetwork, bar_features, compare, kept_scenes
from benchmarks.contact_surrogate import INCREMENTS, draw_scene
from softgym_envs import make_robot
from softgym_envs.surrogate.chain.model import load_chain


def test_features_have_the_gap_and_the_normal_of_a_bar():
    corners = np.array([[0.03, 0.0], [0.03, 0.05], [0.03, 0.1]])
    (row,) = bar_features(corners, np.array([[0.036, 0.02, 0.002, 0.4]])) * SCALES
    assert row == pytest.approx([0.036, 0.02, 0.002, 0.4, 0.004, 1.0, 0.0])


def test_the_order_and_the_number_of_contacts_are_free():
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    network = SetNetwork(4, seed=0)
    body, bars = torch.tensor(rng.normal(size=(3, 4))), torch.tensor(rng.normal(size=(3, MOST, FEATURES)))
    there = torch.arange(MOST).expand(3, -1) < 3
    force, tip = network(body, bars, there)
    order = [2, 0, 1, 3]
    turned, same = network(body, bars[:, order], there[:, order])
    assert torch.allclose(turned, force[:, order])
    assert torch.allclose(same, tip)
    assert not force[:, 3:].any()
    fewer, same = network(body, bars[:, :3], there[:, :3])
    assert torch.allclose(fewer, force[:, :3])
    assert torch.allclose(same, tip)


def test_scenes_are_kept_and_both_models_are_compared(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    model = load_chain(make_robot("contact_aided_finger"))
    monkeypatch.setattr(contact_sets, "TESTED", (1, 2))
    monkeypatch.setattr(contact_sets, "LEARNED", (1,))
    chain = contact_sets.close_chain
    monkeypatch.setattr(contact_sets, "close_fem", lambda model, scene, self_contact: chain(model, scene))
    found = compare(model, tmp_path, taught=2, chain_taught=2, tests=1, steps=100)
    assert found["chain, 2 bars"]["force_error, worst"] == 0.0
    assert found["states of finite elements"] == 2 * INCREMENTS
    assert found["taught by finite elements, its own scenes"]["tip_error, median"] < 5e-3
    monkeypatch.setattr(contact_sets, "make_scene", lambda *_: pytest.fail("the scenes are kept"))
    (scene,) = kept_scenes(model, tmp_path, (2,), 1, contact_sets.TEST_SEED)
    drawn = draw_scene(model, 2, np.random.default_rng([contact_sets.TEST_SEED, 2, 0]))
    assert scene.bars[:, 2] == pytest.approx([bar.radius for bar in drawn.bars])

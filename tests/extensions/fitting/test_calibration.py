"""Calibration of the uncertainty by stratum, the limit of trust, and the search for the worst trusted states."""

import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from softgym_envs import make_robot
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.fitting import calibration as module
from softgym_envs.extensions.fitting.calibration import (
    FACTOR_OF,
    adversarial_search,
    calibrate,
    conformal_quantile,
    fit_calibration,
    judged_states,
    safe_bounds,
    safe_limit,
    with_domain,
)
from softgym_envs.extensions.fitting.cli import calibrate_trust
from softgym_envs.extensions.fitting.data import strata
from softgym_envs.extensions.fitting.data.strata import StratifiedStates, draw_commands, strata_of
from softgym_envs.extensions.fitting.potential import stack_members, unstack_members
from softgym_envs.extensions.fitting.predictions import TOUCHING, Predictions, predict, reached, report
from softgym_envs.extensions.gpu.surrogates import TorchBatch
from softgym_envs.surrogate.domain import OUTSIDE, SOFT, SPREAD, Calibration, Domain, distrust_text
from softgym_envs.surrogate.features import learned_variables
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_folder, pretrained_model, shipped_robots
from softgym_envs.surrogate.weight_files import load_model, save_model
from tests.helpers import random_states

CALIBRATION = {
    "forces": 0.7,
    "floor": 1e-5,
    "power": 0.75,
    "inside": 2.0,
    "faces": 3.0,
    "corners": 4.0,
    "slack_corners": 6.0,
    "buckling": 1.5,
    "soft": 2.0,
}


def predicted_states(model, stratum, bodies, states, seed, noise=None):
    """The model's own predictions as if FEM had found them, with errors of given sizes (N,) added."""
    robot = model.robot
    soft = module.softness(model)
    drawn = draw_commands(robot, stratum, bodies, states, seed, soft)
    command = drawn.command.reshape(-1, model.count)
    design = np.repeat(drawn.design, states, axis=0)
    context = model.context(design)
    displacement, _ = reached(model, context, command)
    effector, spread = model.effector(context, displacement)
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((len(effector), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    error = np.zeros(len(effector)) if noise is None else noise(spread, rng)
    effector = effector.copy()
    effector[:, :3] += error[:, None] * direction
    rows = len(command)
    return StratifiedStates(
        stratum=np.full(rows, stratum, dtype="<U14"),
        body=np.repeat(np.arange(bodies), states),
        design=design,
        command=command,
        displacement=displacement,
        effort=np.zeros_like(displacement),
        effector=effector,
        slack=displacement > command,
        touching=np.zeros(rows, dtype=bool),
        growth=np.ones(rows),
        apart=np.zeros(rows),
        found=np.ones(rows, dtype=bool),
    )


@pytest.fixture(scope="module")
def trunk():
    return pretrained_model(make_robot("trunk"))


# -- the rule ---------------------------------------------------------------------------------------------------------


def test_factors_are_interpolated_between_strata():
    found = Calibration.of_card(CALIBRATION)
    factor, corner = found.body_factors(np.array([0.0, 0.125, 0.25, 1.0]), 4)
    np.testing.assert_allclose(factor, [2.0, 6.0**0.5, 3.0, 4.0])
    np.testing.assert_allclose(corner, 1.5 ** np.array([0.0, 0.125, 0.25, 1.0]))
    # With one design variable a face is a corner.
    np.testing.assert_allclose(found.body_factors(np.array([0.0, 1.0]), 1)[0], [2.0, 4.0])
    plain = Calibration()
    assert plain.body_factors(np.array([0.0, 0.5, 1.0]), 3)[0].tolist() == [1.0, 1.0, 1.0]


def test_poisson_ratios_are_trusted_up_to_those_of_the_training():
    """The margin is 1 % of the training's range of ``log(1 - 2 nu)``: a linear one would end beyond 0.499."""
    model = pretrained_model(make_robot("diamond"))
    space, domain = model.robot.design_space, model.domain
    low, high = model.card["domain"]["design"]["poisson_ratio"]
    k = space.names.index("poisson_ratio")
    learned = np.log((1.0 - 2.0 * low) / (1.0 - 2.0 * high))
    assert np.log((1.0 - 2.0 * high) / (1.0 - 2.0 * domain.design_high[k])) == pytest.approx(0.01 * learned, rel=1e-4)
    assert domain.design_low[k] == pytest.approx(low - 0.01 * (high - low), rel=1e-8)  # here the linear one is narrower
    designs = np.array([space.complete({"poisson_ratio": nu}).array for nu in (high, 0.4988, 0.499)])
    context, still = model.context(designs), np.zeros((3, model.count))
    assert (model.distrust(context, still, np.zeros(3), still)[1] & OUTSIDE).tolist() == [0, OUTSIDE, OUTSIDE]
    # A ratio that was not learned stays trusted, in spite of round-off.
    card = {"domain": {"design": {"poisson_ratio": [0.3, 0.3]}}}
    fixed = Domain.of_card(card, model.robot)
    assert fixed.design_low[k] < 0.3 < fixed.design_high[k]


def test_malformed_calibrations():
    with pytest.raises(ValueError, match="unknown entries: vertices"):
        Calibration.of_card({"vertices": 2.0})
    for name in ("inside", "power", "soft"):
        with pytest.raises(ValueError, match=f"has {name} = -1.0; it must be positive"):
            Calibration.of_card({**CALIBRATION, name: -1.0})
    with pytest.raises(ValueError, match=r"floor = 0.0"):
        Calibration.of_card({"power": 0.5})


def test_uncertainty_follows_the_formula():
    robot = make_robot("finger")
    space = robot.design_space
    model = pretrained_model(robot)
    model = with_domain(model, inflation=1.0, limit=1e-4, calibration=CALIBRATION)
    low, high = (np.array([getattr(v, end) for v in space]) for end in ("low", "high"))
    middle = 0.5 * (low + high)
    face = middle.copy()
    face[space.names.index("length")] = high[space.names.index("length")]
    beyond = middle.copy()
    beyond[space.names.index("length")] *= 2.0
    designs = np.stack([middle, face, low, low, low, beyond])
    full, half = 0.02, 0.01
    command = np.array([[half, half], [half, half], [half, half], [full, 0.0], [full, full], [half, half]])
    displacement = command.copy()
    displacement[3, 1] = 0.004  # slack
    spread = np.array([1e-5, 0.0, 3e-5, 2e-5, 2e-5, 1e-6])
    context = model.context(designs)
    uncertainty, distrust = model.distrust(context, displacement, spread, command)
    sigma = 1e-5 * (np.hypot(spread, 1e-5) / 1e-5) ** 0.75
    np.testing.assert_allclose(uncertainty, np.array([2.0, 3.0, 4.0, 6.0, 4.0, 3.0]) * sigma, rtol=2e-3)
    assert distrust.tolist() == [0, 0, 0, SPREAD if uncertainty[3] > 1e-4 else 0, 0, OUTSIDE]
    assert (uncertainty[3] > 1e-4) == bool(distrust[3] & SPREAD)
    # Without commands the reached displacements count, and no cable is slack.
    plain = model.distrust(context, displacement, spread)[0]
    assert plain[3] == pytest.approx(4.0 * sigma[3], rel=2e-3) and (plain[[0, 1, 2]] == uncertainty[[0, 1, 2]]).all()
    outside = displacement.copy()
    outside[0, 0] = 0.03
    assert model.distrust(context, outside, spread, command)[1][0] == OUTSIDE
    assert model.distrust(context, displacement, np.full(6, np.inf), command)[1].tolist() == [0, 0, 0, 0, 0, OUTSIDE]


@pytest.mark.parametrize("name", ["finger", "three_finger_gripper"])
def test_what_members_disagree_about_moves_the_effector(name):
    model = pretrained_model(make_robot(name))
    designs, displacement = random_states(model.robot, 7)
    states, scales = unstack_members(model.tensors)
    alone = [Model(model.robot, stack_members([state], scales), {**model.card, "domain": {}}) for state in states]
    context = model.context(designs)
    each = np.stack([one.effort(one.context(designs), displacement) for one in alone])
    places = np.stack([one.effector(one.context(designs), displacement)[0] for one in alone])
    np.testing.assert_allclose(each.mean(axis=0), model.effort(context, displacement), atol=1e-4 * np.abs(each).max())
    n = model.count
    W = model.compliance(context, np.zeros_like(displacement))[:, n : n + model.effectors, :n]
    moved = np.einsum("bei,mbi->mbe", W, each - each.mean(axis=0))
    by_forces = np.sqrt((moved**2).sum(axis=2).mean(axis=0))
    np.testing.assert_allclose(model.force_spread(context, displacement), by_forces, rtol=2e-2)
    by_places = np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0))
    for weight in (0.0, 0.5):
        judged = with_domain(model, calibration={"forces": weight})
        spread = judged.effector(judged.context(designs), displacement)[1]
        np.testing.assert_allclose(spread, np.hypot(by_places, weight * by_forces), rtol=2e-2)
    few = pretrained_model(model.robot, members=3)
    few.domain = judged.domain
    assert np.isinf(few.effector(few.context(designs), displacement)[1]).all()


def test_a_calibration_finds_whether_forces_tell_the_error(trunk):
    """Errors that are those of the forces are bounded by them, others by the places alone."""
    for forces, wanted in ((True, {1.0, 2.0}), (False, {0.0, 0.5})):
        parts = []
        for kind in strata_of(trunk.robot, buckles=False):
            states = predicted_states(trunk, kind, 40, 4, seed=3)
            context = trunk.context(states.design)
            size = (
                trunk.force_spread(context, states.displacement)
                if forces
                else trunk.effector(context, states.displacement)[1]
            )
            states.effector[:, 0] += size * np.random.default_rng(0).uniform(0.9, 1.1, len(size))
            parts.append(states)
        assert fit_calibration(trunk, StratifiedStates.join(parts)).forces in wanted


def test_doubt_in_words():
    assert distrust_text(0) == ""
    assert distrust_text(OUTSIDE | SOFT) == "outside box, softening"
    assert distrust_text(SPREAD) == "spread"


@pytest.mark.parametrize("name, options", shipped_robots().values(), ids=shipped_robots())
def test_tensors_are_judged_as_arrays(name, options):
    robot = make_robot(name, **options)
    model = pretrained_model(robot)
    domain: dict[str, object] = {"calibration": CALIBRATION, "limit": np.inf}
    if len(robot.sensing.scale):  # learned for few of its dimensions: random bodies are outside the box
        domain["design"] = {}
    if model.domain.limits_growth:
        domain["growth"] = 4.0
    model = with_domain(model, **domain)
    designs, command = random_states(robot, 200)
    vertex = draw_commands(robot, strata_of(robot, buckles=False)[-1], 100, 1)
    designs[:100], command[:100] = vertex.design, vertex.command[:, 0]
    displacement = command + 0.1 * (robot.upper - robot.lower) * np.random.default_rng(0).integers(
        2, size=command.shape
    )
    context = model.context(designs)
    _, spread = model.effector(context, displacement)
    limit = float(np.median(model.trust(context, displacement, spread, command)[0]))
    model = with_domain(model, **domain | {"limit": limit})
    uncertainty, trusted = model.trust(context, displacement, spread, command)
    assert 0 < trusted.sum() < 200
    batch = TorchBatch(model, torch.device("cpu"), torch.float64)

    def scaled(values):
        return torch.as_tensor((values - model.middle) / model.half_range)

    bodies = batch.prepare(torch.as_tensor(designs))
    _, found, judged = batch.measure(bodies, scaled(displacement), scaled(command))
    np.testing.assert_allclose(found.numpy(), uncertainty, rtol=1e-3)
    assert (judged.numpy() != trusted).sum() <= 1  # one row may be at a limit


# -- calibration ------------------------------------------------------------------------------------------------------


def test_conformal_quantiles_cover_new_scores(rng):
    assert conformal_quantile(np.arange(1.0, 20.0)) == 19.0  # 20 * 0.95 = 19
    covered = [(rng.random() <= conformal_quantile(rng.random(40))) for _ in range(4000)]
    assert 0.945 < np.mean(covered) < 0.985  # between 0.95 and 0.95 + 1 / 41


@pytest.mark.parametrize("robot, bodies, off", [("trunk", 100, 0.045), ("two_finger_gripper", 30, 0.085)])
def test_every_stratum_is_covered_on_new_states(robot, bodies, off):
    model = pretrained_model(make_robot(robot))
    size = {"inside": 1.0, "faces": 2.0, "corners": 5.0, "slack corners": 9.0, "near buckling": 20.0}

    def states(seed):
        parts = []
        for stratum in strata_of(model.robot, buckles=model.domain.limits_growth):

            def noise(spread, rng, scale=size[stratum]):
                return scale * spread * np.abs(rng.standard_normal(len(spread)))

            parts.append(predicted_states(model, stratum, bodies, 4, seed, noise))
        return StratifiedStates.join(parts)

    found = fit_calibration(model, states(1))
    calibrated = module._calibrated(model, found)
    rows = report(calibrated, states(2))
    assert rows.keys() == {"inside", "faces", "corners", "slack corners"} | (
        {"near buckling"} if robot == "two_finger_gripper" else set()
    )
    # Three standard deviations: of the coverage of 400 states 3.3 %, of 120 states 6 %, and as much by calibration.
    assert all(abs(row.coverage - 0.95) < off for row in rows.values()), rows
    assert found.inside < found.corners < found.slack_corners


def test_reports_count_the_states_whose_slack_actuators_are_told():
    model = pretrained_model(make_robot("finger"))
    states = predicted_states(model, "slack corners", 4, 5, seed=3)
    assert states.slack.any()
    states.slack[:] = states.displacement > states.command + 1e-6 * (model.robot.upper - model.robot.lower)
    assert report(model, states)["slack corners"].slack == 1.0
    states.slack[7, 1] = ~states.slack[7, 1]
    assert report(model, states)["slack corners"].slack == 0.95


def test_the_limit_is_below_all_wrong_states():
    def judged(error, uncertainty, found=None, trusted=None):
        error = np.array(error)
        every = np.ones(len(error), bool)
        found, trusted = (every if which is None else np.array(which) for which in (found, trusted))
        return Predictions(error, np.array(uncertainty), np.array(uncertainty), trusted, np.ones(len(error)), found)

    assert safe_limit(judged([1e-3, 1e-4], [5e-3, 1e-4]), 2e-3) == 2e-3
    assert safe_limit(judged([1e-3, 3e-3, 5e-3], [1e-4, 1e-3, 4e-4]), 2e-3) == pytest.approx(0.8 * 4e-4)
    # The second state is trusted, but has no equilibrium on FEM.
    assert safe_limit(judged([1e-3, np.nan], [1e-4, 6e-4], [True, False]), 2e-3) == pytest.approx(0.8 * 6e-4)
    # States that softening or the box tells do not lower the limit for all others.
    told = judged([1e-3, np.nan, 9e-3], [1e-4, 6e-4, 3e-4], [True, False, True], [True, False, False])
    assert safe_limit(told, 2e-3) == 2e-3


def test_commands_without_an_equilibrium_are_told_by_their_softness(trunk, monkeypatch):
    """Growth is that of a made-up model; FEM finds no equilibrium where it is large."""
    states = StratifiedStates.join([predicted_states(trunk, kind, 50, 2, 3) for kind in ("inside", "faces")])
    growth = 1.0 + np.arange(len(states)) / len(states)
    monkeypatch.setattr(module, "softness", lambda model: lambda designs, commands: growth[: len(designs)])
    # All have an equilibrium, or nearly all: no limit.
    assert module.usual_growth(trunk, states) is None
    states.found[-2:] = False
    assert module.usual_growth(trunk, states) is None
    states.found[-10:] = False
    limit = module.usual_growth(trunk, states)
    # The states inside come first: a bound on 98 % of these 100.
    assert limit == pytest.approx(np.quantile(growth[:100], 0.98))
    # Reports count states without an equilibrium, but not in any error.
    rows = report(trunk, states)
    assert (rows["inside"].lost, rows["faces"].lost) == (0, 10)
    assert (rows["inside"].states, rows["faces"].states) == (100, 90)
    # Networks compute in single precision, where round-off depends on the number of rows.
    assert rows["faces"].unsolved <= 10 and rows["faces"].worst < 1e-7


def test_an_attack_finds_what_random_states_do_not(trunk, monkeypatch):
    """FEM is replaced by the model itself with an error in one corner of the design box."""
    model = module._calibrated(trunk, Calibration(inside=2.0, faces=2.0, corners=2.0, slack_corners=2.0), 1e-3)
    robot = model.robot
    columns = [robot.design_space.names.index(name) for name in ("module_length", "outer_radius")]

    def solve(robot, commands, folder, workers):
        count, states, n = commands.command.shape
        design = np.repeat(commands.design, states, axis=0)
        command = commands.command.reshape(-1, n)
        context = model.context(design)
        displacement, _ = reached(model, context, command)
        effector, _ = model.effector(context, displacement)
        low, high = (np.array([getattr(v, end) for v in robot.design_space])[columns] for end in ("low", "high"))
        assert (design[:, columns] >= low - 1e-12).all() and (design[:, columns] <= high + 1e-12).all()
        away = ((design[:, columns] - low) / (high - low)).sum(axis=1)
        effector = effector + 5e-3 * np.exp(-20.0 * away)[:, None] * np.eye(3)[0]
        rows, found = len(design), np.ones(len(design), bool)
        return StratifiedStates(
            np.repeat(commands.stratum, states), np.repeat(np.arange(count), states), design, command, displacement,
            command, effector, np.zeros((rows, n), bool), ~found, np.ones(rows), np.zeros(rows), found,
        )  # fmt: skip

    monkeypatch.setattr(module, "solve_commands", solve)
    found = adversarial_search(model, 320, 4, seed=0)
    judged = predict(model, found)
    assert 300 <= len(found) <= 340 and (found.stratum == "adversarial").all()
    assert judged.trusted.mean() > 0.3
    # They are close to the limit of trust, unlike random states.
    assert np.median(judged.uncertainty[judged.trusted]) > 0.8e-3
    random = predict(model, predicted_states(model, "inside", 80, 4, 0))
    assert np.median(random.uncertainty) < 0.6e-3
    assert judged.error[judged.trusted].max() > 2e-3
    again = adversarial_search(model, 320, 4, seed=0)
    np.testing.assert_array_equal(again.design, found.design)


def test_an_attack_reaches_the_bounds_of_a_box_of_trust_inside_the_design_box():
    """The training of the finger with one cable ends at a Poisson's ratio of 0.4988, its design box at 0.499."""
    model = pretrained_model(make_robot("finger", cables=1))
    model = with_domain(model, limit=1.0)
    space, domain = model.robot.design_space, model.domain
    k = space.names.index("poisson_ratio")
    d, n = len(learned_variables(model.robot)), model.count
    vertices = module._designs(model, np.stack([np.zeros(d), np.ones(d)]))
    assert model.context(vertices).arrays["known"].all()
    assert vertices[1, k] == domain.design_high[k] < space["poisson_ratio"].high
    assert vertices[0, k] == space["poisson_ratio"].low
    # One step from the bound: nothing is untrusted for another reason here, so all bodies arrive there.
    x, c = np.full((20, d), 0.5), np.full((20, 3, n), 0.5)
    x[:, learned_variables(model.robot).index("poisson_ratio")] = 0.97
    moved, _ = module._climb(model, x, c, steps=1)
    assert (module._designs(model, moved)[:, k] == domain.design_high[k]).all()


def test_bodies_with_one_design_are_told_by_their_commands(trunk):
    designs = np.tile(trunk.robot.design_space.baseline.array, (4, 1))
    designs[3] *= 1.01
    command = np.arange(4 * 2 * trunk.count, dtype=float).reshape(4, 2, -1)
    states = predicted_states(trunk, "inside", 2, 2, 0)
    # The second body could not be built.
    found = replace(
        states, design=np.repeat(designs[[0, 2]], 2, axis=0), command=command[[0, 2]].reshape(4, trunk.count)
    )
    worst = module._worst_of_bodies(designs, command, found, np.array([1.0, 2.0, 4.0, 3.0]))
    assert worst.tolist() == [2.0, 0.0, 4.0, 0.0]


def test_searches_go_on_below_the_limit_that_the_last_one_left(trunk, tmp_path, monkeypatch):
    """The first search finds errors of 3 mm, the second none."""
    folder = tmp_path / "weights"
    shutil.copytree(pretrained_folder(trunk.robot), folder)

    def errors(size):
        return lambda spread, rng: np.full(len(spread), size)

    known = [
        predicted_states(trunk, s, 10, 4, k, errors(1e-4)) for k, s in enumerate(strata_of(trunk.robot, buckles=False))
    ]
    monkeypatch.setattr(module, "judged_states", lambda *_, **__: StratifiedStates.join(known))
    limits = []

    def search(model, count, states, seed, folder, number, workers):
        limits.append(model.domain.limit)
        found = predicted_states(model, "corners", 10, 4, 50 + number, errors(3e-3 if number == 1 else 1e-4))
        return replace(found, stratum=np.full(40, "adversarial"))

    monkeypatch.setattr(module, "adversarial_search", search)
    calibrate(folder, trunk.robot, bodies=10, states=4, adversarial_states=40)
    card = load_model(folder, trunk.robot).card
    assert limits[0] == trunk.robot.goal_tolerance > limits[1] > 0.0 and len(limits) == 2
    assert card["calibration"]["limits"] == limits and card["domain"]["limit"] == pytest.approx(limits[1], rel=1e-4)


def test_a_soft_command_without_an_equilibrium_costs_growth_rather_than_uncertainty():
    """A hundred good states and a lost one, which is softer than nearly all of them but has a small spread."""
    found = np.arange(101) < 100
    growth = np.append(np.linspace(1.0, 2.0, 100), 1.9)
    uncertainty = np.append(np.full(100, 5e-4), 1e-4)
    judged = Predictions(np.full(101, 1e-4), uncertainty, uncertainty, np.full(101, True), growth, found)
    stratum = np.full(101, "inside")
    softest, limit = safe_bounds(judged, stratum, 2e-3, 2.0, 2e-3)
    assert 1.8 < softest < 1.9 and limit == 2e-3
    # A body that does not buckle has the other limit only, and bounds are never above those that were searched.
    assert safe_bounds(judged, stratum, 2e-3, np.inf, 2e-3) == (np.inf, pytest.approx(0.8e-4))
    assert safe_bounds(judged, stratum, 2e-3, 1.5, 7e-4) == (1.5, 7e-4)


def test_a_new_calibration_sets_its_own_limit_of_growth(trunk, tmp_path, monkeypatch):
    """Growth is made up. At first some commands have no equilibrium, in the end all have one."""
    folder = tmp_path / "weights"
    shutil.copytree(pretrained_folder(trunk.robot), folder)
    growth, lost = np.ones(40), [0, 10, 20, 30]

    def off(spread, rng):
        return np.full(len(spread), 1e-4)

    def known(model, *_):
        kinds = strata_of(model.robot, buckles=model.domain.limits_growth)
        assert "near buckling" not in kinds  # an earlier calibration's limit does not count
        states = StratifiedStates.join([predicted_states(model, kind, 10, 4, k, off) for k, kind in enumerate(kinds)])
        states.found[40 + np.array(lost, dtype=int)] = False
        return states

    def softness(model):
        return lambda designs, commands: growth[np.arange(len(designs)) % 40]

    monkeypatch.setattr(module, "_drawn", lambda model, stratum, *_: predicted_states(model, stratum, 10, 4, 9, off))
    monkeypatch.setattr(module, "softness", softness)
    monkeypatch.setattr(module, "judged_states", known)
    for largest in (2.0, 3.0):
        growth[:] = np.linspace(1.0, largest, 40)
        calibrate(folder, trunk.robot, bodies=10, states=4, adversarial_states=0)
        card = load_model(folder, trunk.robot).card
        assert card["domain"]["growth"] == pytest.approx(np.quantile(growth, module.USUAL))
        assert card["calibration"]["limits_growth"] is True
    lost.clear()
    calibrate(folder, trunk.robot, bodies=10, states=4, adversarial_states=0)
    card = load_model(folder, trunk.robot).card
    assert "growth" not in card["domain"] and card["calibration"]["limits_growth"] is False


def test_calibration_of_weights_from_start_to_end(tmp_path, monkeypatch):
    robot = make_robot("trunk")
    folder = tmp_path / "weights"
    shutil.copytree(pretrained_folder(robot), folder)
    monkeypatch.setattr(module, "SEARCHES", 1)  # each takes seconds; for more see above
    arguments = ["trunk", "--weights", str(folder), "--folder", str(tmp_path / "states")]
    arguments += ["--bodies", "6", "--states", "2", "--adversarial-states", "16"]
    result = CliRunner().invoke(calibrate_trust, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    rows = json.loads(result.output)
    assert rows.keys() == {"inside", "faces", "corners", "slack corners", "adversarial"}
    model = load_model(folder, robot)
    assert model.card["calibration"]["strata"] == rows
    assert 0.0 < model.domain.limit <= robot.goal_tolerance
    assert all(row["worst_trusted"] <= robot.goal_tolerance for row in rows.values())
    assert all(getattr(model.domain.calibration, name) > 0.0 for name in FACTOR_OF.values())
    card = (folder / "model.json").read_text()
    # A second run finds all states, and the same calibration, although the weights have been calibrated.
    monkeypatch.setattr(strata, "_solve_body", None)
    again = calibrate(folder, robot, bodies=6, states=2, adversarial_states=16, state_folder=tmp_path / "states")
    assert (folder / "model.json").read_text() == card
    assert again.keys() == rows.keys()
    kept = module.calibration_states(load_model(folder, robot), tmp_path / "states")
    assert {name: asdict(row) for name, row in report(model, kept).items()} == rows
    # A test on other states leaves the card as it is, and refuses those of the calibration.
    monkeypatch.undo()
    new = ["trunk", "--test", "--weights", str(folder), "--bodies", "2", "--states", "2", "--adversarial-states", "8"]
    result = CliRunner().invoke(calibrate_trust, [*new, "--seed", "12"], catch_exceptions=False)
    assert json.loads(result.output).keys() == rows.keys()
    assert (folder / "model.json").read_text() == card
    with pytest.raises(ValueError, match="seed = 11 is that of the calibration"):
        CliRunner().invoke(calibrate_trust, new, catch_exceptions=False)


def test_a_calibration_names_the_weights_that_it_writes_to():
    result = CliRunner().invoke(calibrate_trust, ["trunk"])
    assert result.exit_code == 2 and "--weights FOLDER is missing" in result.output
    result = CliRunner().invoke(calibrate_trust, ["tetrapod", "--test"])
    assert result.exit_code == 2 and "learned parts" in result.output


def test_weights_without_a_spread_are_refused(tmp_path):
    trunk = make_robot("trunk")
    save_model(load_model(pretrained_folder(trunk), trunk, members=1), tmp_path)
    with pytest.raises(WeightsError, match=r"two or more members.*have one member of kind 'potential'"):
        calibrate(tmp_path, trunk, bodies=2, states=1, adversarial_states=0)


# -- shipped weights --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", shipped_robots())
def test_shipped_weights_hold_what_trust_promises(variant):
    name, options = shipped_robots()[variant]
    robot = make_robot(name, **options)
    model = pretrained_model(robot)
    if "calibration" not in model.card:
        assert model.domain.calibration == Calibration()
        return
    calibration = model.card["calibration"]
    rows = dict(calibration["strata"])
    judged = make_robot(calibration["within"]) if "within" in calibration else robot  # whose effector is judged
    assert model.domain.limit <= robot.goal_tolerance
    assert max(row["worst_trusted"] for row in rows.values()) <= judged.goal_tolerance
    assert all(row["unsolved"] == 0 for row in rows.values())
    assert ("adversarial" in rows) == bool(calibration.get("adversarial_states"))
    rows.pop("adversarial", None)
    rows.pop(TOUCHING, None)
    assert rows.keys() == set(strata_of(judged, buckles=model.domain.limits_growth))
    if judged is not robot:  # one factor for all strata
        states = sum(row["states"] for row in rows.values())
        rows = {"all": {"states": states, "coverage": sum(r["coverage"] * r["states"] for r in rows.values()) / states}}
    for row in rows.values():
        covered = conformal_quantile(np.arange(1.0, row["states"] + 1.0)) / row["states"]
        # At the corners of a symmetric body, up to four mirrored states have the same error and lie on the quantile.
        one = 1.01 / row["states"]
        assert covered - max(0.01, one) <= row["coverage"] <= covered + max(0.01, 4 * one)


def test_the_trunk_is_right_where_it_is_trusted(trunk):
    robot = trunk.robot
    if "calibration" not in trunk.card:
        pytest.skip("these weights are calibrated on their validation states only")
    rows = report(trunk, judged_states(trunk, 6, 3, seed=77))
    assert all(row.worst_trusted <= robot.goal_tolerance for row in rows.values())
    assert np.mean([row.coverage for row in rows.values()]) > 0.8
    assert rows["inside"].trusted > 0.5

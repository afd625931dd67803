"""Strata of test states, and points on the boundary of the boxes in training data."""

import json
from dataclasses import replace

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign
from softgym_envs.extensions.fitting.data import strata
from softgym_envs.extensions.fitting.data.dataset import generate_dataset
from softgym_envs.extensions.fitting.data.sampling import SamplingPlan, pushed
from softgym_envs.extensions.fitting.data.strata import (
    Commands,
    StratifiedStates,
    draw_commands,
    solve_commands,
    strata_of,
)
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.surrogate.features import learned_variables
from softgym_envs.surrogate.pretrained import shipped_robots


def ends_of(robot, designs):
    """Which learned variables lie at a bound of their box, shape (N, k)."""
    columns = [robot.design_space.names.index(name) for name in learned_variables(robot)]
    bounds = np.array(
        [[robot.design_space[name].low, robot.design_space[name].high] for name in learned_variables(robot)]
    )
    values = designs[:, columns]
    assert ((values >= bounds[:, 0]) & (values <= bounds[:, 1])).all()
    return (values == bounds[:, 0]) | (values == bounds[:, 1])


@pytest.mark.parametrize("name, options", shipped_robots().values(), ids=shipped_robots())
def test_every_robot_has_strata_where_they_say(name, options):
    robot = make_robot(name, **options)
    columns = [robot.design_space.names.index(name) for name in learned_variables(robot)]
    for stratum in strata_of(robot, buckles=False):
        commands = draw_commands(robot, stratum, 30, 5, seed=1)
        assert commands.design.shape[0] == 30 and commands.command.shape == (30, 5, len(robot.actuators))
        assert (commands.command >= robot.lower).all() and (commands.command <= robot.upper).all()
        at_bound = ends_of(robot, commands.design).sum(axis=1)
        expected = {"inside": 0, "faces": 1}.get(stratum, len(learned_variables(robot)))
        assert (at_bound == expected).all()
        if "corners" in stratum:  # no vertex is drawn twice before all are drawn
            assert len(np.unique(commands.design[:, columns], axis=0)) == min(30, 2 ** len(columns))
        if stratum == "slack corners":
            low, high = (np.isclose(commands.command, end, 1e-9, 0.0) for end in (robot.lower, robot.upper))
            assert (low | high).all() and low.any(axis=2).all() and high.any(axis=2).all()
        again = draw_commands(robot, stratum, 30, 5, seed=1)
        assert (again.design == commands.design).all() and (again.command == commands.command).all()


def test_states_near_buckling_are_the_softest():
    robot = make_robot("diamond")

    def softness(designs, commands):
        return commands[:, 0]

    commands = draw_commands(robot, "near buckling", 6, 4, seed=0, softness=softness)
    assert commands.command.shape == (6, 4, 4)
    assert (commands.command[:, :, 0] > robot.upper[0] - 0.1 * (robot.upper - robot.lower)[0]).all()
    with pytest.raises(ValueError, match="need an estimate of the softness"):
        draw_commands(robot, "near buckling", 1, 1)
    with pytest.raises(ValueError, match="stratum = 'edges' is unknown; allowed: 'inside', 'faces'"):
        draw_commands(robot, "edges", 1, 1)


def test_states_are_the_equilibria_under_their_commands(tmp_path):
    from softgym_envs.backends.fem import FEMBackend

    robot = make_robot("trunk")
    states = solve_commands(robot, draw_commands(robot, "slack corners", 3, 4, seed=2), second_start=True)
    assert len(states) == 12 and states.found.all() and (states.stratum == "slack corners").all()
    assert states.slack.any(axis=1).mean() > 0.8
    assert states.apart.max() < 1e-6
    for row in (0, 5, 11):
        backend = FEMBackend(robot, dict(zip(robot.design_space.names, states.design[row].tolist(), strict=True)))
        found = backend.probe(states.command[row])
        np.testing.assert_allclose(found.effector.ravel(), states.effector[row], atol=1e-7)
    beyond = (states.displacement - states.command) / (robot.upper - robot.lower)
    assert (beyond[states.slack] > 1e-6).all() and np.abs(beyond[~states.slack]).max() <= 1e-6
    assert np.abs(states.effort[states.slack]).max() < 1e-6 * states.effort.max()
    states.save(tmp_path / "states.npz")
    read = StratifiedStates.load(tmp_path / "states.npz")
    assert (read.effector == states.effector).all() and (read.stratum == states.stratum).all()
    both = StratifiedStates.join([states, read.rows(np.arange(4))])
    assert len(both) == 16 and np.unique(both.body).tolist() == [0, 1, 2, 3]


def test_a_second_start_tells_other_equilibria(monkeypatch):
    robot = make_robot("trunk")
    commands = draw_commands(robot, "inside", 1, 2)

    def elsewhere(robot, statics, rest, wanted):
        yield from ((k, statics.solve(0.5 * wanted[k])) for k in range(2))

    half = solve_commands(robot, Commands(commands.stratum, commands.design, 0.5 * commands.command))
    monkeypatch.setattr(strata, "solve_path", elsewhere)
    states = solve_commands(robot, commands, second_start=True)
    # The state from rest counts; the other one is only compared with it.
    assert states.apart == pytest.approx(np.abs(states.effector - half.effector).max(axis=1), rel=1e-6)
    assert states.apart.min() > 1e-3


def test_commands_and_bodies_without_equilibrium_are_marked(monkeypatch):
    robot = make_robot("trunk")
    build = robot.build
    bodies = []

    def some(design):
        bodies.append(design)
        if len(bodies) == 1:
            raise InfeasibleDesign("cannot be built")
        return build(design)

    monkeypatch.setattr(robot, "build", some)
    commands = draw_commands(robot, "inside", 2, 3)
    commands.command[1, 1] = np.nan
    solve = Statics.solve

    def solved(self, command, *args):
        if np.isnan(command).any():
            raise ConvergenceError("no equilibrium")
        return solve(self, command, *args)

    monkeypatch.setattr(Statics, "solve", solved)
    states = solve_commands(robot, commands)
    assert len(bodies) == 2 and len(states) == 3
    assert states.found.tolist() == [True, False, True]
    assert np.isnan(states.effector[1]).all() and np.isfinite(states.effector[[0, 2]]).all()


def test_states_that_no_convex_energy_can_have_do_not_count():
    """Taut cables hold this gripper where it would buckle under their tensions."""
    robot = make_robot("two_finger_gripper")
    design = {"length": 0.0398, "height": 0.0214, "joint_height": 0.0052, "poisson_ratio": 0.307, "bar_length": 0.051}
    pulls = np.array([0.016, 0.0025, 0.0195, 0.004]) * np.linspace(0.2, 1.0, 5)[:, None]
    commands = Commands(np.array(["inside"]), robot.design_space.complete(design).array[None], pulls[None])
    states = solve_commands(robot, commands)
    assert states.found.tolist() == [True, True, True, True, False]
    assert np.isfinite(states.growth[:4]).all()
    assert not Statics(robot.build(design)).solve(pulls[-1]).stable  # it is there


def test_mirror_images_of_commands_are_not_solved_again(monkeypatch):
    robot = make_robot("finger", mesh="accurate", mesh_size=0.02, self_contact=False)
    space, count = robot.design_space, []
    command = np.array([[[0.01, 0.0], [0.002, 0.006], [0.0, 0.01], [0.01, 0.0]]])
    commands = Commands(np.array(["inside"]), space.complete(None).array[None], command)
    solve = Statics.solve
    monkeypatch.setattr(Statics, "solve", lambda *args: (count.append(1), solve(*args))[1])
    states = solve_commands(robot, commands)
    assert states.found.all()
    solved = len(count)
    monkeypatch.setattr(robot, "learning", replace(robot.learning, symmetries=()))
    every = solve_commands(robot, commands)
    assert len(count) == 2 * solved + 1
    for name in ("displacement", "effort", "effector", "slack", "growth"):
        np.testing.assert_allclose(getattr(states, name), getattr(every, name), rtol=1e-6, atol=1e-9)


def test_bodies_lie_within_narrower_bounds():
    robot = make_robot("finger")
    bounds = {"joint_height": (0.0055, 0.007)}
    column = robot.design_space.names.index("joint_height")
    for stratum in strata_of(robot, buckles=False):
        heights = draw_commands(robot, stratum, 40, 1, bounds=bounds).design[:, column]
        assert heights.min() >= 0.0055 and heights.max() <= 0.007
        at_bounds = np.isin(heights, bounds["joint_height"])
        assert at_bounds.all() if "corners" in stratum else not at_bounds.all()


def test_an_interrupted_run_continues_with_the_next_body(tmp_path, monkeypatch):
    robot = make_robot("trunk")
    commands = draw_commands(robot, "inside", 3, 2)
    solved, solve = [], strata._solve_body

    def counted(robot, commands, number, second_start):
        if len(solved) == 2:
            raise KeyboardInterrupt
        solved.append(number)
        return solve(robot, commands, number, second_start)

    monkeypatch.setattr(strata, "_solve_body", counted)
    with pytest.raises(KeyboardInterrupt):
        solve_commands(robot, commands, folder=tmp_path)
    assert solved == [0, 1]
    # What the interrupted run left can be used as it is.
    kept = solve_commands(robot, commands, folder=tmp_path, kept_only=True)
    assert kept.body.tolist() == [0, 0, 1, 1] and (kept.command == commands.command[:2].reshape(-1, 6)).all()
    assert solved == [0, 1]
    with pytest.raises(DataError, match="holds no states of the stratum 'inside' with these commands"):
        solve_commands(robot, commands, folder=tmp_path / "empty", kept_only=True)
    solved[:] = [None]
    states = solve_commands(robot, commands, folder=tmp_path)
    assert solved == [None, 2]
    assert states.body.tolist() == [0, 0, 1, 1, 2, 2]
    assert (states.command == commands.command.reshape(-1, 6)).all()
    # Other commands of the same body are solved.
    solved[:] = []
    other = Commands(commands.stratum[:1], commands.design[:1], 0.5 * commands.command[:1])
    assert (solve_commands(robot, other, folder=tmp_path).command == other.command[0]).all() and solved == [0]


def test_several_processes_solve_the_same_states(tmp_path, monkeypatch):
    robot, asked, parallel_map = make_robot("trunk"), [], strata.parallel_map

    def counted(function, arguments, workers):
        asked.append(workers)
        return parallel_map(function, arguments, workers)

    monkeypatch.setattr(strata, "parallel_map", counted)
    commands = draw_commands(robot, "inside", 3, 2)
    alone, together = (solve_commands(robot, commands, folder=tmp_path / str(n), workers=n) for n in (1, 2))
    assert asked == [1, 2]
    for name, values in vars(alone).items():
        other = vars(together)[name]
        if values.dtype.kind == "f":  # their last digits depend on where arrays lie in memory
            np.testing.assert_allclose(other, values, rtol=1e-6, atol=1e-12)
        else:
            np.testing.assert_array_equal(other, values)


def test_states_that_touch_are_marked():
    wall = {"kind": "plane", "point": [0.0, 0.045, 0.0], "normal": [0.0, -1.0, 0.0]}
    robot = make_robot("finger", obstacles=[wall])
    commands = draw_commands(robot, "inside", 1, 2)
    commands.design[:] = robot.design_space.complete(None).array
    commands.command[:] = [[[0.0, 0.0], [0.01, 0.01]]]
    states = solve_commands(robot, commands)
    assert states.found.all()
    assert states.touching.tolist() == [False, True]
    assert states.stratum.tolist() == ["inside", "inside"]


def test_pushed_points_lie_on_faces_edges_and_vertices(rng):
    points = rng.random((4000, 3))
    moved = pushed(points, rng)
    count = (moved != points).sum(axis=1)
    assert ((moved == points) | (moved == np.round(points))).all()
    # The number of moved coordinates is uniform from none to all.
    assert np.bincount(count, minlength=4) / 4000 == pytest.approx([0.25] * 4, abs=0.04)


def test_a_share_of_the_training_bodies_lies_on_the_boundary():
    robot = make_robot("finger")
    plain, half, every = (SamplingPlan(200, 3, "random", seed=1, boundary=share) for share in (0.0, 0.5, 1.0))
    drawn = [np.array([d.array for d in plan.designs(robot, 0, 200)]) for plan in (plain, half, every)]
    on_boundary = [ends_of(robot, designs).any(axis=1) for designs in drawn]
    assert not on_boundary[0].any()
    assert 0.3 < on_boundary[1].mean() < 0.5 and 0.7 < on_boundary[2].mean() < 0.9
    # Other bodies are those of the plan without the option, and parts of a plan agree with the whole.
    columns = [robot.design_space.names.index(name) for name in learned_variables(robot)]
    same = (drawn[0] == drawn[1])[:, columns].all(axis=1)
    assert 0.5 < same.mean() < 0.7
    part = np.array([d.array for d in half.designs(robot, 120, 30)])
    assert (part == drawn[1][120:150]).all()
    at_ends = [np.isin(half.commands(robot, group), [0.0, 0.02]).any() for group in range(200)]
    assert 0.38 < np.mean(at_ends) < 0.58  # 26 of 27 groups of the half
    assert not any(np.isin(plain.commands(robot, group), [0.0, 0.02]).any() for group in range(200))
    with pytest.raises(ValueError, match=r"boundary = 1.5 is out of bounds; allowed: \[0, 1\]"):
        SamplingPlan(1, 1, boundary=1.5)


def test_commands_may_come_from_a_part_of_their_ranges():
    robot = make_robot("finger")
    whole, part = (SamplingPlan(9, 3, seed=1, share=share) for share in (1.0, 0.25))
    for group in range(9):
        assert part.designs(robot, group, 1) == whole.designs(robot, group, 1)
        assert part.commands(robot, group) == pytest.approx(0.25 * whole.commands(robot, group))
    with pytest.raises(ValueError, match=r"share = 2.0 is out of bounds; allowed: \[0, 1\]"):
        SamplingPlan(1, 1, share=2.0)


def test_a_dataset_without_the_option_is_continued(tmp_path):
    plan = SamplingPlan(2, 1, "halton", 3)
    generate_dataset(tmp_path, "trunk", plan, groups_per_shard=1, progress=False)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    del manifest["plan"]["boundary"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    data = generate_dataset(tmp_path, "trunk", SamplingPlan(3, 1, "halton", 3), groups_per_shard=1, progress=False)
    assert data["rest"].sum() == 3
    with pytest.raises(DataError, match=r"different: plan\)"):
        generate_dataset(
            tmp_path, "trunk", SamplingPlan(3, 1, "halton", 3, boundary=0.5), groups_per_shard=1, progress=False
        )

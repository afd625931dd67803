"""softgym validate on recordings made here, with known differences between robot and model."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.backends.fem import FEMBackend
from softgym_envs.envs.plant import play
from softgym_envs.extensions.design.measurements import Measurements
from softgym_envs.extensions.measured import silicone_beam_recordings, tendon_cone_recordings, tendon_rod_recordings
from softgym_envs.extensions.measured.comparison import SOURCES
from softgym_envs.extensions.measured.silicone_beam import LENGTH, MESHES, SiliconeBeam, box_of_tetrahedra
from softgym_envs.mechanics.solvers.statics import Statics


@pytest.mark.parametrize("robot", sorted(SOURCES))
def test_without_data_it_says_where_they_are(softgym, robot):
    status, out, _ = softgym("validate", robot)
    assert status == 0
    assert SOURCES[robot].folder in out and f"softgym validate {robot} --data FOLDER" in out


def test_wrong_robots_and_empty_folders(refused, tmp_path):
    assert "unknown robot 'finger'" in refused("validate", "finger", "--data", ".")
    assert "copy *train.csv" in refused("validate", "tendon_rod", "--data", ".")


@pytest.mark.parametrize("robot", sorted(SOURCES))
def test_robots_of_the_extension(robot):
    """W is the derivative of the equilibrium, as for every robot."""
    backend = FEMBackend(make_robot(robot))
    n = len(backend.robot.actuators)
    half, step = backend.robot.displacements(np.full((1, n), 0.3))[0], 1e-6
    base = backend.step(half)
    taut = np.flatnonzero(~base.slack)
    exact = base.condensed.W.ea[:, taut] @ np.linalg.inv(base.condensed.W.aa[taut[:, None], taut])
    change = step * np.isin(np.arange(len(half)), taut[:1])
    ends = [backend.step(half + sign * change).effector.ravel() for sign in (1.0, -1.0)]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2.0 * step), exact[:, 0], rtol=1e-4, atol=1e-5)


def test_a_box_of_tetrahedra():
    nodes, tetrahedra = box_of_tetrahedra((2, 3, 1))
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    volumes = np.linalg.det(edges) / 6.0
    assert (volumes > 0.0).all() and volumes.sum() == pytest.approx(1.0)


def test_a_beam_of_known_motion(tmp_path, monkeypatch, softgym, write_c3d):
    """Markers that move as the computed ones do are met to the precision of the file, on the mesh they come from."""
    monkeypatch.setattr(silicone_beam_recordings, "MESHES", {"fine": (4, 2, 2)})
    monkeypatch.setitem(MESHES, "fine", (4, 2, 2))
    monkeypatch.setattr(silicone_beam_recordings, "ELEMENTS", ("quadratic",))
    places = silicone_beam_recordings.PLACES
    for word, load in silicone_beam_recordings.LOADS.items():
        model = SiliconeBeam(mesh="fine").build({"tip_load": load})
        rest = np.concatenate([c.value(model.nodes) for c in model.constraints["e"]])
        moved = (Statics(model).solve([0.0], "effort").condensed.delta.e - rest).reshape(3, 3)
        end = places.copy()
        end[:3] += moved
        share = np.clip((np.arange(120) - 40) / 5.0, 0.0, 1.0)[:, None, None]
        # The cameras see it turned and elsewhere.
        frames = ((1.0 - share) * places + share * end)[:, :, [1, 2, 0]] + 0.5
        write_c3d(tmp_path / f"beam_{word}_a.c3d", frames)
    monkeypatch.chdir(tmp_path)
    status, out, _ = softgym("validate", "silicone_beam", "--data", ".", "--page", "page.html")
    assert status == 0
    assert "vertical error, largest of all markers and loads: 0.00 mm" in out
    page = (tmp_path / "page.html").read_text()
    assert page.count("<img") == 1 and "Error by load, element and mesh" in page
    assert LENGTH == 0.1


TRUTH = {"young_modulus": 4.2e5, "density": 1150.0}


def test_a_cone_of_known_material(tmp_path, monkeypatch, softgym):
    """Five unnamed markers in any order: material and mounting are found, and held-out pulls predicted."""
    rng = np.random.default_rng(4)
    backend = FEMBackend(make_robot("tendon_cone"), TRUTH)
    names = [f"m{motor}_u0{digits}" for motor in (1, 2) for digits in ("1", "15", "2", "25")]
    for name in names:
        backend.reset()
        own = backend.step(tendon_cone_recordings.tensions(name), "effort").effector
        seen = own @ tendon_cone_recordings.TURN + tendon_cone_recordings.BASE + tendon_cone_recordings.CENTRE
        points = np.vstack([seen, tendon_cone_recordings.BASE])[rng.permutation(5)]
        with open(tmp_path / f"{name}.csv", "w", newline="") as stream:
            rows = [[k, 0.005 * k, *(points + rng.normal(0.0, 2e-4, (5, 3))).ravel()] for k in range(20)]
            csv.writer(stream).writerows(rows)
    (tmp_path / "m12_u01.csv").write_text("0,0\n")  # both tendons pulled: how much each is not in its name
    data = tendon_cone_recordings.read(tmp_path)
    assert data.trials == tuple(sorted(names))
    found = tendon_cone_recordings.compare(tmp_path)
    mean, held_out = (float(line.ours.removesuffix(" mm")) for line in found.lines[:2])
    assert mean < 0.3 and held_out < 0.3
    assert [line.ours for line in found.lines if "left out" in line.what] == ["m12_u01.csv"]
    (modulus,) = [text for text in found.fitted if text.startswith("young_modulus")]
    low, high = (float(text) for text in modulus.split()[2:5:2])
    assert 415.0 < low < high < 425.0
    (tmp_path / "m1_u01.csv").unlink()
    monkeypatch.chdir(tmp_path)
    status, _, err = softgym("validate", "tendon_cone", "--data", ".")
    assert status == 2 and "lacks m1_u01.csv" in err


STRETCH, TWIST, TURN = 6e-4, 0.12, -0.1
ZEROS = 1e-3 * np.array([0.4, -0.3, 0.2, 0.5, 0.3, 0.0, 0.6, 0.1, 0.2])


def rod_poses(path, trials, rng, noise, version="v6"):
    """Write poses of a rod whose tendons stretch and whose servos have offsets, seen in a turned frame."""
    robot = make_robot("tendon_rod", version=version)
    backend = FEMBackend(robot, {"twist": TWIST}, cable_compliance=STRETCH)
    header = ["timestamp", "pattern_label", *(f"servo_{n}_mm" for n in tendon_rod_recordings.SERVOS[version])]
    c, s = np.cos(TURN), np.sin(TURN)
    rows = []
    for k, fractions in enumerate(rng.uniform(0.0, 1.0, (6 * trials, 9))):
        pulls = robot.displacements(fractions[None])[0]
        tip = backend.step(pulls - ZEROS).effector[0] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        seen = 1e3 * (tip * [-1.0, -1.0, 1.0] + rng.normal(0.0, noise, 3))
        label = f"rep1_seg{k // 6 % 3 + 1}_dir{k // 6}" + ("_hold" if k % 6 == 5 else "")
        rows.append([k, label, *(1e3 * pulls), *seen])
    with open(path, "w", newline="") as stream:
        csv.writer(stream).writerows([[*header, "tip_x", "tip_y", "tip_z"], *rows])


@pytest.mark.parametrize(("version", "held_out_file"), [("v6", False), ("v4", True)])
def test_a_rod_of_known_tendons(tmp_path, version, held_out_file):
    rng = np.random.default_rng(7)
    rod_poses(tmp_path / "made_train.csv", 12, rng, 3e-4, version)
    if held_out_file:
        rod_poses(tmp_path / "made_val.csv", 3, rng, 3e-4, version)
    found = tendon_rod_recordings.compare(tmp_path)
    assert float(found.lines[0].ours.split()[0]) < 1.0
    values = {text.split()[0]: [float(v) for v in text.replace(" to ", " ").split()[1:4]] for text in found.fitted}
    truth = {"twist": np.degrees(TWIST), "turn": np.degrees(TURN), "stretch": STRETCH}
    truth |= {f"zero_{name[-2:]}": 1e3 * zero for name, zero in zip(tendon_rod_recordings.TENDONS, ZEROS, strict=True)}
    outside = 0
    for name, true in truth.items():
        value, low, high = values[name]
        print(f"{name}: {true:.4g}, found {value:.4g}, {low:.4g} to {high:.4g}")
        width = high - low
        outside += not low <= true <= high
        assert low - width < true < high + width
    assert outside <= 2
    if held_out_file:
        assert "made_val.csv" in found.lines[0].what


def test_recordings_of_another_rod(refused, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    (folder / "x_train.csv").write_text("timestamp,pattern_label,servo_1_mm,tip_x\n0,a,0,0\n")
    assert "has no columns servo_N_mm of one of the robots v6, v4" in refused(
        "validate", "tendon_rod", "--data", folder
    )
    with pytest.raises(ValueError, match="version = 'v5' is unknown; allowed: 'v6', 'v4'"):
        make_robot("tendon_rod", version="v5")


@pytest.mark.parametrize("width", [0.0, 2e-3])
def test_friction_is_seen_in_poses_at_rest(rng, width):
    """Tips that follow the pulls, and tips that lag behind by a play, as friction would make them."""
    pulls = 1e-3 * np.cumsum(rng.normal(0.0, 0.7, (900, 3, 3)), axis=0)
    pulls[::6] = 1e-4 * rng.uniform(-1.0, 1.0, (150, 3, 3))
    pulls -= pulls.mean(axis=2, keepdims=True)
    bending = (pulls @ np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])).reshape(-1, 6)
    behind, tips = bending[0], []
    for now in bending:
        behind = play(now, behind, np.full(6, width))
        tips.append([3.0 * behind[0] - behind[1], 2.0 * behind[3], behind[5]])
    seen = pulls.reshape(-1, 9)
    data = Measurements("displacement", seen, np.full_like(seen, np.nan), np.array(tips), ("",) * len(seen))
    found = tendon_rod_recordings.scatter_at_rest(data)
    assert found["and a play of 2 mm"] < 1e-9
    assert found["knowing the present pulls"] > 0.3 if width else found["knowing the present pulls"] < 1e-9

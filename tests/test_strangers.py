"""Files of strangers run no code, show no secret, and are refused with one line where they are damaged."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

from softgym_envs import make_robot
from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.policy import Policy, policy_path
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.config import load_config
from softgym_envs.errors import ConfigError, DataError, WeightsError
from softgym_envs.extensions.leaderboard.board import _escaped
from softgym_envs.extensions.leaderboard.submission import Submission
from softgym_envs.extensions.motion.inertia import read_inertia
from softgym_envs.registry import ALLOW_CODE
from softgym_envs.robots.soft_finger import SoftFinger
from softgym_envs.runs import RunFolder
from softgym_envs.storage import read_json
from softgym_envs.surrogate.identity import class_of, difference, fingerprint
from softgym_envs.surrogate.pretrained import pretrained_folder
from softgym_envs.surrogate.weight_files import load_model
from tests.test_units import Bar

STUDY = {
    "name": "x",
    "environment": {"id": "SoftGym/FingerReach-v0"},
    "variables": ["length"],
    "objective": "mean_distance",
    "strategy": "qp",
    "trials": 3,
    "sampler": {"name": "random"},
    "finalists": {"count": 0},
}
CODE = "open('RAN', 'w').write('x')\nfrom softgym_envs.envs.tasks.reach import Reach\nclass Task(Reach): pass\n"


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A folder in which the module ``stranger_code`` leaves a file as soon as it is imported."""
    (tmp_path / "stranger_code.py").write_text(CODE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delenv(ALLOW_CODE, raising=False)
    yield tmp_path
    sys.modules.pop("stranger_code", None)


def study(folder, **changes):
    (folder / "x.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return folder / "x.yaml"


@pytest.mark.parametrize(
    "changes",
    [
        {"environment": {"robot": "finger", "task": "stranger_code:Task"}},
        {"environment": {"robot": "stranger_code:Arm", "task": "reach", "backend": "fem"}},
        {"environment": {"id": "SoftGym/FingerReach-v0", "backend": "stranger_code:Backend"}},
        {"objective": "stranger_code:objective"},
        {"secondary_objectives": ["stranger_code:objective"]},
        {"constraints": {"stranger_code:objective": 1.0}},
    ],
    ids=["task", "robot", "backend", "objective", "second objective", "constraint"],
)
def test_a_study_names_registered_things_only(changes, stranger):
    with pytest.raises(ConfigError, match=r"'stranger_code:\w+' names code, .*--allow-code"):
        load_config(study(stranger, **changes), StudyConfig)
    # A stranger's folder of a study is read as any other file.
    (stranger / "run").mkdir()
    shutil.copy(stranger / "x.yaml", stranger / "run" / "config.yaml")
    with pytest.raises(ConfigError):
        RunFolder(stranger / "run", StudyConfig, "a co-design study").config  # noqa: B018
    assert not (stranger / "RAN").exists()


def test_the_flag_of_the_user_runs_it(stranger):
    path = study(stranger, environment={"robot": "finger", "task": "stranger_code:Task"}, trials=1)
    command = [sys.executable, "-m", "softgym_envs.cli", "codesign", "--config", path.name, "--folder", "out"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    done = subprocess.run(command, cwd=stranger, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "names code" in done.stderr and not (stranger / "RAN").exists()
    done = subprocess.run([*command, "--allow-code"], cwd=stranger, env=environment, capture_output=True, check=False)
    assert (stranger / "RAN").exists()


def test_a_policy_names_registered_things_only(stranger):
    shipped = policy_path("finger_reach")
    shutil.copy(shipped, "policy.safetensors")
    card = json.loads(shipped.with_suffix(".json").read_text())
    card["config"]["environment"] = {"robot": "finger", "task": "stranger_code:Task"}
    Path("policy.json").write_text(json.dumps(card))
    with pytest.raises(WeightsError, match="task = 'stranger_code:Task' names code"):
        Policy("policy.safetensors")
    assert not Path("RAN").exists()


@pytest.mark.parametrize(
    "address",
    [
        *("postgresql://u@h/db?password=SECRETPW", "postgresql://u:a@SECRETPW@h/db", "postgresql://u:SECRETPW@h/db"),
        *("postgresql://u:a/SECRETPW@h:5432/db", "postgresql://u:SECRETPW:b@h:5432/db", "mysql://u:SECRETPW@h/db"),
        *("postgresql://u:a SECRETPW@h:5432/db", "postgresql://u@h/db?sslpassword=SECRETPW", "x://SECRETPW@"),
        *("postgresql://u@h/db?user=u&PASSWORD=SECRETPW", "postgresql+psycopg://u:%40SECRETPW@h/db"),
        *("postgresql://u:SECRETPW@h:port/db", "postgresql://[::1:SECRETPW@h/db", "'postgresql://u:SECRETPW@h/db"),
    ],
)
@pytest.mark.parametrize("form", ["storage={}", "storage.deeper={}", "storage {}", "trials={}", "goals=[{}]"])
def test_no_message_shows_a_password(address, form, tmp_path):
    with pytest.raises(ConfigError) as caught:
        load_config(study(tmp_path), StudyConfig, [form.format(address)])
    assert "SECRETPW" not in str(caught.value)


@pytest.mark.parametrize(
    "edit", [("mean_distance", "mean_effort"), ("# SHA-256", "# SHA-255"), ("trials: 3", "trials: 4")]
)
def test_an_edited_configuration_does_not_relabel_the_results_beside_it(edit, tmp_path):
    config = load_config(study(tmp_path), StudyConfig)
    RunFolder(tmp_path / "run", StudyConfig, "a co-design study").begin(config)
    assert RunFolder(tmp_path / "run", StudyConfig, "a co-design study").config == config
    stored = tmp_path / "run" / "config.yaml"
    stored.write_text(stored.read_text().replace(*edit))
    with pytest.raises(ConfigError, match="was edited after the run began"):
        RunFolder(tmp_path / "run", StudyConfig, "a co-design study").config  # noqa: B018


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trials: 24\ntrials: 3\n", "line 2: key 'trials' is given twice"),
        ("goals:\n  count: 3\n  count: 4\n", "line 3: key 'count' is given twice"),
        ("trials: 024\n", "line 1: '024' is no decimal number"),
        ("trials: 1:30\n", "line 1: '1:30' is no decimal number"),
        ("trials: 1:30.5\n", "line 1: '1:30.5' is no decimal number"),
        ("trials: 089\n", "line 1: '089' is no decimal number"),
        ("trials: " + "[" * 5000, "nested too deeply"),
        ("problem: &p {design: *p}", "not valid YAML: an alias stands for what it is in"),
        ("configurations: [first]", "configurations and defaults must be groups of keys"),
        ("defaults: 3\nconfigurations: {first: {}}", "configurations and defaults must be groups of keys"),
    ],
)
def test_yaml_is_read_as_people_read_it(text, message, tmp_path):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(tmp_path / "x.yaml", TrainConfig)


@pytest.mark.parametrize(("text", "value"), [("0.5", 0.5), ("-0.25", -0.25), ("1e-3", 1e-3), ("0", 0), ("10", 10)])
def test_decimal_numbers_stay_numbers(text, value):
    from softgym_envs.config import read_value

    assert read_value(text) == value


def test_json_that_is_nested_too_deeply_is_one_line(tmp_path):
    (tmp_path / "x.json").write_text("[" * 100_000)
    with pytest.raises(DataError, match="nested too deeply"):
        read_json(tmp_path / "x.json")


# -- weights ----------------------------------------------------------------------------------------------------------


def changed(path):
    """Change the last byte of a file."""
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def test_damaged_weights_are_noticed(tmp_path):
    finger = make_robot("finger")
    for name in ("model.json", "model.safetensors", "inertia.safetensors"):
        shutil.copy(pretrained_folder(finger) / name, tmp_path)
    load_model(tmp_path, finger)
    changed(tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match="damaged, or not those of the card beside them"):
        load_model(tmp_path, finger)
    read_inertia(tmp_path, finger)
    changed(tmp_path / "inertia.safetensors")
    with pytest.raises(WeightsError, match="damaged"):
        read_inertia(tmp_path, finger)
    for suffix in (".safetensors", ".json"):
        shutil.copy(policy_path("finger_reach").with_suffix(suffix), tmp_path / f"policy{suffix}")
    Policy(tmp_path / "policy.safetensors")
    changed(tmp_path / "policy.safetensors")
    with pytest.raises(WeightsError, match="is damaged"):
        Policy(tmp_path / "policy.safetensors")


class Softer(SoftFinger):
    """A body of its own under the name of its parent."""

    def equip(self, mesh, design):
        return super().equip(mesh, {**design, "young_modulus": 0.5 * design["young_modulus"]})


class Renamed(SoftFinger):
    name = "renamed_finger"


@pytest.mark.parametrize("robot", [Softer, Renamed])
def test_a_subclass_does_not_take_the_weights_of_its_parent(robot):
    env = gymnasium.make("SoftGym/Reach-v0", robot=robot)
    assert type(env.unwrapped.backend).__name__ == "FEMBackend"
    with pytest.raises(WeightsError, match=r"were trained for|no weights ship"):
        gymnasium.make("SoftGym/Reach-v0", robot=robot, backend="surrogate")
    assert class_of(make_robot("finger")) == "finger"


def test_a_fingerprint_tells_bodies_apart():
    class Edited(Bar):
        def assemble(self, design):
            model = super().assemble(design)
            self.edit(model)
            return model

        def edit(self, model):
            pass

    def after(change):
        return fingerprint(type("Edited", (Edited,), {"edit": lambda self, model: change(model)})())

    known = fingerprint(Bar())
    assert known["baseline"]["parts"][:2] == ["QuadraticTetrahedra", "Corotational"]  # the same in every process
    assert difference(json.loads(json.dumps(known)), after(lambda model: None)) == ""
    assert "compliance" in difference(known, after(lambda model: model.solids[0].set_elasticity(6e5, 0.3)))
    assert "actuators" not in difference(known, known)

    def moved(model):
        model.constraints["e"].clear()
        model.add_effector("tip", [0.1, 0.01, 0.012])

    assert "positions" in difference(known, after(moved))
    assert difference(None, known) == "the card has no fingerprint of the body"


# -- submissions ------------------------------------------------------------------------------------------------------

ROW = {"design": {"length": 0.04}, "judge": "qp", "values": {"d": 1.0}, "scores": [-1.0]}
SUBMISSION = {
    **{"problem": "p", "hash": "h", "method": "m", "author": "a", "level": "l", "judge": "qp", "seed": 0},
    **{"designs": [{"length": 0.04}], "controller": "qp", "claimed": [[-1.0]], "ledger": [ROW]},
}


@pytest.mark.parametrize(
    "changes",
    [
        *({"seed": -1}, {"seed": 2**40}, {"optimiser_seconds": -1.0}, {"optimiser_seconds": float("nan")}),
        *({"pretraining_steps": -5}, {"claimed": [[float("nan")]]}, {"designs": [{"length": float("inf")}]}),
        *({"ledger": [{**ROW, "scores": [float("nan")]}]}, {"ledger": [{**ROW, "environment_steps": -1}]}),
        *({"ledger": [{**ROW, "cpu_seconds": float("nan")}]}, {"ledger": [{**ROW, "share": 2.0}]}),
        *(
            {"ledger": [{**ROW, "share": 0.0}]},
            {"ledger": [{**ROW, "reason": "x"}]},
            {"ledger": [{**ROW, "scores": []}]},
        ),
        *({"ledger": [{**ROW, "values": {"d": float("inf")}}]}, {"ledger": [{**ROW, "design": {"length": np.nan}}]}),
    ],
)
def test_impossible_submissions_are_refused(changes):
    Submission.from_json(SUBMISSION)
    with pytest.raises(DataError) as caught:
        Submission.from_json({**SUBMISSION, **changes})
    assert "\n" not in str(caught.value)


def test_names_of_strangers_are_no_markup():
    shown = _escaped("<script>alert(1)</script> [x](javascript:y) | a\nb")
    assert not set("<>[]()|\n") & set(shown)


def test_an_archive_does_not_fill_the_memory(tmp_path, monkeypatch):
    from softgym_envs import storage

    path = tmp_path / "states.npz"
    np.savez_compressed(path, states=np.zeros(1_000_000))
    assert path.stat().st_size < 20_000
    assert storage.read_npz(path, ("states",))["states"].shape == (1_000_000,)
    monkeypatch.setattr(storage, "LARGEST_ARCHIVE", 7_000_000)
    with pytest.raises(DataError, match=r"states.npz' would unpack to 0.008 GB; allowed: 0.007 GB"):
        storage.read_npz(path, ("states",))
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DataError, match="one.npy' holds one array; expected an npz file of states"):
        storage.read_npz(tmp_path / "one.npy", ("states",))

"""Shipped configurations: found by name, copied, and paths that are relative to the file they stand in."""

import shutil
from pathlib import Path

import pytest
import yaml

from softgym_envs.agents.config import TrainConfig
from softgym_envs.cli import options
from softgym_envs.config import load_config, shipped_configs
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.design.config import CalibrationConfig

ROOT = Path(__file__).resolve().parent.parent
CALIBRATION = ROOT / "configs" / "design" / "finger_calibration.yaml"


def test_every_configuration_is_listed_under_its_verbs(softgym):
    status, out, _ = softgym("configs")
    assert status == 0
    assert set(options.VERBS) == {path.name for path in (ROOT / "configs").iterdir()}
    listed = {line.strip() for line in out.splitlines()}
    assert {name for kind in options.VERBS for name in shipped_configs(kind)} < listed
    assert {"finger_reach", "finger_reach_ppo", "finger_2cables_accurate"} < listed


def test_a_name_selects_the_kind_of_the_verb(softgym, monkeypatch):
    seen = []
    monkeypatch.setattr("softgym_envs.config.load_config", lambda path, *_: seen.append(path) or 1 / 0)
    for verb in ("train", "codesign"):
        with pytest.raises(ZeroDivisionError):
            softgym(verb, "--config", "finger_reach", "--folder", "x")
    assert seen == [shipped_configs(kind)["finger_reach"] for kind in ("agents", "codesign")]


def test_copies_can_be_edited_and_used(softgym, tmp_path):
    status, out, _ = softgym("configs", "--copy", tmp_path / "mine")
    assert status == 0 and "mine" in out
    config = load_config(tmp_path / "mine" / "design" / "finger_calibration.yaml", CalibrationConfig)
    assert Path(config.data) == tmp_path / "mine" / "design" / "finger_measured.csv"
    for kind in ("agents", "surrogate"):
        for name, path in shipped_configs(kind).items():
            copied = yaml.safe_load((tmp_path / "mine" / kind / f"{name}.yaml").read_text())
            assert "like" not in copied and (path.is_file() or "configurations" not in copied)
    one = load_config(tmp_path / "mine" / "agents" / "finger_reach_ppo.yaml", TrainConfig)
    assert one == load_config(shipped_configs("agents")["finger_reach_ppo"], TrainConfig)
    status, _, err = softgym("configs", "--copy", tmp_path / "mine")
    assert status == 2 and "exists" in err


def test_paths_in_a_file_are_relative_to_it_and_in_overrides_to_the_working_directory(tmp_path, monkeypatch):
    folder, here = tmp_path / "study", tmp_path / "here"
    folder.mkdir()
    here.mkdir()
    monkeypatch.chdir(here)
    for place in (folder, here):
        shutil.copy(CALIBRATION.parent / "finger_measured.csv", place)
    shutil.copy(CALIBRATION, folder)
    config = folder / CALIBRATION.name
    assert load_config(config, CalibrationConfig).data == str(folder / "finger_measured.csv")
    assert load_config(config, CalibrationConfig, ["data=finger_measured.csv"]).data == "finger_measured.csv"
    (folder / "finger_measured.csv").unlink()  # then the path is relative to the working directory
    assert load_config(config, CalibrationConfig).data == "finger_measured.csv"


SEVERAL = """
defaults: {environment: {id: SoftGym/FingerReach-v0}, sac: {gamma: 0.9, net_arch: [8]}, steps: 2000}
configurations:
  plain: {}
  wide: {sac: {net_arch: [64]}}
  longer: {like: wide, steps: 4000}
  wrong: {like: octopus}
  later: {like: last}
  last: {}
"""


def test_entries_of_a_file_hold_what_differs(tmp_path):
    path = tmp_path / "several.yaml"
    path.write_text(SEVERAL)
    plain, wide, longer = (load_config(path / name, TrainConfig) for name in ("plain", "wide", "longer"))
    assert (plain.settings.gamma, plain.settings.net_arch, plain.steps) == (0.9, [8], 2000)
    assert (wide.settings.gamma, wide.settings.net_arch, wide.steps) == (0.9, [64], 2000)
    assert (longer.settings.net_arch, longer.steps) == ([64], 4000)
    assert load_config(path / "wide", TrainConfig, ["steps=3000"]).steps == 3000 and wide.steps == 2000
    for place, message in (
        (path, r"several.yaml' holds several: add the name of one; allowed: plain, wide"),
        (path / "wider", r"unknown configuration 'wider'.*wide"),
        (path / "wrong", r"like none of those above it.*octopus"),
        (path / "later", r"like none of those above it.*last"),
        (tmp_path / "other.yaml" / "plain", "cannot be read"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config(place, TrainConfig)


def test_paths_in_options_and_names_of_policies(tmp_path):
    environment = {"id": "SoftGym/FingerReach-v0", "backend_options": {"weights": "./fit", "members": 1}}
    path = tmp_path / "train.yaml"
    path.write_text(yaml.safe_dump({"environment": environment, "initial": "finger_reach"}))
    (tmp_path / "fit").mkdir()
    (tmp_path / "finger_reach").mkdir()
    config = load_config(path, TrainConfig)
    assert config.environment.backend_options == {"weights": str(tmp_path / "fit"), "members": 1}
    assert config.initial == "finger_reach"


def test_names_are_completed(monkeypatch):
    parameter = options.ConfigFile("codesign")
    found = parameter.shell_complete(None, None, "finger_reach")
    names = ["finger_reach", "finger_reach_sac", "finger_reach_scratch"]
    assert [item.value for item in found] == names

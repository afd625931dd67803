"""The command line: every command, and one clear line with status 2 for bad input."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from softgym_envs.cli import app
from softgym_envs.codesign.scheduling import worker
from softgym_envs.extensions.recordings.films import write_video

ROOT = Path(__file__).resolve().parent.parent


def test_list_and_show(softgym, tmp_path):
    status, out, _ = softgym("list")
    assert status == 0 and "SoftGym/FingerReach-v0" in out and "surrogate" in out
    picture = tmp_path / "body.png"
    status, out, _ = softgym("show", "finger", "--design", "length=0.041", "--picture", picture)
    assert status == 0 and "joint_height" in out and "nodes" in out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_film_of_an_episode(softgym, tmp_path):
    film = tmp_path / "film.gif"
    status, out, _ = softgym("rollout", "SoftGym/FingerReach-v0", "--video", film)
    assert status == 0 and f"wrote {film}" in out
    with Image.open(film) as frames:
        assert frames.size == (480, 480) and frames.n_frames > 5
    status, _, error = softgym("rollout", "SoftGym/FingerReach-v0", "--video", film.with_suffix(".avi"))
    assert status == 2 and "must end with .gif" in error


def test_rollout_evaluate_and_record(softgym, tmp_path):
    status, out, _ = softgym("rollout", "SoftGym/FingerReach-v0", "--backend", "fem")
    assert status == 0 and "success True" in out
    recording = tmp_path / "episode.rrd"
    status, out, _ = softgym("rollout", "SoftGym/FingerTrack-v0", "--record", recording)
    assert status == 0 and recording.stat().st_size > 10_000
    assert "100 steps, return " in out and "final distance" in out and " mm, success" in out
    assert out.endswith(f"open it with 'softgym view {recording}'\n")
    status, _, error = softgym("rollout", "SoftGym/FingerTrack-v0", "--record", recording.with_suffix(".mp4"))
    assert status == 2 and "episode.mp4' must end with .rrd" in error
    config = "finger_reach"
    output = tmp_path / "table.json"
    status, out, _ = softgym("evaluate", "--config", config, "--goals", 4, "--output", output)
    assert status == 0
    table = json.loads(output.read_text())
    assert {r["agent"] for r in table["results"]} == {"qp", "random"}
    assert table["results"][0]["success_rate"] == 1.0


def test_a_rollout_says_what_is_not_trusted_and_shows_forces_in_percent(softgym):
    corner = {"module_length": 0.065, "outer_radius": 0.0052, "chamber_offset": 0.003, "chamber_radius": 0.0006}
    design = [f"--design={name}={value}" for name, value in corner.items()]
    status, out, _ = softgym("rollout", "SoftGym/TrunkReach-v0", "--agent", "random", *design)
    assert status == 0 and re.search(r"\d+ of 51 states are not trusted: spread; compare with --backend fem", out)
    status, out, _ = softgym("rollout", "SoftGym/FingerGrasp-v0", "--agent", "force", "--backend", "surrogate")
    assert status == 0 and "trusted" not in out and re.search(r"final error 0\.\d+ %, success True", out)


def test_evaluate_draws_the_bodies_of_a_configuration_that_samples_them(softgym):
    command = ("evaluate", "--config", "finger_reach_designs", "--agent", "qp", "--goals", 2)
    status, out, err = softgym(*command, "--json")
    table = json.loads(out)
    assert status == 0 and [row["bodies"] for row in table["results"]] == ["drawn", "own"]
    first, second = table["drawn_designs"]
    assert {name for name in first if first[name] != second[name]} == {"length", "height", "joint_height"}
    assert re.search(
        r"2 drawn bodies, one for each goal \(seed 2000003\):\nqp .*\nthe environment's own body:\nqp ", err
    )
    status, out, err = softgym(*command, "--json", "--design", "length=0.041")
    assert [row["bodies"] for row in json.loads(out)["results"]] == ["one"] and "drawn" not in err


def test_results_as_json(softgym, tmp_path):
    status, out, _ = softgym("list", "--json")
    tables = json.loads(out)
    assert status == 0 and "finger" in tables["robots"]
    assert tables["environments"]["SoftGym/FingerReach-v0"]["task"] == "reach"
    status, out, _ = softgym("show", "finger", "--json", "--design", "length=0.041")
    robot = json.loads(out)
    length = next(each for each in robot["design_variables"] if each["name"] == "length")
    assert status == 0 and length["value"] == 0.041 and length["unit"] == "m"
    assert robot["nodes"] > 100 and 0.0 < robot["mass"] < 1.0
    status, out, _ = softgym("show", "finger", "--design", "length=0.041")
    assert status == 0 and "  length           0.041      [0.038, 0.042] m " in out
    status, out, err = softgym("evaluate", "--config", "finger_reach", "--agent", "qp", "--goals", 2, "--json")
    table = json.loads(out)
    assert status == 0 and table["goals"] == 2 and table["results"][0]["agent"] == "qp"
    assert "qp" in err  # the table, for whoever watches
    (tmp_path / "finger_reach").symlink_to(ROOT / "agents" / "results" / "finger_reach")
    status, out, _ = softgym("results", "--folder", tmp_path, "--json")
    rows = json.loads(out)
    assert status == 0 and all(row["low"] is None or row["low"] <= row["mean"] <= row["high"] for row in rows)
    assert {"backend": "fem", "agent": "sac"}.items() <= rows[0].items()


def test_dataset_fit_and_train(softgym, tmp_path):
    tiny = ["workers=1", "network.steps=3", "network.width=16", "robot_options.cables=1"]
    tiny += [f"data.{s}.groups=2" for s in ("train", "validation", "test")]
    tiny += [f"data.{s}.states=3" for s in ("train", "validation", "test")]
    config = "finger_1cable"
    data = tmp_path / "data"
    status, out, err = softgym("dataset", "--config", config, "--folder", data, "--quiet", *tiny)
    assert status == 0, err
    assert "train: 8 states of 2 designs" in out
    fitted = tmp_path / "fit"
    arguments = ["fit", "--config", config, "--folder", fitted, "--data", data, "--quiet", *tiny]
    status, out, err = softgym(*arguments)
    assert status == 0, err
    assert json.loads(out)["effector_mean"] > 0.0 and (fitted / "model.safetensors").exists()
    assert "errors of the effector are in metres, all others are shares (1 is 100%)" in err
    config = "finger_reach"
    small = [
        "steps=64",
        "num_envs=8",
        "report_every=64",
        "evaluation_episodes=2",
        "sac.net_arch=[8]",
        "sac.learning_starts=16",
    ]
    arguments = ["train", "--config", config, "--folder", tmp_path / "sac", "--quiet", *small]
    status, out, err = softgym(*arguments)
    assert status == 0, err
    assert (tmp_path / "sac" / "policy.safetensors").exists()


CONFIG = "finger_reach"
FRONT = "configs/design/sensorized_finger_front.yaml"
STRENGTH = "configs/design/finger_strength.yaml"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["show", "octopus"], ["octopus", "finger"]),
        (["show", "finger", "--design", "length=1"], ["length", "0.038", "0.042"]),
        (["show", "finger", "--design", "young_modulus=3"], ["young_modulus", "3 Pa", "1e+06 to 1e+07 Pa"]),
        (["show", "finger", "--design", "size=1"], ["size", "length"]),
        (["show", "finger", "--design", "length"], ["length", "name=value"]),
        (["show", "finger", "--option", "cables=9"], ["cables", "1, 2"]),
        (["rollout", "SoftGym/Nothing-v0"], ["Nothing", "FingerReach"]),
        (
            ["rollout", "SoftGym/FingerTrack-v0", "--agent", "finger_reach"],
            ["SoftGym/FingerTrack-v0", "task reach", "finger_reach"],
        ),
        (["rollout", "SoftGym/FingerReach-v0", "--backend", "magic"], ["magic", "fem, surrogate"]),
        (["rollout", "SoftGym/FingerReach-v0", "--agent", "nowhere.safetensors"], ["nowhere.safetensors"]),
        (["rollout", "SoftGym/FingerReach-v0", "--design", "height=nan"], ["height", "finite"]),
        (["view", "nowhere.rrd"], ["nowhere.rrd", "does not exist"]),
        (["train", "--config", "nowhere.yaml", "--folder", "x"], ["nowhere.yaml"]),
        (["train", "--config", CONFIG, "--folder", "x", "stesp=3"], ["stesp", "steps"]),
        (["train", "--config", CONFIG, "--folder", "x", "steps=-3"], ["steps", "-3", "greater than 0"]),
        (["train", "--config", CONFIG, "--folder", "x", "steps"], ["steps", "key=value"]),
        (["train", "--config", CONFIG, "--folder", "x", "environment.id=Foo-v0"], ["Foo-v0", "FingerReach"]),
        (["train", "--config", CONFIG, "--folder", "x", "sac.gamma=2"], ["sac.gamma", "2"]),
        (["train", "--config", CONFIG, "--folder", "x", "steps=900"], ["learning_starts = 1000", "steps = 900"]),
        (["train", "--config", CONFIG, "--folder", "x", "environment.backend=foo"], ["foo", "fem, surrogate"]),
        (["train", "--config", CONFIG, "--folder", "x", "environment.action_mode=foo"], ["action_mode", "foo"]),
        (["train", "--config", CONFIG, "--folder", "x", "environment.task_options={foo: 1}"], ["task 'reach'", "foo"]),
        (
            ["train", "--config", CONFIG, "--folder", "x", "initial=finger_reach", "environment.residual_scale=0.5"],
            ["environment.residual_scale = 0.5", "finger_reach", "0.0"],
        ),
        (["evaluate", "--config", CONFIG, "--goals", "0"], ["goals", "0"]),
        (["evaluate", "--config", CONFIG, "--output", "/dev/null/x.json"], ["'/dev/null' cannot be a folder"]),
        (["evaluate", "--config", CONFIG, "--output", "."], ["--output '.' is a folder; name a file"]),
        (["show", "finger", "--picture", "x.jpg"], ["picture 'x.jpg' must end with .png"]),
        (
            ["evaluate", "--config", CONFIG, "--agent", "finger_reach", "environment.action_mode=absolute"],
            ["environment.action_mode = absolute", "finger_reach", "increment"],
        ),
        (["fit", "--config", CONFIG, "--folder", "x"], ["'finger_reach' is for train", "allowed: cable_trunk"]),
        (
            ["fit", "--config", "diamond_reach", "--folder", "x"],
            ["for train, evaluate and codesign; allowed:"],
        ),
        (["frobnicate"], ["frobnicate", "rollout"]),
        (["rolout"], ["unknown verb 'rolout'; did you mean 'rollout'?"]),
        (["bench", "nothing"], ["nothing"]),
        (["show", "finegr"], ["unknown robot 'finegr'; did you mean 'finger'?", "one of your own as 'module:Class'"]),
        (["show", "softgym_envs.robots.soft_finger:Softfinger"], ["has no 'Softfinger'; did you mean 'SoftFinger'?"]),
        (
            ["rollout", "softgym_envs.robots.soft_finger:SoftFinger"],
            ["a robot is given as --robot softgym_envs."],
        ),
        (["show", "SoftGym/FingerReach-v0"], ["'SoftGym/FingerReach-v0' is an environment; its robot is 'finger'"]),
        (["show", "finger", "--option", "cabels=1"], ["unknown option 'cabels'; did you mean 'cables'? allowed: "]),
        (["show", "finger", "--option", "cables=two"], ["cables = 'two' must be an integer"]),
        (["show", "finger", "--desing", "length=0.04"], ["No such option '--desing'. Did you mean '--design'?"]),
        (["show", "finger", "--design", "lenght=0.04"], ["unknown design variable 'lenght'; did you mean 'length'?"]),
        (["list", "--jsn"], ["No such option '--jsn'. Did you mean '--json'?"]),
        (["rollout"], ["rollout needs an ENVIRONMENT (softgym list), --robot my_module:MyRobot, --config or a policy"]),
        (["rollout", "SoftGym/FingerReach-v0", "--robot", "finger"], ["takes one environment, got ENVIRONMENT and"]),
        (["rollout", "SoftGym/FingerReach-v0", "--task", "track"], ["--task track needs --robot"]),
        (["rollout", "nowhere:X/Y-v0"], ["environment 'nowhere:X/Y-v0': module 'nowhere' cannot be imported"]),
        (["record", "--robot", "finger"], ["record takes [ENVIRONMENT] NAME, got nothing"]),
        (["evaluate", "--robot", "finger", "environment.backend=fem"], ["changes a configuration: it needs --config"]),
        (["evaluate", "SoftGym/FingerReach-v0"], ["'SoftGym/FingerReach-v0' is not KEY=VALUE"]),
        (["rollout", "FingerReach"], ["unknown environment 'FingerReach'; did you mean 'SoftGym/FingerReach-v0'?"]),
        (["rollout", "SoftGym/FingerReach-v0", "--agent", "qpp"], ["unknown agent 'qpp'; did you mean 'qp'?"]),
        (["rollout", "SoftGym/FingerReach-v0", "--seed", "x"], ["--seed", "'x' is not a valid integer"]),
        (["train", "--config", CONFIG], ["Missing option '--folder'"]),
        (["train", "--config", "finger_reech", "--folder", "x"], ["'finger_reech'; did you mean 'finger_reach'?"]),
        (
            ["train", "--config", "finger_reach", "--folder", "x", "environment.backend_options={memebrs: 1}"],
            ["backend 'surrogate': unknown option 'memebrs'; did you mean 'members'? allowed: weights, members"],
        ),
        (
            ["train", "--config", "finger_reach", "--folder", "x", "environment.robot_options={cabels: 1}"],
            ["robot 'finger': unknown option 'cabels'; did you mean 'cables'? allowed: "],
        ),
        (["evaluate", "--config", "finger_reach", "--agent", "finger_reech"], ["did you mean 'finger_reach'?"]),
        (["evaluate", "--config", "nowhere.yaml"], ["config 'nowhere.yaml' cannot be read: No such file"]),
        (["results", "--folder", "nowhere"], ["'nowhere' contains no results"]),
        (
            ["codesign", "--config", "finger_reach", "variables=[heigth]"],
            ["'heigth'; did you mean 'height'? allowed: "],
        ),
        (["codesign", "--config", "finger_reach", "strategy=polcy"], ["strategy: must be 'policy'", "got 'polcy'"]),
        (["codesign", "--config", "finger_reach", "--workers", "0"], ["workers = 0 is out of bounds; allowed: 1"]),
        (["codesign", "--config", "finger_reach", "--storage", "mysql://x"], ["allowed: journal, postgresql://user@"]),
        (["codesign", "--config", "finger_reach", "--folder", "/proc/x"], ["'/proc/x': No such file or directory"]),
        (["calibrate", "--config", "finger_calibration", "data=nowhere.csv"], ["'nowhere.csv' cannot be read"]),
        (["benchmark", "verifi", "x.json"], ["unknown verb 'verifi'; did you mean 'verify'?"]),
        (["benchmark", "verify", "nowhere.json"], ["error: 'nowhere.json' cannot be read: No such file"]),
        (["sensitivity", "--config", "finger_sensitivity", "method=sobl"], ["method: must be 'oat'", "'sobl'"]),
        (["export", "finger", "x.obj"], ["'x.obj' must end with .step or .stl"]),
        (["export", "finger"], ["nothing to write"]),
        (["deploy", "finger", "x.bin"], ["'x.bin' must end with .h or .onnx"]),
        (["deploy", "finger", "x.h", "--members", "99"], ["members = 99", "1 to 5"]),
        (["deploy-policy", "finger_reech", "x.h"], ["unknown policy 'finger_reech'; did you mean 'finger_reach'?"]),
        (["evaluate", "--agent", "sac"], ["'sac' is a learner, not an agent; agents are qp, ", "file of a policy"]),
        (["rollout", "SoftGym/FingerReach-v0", "--agent", "ppo"], ["'ppo' is a learner, not an agent"]),
        (["configs", "--copy", "."], ["'.' exists; choose a new folder"]),
        (["--verison"], ["No such option '--verison'. Did you mean '--version'?"]),
    ],
)
def test_bad_input_is_one_line_and_status_two(refused, arguments, words):
    line = refused(*arguments)
    for word in words:
        assert word in line
    assert line.count("did you mean") <= 1


def test_a_finished_training_is_extended_and_its_folder_is_named(softgym, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    small = ["report_every=256", "evaluation_episodes=2"]
    arguments = ["train", "--config", "finger_reach_analytic", "--folder", "run", "--quiet", *small]
    assert softgym(*arguments, "steps=256")[:2] == (0, "wrote run/policy.safetensors\n")
    status, out, _ = softgym(*arguments, "steps=256")
    assert status == 0 and "is finished after 256 steps; a larger steps=... trains on" in out
    assert softgym(*arguments, "steps=512")[:2] == (0, "wrote run/policy.safetensors\n")
    lines = Path("run/curve.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["step", "256", "512"]
    _, _, err = softgym("codesign", "--config", "finger_reach", "--folder", "run")
    assert "run' does not hold a co-design study: config" in err and "missing required keys name" in err
    told = [softgym("evaluate", "--agent", agent, "--goals", "2") for agent in ("run", "run/policy.safetensors")]
    assert told[0][0] == 0 and told[0][1].split()[-6:] == told[1][1].split()[-6:]
    assert softgym("rollout", "--agent", "run")[0] == 0
    _, _, err = softgym("evaluate", "--config", "finger_reach_analytic", "--agent", ".")
    assert "unknown agent '.'; " in err and "the folder of a training" in err
    _, _, err = softgym("evaluate", "--config", "./run", "--agent", "qp")
    assert "it is a folder; its file is run/config.yaml" in err


def test_indices_of_a_sensitivity_study_are_explained(softgym, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    arguments = ["sensitivity", "--config", "finger_sensitivity", "--quiet", "method=oat", "levels=2"]
    status, out, _ = softgym(*arguments, "bodies.variables=[poisson_ratio]", "metrics=[bending_angle]")
    assert status == 0 and out.startswith("share: range along a variable, of that over all designs [%]; low, high: ")
    assert "bending_angle" in out and "3 designs, 0 infeasible; wrote results/finger_sensitivity" in out


@pytest.mark.parametrize(
    "arguments",
    [
        ["deploy", "finger", "x.h"],
        ["show", "finger", "--picture", "x.png"],
        ["configs", "--copy", "copies"],
        ["rollout", "SoftGym/FingerReach-v0", "--record", "x.rrd"],
        ["rollout", "SoftGym/FingerReach-v0", "--paraview", "x"],
        ["rollout", "SoftGym/FingerReach-v0", "--video", "x.gif"],
        ["rollout", "SoftGym/FingerReach-v0", "--video", "x.mp4"],
    ],
)
def test_a_full_disk_is_one_line_that_names_the_file(arguments, softgym, monkeypatch, tmp_path):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    status, _, err = softgym(*arguments)
    assert status == 2 and re.fullmatch(r"softgym: error: '(x|copies).*': No space left on device\n", err)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_film_that_does_not_fit_into_the_temporary_folder_is_not_written(tmp_path):
    resource = pytest.importorskip("resource")
    frames = np.random.default_rng(0).integers(0, 255, (10, 100, 100, 3), dtype=np.uint8)
    allowed, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, most))  # as full as a disk
    try:
        with pytest.raises(OSError, match=r"the film is incomplete; .*x\.mp4'"):
            write_video(tmp_path / "x.mp4", frames)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (allowed, most))
    assert list(tmp_path.iterdir()) == []
    write_video(tmp_path / "x.mp4", frames)


def test_a_file_in_the_way_of_a_folder_is_named(softgym, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("")
    status, _, err = softgym("deploy", "finger", "taken/model.h")
    assert status == 2 and re.fullmatch(r"softgym: error: 'taken.*' cannot be a folder: a file is in its way\n", err)


def test_a_worker_reports_a_full_disk_in_one_line(monkeypatch, capsys, tmp_path):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "trials/0000/result.json")

    monkeypatch.setattr(worker, "_end_with_parent", lambda: None)
    monkeypatch.setattr(worker.signal, "signal", lambda *_: None)
    monkeypatch.setitem(worker.PHASES, "trials", full)
    assert worker.main([str(tmp_path), "trials"]) == 2
    assert capsys.readouterr().err == "DataError: 'trials/0000/result.json': No space left on device\n"


def test_viewing_without_a_display(softgym, monkeypatch, tmp_path):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    recording = tmp_path / "x.rrd"
    recording.touch()
    status, _, err = softgym("view", recording)
    assert status == 2 and "there is no display" in err and len(err.splitlines()) == 1


@pytest.mark.parametrize("text", ["", "steps: [1, 2", "- a\n- b\n", "steps: {a: 1}", "\x00\x01"])
def test_malformed_files(softgym, tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    status, _, err = softgym("train", "--config", path, "--folder", tmp_path / "x")
    assert status == 2 and len(err.strip().splitlines()) == 1 and "config.yaml" in err


@pytest.mark.parametrize(
    ("module", "name", "arguments", "resumes"),
    [
        ("softgym_envs.agents.training", "train", ["train", "--config", CONFIG, "--folder", "x"], True),
        ("softgym_envs.agents.evaluation", "evaluate", ["evaluate", "--config", CONFIG, "--goals", "1"], False),
        ("softgym_envs.extensions.design.gradient_free", "search", ["optimise", "--config", FRONT], True),
        ("softgym_envs.extensions.design.gradient", "optimise", ["optimise", "--config", STRENGTH], False),
    ],
)
def test_an_interrupted_command_says_whether_it_can_continue(
    module, name, arguments, resumes, softgym, monkeypatch, tmp_path
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"{module}.{name}", stop)
    monkeypatch.chdir(tmp_path)
    arguments = [str(ROOT / a) if a.startswith("configs/") else a for a in arguments]
    status, _, err = softgym(*arguments)
    assert status == 130 and "stopped" in err
    assert ("again to continue" in err) == resumes


def test_help_without_a_verb(softgym):
    status, out, err = softgym()
    assert status == 0 and not err
    for words in ("Usage: softgym", "Environments:", "Design and control:", "rollout", "calibrate"):
        assert words in out


@pytest.mark.parametrize("verb", app.VERBS)
def test_every_verb_has_help_in_a_section(verb, softgym):
    _, listed, _ = softgym()
    status, out, _ = softgym(verb, "--help")
    assert status == 0 and f"softgym {verb}" in out
    assert re.search(rf"^  {verb} +[A-Z]", listed, re.MULTILINE)


def test_console_module_runs():
    done = subprocess.run(
        [sys.executable, "-m", "softgym_envs.cli", "--version"], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert "0.1.0" in done.stdout

"""Exported models compute what the Python model computes: the C header compiled, the ONNX graph run."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from softgym_envs import make_robot
from softgym_envs.errors import DesignError
from softgym_envs.extensions.deployment.surrogate_c import export_c
from softgym_envs.extensions.deployment.surrogate_onnx import export_onnx
from softgym_envs.extensions.fitting.potential import stack_members
from softgym_envs.surrogate.features import Features
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.pretrained import pretrained_model
from tests.helpers import random_states

CC = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")
WRAPPER = """#include "model.h"
void state(const float *q, float *f, float *x) { finger_state(q, f, x); }
int condensed(const float *q, float *f, float *x, float *W) { return finger_condensed(q, f, x, W); }
int sizes(void) { return 100 * FINGER_MEMBERS + 10 * FINGER_ACTUATORS + FINGER_COORDINATES; }
"""
# Robots of 1, 2, 4 and 6 actuators, the last driven by volume and without a stiffness variable; whether the effort at
# rest is zero by construction; members.
CASES = {
    "one": ("finger", {"cables": 1}, True, 2),
    "two": ("finger", {"cables": 2}, True, 1),
    "four": ("diamond", {}, False, 2),
    "six": ("trunk", {}, False, 1),
}


def random_model(case, seed=0, learned=None):
    """A model with random weights and magnitudes like real ones; its width is not a multiple of a vector register's.

    ``learned``: the design variables it depends on, beside the stiffness; default all of the robot.
    """
    import torch

    from softgym_envs.extensions.fitting.torch_potential import PotentialNet

    name, options, at_rest, members = CASES[case]
    robot = make_robot(name, **options)
    half = 0.5 * (robot.upper - robot.lower)
    features = Features(robot, learned)
    rest = (0.0 - robot.lower - half) / half if at_rest else None
    states = []
    for member in range(members):
        torch.manual_seed(seed + member)
        net = PotentialNet(len(robot.actuators), 3, features.design_size, 19, 9, rest)
        states.append({key: value.detach().numpy().copy() for key, value in net.state_dict().items()})
    scales = {
        "energy": np.array(float(np.mean(robot.effort_scale * half))),
        "effector_mean": np.asarray(robot.effector_rest, dtype=float),
        "effector": np.array(0.2 * robot.size),
        "held": np.array(1e-2),
    }
    model = Model(robot, stack_members(states, scales), {})
    model.features = features
    return model


def assert_same(model, designs, displacement, found, tolerance=2e-5):
    """Compare (effort, effector, W) with the Python model, W block by block, relative to the largest entry."""
    context = model.context(designs)
    condensed = model.condensed(context, displacement)
    n = model.count
    effort, effector, W = found
    pairs = {
        "effort": (effort, condensed.lambda_.a),
        "effector": (effector, condensed.delta.e),
        "W_aa": (W[:, :n, :n], condensed.W.aa),
        "W_ea": (W[:, n:, :n], condensed.W.ea),
        "W_ae": (W[:, :n, n:], condensed.W.ea.swapaxes(1, 2)),
        "W_ee": (W[:, n:, n:], condensed.W.ee),
    }
    for name, (ours, theirs) in pairs.items():
        assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max(), name


class Compiled:
    """A header compiled without warnings into a shared library."""

    def __init__(self, header):
        folder = header.parent
        (folder / "wrapper.c").write_text(WRAPPER)
        flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
        library = folder / "model.so"
        command = [CC, *flags, str(folder / "wrapper.c"), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(library))

    def __call__(self, displacement, effectors, function="condensed"):
        """States and, from ``condensed``, W at displacements (B, n); also the status of each."""
        rows, n = displacement.shape
        size = n + effectors
        arrays = [np.full(shape, np.nan, np.float32) for shape in ((rows, n), (rows, effectors), (rows, size, size))]
        displacement = displacement.astype(np.float32)
        status = []
        for k in range(rows):
            pointers = [ctypes.c_void_p(a[k].ctypes.data) for a in (displacement, *arrays)]
            status.append(getattr(self.library, function)(*(pointers if function == "condensed" else pointers[:3])))
        return arrays, status


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_the_header_agrees_with_the_model(case, tmp_path):
    model = random_model(case)
    designs, displacement = random_states(model.robot, 40)
    design = dict(zip(model.robot.design_space.names, designs[0].tolist(), strict=True))
    path = export_c(model, design, tmp_path / "model.h", name="finger")
    compiled = Compiled(path)
    assert compiled.library.sizes() == 100 * model.members + 10 * model.count + 3
    designs = np.repeat(designs[:1], len(displacement), axis=0)
    (effort, effector, W), status = compiled(displacement, 3)
    assert not any(status)
    assert_same(model, designs, displacement, (effort, effector, W))
    assert (W == W.swapaxes(1, 2)).all()
    (effort, effector, _), _ = compiled(displacement, 3, "state")
    assert_same(model, designs, displacement, (effort, effector, W))
    # Results that are not finite are reported, not returned.
    (_, _, W), status = compiled(np.full((1, model.count), np.nan), 3)
    assert status == [1] and np.isnan(W).all()


@needs_compiler
def test_fewer_members_are_the_first_ones(tmp_path):
    model = random_model("one")
    fewer = Model(model.robot, model.tensors, {}, 1)
    designs, displacement = random_states(model.robot, 5)
    baseline = np.tile(model.robot.design_space.baseline.array, (5, 1))
    compiled = Compiled(export_c(model, None, tmp_path / "model.h", members=1, name="finger"))
    assert_same(fewer, baseline, displacement, compiled(displacement, 3)[0])
    with pytest.raises(AssertionError, match="effort"):
        assert_same(model, baseline, displacement, compiled(displacement, 3)[0])
    runtime = pytest.importorskip("onnxruntime")
    path = export_onnx(model, tmp_path / "model.onnx", members=1)
    assert_same(fewer, designs, displacement, run_graph(runtime, path, designs, displacement))


def test_the_header_describes_itself_and_keeps_every_digit(tmp_path):
    model = random_model("two")
    text = export_c(model, {"young_modulus": 4e6}, tmp_path / "a" / "model.h", name="my_robot").read_text()
    assert re.findall(r"#include.*", text) == ["#include <math.h>"]
    assert "malloc" not in text and max(map(len, text.splitlines())) <= 160
    for word in ("finger_2cables", '"cables": 2', "young_modulus = 4000000.0 Pa", "effort in N", "float W[25]"):
        assert word in text
    assert text.count("/*") == text.count("*/")
    # The weights come back bit for bit.
    block = re.search(r"my_robot_shape2\[.*?= (\{.*?\});", text, re.DOTALL)
    assert block is not None
    numbers = np.array(re.findall(r"-?[0-9.]+(?:e[+-]?[0-9]+)?(?=f)", block[1]), dtype=np.float32)
    np.testing.assert_array_equal(numbers, model.tensors["shape2"].swapaxes(1, 2).ravel())


def run_graph(runtime, path, designs, displacement):
    """Run a graph on the CPU."""
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    feed = {"design": designs.astype(np.float32), "displacement": displacement.astype(np.float32)}
    return session.run(["effort", "effector", "W"], feed)


@pytest.mark.parametrize("case", CASES)
def test_the_graph_agrees_with_the_model(case, tmp_path):
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    model = random_model(case)
    path = export_onnx(model, tmp_path / "model.onnx")
    for rows in (1, 30):
        designs, displacement = random_states(model.robot, rows, seed=rows)
        # The single precision of the input matters at the nearly incompressible end.
        assert_same(model, designs, displacement, run_graph(runtime, path, designs, displacement), 1e-4)
    properties = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert properties["robot"] == model.robot.name
    assert json.loads(properties["mechanics_key"]) == json.loads(json.dumps(model.robot.mechanics_key))
    assert [variable["name"] for variable in json.loads(properties["design"])] == list(model.robot.design_space.names)
    efforts = {actuator["effort_unit"] for actuator in json.loads(properties["displacement"])}
    assert efforts == ({"Pa"} if case == "six" else {"N"})


def test_a_graph_of_one_body(tmp_path):
    """No design variable but the stiffness, or none at all: the layers of the design have no inputs."""
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    for case in ("two", "four", "six"):
        model = random_model(case, learned=())
        path = export_onnx(model, tmp_path / "model.onnx")
        states = random_states(model.robot, 7)
        assert_same(model, *states, run_graph(runtime, path, *states))


class Other(SurrogateModel):
    """A model of an unsupported network."""

    network = "thesis"

    def _prepare(self, design):
        raise NotImplementedError

    _state = _compliance = _prepare


def test_bad_input_is_named_and_nothing_is_written(tmp_path, monkeypatch):
    model = random_model("two")
    for name in ("", "1st", "two words", "a-b", "_x", "naïve", "x\n"):
        with pytest.raises(ValueError, match="not a C identifier"):
            export_c(model, None, tmp_path / "model.h", name=name)
    with pytest.raises(DesignError, match="out of bounds"):
        export_c(model, {"length": 1.0}, tmp_path / "model.h")
    for members in (0, 2):
        with pytest.raises(ValueError, match="members = . is out of bounds"):
            export_c(model, None, tmp_path / "model.h", members=members)
    with pytest.raises(ValueError, match=r"must end with \.h"):
        export_c(model, None, tmp_path / "model.c")
    with pytest.raises(ValueError, match=r"must end with \.onnx"):
        export_onnx(model, tmp_path / "model.h")
    other = Other(model.robot, {}, {})
    with pytest.raises(ValueError, match="network 'thesis' cannot be exported"):
        export_c(other, None, tmp_path / "model.h")
    with pytest.raises(ValueError, match="network 'thesis' cannot be exported"):
        export_onnx(other, tmp_path / "model.onnx")
    broken = Model(model.robot, model.tensors | {"scale.energy": np.array(1e60)}, {})
    with pytest.raises(ValueError, match="'effort_scale' holds values that are not finite"):
        export_c(broken, None, tmp_path / "model.h")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match="pip install"):
        export_onnx(model, tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())


def test_the_command_line_writes_both(tmp_path, monkeypatch, softgym):
    pytest.importorskip("onnx")
    model = random_model("two")
    monkeypatch.setattr("softgym_envs.surrogate.pretrained.load_model", lambda *_: model)

    header, graph = tmp_path / "model.h", tmp_path / "model.onnx"
    weights = ("--weights", tmp_path)
    status, out, _ = softgym(
        "deploy", "finger", header, graph, *weights, "--design", "length=0.041", "--members", 1, "--name", "tip"
    )
    assert status == 0 and f"wrote {header}" in out and f"wrote {graph}" in out
    assert "tip_state" in header.read_text() and "length = 0.041 m" in header.read_text()
    for arguments, message in (
        ((tmp_path / "a.h", tmp_path / "model.txt"), "must end with .h or .onnx"),
        ((tmp_path / "a.onnx", "--design", "length=0.041"), "takes the design as an input"),
        ((tmp_path / "a.h", "--members", "7"), "members = 7 is out of bounds"),
        ((tmp_path / "a.h", "--design", "size=1"), "unknown design variable 'size'"),
        ((), "FILES"),
    ):
        status, _, err = softgym("deploy", "finger", *arguments, *weights)
        assert status == 2 and message in err
    assert sorted(tmp_path.iterdir()) == [header, graph]


@needs_compiler
def test_the_header_of_a_robot_with_sensors_has_its_effectors(tmp_path):
    """The model of a touched finger has a touched point and sensors, which the header of the finger leaves out."""
    robot = make_robot("sensorized_finger")
    model = pretrained_model(robot.learning.touch.variant(), members=1)
    design = {"joint_height": 0.0063, "young_modulus": 2.4e6}
    compiled = Compiled(export_c(model, design, tmp_path / "model.h", name="finger", robot=robot))
    displacement = np.linspace(0.0, 0.012, 7)[:, None]
    (effort, effector, W), status = compiled(displacement, 3)
    assert not any(status)
    body = model.robot.design_space.complete(design).array[None]
    expected = model.condensed(model.context(np.tile(body, (7, 1))), displacement)
    for ours, theirs in (
        (effort, expected.lambda_.a),
        (effector, expected.delta.e[:, :3]),
        (W, expected.compliance[:, :4, :4]),
    ):
        assert np.abs(ours - theirs).max() <= 2e-5 * np.abs(theirs).max()
    with pytest.raises(ValueError, match="sensor rows are not part of a graph"):
        export_onnx(model, tmp_path / "model.onnx")

"""Exported policies compute what the Python policy computes: the ONNX graph run, the C header compiled."""

import ctypes
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from softgym_envs.agents.config import TrainConfig
from softgym_envs.agents.policy import Policy
from softgym_envs.agents.training import train
from softgym_envs.extensions.deployment.policy_c import export_policy_c
from softgym_envs.extensions.deployment.policy_onnx import export_policy_onnx

CC = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")

POLICIES = {
    "increment": {"environment": {"id": "SoftGym/FingerReach-v0"}},
    "absolute, bodies shown": {
        "environment": {
            "id": "SoftGym/DiamondReach-v0",
            "action_mode": "absolute",
            "design_in_observation": ["young_modulus", "top_height"],
        }
    },
    "one axis": {"environment": {"id": "SoftGym/FingerPress-v0"}},
    "moving": {"environment": {"id": "SoftGym/TetrapodReach-v0"}, "num_envs": 1},
    "on the QP": {"environment": {"id": "SoftGym/TrunkReach-v0", "residual_scale": 0.3}},
}


@pytest.fixture(scope="module", params=POLICIES)
def case(request, tmp_path_factory):
    """A policy after a few steps of training, random measurements, and the action and command it gives for them."""
    small = {"sac": {"net_arch": [16, 12], "learning_starts": 4}, "steps": 10, "num_envs": 2, "report_every": 10}
    config = TrainConfig.model_validate({**small, "evaluation_episodes": 1, **POLICIES[request.param]})
    policy = Policy(train(config, tmp_path_factory.mktemp("run"), progress=False))
    env = config.environment.make().unwrapped
    spaces, robot = env.spaces, env.robot
    rng = np.random.default_rng(0)
    count, n = 40, len(robot.actuators)
    inputs = {
        "command": rng.uniform(robot.lower, robot.upper, (count, n)),
        "displacement": rng.uniform(robot.lower, robot.upper, (count, n)),
        "effort": robot.effort_scale * rng.normal(size=(count, n)),
        "effector": robot.size * rng.normal(size=(count, 3)),
        "goal": robot.size * rng.normal(size=(count, 3)),
        "velocity": robot.size * rng.normal(size=(count, 3)),
    }
    units = rng.uniform(-1, 1, (count, len(spaces.design_names)))
    observed = spaces.observe(*(inputs[name] for name in list(inputs)[:5]), units, inputs["velocity"])
    if spaces.design_names:
        variables = [robot.design_space[name] for name in spaces.design_names]
        inputs["design"] = np.stack([v.from_unit(units[:, k]) for k, v in enumerate(variables)], axis=1)
    if not spaces.moving:
        del inputs["velocity"]
    action = policy(observed)
    command = None
    if not config.environment.residual_scale:
        command = spaces.command(action.astype(float), inputs["command"])
    return SimpleNamespace(
        policy=policy, inputs=inputs, action=action, command=command, width=robot.upper - robot.lower, robot=robot
    )


def test_the_graph_of_a_policy_agrees_with_the_policy(case, tmp_path):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    path = export_policy_onnx(case.policy, tmp_path / "policy.onnx")
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert {entry.name for entry in session.get_inputs()} == set(case.inputs)
    feed = {name: values.astype(np.float32) for name, values in case.inputs.items()}
    found = dict(zip([entry.name for entry in session.get_outputs()], session.run(None, feed), strict=True))
    assert np.abs(found["action"] - case.action).max() < 2e-5
    if case.command is None:
        assert set(found) == {"action"}
    else:
        assert (np.abs(found["next_command"] - case.command) / case.width).max() < 1e-5


def compiled(header):
    """The functions of a header with the prefix ``policy``, compiled without warnings; None where one is missing."""
    text = header.read_text()
    wrapper = header.with_name("wrapper.c")
    count = text.partition("int policy_action(")[2].partition(")")[0].count("const float")
    pointers = ", ".join(f"const float *a{k}" for k in range(count))
    names = ", ".join(f"a{k}" for k in range(count))
    code = f'#include "policy.h"\nint act({pointers}, float *y) {{ return policy_action({names}, y); }}\n'
    if "policy_next_command" in text:
        code += "void step(const float *c, const float *a, float *y) { policy_next_command(c, a, y); }\n"
    wrapper.write_text(code)
    library = header.with_suffix(".so")
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
    done = subprocess.run([CC, *flags, str(wrapper), "-o", str(library), "-lm"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = ctypes.CDLL(str(library))
    return loaded.act, getattr(loaded, "step", None)


def pointer(array):
    return ctypes.c_void_p(array.ctypes.data)


@needs_compiler
def test_the_header_of_a_policy_agrees_with_the_policy(case, tmp_path):
    act, step = compiled(export_policy_c(case.policy, tmp_path / "policy.h", name="policy"))
    assert (step is None) == (case.command is None)
    inputs = [np.ascontiguousarray(values, dtype=np.float32) for values in case.inputs.values()]
    for k in range(len(case.action)):
        action = np.full(case.action.shape[1], np.nan, np.float32)
        assert act(*(pointer(values[k]) for values in inputs), pointer(action)) == 0
        assert np.abs(action - case.action[k]).max() < 2e-5
        if step is not None:
            command = np.empty_like(action)
            step(pointer(inputs[0][k]), pointer(action), pointer(command))
            assert (np.abs(command - case.command[k]) / case.width).max() < 1e-5
    inputs[2][0] = np.nan
    action = np.full(case.action.shape[1], 7.0, np.float32)
    assert act(*(pointer(values[0]) for values in inputs), pointer(action)) == 1
    assert (action == 7.0).all()


@needs_compiler
def test_a_shipped_policy_runs_as_a_program_in_c(softgym, tmp_path):
    """As on a microcontroller: the model's header and the policy's header, compiled into one program and run."""
    status, out, _ = softgym("deploy-policy", "finger_reach", tmp_path / "policy.h")
    assert status == 0 and "policy.h" in out
    status, *_ = softgym("deploy", "finger", tmp_path / "model.h", "--name", "finger", "--members", "1")
    assert status == 0
    (tmp_path / "main.c").write_text(
        """#include <stdio.h>
#include "model.h"
#include "policy.h"
int main(void)
{
    float command[2] = {0.0f, 0.0f}, action[2], effort[2], effector[3], goal[3] = {0.0f, 0.05f, -0.10f};
    int step;
    for (step = 0; step < 50; ++step) {
        finger_state(command, effort, effector);
        if (softgym_policy_action(command, command, effort, effector, goal, action))
            return 1;
        softgym_policy_next_command(command, action, command);
    }
    finger_state(command, effort, effector);
    printf("%.6f %.6f %.6f\\n", effector[0], effector[1], effector[2]);
    return 0;
}
"""
    )
    program = str(tmp_path / "main")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2"]
    subprocess.run([CC, *flags, str(tmp_path / "main.c"), "-o", program, "-lm"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    effector = np.array(done.stdout.split(), dtype=float)
    assert np.linalg.norm(effector - [0.0, 0.05, -0.10]) < 0.003


@pytest.mark.parametrize("export", [export_policy_c, export_policy_onnx])
@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        ("sensorized_finger_reach_sac", "observes sensors in place of the effector"),
        ("modular_reach_structures", r"observes choices of its body \(kind_1, "),
        ("sensorized_finger_reach_recurrent", "has a memory"),
    ],
)
def test_policies_that_formats_cannot_hold_are_refused(policy, reason, export, tmp_path):
    if export is export_policy_onnx:
        pytest.importorskip("onnx")
    path = tmp_path / f"policy{'.onnx' if export is export_policy_onnx else '.h'}"
    with pytest.raises(ValueError, match=reason):
        export(policy, path)
    assert not path.exists()


def test_exports_name_what_is_wrong(softgym, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"must end with \.onnx"):
        export_policy_onnx("finger_reach", tmp_path / "policy.h")
    with pytest.raises(ValueError, match="not a C identifier"):
        export_policy_c("finger_reach", tmp_path / "policy.h", name="my policy")
    status, _, err = softgym("deploy-policy", "finger_reach", tmp_path / "policy.h", tmp_path / "policy.txt")
    assert status == 2 and r"must end with .h or .onnx" in err and not (tmp_path / "policy.h").exists()
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match="pip install"):
        export_policy_onnx("finger_reach", tmp_path / "policy.onnx")

"""Wrong units, names and values are refused at once, with one line that says what is wrong and what is allowed."""

from __future__ import annotations

import fnmatch
from pathlib import Path

import gymnasium
import meshio
import numpy as np
import pytest
import yaml

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs import DesignSpace, DesignVariable, make_robot
from softgym_envs.agents.config import EnvironmentConfig, TrainConfig
from softgym_envs.agents.evaluation import evaluate
from softgym_envs.agents.policy import Policy
from softgym_envs.backends import make_backend
from softgym_envs.codesign.config import StudyConfig
from softgym_envs.config import load_config
from softgym_envs.errors import SoftGymError
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.design import measure
from softgym_envs.extensions.design.config import CalibrationConfig, OptimiseConfig
from softgym_envs.extensions.fitting.training import FitConfig
from softgym_envs.extensions.sensing.loads import Payload, Touch, finger_grid
from softgym_envs.extensions.sensing.readings import Noise
from softgym_envs.mechanics import MechanicalModel
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.constraints.embedding import EmbeddedPoints
from softgym_envs.mechanics.constraints.point import Point
from softgym_envs.robots import Actuator, Robot
from softgym_envs.storage import cache_directory
from tests.helpers import box_mesh

ROOT = Path(__file__).resolve().parent.parent
NODES, TETRAHEDRA = box_mesh((0.1, 0.02, 0.02), (4, 1, 1))
REACH = "SoftGym/FingerReach-v0"
ENVIRONMENT, GOALS = EnvironmentConfig(id=REACH), [[0.0, 0.05, -0.1]]


def body(nodes=NODES, **options):
    return MechanicalModel.from_mesh(nodes, TETRAHEDRA, fixed=nodes[:, 0] == 0.0, **options)


def from_file(folder, width=100.0, **options):
    path = folder / "body.vtk"
    meshio.Mesh(width / np.ptp(NODES[:, 0]) * NODES, [("tetra", TETRAHEDRA)]).write(path)
    return MechanicalModel.from_file(path, fixed_box=(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0), **options)


class Leg(Robot):
    """A beam whose design has its modulus in MPa, and forgets to convert it."""

    name, effectors, size = "leg", ("tip",), 0.1
    design_space = DesignSpace(DesignVariable("modulus", 10.0, 600.0, 35.0, "Pa", "stiffness of the leg"))
    actuators = (Actuator("push", low=0.0, high=0.01, rate=0.001),)
    effector_rest, effort_scale = np.array([0.1, 0.0, 0.0]), np.ones(1)

    def assemble(self, design):
        builder = ModelBuilder()
        frames = [builder.add_frame([x, 0.0, 0.0], fixed=x == 0.0) for x in (0.0, 0.05, 0.1)]
        builder.add_element(Beam, frames, section=Section.circle(5e-3), young_modulus=design["modulus"], order=2)
        model = builder.build()
        for role, name in (("a", "push"), ("e", "tip")):
            model.add(role, Point(name, EmbeddedPoints.in_frame(frames[-1], np.zeros(3), model.nodes)))
        return model


def carried(_):
    builder = ModelBuilder()
    builder.add_solid(NODES, TETRAHEDRA, fixed=NODES[:, 0] == 0.0, element="linear")
    builder.carry(builder.add_frame([0.1, 0.01, 0.01]), NODES[:, 0] == 0.1)


def reset(**options):
    env = gymnasium.make(REACH, backend="fem")
    try:
        env.reset(seed=0, options=options)
    finally:
        env.close()


def touched(path):
    path.touch()
    return path


def act(action):
    env = gymnasium.make(REACH)
    env.reset(seed=0)
    env.step(action)


def config(folder, model, name, *overrides):
    """Load a configuration of the repository, or one given as plain data, with overrides."""
    path = ROOT / "configs" / name if isinstance(name, str) else folder / "x.yaml"
    if not isinstance(name, str):
        path.write_text(yaml.safe_dump(name))
    return load_config(path, model, overrides)


TRAIN, FINGER, STRENGTH = "agents/sac.yaml/finger_reach", "codesign/finger_reach.yaml", "design/finger_strength.yaml"
ZONE = "codesign/finger_zone.yaml"

# Mistake -> (function of a temporary folder that makes it; the message, in which * stands for any text)
MISTAKES = {
    # Units
    "body in millimetres": (
        lambda _: body(1e3 * NODES),
        "the body measures 100 x 20 x 20 m; its size = 100 m is implausible, allowed: 0.001 to 10 m (*); did you mean "
        "0.1 m (100 mm)? (for nodes in millimetres pass 1e-3 * nodes) if it is meant, set SOFTGYM_UNCHECKED=size",
    ),
    "effector in millimetres": (
        lambda _: body().add_effector("tip", np.array([100.0, 10.0, 10.0])),
        "effector 'tip' at [100.0, 10.0, 10.0] m lies 101 m outside the body, which is 0.104 m long; did you "
        "mean metres?",
    ),
    "cable in millimetres": (
        lambda _: body().add_cable("cable", np.array([[20.0, 10.0, 10.0], [90.0, 10.0, 10.0]]), np.zeros(3)),
        "a guide of cable 'cable' at [90.0, 10.0, 10.0] m lies 91 m outside the body, which is 0.104 m long; "
        "did you mean metres?",
    ),
    "effector a kilometre away": (
        lambda _: body().add_effector("tip", np.array([1000.0, 0.0, 0.0])),
        "effector 'tip' at [1000.0, 0.0, 0.0] m lies 1e+03 m outside the body, which is 0.104 m long; did you "
        "mean metres?",
    ),
    "mesh file in millimetres without its unit": (
        lambda f: from_file(f),
        "the body measures 100 x 20 x 20 m; its size = 100 m is implausible, *; did you mean 0.1 m (100 mm)? (for a "
        "file in millimetres pass unit='mm', in inches unit='in', in metres unit='m') *",
    ),
    "mesh file in inches without its unit": (
        lambda f: from_file(f, width=4.0),
        "the body measures 4 x 0.8 x 0.8 m; its size = 4 m is implausible, allowed: 0.001 to 1 m (a file that states "
        "no unit); *, in inches unit='in', in metres unit='m') *",
    ),
    "goal in millimetres": (
        lambda _: reset(goal=[0.0, 50.0, -90.0]),
        "goal = [0.0, 50.0, -90.0] m is 102.8 m away from the effector of robot 'finger', whose size is * m; "
        "did you mean metres?",
    ),
    "goal zone in millimetres": (
        lambda f: config(f, StudyConfig, FINGER, "goals.zone.center=[0,66,-72]"),
        "config '*': *center = [0.0, 66.0, -72.0] m is * m away from the effector of robot 'finger', *; did you "
        "mean metres?",
    ),
    "design in millimetres": (
        lambda _: reset(design={"length": 40.0}),
        "design variable 'length' = 40 m is out of bounds; allowed: 0.038 to 0.042 m",
    ),
    "design in megapascals": (
        lambda _: make_robot("finger").build({"young_modulus": 3.0}),
        "design variable 'young_modulus' = 3 Pa is out of bounds; allowed: 1e+06 to 1e+07 Pa",
    ),
    "design of an environment in megapascals": (
        lambda _: gymnasium.make(REACH, design={"young_modulus": 3.0}),
        "design variable 'young_modulus' = 3 Pa is out of bounds; allowed: 1e+06 to 1e+07 Pa",
    ),
    "design at a reset in megapascals": (
        lambda _: reset(design={"young_modulus": 3.0}),
        "design variable 'young_modulus' = 3 Pa is out of bounds; allowed: 1e+06 to 1e+07 Pa",
    ),
    "modulus in megapascals": (
        lambda _: body(young_modulus=0.5),
        "young_modulus = 0.5 Pa is implausible, allowed: 5000 to 2e+12 Pa (soft gels to diamond); did you mean 5e+05 "
        "Pa (0.5 MPa)? if it is meant, set SOFTGYM_UNCHECKED=modulus",
    ),
    "modulus of a file in megapascals": (
        lambda f: from_file(f, unit="mm", young_modulus=0.5),
        "young_modulus = 0.5 Pa is implausible, *",
    ),
    "modulus of one element in megapascals": (
        lambda _: body(young_modulus=lambda x: np.where(x[:, 0] > x[:, 0].min(), 3e6, 3.0)),
        "young_modulus = 3 Pa is implausible, *",
    ),
    "modulus of a beam in megapascals": (
        lambda _: Leg().build(),
        "young_modulus = 35 Pa is implausible, *",
    ),
    "Poisson's ratio in percent": (
        lambda _: body(poisson_ratio=45.0),
        "poisson_ratio = 45.0 must be inside (-1, 0.5)",
    ),
    "elements in millimetres": (
        lambda _: make_robot("finger", mesh_size=5),
        "robot 'finger': mesh_size = 5 m is larger than the robot, whose size is 0.12 m; did you mean metres?",
    ),
    "pulls in millimetres": (
        lambda _: make_backend("surrogate", make_robot("finger")).step([4.0, 1.0]),
        "command = 4 m of actuator 'cable_1' is far beyond its range of 0 to 0.02 m; check its unit",
    ),
    "one of several bodies in millimetres": (
        lambda _: gymnasium.make_vec(REACH, num_envs=2).reset(options={"design": [{}, {"length": 40.0}]}),
        "sub-environment 1: design variable 'length' = 40 m is out of bounds; allowed: 0.038 to 0.042 m",
    ),
    # Names
    "agent": (
        lambda _: evaluate("qpp", ENVIRONMENT, GOALS),
        "unknown agent 'qpp'; did you mean 'qp'? allowed too: the folder of a training, a policy file (.safetensors)",
    ),
    "robot": (
        lambda _: make_robot("fingr"),
        "unknown robot 'fingr'; did you mean 'finger'? allowed too: one of your own as 'module:Class'",
    ),
    "robot option": (
        lambda _: make_robot("finger", cabels=1),
        "robot 'finger': unknown option 'cabels'; did you mean 'cables'? allowed: cables, mesh, mesh_size, *",
    ),
    "robot option of the wrong type": (
        lambda _: make_robot("finger", cables="two"),
        "robot 'finger': option cables = 'two' must be an integer",
    ),
    "environment": (
        lambda f: config(f, TrainConfig, TRAIN, "environment.id=FingerReach"),
        "config '*': environment*: unknown environment 'FingerReach'; did you mean 'SoftGym/FingerReach-v0'?",
    ),
    "backend": (
        lambda _: gymnasium.make(REACH, backend="femm"),
        "unknown backend 'femm'; did you mean 'fem'? allowed: fem, surrogate, hardware, hybrid, or one of your own as "
        "'module:Class'",
    ),
    "task option": (
        lambda _: gymnasium.make(REACH, task_options={"spred": 0.1}),
        "task 'reach': unknown option 'spred'; did you mean 'spread'? allowed: goals, command_low, spread",
    ),
    "design variable": (
        lambda _: reset(design={"lenght": 0.04}),
        "unknown design variable 'lenght'; did you mean 'length'? allowed: length, height, *",
    ),
    "material": (
        lambda _: body(material="neohooke"),
        "unknown material 'neohooke'; did you mean 'stable_neo_hookean'? allowed: corotational, stable_neo_hookean",
    ),
    "element": (
        lambda _: body(element="quadratc"),
        "unknown element 'quadratc'; did you mean 'quadratic'? allowed: linear, averaged, quadratic",
    ),
    "configuration key": (
        lambda f: config(f, TrainConfig, TRAIN, "sac.gama=0.9"),
        "config '*': sac: unknown key 'gama'; did you mean 'gamma'? allowed: learning_rate, *",
    ),
    "variable of a study": (
        lambda f: config(f, StudyConfig, FINGER, "variables=[heigth]"),
        "config '*': *unknown design variable 'heigth'; did you mean 'height'? allowed: length, height, *",
    ),
    "objective": (
        lambda f: config(f, StudyConfig, FINGER, "objective=mean_distanse"),
        "config '*': *unknown metric 'mean_distanse'*mean_distance*",
    ),
    "name in place of a list": (
        lambda f: config(f, StudyConfig, FINGER, "variables=length"),
        "config '*': variables: must be a list, got 'length'",
    ),
    "number in place of a group": (
        lambda f: config(f, StudyConfig, FINGER, "goals=3"),
        "config '*': goals: must be a mapping of keys to values, got 3",
    ),
    "sampler": (
        lambda f: config(f, StudyConfig, FINGER, "sampler.name=tpee"),
        "config '*': sampler: unknown sampler 'tpee'; did you mean 'tpe'? *",
    ),
    "metric of a design search": (
        lambda f: config(f, OptimiseConfig, STRENGTH, "objectives=[{metric: contact_forse}]"),
        "config '*': objectives.0.metric: unknown metric 'contact_forse'; did you mean 'contact_force'?*",
    ),
    "configuration of another verb": (
        lambda f: config(f, CalibrationConfig, TRAIN),
        "config '*': missing required keys *fit, data (and * more problems)",
    ),
    "shipped policy": (
        lambda _: Policy("finger_rech"),
        "unknown policy 'finger_rech'; did you mean 'finger_reach'? allowed*a policy file (.safetensors)",
    ),
    "name without a list": (
        lambda _: gymnasium.make(REACH, sample_design="length"),
        "sample_design = 'length' must be True, False or a list of names, such as ['length']",
    ),
    "option that only the environment takes": (
        lambda _: gymnasium.make(REACH, bakend="fem"),
        "unknown environment option 'bakend'; did you mean 'backend'? allowed: robot, task, backend, render_mode, *",
    ),
    # Kinds
    "ID in place of a configuration": (
        lambda _: evaluate("qp", REACH, GOALS),
        f"environment = '{REACH}' must be an EnvironmentConfig, such as EnvironmentConfig(id=ID)",
    ),
    "number in place of a robot": (
        lambda _: make_robot(3),
        "a robot must be a registered name, 'module:class', a subclass of *Robot or an object of one, got 3",
    ),
    "bodies in place of a body": (
        lambda _: gymnasium.make_vec(REACH, num_envs=2, design=[{}, {}]),
        "design is one body for all episodes, got 2; give a body for each sub-environment in "
        "reset(options={'design': [...]})",
    ),
    "action that is no number": (
        lambda _: act("left"),
        "action = 'left' must be numbers; allowed: -1 to 1",
    ),
    "command that is no number": (
        lambda _: make_backend("surrogate", make_robot("finger")).step("left"),
        "command must be 2 finite numbers, got 'left'",
    ),
    "state of nothing": (
        lambda _: gymnasium.make(REACH).unwrapped.set_state({}),
        "state = {} must be what get_state returned",
    ),
    "file of weights in place of their folder": (
        lambda f: gymnasium.make(REACH, backend_options={"weights": touched(f / "model.safetensors")}),
        "weights '*model.safetensors' are a file; give their folder: '*'",
    ),
    # Values
    "measurement of nothing": (
        lambda _: measure(make_robot("finger"), {}, []),
        "commands is empty; give one or more commands of the actuators",
    ),
    "measurement driven by something else": (
        lambda _: measure(make_robot("finger"), {}, [[1.0, 1.0]], driven="force"),
        "driven = 'force' is unknown; allowed: 'displacement', 'effort'",
    ),
    "range of an actuator": (
        lambda _: Actuator("cable", low=0.02, high=0.0, rate=0.001),
        "actuator 'cable': low 0.02 must be below high 0, both finite",
    ),
    "rate of an actuator": (
        lambda _: Actuator("cable", low=0.0, high=0.02, rate=0.0),
        "actuator 'cable': rate = 0 must be positive",
    ),
    "range of an actuator without its command at rest": (
        lambda _: Actuator("cable", low=0.002, high=0.02, rate=0.001),
        "actuator 'cable': the range 0.002 to 0.02 m must contain 0, which is its command at rest",
    ),
    "mask of another mesh": (
        lambda _: MechanicalModel.from_mesh(NODES, TETRAHEDRA, fixed=np.ones(3, dtype=bool), element="linear"),
        "'fixed' must be numbers of nodes from 0 to 19, or a mask (20,) or (20, 3), got an array of shape (3,) of bool",
    ),
    "clamped node that does not exist": (
        lambda _: MechanicalModel.from_mesh(NODES, TETRAHEDRA, fixed=[0, 99], element="linear"),
        "'fixed' must be numbers of nodes from 0 to 19, *, got integers of shape (2,) from 0 to 99",
    ),
    "clamped node counted from the end": (
        lambda _: MechanicalModel.from_mesh(NODES, TETRAHEDRA, fixed=[-1], element="linear"),
        "'fixed' must be numbers of nodes from 0 to 19, *",
    ),
    "two pull points": (
        lambda _: body().add_cable("cable", np.array([[0.05, 0.01, 0.01]]), np.zeros((2, 3))),
        "the pull point of cable 'cable' must be three finite numbers, got *",
    ),
    "pull point that is not finite": (
        lambda _: body().add_cable("cable", np.array([[0.05, 0.01, 0.01]]), [0.0, np.nan, 0.0]),
        "the pull point of cable 'cable' must be three finite numbers, got *nan*",
    ),
    "mask of nodes that a frame carries": (
        carried,
        "rows that frame 20 carries must be numbers from 0 to 23, got an array of shape (20,) of bool",
    ),
    "noise of an exact actuator": (
        lambda _: Noise(displacement=0.0),
        "noise: displacement = 0.0 must be positive and finite",
    ),
    "touch without a force": (
        lambda _: Touch(finger_grid(), (0, 0), 0.0),
        "expected_force = 0.0 N must be positive and finite",
    ),
    "payload without a mass": (
        lambda _: Payload(expected_mass=float("nan")),
        "expected_mass = nan kg must be positive and finite",
    ),
    "touch cells without a size": (
        lambda _: finger_grid(0.0),
        "pitch = 0.0 m of touch cells is out of bounds; allowed: up to 0.015 m",
    ),
    "empty configuration": (
        lambda f: config(f, FitConfig, {}),
        "config '*': missing required keys robot, data",
    ),
    "configuration that is a list": (
        lambda f: config(f, FitConfig, ["robot", "finger"]),
        "config '*' must be a mapping of keys to values, got a list",
    ),
    "number that is not finite": (
        lambda f: config(f, TrainConfig, TRAIN, "sac.gamma=.nan"),
        "config '*': sac.gamma: must be a finite number, got nan",
    ),
    "design that is not a number": (
        lambda _: reset(design={"length": float("nan")}),
        "design variable 'length' = nan is not finite; allowed: 0.038 to 0.042 m",
    ),
    "goal that is not finite": (
        lambda _: reset(goal=[0.0, float("nan"), -0.09]),
        "goal must be finite, got *nan*",
    ),
    "goal of two coordinates": (
        lambda _: reset(goal=[0.0, 0.09]),
        "goal must have shape (3) or (p, 3), got (2,)",
    ),
    "negative mass": (
        lambda _: body(total_mass=-0.1),
        "total_mass = -0.1 kg must be positive and finite",
    ),
    "missing file": (
        lambda f: MechanicalModel.from_file(f / "body.msh", fixed_box=(0, 1, 0, 1, 0, 1), element="linear"),
        "mesh file '*body.msh' does not exist",
    ),
    "nothing clamped": (
        lambda _: MechanicalModel.from_mesh(NODES, TETRAHEDRA, fixed=NODES[:, 0] > 1.0, element="linear"),
        "no node is fixed: the body could float away; pass the clamped nodes as 'fixed'",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_ends_with_one_line(mistake, tmp_path):
    call, expected = MISTAKES[mistake]
    with pytest.raises((SoftGymError, ValueError, gymnasium.error.Error)) as caught:
        call(tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    assert fnmatch.fnmatchcase(message, expected.replace("[", "[[]")), message


@pytest.mark.parametrize("value", ["0.04", b"0.04", True, None, [0.04]])
def test_numbers_of_designs_and_actuators_are_numbers(value, tmp_path):
    with pytest.raises(ValueError, match=r"'length' = .* (is not|must be) a number"):
        make_robot("finger").design_space.complete({"length": value})
    with pytest.raises(ValueError, match="high = .* must be a number"):
        DesignVariable("length", 0.01, value, 0.02, "m", "of the finger")
    with pytest.raises(ValueError, match="high = .* must be a number"):
        Actuator("cable", 0.0, value, 0.01)
    if isinstance(value, str):
        with pytest.raises(SoftGymError, match="'length' = '0.04' must be a number"):
            config(tmp_path, StudyConfig, FINGER, "environment.design={length: '0.04'}")


def test_caches_are_kept_elsewhere_where_nothing_can_be_written(tmp_path, monkeypatch, capfd):
    """A container without a home: a folder below a file cannot be made, not even by root."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = cache_directory("meshes")
    assert found.parent.parent == tmp_path and found.parent.stat().st_mode & 0o077 == 0
    assert capfd.readouterr().err.count("\n") == 1
    assert cache_directory("kernels").parent == found.parent and capfd.readouterr().err == ""

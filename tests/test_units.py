"""Numbers in a wrong unit are refused at every entry with the likely unit; who means them insists by name."""

from __future__ import annotations

import fnmatch
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import yaml

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs import DesignSpace, DesignVariable, make_robot, unchecked
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.backends import make_backend
from softgym_envs.backends.backend import PointForce
from softgym_envs.config import load_config
from softgym_envs.extensions.beams.beam import Beam, Section
from softgym_envs.extensions.sensing.loads import Payload, Touch, finger_grid
from softgym_envs.mechanics import MechanicalModel
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.contact import ContactSettings
from softgym_envs.mechanics.contact.obstacles import MeshObstacle, Plane, Sphere
from softgym_envs.quantities import QUANTITIES, check_quantity, check_unit
from softgym_envs.robots import Actuator, Robot
from tests.helpers import box_mesh

NODES, TETRAHEDRA = box_mesh((0.1, 0.02, 0.02), (4, 1, 1))


def body(scale=1.0, **options):
    nodes = scale * NODES
    return MechanicalModel.from_mesh(nodes, TETRAHEDRA, fixed=nodes[:, 0] == 0.0, **options)


class Bar(Robot):
    """A bar of any size, pulled by one cable."""

    name, effectors, size = "bar", ("tip",), 0.1
    design_space = DesignSpace(DesignVariable("young_modulus", 2e5, 1e6, 5e5, "Pa", "stiffness"))
    actuators = (Actuator("pull", low=0.0, high=0.004, rate=0.0005),)
    effector_rest, effort_scale = np.array([0.1, 0.01, 0.01]), np.ones(1)
    scale = 1.0

    def assemble(self, design):
        model = body(self.scale, young_modulus=design["young_modulus"], gravity=self.gravity)
        route = self.scale * np.linspace([0.005, 0.01, 0.017], [0.095, 0.01, 0.017], 4)
        model.add_cable("pull", route, self.scale * np.array([-0.001, 0.01, 0.017]))
        model.add_effector("tip", self.scale * np.array([0.1, 0.01, 0.01]))
        return model


class Loaded(Bar):
    """The bar with a rigid part whose mass was given in grams."""

    def assemble(self, design):
        builder = ModelBuilder(gravity=self.gravity)
        builder.add_solid(NODES, TETRAHEDRA, fixed=NODES[:, 0] == 0.0, young_modulus=design["young_modulus"])
        frame = builder.add_frame([0.1, 0.01, 0.01])
        builder.add_mass(frame, 20.0, np.eye(3) * 1e-3)
        model = builder.build()
        model.add_cable("pull", np.linspace([0.005, 0.01, 0.017], [0.095, 0.01, 0.017], 4), [-0.001, 0.01, 0.017])
        model.add_effector("tip", [0.1, 0.01, 0.01])
        return model


def scaled(factor):
    """Return the class of the bar, larger by a factor."""
    pull = (Actuator("pull", low=0.0, high=0.004 * factor, rate=0.0005 * factor),)
    rest = factor * Bar.effector_rest
    return type("Scaled", (Bar,), {"size": 0.1 * factor, "scale": factor, "actuators": pull, "effector_rest": rest})


def beam(**options):
    builder = ModelBuilder()
    frames = [builder.add_frame([x, 0.0, 0.0], fixed=x == 0.0) for x in (0.0, 0.05, 0.1)]
    builder.add_element(Beam, frames, section=Section.circle(5e-3), young_modulus=3e7, **options)
    return builder.build()


def environment(name, **options):
    return gymnasium.make(f"SoftGym/{name}-v0", **options)


def from_yaml(folder, **options):
    path = folder / "environment.yaml"
    path.write_text(yaml.safe_dump({"id": "SoftGym/FingerReach-v0", **options}))
    return load_config(path, EnvironmentConfig).make()


def plane(y, **options):
    return Plane((0.0, y, 0.0), (0.0, -1.0, 0.0), **options)


def touching(**options):
    return body().set_contact(obstacles=[plane(1.0)], settings=ContactSettings(**options))


# Mistake -> (function of a temporary folder that makes it; the message, in which * stands for any text)
MISTAKES = {
    # Bodies
    "density in g/cm3": (lambda _: body(density=1.1), "density = 1.1 kg/m3 *; did you mean 1100 kg/m3 (1.1 g/cm3)?*"),
    "density in kg/mm3": (lambda _: body(density=1.1e-6), "density = 1.1e-06 kg/m3 *; did you mean 1100 kg/m3 *"),
    "density in t/mm3": (lambda _: body(density=1.1e-9), "density = 1.1e-09 kg/m3 *; did you mean 1100 kg/m3 *"),
    "density of a beam in g/cm3": (lambda _: beam(density=1.2), "density = 1.2 kg/m3 *; did you mean 1200 kg/m3 *"),
    "mass in g": (lambda _: body(total_mass=44.0), "total_mass = 44 kg: density = *; did you mean 1100 kg/m3 *in g)?*"),
    "mass in mg": (lambda _: body(total_mass=44e3), "total_mass = 44000 kg: density = *"),
    "modulus in kPa": (lambda _: body(young_modulus=500.0), "young_modulus = 500 Pa *"),
    "modulus in MPa": (
        lambda _: body(young_modulus=2.1),
        "young_modulus = 2.1 Pa *; did you mean 2.1e+06 Pa (2.1 MPa)?*",
    ),
    "modulus in MPa, converted twice": (lambda _: body(young_modulus=3e12), "*; did you mean 3e+06 Pa (MPa, conver*"),
    "modulus of a block in MPa": (lambda _: body().solids[0].set_elasticity(0.5, 0.3), "young_modulus = 0.5 Pa *"),
    "gravity of a body in mm/s2": (
        lambda _: body(gravity=(0.0, 0.0, -9810.0)),
        "gravity (0.0, 0.0, -9810.0): length = 9810 m/s2 *; did you mean 9.81 m/s2 (9810 mm/s2)?*",
    ),
    "gravity set in cm/s2": (lambda _: body().set_gravity((0.0, -981.0, 0.0)), "*; did you mean 0.981 m/s2 *"),
    "gravity in mm/ms2": (lambda _: body(gravity=(0.0, 0.0, -0.00981)), "*; did you mean 9.81 m/s2 (0.00981 mm/ms2)?*"),
    "body in micrometres, taken for metres": (lambda _: body(1e6), "*size = 100000 m *; did you mean 0.1 m *um)?*"),
    "body in metres, scaled twice": (lambda _: body(1e-6), "*its size = 1e-07 m *; did you mean 0.1 m (metres, read*"),
    "clamp in millimetres": (
        lambda _: MechanicalModel.from_mesh(NODES, TETRAHEDRA, fixed=NODES[:, 0] < 1.0, element="linear"),
        "*every node is clamped, so that nothing can move*",
    ),
    # Actuators and designs
    "actuator in degrees": (
        lambda _: Actuator("servo", low=-90.0, high=90.0, rate=5.0, unit="rad"),
        "actuator 'servo': low = -90 rad *; did you mean -1.571 rad (-90 deg)?*",
    ),
    "unit of an actuator": (
        lambda _: Actuator("servo", low=-90.0, high=90.0, rate=5.0, unit="deg"),
        "actuator 'servo': unit 'deg' is not SI; give its values in rad (1 deg = 0.0174533 rad)",
    ),
    "millimetres of an actuator": (
        lambda _: Actuator("cable", low=0.0, high=4.0, rate=0.5, unit="mm"),
        "actuator 'cable': unit 'mm' is not SI; give its values in m (1 mm = 0.001 m)",
    ),
    "unknown unit": (lambda _: Actuator("a", 0.0, 1.0, 0.1, unit="furlong"), "actuator 'a': unknown unit 'furlong'*"),
    "stroke in millimetres": (lambda _: Actuator("cable", 0.0, 40.0, 0.5), "actuator 'cable': high = 40 m *(40 mm)?*"),
    "rate in millimetres": (
        lambda _: Actuator("cable", low=0.0, high=0.004, rate=0.5),
        "actuator 'cable': rate = 0.5 m * exceeds its range of 0.004 m; *",
    ),
    "volume in millilitres": (lambda _: Actuator("air", 0.0, 5.0, 1.0, unit="m3"), "*high = 5 m3 *(5 ml)?*"),
    "volume of a small robot in litres": (
        lambda _: type("Air", (Bar,), {"actuators": (Actuator("air", 0.0, 0.005, 1e-3, unit="m3"),)})(),
        "robot 'bar': stroke of actuator 'air' = 0.005 m3 *",
    ),
    "angle of a design in degrees": (
        lambda _: DesignVariable("angle", -45.0, 45.0, 10.0, "rad", "tilt"),
        "design variable 'angle': low = -45 rad *; did you mean -0.7854 rad (-45 deg)?*",
    ),
    "unit of a design variable": (
        lambda _: DesignVariable("angle", -45.0, 45.0, 10.0, "degrees", "tilt"),
        "design variable 'angle': unit 'degrees' is not SI; *",
    ),
    "MPa of a design variable": (
        lambda _: DesignVariable("modulus", 1.0, 10.0, 3.0, "Pa", "stiffness"),
        "design variable 'modulus': high = 10 Pa *; did you mean 1e+07 Pa (10 MPa)?*",
    ),
    "g/cm3 of a design variable": (
        lambda _: DesignVariable("density", 0.9, 1.3, 1.1, "kg/m3", "of the silicone"),
        "design variable 'density': high = 1.3 kg/m3 *; did you mean 1300 kg/m3 *",
    ),
    "length of a design variable in millimetres": (
        lambda _: DesignVariable("length", 30.0, 70.0, 50.0, "m", "of the finger"),
        "design variable 'length': high = 70 m *; did you mean 0.07 m (70 mm)?*",
    ),
    "thickness of a small robot in millimetres": (
        lambda _: type(
            "Thick", (Bar,), {"design_space": DesignSpace(DesignVariable("t", 1.0, 3.0, 2.0, "m", "wall"))}
        )(),
        "robot 'bar': design variable 't' = 3 m *; did you mean 0.003 m (3 mm)?*",
    ),
    # Robots
    "size in millimetres": (lambda _: type("Big", (Bar,), {"size": 100.0})(), "robot 'bar': size = 100 m *(100 mm)?*"),
    "size in metres, scaled twice": (
        lambda _: type("Tiny", (Bar,), {"size": 1e-4})(),
        "robot 'bar': size = 0.0001 m *",
    ),
    "effector far from where it rests": (
        lambda _: type("Far", (Bar,), {"effector_rest": np.array([0.3, 0.01, 0.01])})().build(),
        "robot 'bar': effector 'tip' of the baseline body is at [0.1, 0.01, 0.01] m, 0.2 m away from effector_rest = *",
    ),
    "gravity in mm/s2": (
        lambda _: make_robot("finger", gravity=(0.0, 0.0, -9810.0)),
        "robot 'finger': gravity = -9810 *",
    ),
    "payload in g": (
        lambda _: make_robot("tetrapod", payload=1000.0),
        "robot 'tetrapod': payload = 1000 kg *(1000 g)?*",
    ),
    "size of a robot in cm": (
        lambda _: type("Large", (Bar,), {"size": 1.1})().build(),
        "robot 'bar': size = 1.1 m does not fit the body that assemble returns, which extends over 0.104 m; allowed: *",
    ),
    "typical effort in mN": (
        lambda _: type("Strong", (Bar,), {"effort_scale": np.array([2e5])})(),
        "robot 'bar': effort_scale of actuator 'pull' = 200000 N *; did you mean 200 N (2e+05 mN)?*",
    ),
    "payload of some grams": (
        lambda _: make_robot("tetrapod", payload=10.0),
        "robot 'tetrapod': payload = 10 kg *lift*; did you mean 0.01 kg (10 g)?*",
    ),
    "mass of a rigid part in g": (
        lambda _: Loaded().build(),
        "robot 'bar': mass of a rigid part = 20 kg *; did you mean 0.02 kg (20 g)?*",
    ),
    "force of a step in mN": (
        lambda _: make_backend("fem", Bar()).step([0.0], force=[0.0, 0.0, 100.0]),
        "force = 100 N *ten times what its actuators can do*; did you mean 0.1 N (100 mN)?*",
    ),
    "force of a step in mN, though the actuators are strong": (
        lambda _: make_backend("fem", make_robot("finger")).step(np.zeros(2), force=[0.0, 300.0, 0.0]),
        "force = 300 N *moves its effector by 10 sizes*; did you mean 0.3 N (300 mN)?*",
    ),
    "force of a touch in mN": (
        lambda _: make_backend("fem", Bar()).touch(PointForce([0.1, 0.01, 0.01], [0.0, 0.0, -100.0])),
        "force of a touch = -100 N *; did you mean -0.1 N (-100 mN)?*",
    ),
    "effort in mN": (
        lambda _: make_backend("fem", Bar()).step([900.0], "effort"),
        "effort of actuator 'pull' = 900 N *; did you mean 0.9 N (900 mN)?*",
    ),
    "object's mass in g": (
        lambda _: make_robot("two_finger_friction_gripper", object_mass=50.0),
        "robot 'two_finger_friction_gripper': object_mass = 50 kg *; did you mean 0.05 kg (50 g)?*",
    ),
    "friction in percent": (
        lambda _: make_robot("two_finger_friction_gripper", friction=30.0),
        "robot 'two_finger_friction_gripper': friction = 30 *; did you mean 0.3 (30 %)?*",
    ),
    "stroke of an arm in mm": (
        lambda _: make_robot("modular_arm", stroke=6.0),
        "*stroke of actuator 'wire_x' = -6 m *",
    ),
    "strokes of a trunk in mm": (
        lambda _: make_robot("cable_trunk", strokes=(20.0, 20.0)),
        "*actuator 'long_north': high*",
    ),
    "servo range in degrees": (lambda _: make_robot("tetrapod", servo_range=90.0), "servo_range = 90.0 rad is out *"),
    "force of a button in mN": (lambda _: make_robot("press_finger", button_force=2000.0), "*button_force = 2000 N *"),
    "negative contact distance": (
        lambda _: make_robot("finger", contact_distance=-1.0),
        "*contact_distance = -1 m must *",
    ),
    "contact distance in mm": (
        lambda _: make_robot("finger", self_contact=True, contact_distance=0.5),
        "robot 'finger': contact_distance = 0.5 m *; did you mean 0.0005 m (0.5 mm)?*",
    ),
    "negative friction on itself": (lambda _: make_robot("finger", self_friction=-1.0), "*self_friction = -1 must *"),
    "friction on itself without contact": (
        lambda _: make_robot("finger", self_friction=0.5),
        "robot 'finger': self_friction = 0.5 has no effect without self_contact=True",
    ),
    "distance of a contact that is not there": (
        lambda _: make_robot("diamond", contact_distance=1e-3),
        "robot 'diamond': contact_distance = 0.001 has no effect: *",
    ),
    # Obstacles
    "obstacle in mm": (
        lambda _: make_robot("finger", obstacles=[{"kind": "plane", "point": [0, 40, 0], "normal": [0, -1, 0]}]),
        "plane: point = 40 m *; did you mean 0.04 m (40 mm)?*",
    ),
    "near obstacle in mm": (
        lambda _: body().set_contact(obstacles=[plane(5.0)]),
        "gap between the body and obstacle 'plane' = 4.98 m *; did you mean 0.00498 m *",
    ),
    "ball in mm": (lambda _: Sphere((0.0, 0.0, 50.0), 5.0, name="ball"), "sphere 'ball': centre = 50 m *(50 mm)?*"),
    "radius in mm": (lambda _: Sphere((0.0, 0.0, 0.1), 30.0), "sphere: radius = 30 m *; did you mean 0.03 m (30 mm)?*"),
    "mesh of an obstacle in mm": (
        lambda _: MeshObstacle(1e3 * NODES, [(0, 1, 2)]),
        "mesh: vertices = *; did you mean *",
    ),
    "friction of an obstacle in percent": (lambda _: plane(0.04, friction=50.0), "plane: friction = 50 *(50 %)?*"),
    "distance of contact in mm": (lambda _: touching(distance=0.5), "distance of contact = 0.5 m *(0.5 mm)?*"),
    "friction on itself in percent": (lambda _: touching(self_friction=50.0), "self_friction = 50 *(50 %)?*"),
    # Backends, plants and tasks
    "control step in ms": (
        lambda _: make_backend("fem", make_robot("tetrapod"), dynamics=True, control_step=50.0),
        "control_step = 50 s *; did you mean 0.05 s (50 ms)?*",
    ),
    "time step in us": (
        lambda _: make_backend("fem", make_robot("tetrapod"), dynamics=True, time_step=1000.0),
        "time_step = 1000 s *; did you mean 1 s (1000 ms)?*",
    ),
    "time step without motion": (
        lambda _: make_backend("surrogate", make_robot("finger"), time_step=0.001),
        "time_step = 0.001 has no effect without dynamics=True",
    ),
    "damping without motion": (
        lambda _: make_backend("fem", make_robot("finger"), mass_damping=1.0),
        "mass_damping = 1.0 has no effect without dynamics=True",
    ),
    "friction of cables in percent": (
        lambda _: make_backend("fem", make_robot("finger"), cable_friction=20.0),
        "cable_friction = 20 *; did you mean 0.2 (20 %)?*",
    ),
    "friction of a plant in percent": (
        lambda _: environment("FingerReach", backend="fem", plant={"cable_friction": 20.0}),
        "plant cable_friction = 20.0; allowed: *",
    ),
    "push in mN": (
        lambda _: environment("TetrapodCarry", task_options={"push": 500.0}),
        "push = 500 N *; did you mean 0.5 N (500 mN)?*",
    ),
    "forces of a grasp in mN": (
        lambda _: environment("FingerGrasp", task_options={"forces": (100.0, 600.0)}),
        "forces = 100 N *; did you mean 0.1 N (100 mN)?*",
    ),
    "touch in mN": (lambda _: environment("SensorizedFingerReach", task_options={"force": 1e4}), "force = 10000 N *"),
    "distance of a task in mm": (
        lambda _: environment("TetrapodCarry", task_options={"distance": 100.0}),
        "distance = *",
    ),
    "gravity in a file in mm/s2": (
        lambda f: from_yaml(f, robot_options={"gravity": [0, 0, -9810]}, backend="fem"),
        "robot 'finger': gravity = -9810 m/s2 *",
    ),
    "control step in a file in ms": (
        lambda f: from_yaml(f, backend="fem", backend_options={"dynamics": True, "control_step": 50}),
        "control_step = 50 s *",
    ),
    "expected mass in g": (lambda _: Payload(expected_mass=5000.0), "expected_mass = 5000 kg *(5000 g)?*"),
    "expected force in uN": (lambda _: Touch(finger_grid(), (0, 0), 2e6), "expected_force = 2e+06 N *"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_ends_with_one_line(mistake, tmp_path):
    call, expected = MISTAKES[mistake]
    with pytest.raises((ValueError, gymnasium.error.Error)) as caught:
        call(tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    assert fnmatch.fnmatchcase(message, expected.replace("[", "[[]")), message


@pytest.mark.parametrize("factor", [0.05, 1.0, 20.0], ids=["5 mm", "10 cm", "2 m"])
def test_robots_of_a_few_millimetres_and_of_metres_pass(factor):
    assert make_robot(scaled(factor)).build().volume == pytest.approx(factor**3 * 4e-5)


def test_who_means_it_insists_by_the_name_of_the_quantity(monkeypatch):
    tiny = scaled(5e-3)  # half a millimetre long
    with pytest.raises(ValueError, match="if it is meant, set SOFTGYM_UNCHECKED=size$"):
        make_robot(tiny)
    with unchecked("size"):
        model = make_robot(tiny).build()
        # Processes started meanwhile inherit it.
        line = "from softgym_envs.quantities import check_quantity; check_quantity('size', 1e-4, 'chip')"
        subprocess.run([sys.executable, "-c", line], check=True)
    assert model.volume == pytest.approx(5e-12)
    with pytest.raises(ValueError, match="size"):
        make_robot(tiny)
    monkeypatch.setenv("SOFTGYM_UNCHECKED", "gravity, size")
    assert make_robot(tiny, gravity=(0.0, 0.0, -500.0)).build().loads.any()
    with pytest.raises(ValueError, match="density = 1.1"):
        body(density=1.1)
    monkeypatch.setenv("SOFTGYM_UNCHECKED", "sise")
    with pytest.raises(ValueError, match=r"SOFTGYM_UNCHECKED: unknown quantity 'sise'; did you mean 'size'\?"):
        make_robot(tiny)
    with pytest.raises(ValueError, match="unknown quantity 'weight'"), unchecked("weight"):
        pass


@pytest.mark.parametrize("name", QUANTITIES)
def test_ranges_contain_their_ends_and_zero_and_nothing_beyond(name):
    quantity = QUANTITIES[name]
    for value in (0.0, quantity.low, quantity.high, [quantity.low, quantity.high]):
        check_quantity(name, value, name)
    if quantity.signed:
        check_quantity(name, -quantity.high, name)
    else:
        with pytest.raises(ValueError, match="must be finite and not negative"):
            check_quantity(name, -quantity.high, name)
    for value in (1.01 * quantity.high, [0.0, 0.99 * quantity.low or 1.01 * quantity.high]):
        with pytest.raises(ValueError, match=f"if it is meant, set SOFTGYM_UNCHECKED={name}"):
            check_quantity(name, value, name)
    with pytest.raises(ValueError, match="must be finite"):
        check_quantity(name, np.nan, name)


@pytest.mark.parametrize("unit", ["1", "m", "rad", "Pa", "N m", "kg/m3", "1/m", "m/s2", "Pa s", "N/m", "m2", "-"])
def test_si_units_pass(unit):
    check_unit(unit, "value")


@pytest.mark.parametrize("unit", ["mm", "MPa", "N mm", "g/cm3", "kPa", "1/mm", "°", "psi", "", None, "parsec"])
def test_other_units_are_named(unit):
    with pytest.raises(ValueError, match="unit"):
        check_unit(unit, "value")

"""Registries: names, classes and objects; entry points; one clear line for every wrong name or option."""

from __future__ import annotations

import re
import sys

import pytest

from softgym_envs import make_robot
from softgym_envs.registry import Registry
from softgym_envs.robots import ROBOTS
from softgym_envs.robots.soft_finger import SoftFinger


class Shape:
    """The base class of the registry below."""

    name: str


class Disc(Shape):
    name = "disc"

    def __init__(
        self,
        *,
        radius: float = 1.0,
        holes: int = 0,
        label: str | None = None,
        filled: bool = True,
        at: tuple[float, float] = (0, 0),
    ):
        self.radius = radius


class Other(Shape):
    name = "disc"


class Bar(Shape):
    def __init__(self, owner, *, length: float):
        self.owner, self.length = owner, length


BASE = f"{__name__}:Shape"


@pytest.fixture
def registry():
    return Registry("shape", {"disc": f"{__name__}:Disc"}, base=BASE)


def test_names_paths_classes_and_objects_are_accepted(registry):
    disc = registry.make("disc", radius=2)
    assert isinstance(disc, Disc)
    assert disc.radius == 2
    assert isinstance(registry.make(f"{__name__}:Disc"), Disc)
    assert isinstance(registry.make(Disc, holes=3), Disc)
    assert registry.make(disc) is disc
    assert registry["disc"] is Disc
    assert list(registry) == ["disc"]


def test_registered_by_call_and_by_decorator(registry):
    class Rod(Bar):
        pass

    assert registry.register("rod", Rod) is Rod
    assert Rod.name == "rod"
    assert registry.make("rod", "me", length=1.0).owner == "me"

    @registry.register
    class Square(Shape):
        name = "square"

    @registry.register("triangle")
    class Triangle(Square):
        pass

    @registry.register()
    class Ellipse(Shape):
        name = "ellipse"

    registry.register("late", f"{__name__}:Disc")
    assert Triangle.name == "triangle"
    assert Square.name == "square"
    assert list(registry) == ["disc", "rod", "square", "triangle", "ellipse", "late"]
    registry.register(Square)  # registering it again is not a conflict


def test_a_redefined_class_replaces_the_old_one(registry):
    def define():
        class Again(Shape):
            name = "again"

        return Again

    registry.register(define())
    new = define()
    registry.register(new)
    assert registry["again"] is new


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("disc", Other), "shape 'disc' is already registered: .*:Disc"),
        (("round", Disc), "is named 'disc': it cannot be registered as 'round'"),
        ((int,), r"a shape must be a subclass of .*Shape, got <class 'int'>"),
        (("pen", "pens.Pen"), "'pens.Pen' must look like module:class"),
    ],
)
def test_invalid_registrations_are_refused(registry, arguments, message):
    with pytest.raises(ValueError, match=message):
        registry.register(*arguments)


def test_a_class_without_a_name_is_refused(registry):
    class Nameless(Shape):
        pass

    with pytest.raises(ValueError, match="Nameless has no name"):
        registry.register(Nameless)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("disk", {}, r"unknown shape 'disk'; did you mean 'disc'\? allowed: disc"),
        ("xyz", {}, "unknown shape 'xyz'; allowed: disc"),
        ("no_such_module:Disc", {}, "there is no module 'no_such_module'"),
        (f"{__name__}:Disk", {}, "module '.*' has no 'Disk'"),
        ("json:JSONDecoder", {}, "a shape must be a subclass of"),
        (Bar(0, length=1.0), {"length": 2.0}, "is already an object: it cannot take length"),
        (3, {}, "a shape must be a registered name, .* a subclass of .*Shape or an object of one, got 3"),
        (
            "disc",
            {"raduis": 1},
            r"'disc': unknown option 'raduis'; did you mean 'radius'\? allowed: radius, holes, label, filled, at$",
        ),
        ("disc", {"radius": "2"}, "shape 'disc': option radius = '2' must be a number$"),
        ("disc", {"radius": True}, "option radius = True must be a number"),
        ("disc", {"holes": 1.5}, "option holes = 1.5 must be an integer"),
        ("disc", {"label": 3}, "option label = 3 must be a string or none"),
        ("disc", {"filled": 1}, "option filled = 1 must be true or false"),
        ("disc", {"at": [1.0]}, r"option at = \[1.0\] must be 2 numbers"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_each_mistake_has_its_own_message(registry, name, options, message):
    with pytest.raises(ValueError, match=message):
        registry.make(name, **options)


def test_values_that_configuration_files_can_hold_are_accepted(registry):
    registry.make("disc", radius=1, at=[1, 2.0], label=None)


def test_a_missing_option_is_named(registry):
    with pytest.raises(ValueError, match="shape 'Bar' needs the option length"):
        Registry("shape", {}, base=BASE).make(type("Bar", (Bar,), {"name": "Bar"}), "me")


def test_errors_inside_a_class_keep_their_traceback(registry):
    @registry.register
    class Broken(Shape):
        name = "broken"

        def __init__(self):
            len(3)

    with pytest.raises(TypeError, match="has no len"):
        registry.make("broken")


def test_a_missing_import_inside_a_module_is_not_hidden(registry, tmp_path, monkeypatch):
    (tmp_path / "half_installed.py").write_text("import no_such_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_dependency"):
        registry.make("half_installed:Disc")


@pytest.mark.parametrize("name", ["grabber", "grabber.py", "grabber.Claw", "grabber.Clau"])
def test_a_file_of_the_current_folder_is_named_as_its_class_is(registry, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grabber.py").write_text("import nowhere\n\nclass Helper: ...\n\nclass Claw: ...\n")  # it is not run
    with pytest.raises(ValueError, match=f"unknown shape '{re.escape(name)}'; did you mean 'grabber:Claw'\\?$"):
        registry.resolve(name)
    (tmp_path / "grabber.py").write_text("class Claw(:\n")
    with pytest.raises(ValueError, match="or one of your own as 'module:Class'"):
        registry.resolve(name)


def test_entry_points_of_installed_packages(tmp_path, monkeypatch):
    (tmp_path / "their_shapes.py").write_text(f"from {__name__} import Disc\n\nclass Star(Disc):\n    name = 'star'\n")
    info = tmp_path / "their_shapes-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-shapes\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[tests.shapes]\nstar = their_shapes:Star\ndisc = their_shapes:Disc\n")
    monkeypatch.syspath_prepend(tmp_path)
    registry = Registry("shape", {"disc": f"{__name__}:Disc"}, base=BASE, group="tests.shapes")
    both = "shape 'disc' is .*:Disc and also their_shapes:Disc, an entry point of the package 'their-shapes': rename"
    for _ in range(2):
        with pytest.raises(ValueError, match=both):
            registry.make("disc")
    registry = Registry("shape", {"square": f"{__name__}:Disc"}, base=BASE, group="tests.shapes")
    assert list(registry) == ["square", "star", "disc"]
    assert "their_shapes" not in sys.modules
    assert registry.make("star", radius=2.0).name == "star"


def test_robots_of_the_suite():
    assert ROBOTS["finger"] is SoftFinger
    assert isinstance(make_robot(SoftFinger, cables=1), SoftFinger)
    finger = make_robot("finger")
    assert make_robot(finger) is finger
    with pytest.raises(ValueError, match=r"'finger': unknown option 'cabels'; did you mean 'cables'\? allowed: c"):
        make_robot("finger", cabels=1)

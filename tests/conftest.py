"""Slow tests, tests that hang, and shared fixtures: reference data, small meshes and solved fingers."""

from __future__ import annotations

import os
import tomllib
from collections import defaultdict
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from hypothesis import settings

from softgym_envs import make_robot
from softgym_envs.cli import main
from softgym_envs.mechanics.compilation import ANNOUNCED
from softgym_envs.mechanics.locking import locking_accepted
from softgym_envs.mechanics.materials import MATERIALS
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.mechanics.solvers.statics import Statics
from softgym_envs.registry import ALLOW_CODE
from tests.hang_guard import end_if_hung
from tests.helpers import box_mesh, train_small_surrogate

# The same examples on every machine, however busy it is.
settings.register_profile("softgym", deadline=None, derandomize=True)
settings.load_profile("softgym")

# Configurations of these tests name code of these tests; `test_strangers` takes this back.
os.environ.setdefault(ALLOW_CODE, "1")

DATA = Path(__file__).parent / "data"

# -- slow tests ---------------------------------------------------------------------------------------------------

SLOW_TESTS = Path(__file__).parent / "slow_tests.txt"
SLOW = 0.1
"""A test function whose cases take longer than this together is slow [CPU s, processes that it waits for included]."""
CPU_TIME = pytest.StashKey[float]()


def cpu_time():
    """Return the CPU time of this process and of those it has waited for [s], which hardly depends on other work."""
    return sum(os.times()[:4])


def pytest_addoption(parser):
    parser.addoption("--update-slow-tests", action="store_true", help=f"write {SLOW_TESTS.name} from this run's times")


def pytest_configure(config):
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    for group, points in project["entry-points"].items():
        if not points.items() <= {(point.name, point.value) for point in entry_points(group=group)}:
            pip = "python -m pip install --no-deps --no-build-isolation -e ."
            raise pytest.UsageError(f"the installed package is older than pyproject.toml ({group}): run {pip}")
    if config.getoption("update_slow_tests") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(SlowTestsWriter())


class SlowTestsWriter:
    """Writes the list of slow tests at the end of a complete run."""

    def __init__(self):
        self.seconds = defaultdict(float)

    def pytest_runtest_logreport(self, report):
        path, _, function = report.nodeid.partition("[")[0].partition("::")
        if report.when == "setup" and report.cpu_time > SLOW:
            function = ""  # a slow fixture, which any test of the file may be the first to need
        self.seconds[f"{path}::{function}" if function else path] += report.cpu_time

    def pytest_sessionfinish(self):
        slow = {test for test, seconds in self.seconds.items() if seconds > SLOW}
        lines = sorted(test for test in slow if test.partition("::")[0] not in slow or "::" not in test)
        head = f"# Slow files and test functions: they took longer than {SLOW} CPU s. Written by `make slow-tests`."
        SLOW_TESTS.write_text("\n".join([head, *lines]) + "\n")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    report = yield
    report.cpu_time = cpu_time() - item.stash[CPU_TIME]
    item.stash[CPU_TIME] += report.cpu_time
    return report


def pytest_ignore_collect(collection_path, config):
    """Files with nothing but slow tests are not imported by `make check`."""
    path = collection_path.relative_to(config.rootpath).as_posix()
    return True if config.option.markexpr == "not slow" and path in SLOW_TESTS.read_text().splitlines() else None


def pytest_collection_modifyitems(items):
    slow = set(SLOW_TESTS.read_text().splitlines())
    for item in items:
        function = item.nodeid.partition("[")[0]
        if function in slow or function.partition("::")[0] in slow:
            item.add_marker(pytest.mark.slow)


# -- tests that hang ----------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_protocol(item):
    item.stash[CPU_TIME] = cpu_time()
    if item.config.option.usepdb:
        return (yield)
    with end_if_hung(item.config.stash[fault_handler_stderr_fd_key]):
        return (yield)


# -- fixtures -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session", autouse=True)
def coarse_bodies():
    """Tests use coarse elements on coarse meshes on purpose; tests/mechanics/test_locking.py tests the warning."""
    with locking_accepted():
        yield


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory):
    """An empty cache of meshes, so that no test depends on, or writes to, the user's own."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOFTGYM_CACHE", str(folder))
        patch.setenv(ANNOUNCED, "1")  # a first run compiles, and tests of messages read standard error
        yield folder


@pytest.fixture(scope="session")
def require_program():
    """Function ``require_program(found, package)``: skip a test if a program is missing, or fail it in CI."""

    def require(found, package):
        if not found:
            reason = f"{package} is not installed (Debian: apt-get install {package})"
            if os.environ.get("CI_REQUIRES_PROGRAMS"):
                pytest.fail(f"{reason}, and CI_REQUIRES_PROGRAMS is set")
            pytest.skip(reason)

    return require


@pytest.fixture
def softgym(monkeypatch, capsys):
    """Function ``softgym(*arguments) -> status, stdout, stderr``: the command line in this process."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["softgym", *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as leave:
            status = leave.code or 0
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def refused(softgym, monkeypatch, tmp_path):
    """Function ``refused(*arguments) -> line``: the error of a command that leaves no file behind."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        status, _, err = softgym(*arguments)
        (line,) = [line for line in err.splitlines() if line.strip()]
        assert status == 2 and line.startswith("softgym: error: ")
        assert list(tmp_path.iterdir()) == []
        return line

    return run


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


@pytest.fixture(scope="session")
def box():
    """The function `box_mesh`."""
    return box_mesh


@pytest.fixture(params=sorted(MATERIALS))
def beam(request):
    """A soft cantilever of one material with two cables off its axis, an effector and a jittered mesh."""
    nodes, tetrahedra = box_mesh((0.1, 0.02, 0.02), (6, 2, 2), jitter=0.2)
    model = MechanicalModel.from_mesh(
        nodes,
        tetrahedra,
        fixed=nodes[:, 0] == 0.0,
        material=request.param,
        young_modulus=2.0e5,
        poisson_ratio=0.35,
        density=1000.0,
        element="linear",
    )
    for name, y, z in (("top", 0.006, 0.017), ("side", 0.018, 0.009)):
        points = np.array([[x, y, z] for x in (0.02, 0.05, 0.09)])
        model.add_cable(name, points, np.array([-0.005, y, z]))
    model.add_effector("tip", np.array([0.1, 0.011, 0.009]))
    return model


@pytest.fixture(scope="session")
def notched():
    """The notched beam and its reference equilibria, in SI."""
    mesh = np.load(DATA / "notched_lc6_mesh.npz")
    solved = np.load(DATA / "notched_lc6_fast_polar_nu0.3_positions.npz")
    return SimpleNamespace(
        nodes=mesh["nodes"] * 1e-3,
        tetrahedra=mesh["tets"],
        fixed=mesh["fixed"],
        cable_points=mesh["cable_points"] * 1e-3,
        pull_point=mesh["pull_point"] * 1e-3,
        positions=solved["positions"] * 1e-3,
        displacements=solved["displacements"] * 1e-3,
        forces=solved["forces_N"],
    )


@pytest.fixture(scope="session")
def fingers():
    """Function ``fingers(cables, material) -> robot, model``; each body is built once."""
    robots = {}

    def get(cables, material):
        key = (cables, material)
        if key not in robots:
            robot = make_robot("finger", cables=cables, material=material)
            robots[key] = robot, robot.build()
        return robots[key]

    return get


@pytest.fixture(params=[(cables, material) for material in sorted(MATERIALS) for cables in (1, 2)], ids=str)
def finger(request, fingers):
    """A baseline finger of each material with 1 and 2 cables: its robot, model and fresh statics of high accuracy."""
    robot, model = fingers(*request.param)
    model.nodal_loads[:] = 0.0
    model.set_gravity((0.0, 0.0, 0.0))
    return SimpleNamespace(robot=robot, model=model, statics=Statics(model, tolerance=1e-12))


@pytest.fixture(scope="session")
def robot():
    """The finger with one cable that the small ensemble `weights` was trained for."""
    return make_robot("finger", cables=1)


@pytest.fixture(scope="session")
def weights(robot, tmp_path_factory):
    """A small ensemble, trained on the cable of a finger up to 8 mm."""
    folder = tmp_path_factory.mktemp("finger_8mm")
    train_small_surrogate(folder, robot, limit=8e-3, states=30, members=3, width=24, steps=400)
    return folder

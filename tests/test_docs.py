"""The documentation: every ID and robot has a page, the code of the tutorials runs, and the site builds."""

import importlib
import importlib.util
import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.config import check_config
from softgym_envs.envs.options import EnvironmentOptions
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.vector_env import SoftRobotVectorEnv
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.fitting.training import FitConfig
from softgym_envs.robots import ROBOTS
from tests.accessibility import defects

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"


def load(name):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = load("generate")  # puts its folder on the search path
writing, api = (importlib.import_module(f"site_{name}") for name in ("writing", "api"))
robots, environments = (importlib.import_module(f"site_{name}") for name in ("robots", "environments"))
code_blocks = load("run_page").code_blocks
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def test_names_of_pages():
    assert writing.page_name("SoftGym/CableTrunkReach-v0") == "cable_trunk_reach"
    assert writing.page_name("SoftGym/FingerTrack-v12") == "finger_track"


@pytest.mark.parametrize("identifier", ENVIRONMENTS)
def test_every_environment_has_a_page_with_a_description(identifier):
    page = DOCS / "environments" / f"{writing.page_name(identifier)}.md"
    assert page.is_file(), f"write {page.relative_to(ROOT)}: a title and '## Description', the rest is generated"
    assert writing.describes(page.read_text())
    version = int(identifier.rsplit("-v", 1)[1])
    assert version == 0 or f"* v{version}:" in page.read_text(), "a new version is a line of the version history"


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_has_a_page_with_a_description(name):
    page = DOCS / "robots" / f"{name}.md"
    assert page.is_file(), (
        f"write {page.relative_to(ROOT)}: a title, '## Description' and '## Comparison with published values'"
    )
    assert writing.describes(page.read_text())
    assert dict(writing.split(page.read_text())).get("Comparison with published values")


def test_an_empty_description_is_detected():
    assert not writing.describes(
        "# Title\n\n## Description\n\n<!-- to be written, by somebody, in many words: " + "x " * 60 + "-->"
    )
    assert not writing.describes("# Title\n\n" + "word " * 60)
    assert writing.describes("# Title\n\n## Description\n\n" + "word " * 60)


@pytest.mark.parametrize("identifier", ENVIRONMENTS)
def test_pages_of_environments_are_completed(identifier):
    text = (DOCS / "environments" / f"{writing.page_name(identifier)}.md").read_text()
    sections = environments.environment_sections(identifier)
    page = writing.compose(text, environments.environment_top(identifier), sections)
    found = [heading for heading, body in writing.split(page) if heading in sections and body]
    assert found == list(sections)
    assert writing.HERE not in page
    robot = robots.robot_of(ENVIRONMENTS[identifier].robot)
    for name in robot.design_space.names:
        assert f"`{name}`" in page
    for field in fields(EnvironmentOptions):
        assert f"\n| `{field.name}` |" in page or field.name == "defaults"


@pytest.mark.parametrize("identifier", ENVIRONMENTS)
def test_scales_of_the_observation_are_the_real_ones(identifier):
    robot = robots.robot_of(ENVIRONMENTS[identifier].robot)
    scales = environments.observation_scales(robot)
    spaces = AgentSpaces(robot, action_mode="increment", design_names=(), moving=True)
    n, none = len(robot.actuators), np.zeros(0)
    here, there, speed = np.zeros(3), np.array([scales["error"], 0.0, 0.0]), np.array([0.0, 0.0, scales["speed"]])
    row = spaces.observe(robot.lower, robot.upper, robot.effort_scale, here, there, none, speed)
    expected = np.concatenate([-np.ones(n), np.ones(n), np.full(n, 0.5), here, there / scales["position"]])
    np.testing.assert_allclose(row, [*expected, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5], atol=1e-6)


@pytest.mark.parametrize("identifier", ENVIRONMENTS)
def test_the_printed_size_of_the_observation_is_the_real_one(identifier):
    import gymnasium

    env = gymnasium.make(identifier)
    assert f"({env.observation_space.shape[0]} + k,)" in environments.environment_top(identifier)
    env.close()


@pytest.mark.parametrize("identifier", ENVIRONMENTS)
def test_pages_say_whether_a_surrogate_ships_and_how_many_environments_are_stepped(identifier):
    import gymnasium

    text = environments.surrogate_and_batches(identifier)
    try:
        gymnasium.make(identifier, backend="surrogate").close()
    except WeightsError:
        assert "no surrogate ships" in text
    else:
        assert "no surrogate ships" not in text
    envs = gymnasium.make_vec(identifier, num_envs=1)
    assert ("in one call" in text) == isinstance(envs, SoftRobotVectorEnv)
    envs.close()


@pytest.mark.parametrize("package", api.PACKAGES)
def test_names_of_the_reference_can_be_imported(package):
    """Every name that the reference links to is imported from the package under which it stands."""
    section = api.api_index().partition(f"`from {package} import ...`")[2].partition("\n## ")[0]
    links = re.findall(r"\[`(\w+)`\]\(([\w.]+)\.md#([\w.]+)\.(\w+)\)", section)
    for name, page, module, anchor in links:
        assert name == anchor and page in (package, module)
        assert f"\n::: {module}.{name}\n" in api.api_page(page)
        assert getattr(importlib.import_module(module), name) is getattr(importlib.import_module(package), name)
    assert [name for name, *_ in links] == api.public_names(package)


def test_sections_written_in_a_page_take_precedence():
    template = {"One": lambda: "generated one", "Two": lambda: "generated two", "Three": lambda: ""}
    page = "# T\n\n## Two\n\nbefore\n\n<!-- generated -->\n\n## Own\n\n```sh\n## no heading\n```\n"
    composed = writing.compose(page, "top", template)
    assert [heading for heading, _ in writing.split(composed)] == ["", "One", "Two", "Own"]
    assert "before\n\ngenerated two" in composed and "generated one" in composed


@pytest.mark.parametrize("page", [p for p in PAGES if code_blocks(p)], ids=lambda p: p.stem)
def test_the_code_of_a_page_runs(page, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    done = subprocess.run(
        [sys.executable, "-W", "error", str(DOCS / "run_page.py"), str(page), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert ".save(" not in page.read_text() or list(tmp_path.glob("*.png"))


def test_defects_of_a_page_are_found():
    page = """<html><body><h2>A</h2><h4>B</h4><img src="x.png"><a href="y"></a>
    <table><tr><th>a</th><th></th></tr></table><div role="region" aria-label="T"></div>
    <div role="region" aria-label="T"></div></body></html>"""
    found = " ".join(defects(page))
    for words in ("language", "title", "[2, 4]", "level 4 follows", "x.png", "<a>", "column", "2 regions"):
        assert words in found
    assert defects('<html lang="en"><title>T</title><h1>A</h1><p>x<h2>B</h2><img src="x" alt="y"></html>') == []


def test_notebooks_hold_the_code_of_their_pages():
    module = importlib.import_module("site_notebooks")
    for path, text in module.notebooks().items():
        first, *cells = json.loads(text)["cells"]
        assert first["source"] == module.INSTALL
        blocks = code_blocks((DOCS / path).with_suffix(".md"))
        expected = [(f"%%writefile {title}\n" if title else "") + block.strip("\n") for title, block, _ in blocks]
        assert [cell["source"] for cell in cells if cell["cell_type"] == "code"] == expected
        assert any(cell["cell_type"] == "markdown" for cell in cells)


def test_the_first_cell_of_notebooks_installs_what_is_missing(monkeypatch):
    install = importlib.import_module("site_notebooks").INSTALL
    asked, missing = [], {"softgym_envs", "torch"}
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name in missing else object())
    monkeypatch.setattr("subprocess.run", lambda command, check: asked.append(command[5:]))
    exec(install, {})
    assert [command[0] for command in asked] == ["torch", "softgym-envs[all]"]
    missing.clear()
    exec(install, {})
    assert len(asked) == 2


def test_the_page_for_assistants_leads_to_pages_of_the_site():
    text = (DOCS / "llms.txt").read_text()
    links = re.findall(r"\]\(([\w/.-]+)\)", text)
    assert len(links) > 15 and text.startswith("# softgym-envs\n\n> ")
    generated = {"environments/index.md", "robots/index.md", "reference/index.md"}
    for link in links:
        assert (DOCS / link).is_file() or link in generated, link


@pytest.mark.parametrize(
    ("page", "config"),
    [("tutorials/codesign", StudyConfig), ("tutorials/fitting", FitConfig), ("surrogates", FitConfig)],
)
def test_configurations_on_pages_are_valid(page, config):
    for _, text, _ in code_blocks(DOCS / f"{page}.md", "yaml"):
        check_config(config, yaml.safe_load(text), page)


def test_parts_of_a_study_on_the_page_of_strategies_are_valid():
    """The first block is a whole study; each of the others replaces some of its keys."""
    study, *parts = (yaml.safe_load(text) for _, text, _ in code_blocks(DOCS / "strategies.md", "yaml"))
    assert len(parts) == 3
    for part in ({}, *parts):
        check_config(StudyConfig, study | part, "strategies")


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs the extra 'docs'")
def test_the_site_builds_without_a_warning(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = sorted(path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html"))
    wanted = [f"environments/{writing.page_name(identifier)}.html" for identifier in ENVIRONMENTS]
    assert {*wanted, *(f"robots/{name}.html" for name in ROBOTS), "index.html"} <= set(pages)
    assert not list((tmp_path / "site").rglob("*.py"))
    assert {page: found for page in pages if (found := defects((tmp_path / "site" / page).read_text()))} == {}
    # Nothing is loaded from elsewhere when a page is read.
    for page in pages:
        text = (tmp_path / "site" / page).read_text()
        for attribute in ("src", 'rel="stylesheet" href'):
            assert f'{attribute}="http' not in text and f'{attribute}="//' not in text, page

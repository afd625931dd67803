"""What strangers meet first: the doctor, and the files of the repository that guide a release."""

from __future__ import annotations

import json
import runpy
import sys
import tomllib

import pytest
import yaml

from softgym_envs import extras
from softgym_envs.extensions.checks.doctor import examine
from softgym_envs.version import __version__
from tests.test_readme import ROOT


def test_doctor_prints_every_section(softgym):
    status, out, error = softgym("doctor")
    assert (status, error) == (0, "")
    assert out.split()[:3] == ["installation:", "softgym-envs", __version__]
    report = json.loads(softgym("doctor", "--json")[1])
    assert list(report) == ["installation", "extras", "machine", "folders", "libraries of the system"]
    assert set(report["extras"]) == set(extras.EXTRAS)


def test_doctor_names_what_is_missing(monkeypatch, tmp_path):
    monkeypatch.setitem(extras.EXTRAS, "viewer", ("pyvista", "no_such_library"))
    monkeypatch.setenv("SOFTGYM_CACHE", str(tmp_path / "file" / "cache"))
    (tmp_path / "file").mkdir()
    report = examine()
    assert report["extras"]["viewer"] == "missing no_such_library"
    assert report["folders"]["cache"].startswith(str(tmp_path))


def _release(*arguments: str, monkeypatch, root=None):
    monkeypatch.setattr(sys, "argv", ["release.py", *arguments])
    module = runpy.run_path(str(ROOT / ".github" / "release.py"))
    if root is not None:
        module["main"].__globals__["ROOT"] = root
    module["main"]()


def _released(folder, heading="## 0.3.0 (2027-01-02)", citation="0.3.0"):
    (folder / "softgym_envs").mkdir()
    (folder / "softgym_envs" / "version.py").write_text('__version__ = "0.3.0"\n')
    log = f"# Changelog\n\n{heading}\n\n* A leg.\n\n## 0.2.0 (2026-01-02)\n\n* An arm.\n"
    (folder / "CHANGELOG.md").write_text(log)
    (folder / "CITATION.cff").write_text(f"version: {citation}\n")
    return folder


def test_a_release_prints_its_section_of_the_changelog(monkeypatch, tmp_path, capsys):
    _release("notes", "v0.3.0", monkeypatch=monkeypatch, root=_released(tmp_path))
    assert capsys.readouterr().out == "* A leg.\n"


@pytest.mark.parametrize(
    "tag, changes, message",
    [
        ("v0.4.0", {}, "the tag is v0.4.0"),
        ("v0.3.0", {"heading": "## 0.3.0 (unreleased)"}, "unreleased"),
        ("v0.3.0", {"heading": "## 0.2.9 (2026-02-03)"}, "no section"),
        ("v0.3.0", {"citation": "0.2.0"}, "CITATION.cff"),
    ],
)
def test_a_release_that_does_not_agree_is_refused(tag, changes, message, monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match=message):
        _release("check", tag, monkeypatch=monkeypatch, root=_released(tmp_path, **changes))


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_workflows_and_templates_are_yaml(path):
    assert isinstance(yaml.safe_load(path.read_text()), dict)


def test_workflows_name_the_system_packages_that_errors_name():
    for name in ("ci", "docs", "release"):
        words = set((ROOT / ".github" / "workflows" / f"{name}.yml").read_text().split())
        assert set(extras.SYSTEM_PACKAGES.split()) <= words


def test_the_demonstration_is_the_shipped_study(softgym, monkeypatch, tmp_path):
    runs = []
    monkeypatch.setattr("softgym_envs.codesign.study.run_study", lambda *args, **options: runs.append((args, options)))
    monkeypatch.setattr("softgym_envs.extensions.report.page.write_report", lambda folder: folder / "report.html")
    status, out, _ = softgym("demo", "--folder", tmp_path, "--workers", "1", "--quiet")
    assert (status, out) == (0, f"report: {tmp_path / 'report.html'}\n")
    (((config, folder), options),) = runs
    assert (config.name, folder, options["workers"]) == ("finger_reach", tmp_path, 1)


def test_the_conda_recipe_asks_for_what_the_wheel_asks_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / ".github" / "conda-recipe.yaml").read_text())
    python, *others = recipe["requirements"]["run"]
    assert python == f"python {project['requires-python']}"
    assert [line.replace(" ", "") for line in others] == project["dependencies"]
    assert recipe["context"]["version"] == __version__
    assert recipe["build"]["python"]["entry_points"] == [f"softgym = {project['scripts']['softgym']}"]
    assert recipe["about"]["summary"] == project["description"]

"""Configurations that differ, damaged files, and provenance: the commit of a clone and of a source archive."""

from __future__ import annotations

import subprocess
from typing import Any

import pytest

from softgym_envs import runs
from softgym_envs.agents import EnvironmentConfig, TrainConfig
from softgym_envs.config import Config, check_config, difference
from softgym_envs.errors import ConfigError, DataError
from softgym_envs.runs import check_compatible, code_change, commit_of, continue_with_code, provenance
from softgym_envs.storage import JsonLines, drop_torn_line, read_json, read_signed, write_signed
from softgym_envs.version import __version__


class Inner(Config):
    size: int


class Outer(Config):
    inner: Inner
    table: dict[str, Any]


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    return subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


def test_commit_of_a_clone_and_of_its_archive(tmp_path):
    clone, archive = tmp_path / "clone", tmp_path / "archive"
    clone.mkdir()
    archive.mkdir()
    git(clone, "init", "-q")
    (clone / ".gitattributes").write_text(".git_archival.txt export-subst\n")
    (clone / ".git_archival.txt").write_text("node: $Format:%H$\n")
    git(clone, "add", "-A")
    git(clone, "commit", "-q", "-m", "one")
    head = git(clone, "rev-parse", "HEAD")
    assert commit_of(clone) == head[:12]
    (clone / ".git_archival.txt").write_text("changed\n")
    assert commit_of(clone) == head[:12] + "-dirty"
    git(clone, "archive", "-o", str(tmp_path / "source.tar"), "HEAD")
    subprocess.run(["tar", "xf", str(tmp_path / "source.tar"), "-C", str(archive)], check=True)
    assert commit_of(archive) == head[:12]


def test_no_commit_if_it_is_unknown(tmp_path):
    assert commit_of(tmp_path) is None
    (tmp_path / ".git_archival.txt").write_text("node: $Format:%H$\n")  # copied, not exported
    assert commit_of(tmp_path) is None


def test_difference_names_the_first_value_that_differs():
    old = Outer(inner=Inner(size=1), table={"a": 1})
    assert difference(old, Outer(inner=Inner(size=1), table={"a": 1})) is None
    assert difference(old, Outer(inner=Inner(size=2), table={"a": 3})) == "inner.size = 1, got 2"
    assert difference(old, Outer(inner=Inner(size=1), table={"a": 3})) == "table.a = 1, got 3"
    assert difference(old, Outer(inner=Inner(size=1), table={"b": 1})) == "table = {'a': 1}, got {'b': 1}"
    assert len(difference(old, Outer(inner=Inner(size=1), table={"b": [0] * 999}))) < 80
    assert difference(old, Outer(inner=Inner(size=2), table={"a": 3}), ignore=["inner.size"]) == "table.a = 1, got 3"
    assert difference(old, Outer(inner=Inner(size=2), table={"b": 3}), ignore=["inner", "table"]) is None


def test_compatible_configurations_differ_only_where_they_may():
    old, new = Outer(inner=Inner(size=1), table={"a": 1}), Outer(inner=Inner(size=2), table={"a": 1})
    check_compatible(old, new, "folder 'x' holds a search", may_change=["inner.size"])
    with pytest.raises(ConfigError) as error:
        check_compatible(old, new, "folder 'x' holds a search", may_change=["table"])
    assert str(error.value) == (
        "folder 'x' holds a search with inner.size = 1, got 2; use another folder, or change only: table"
    )


@pytest.mark.parametrize("content", [b"{", b"", b"\xff\xfe"])
def test_damaged_json_names_its_file(content, tmp_path):
    path = tmp_path / "goals.json"
    with pytest.raises(DataError, match=r"goals\.json' cannot be read"):
        read_json(path)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"goals\.json' cannot be read"):
        read_json(path)
    path.write_text('{"a": 1}')
    assert read_json(path) == {"a": 1}


def test_a_torn_line_is_dropped_and_nothing_else(tmp_path):
    path = tmp_path / "folder" / "records.jsonl"
    lines = JsonLines(path)
    assert lines.read() == []
    lines.append({"number": 0})
    lines.append({"number": 1})
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"numb')
    assert JsonLines(path).read() == [{"number": 0}, {"number": 1}] and path.read_bytes() == whole
    lines.append({"number": 2})
    assert [record["number"] for record in JsonLines(path).read()] == [0, 1, 2]
    path.write_bytes(b'{"numb')  # not even one whole line
    drop_torn_line(path)
    assert path.read_bytes() == b"" and JsonLines(path).read() == []


@pytest.mark.parametrize("line", [b"{", b"3", b"\xff", b""])
def test_a_damaged_line_is_named(line, tmp_path):
    path = tmp_path / "records.jsonl"
    JsonLines(path).append({"number": 0})
    edited = path.read_bytes().replace(b'"number": 0', b'"number": 1').strip()
    path.write_bytes(path.read_bytes() + (line or edited) + b"\n")
    with pytest.raises(DataError, match=r"records\.jsonl', line 2 is damaged"):
        JsonLines(path).read()


def test_a_configuration_made_in_python_says_which_keys_are_allowed():
    with pytest.raises(ValueError, match="unknown key 'stepz'; did you mean 'steps'"):
        TrainConfig(environment=EnvironmentConfig(id="SoftGym/FingerReach-v0"), stepz=3)
    with pytest.raises(ValueError, match="unknown key 'gama'; did you mean 'gamma'"):
        TrainConfig(environment={"id": "SoftGym/FingerReach-v0"}, sac={"gama": 0.9})


@pytest.mark.parametrize(
    ("key", "value", "end"), [("steps", 0, "must be greater than 0, got 0"), ("steps", "x", "got 'x'")]
)
def test_the_value_is_named_once(key, value, end):
    data = {"environment": {"id": "SoftGym/FingerReach-v0"}, key: value}
    with pytest.raises(ConfigError) as caught:
        check_config(TrainConfig, data, "here")
    assert str(caught.value).endswith(end) and str(caught.value).count("got") == 1


def test_code_that_changed_is_named_on_both_sides():
    begun = {"commit": "aaa", "versions": {"softgym-envs": "0.1.0", "numpy": "2.1", "torch": "2.4"}}
    assert code_change(begun, begun) == ""
    assert code_change(begun, {"commit": None, "versions": {"softgym-envs": "0.1.0", "numpy": "2.1"}}) == ""  # unknown
    after = {"commit": "bbb", "versions": {"softgym-envs": "0.2.0", "numpy": "2.1"}}
    assert code_change(begun, after) == (
        "begun with commit aaa, softgym-envs 0.1.0; continued with commit bbb, softgym-envs 0.2.0"
    )


def test_commits_with_the_same_sources_are_no_change_of_code():
    begun = {"commit": "aaa", "sources": "1", "versions": {"numpy": "2.1"}}
    assert code_change(begun, {**begun, "commit": "bbb"}) == ""  # documentation or tests
    other = {**begun, "sources": "2"}
    assert code_change(begun, {**other, "commit": "bbb"}) == "begun with commit aaa; continued with commit bbb"
    assert code_change(begun, other) == "begun with sources 1; continued with sources 2"  # of one dirty commit
    assert code_change(begun, {**other, "commit": None}) == "begun with sources 1; continued with sources 2"
    older = {"commit": "bbb", "versions": {"numpy": "2.1"}}  # a record without sources
    assert code_change(older, begun) == "begun with commit bbb; continued with commit aaa"
    assert code_change({**begun, "commit": "bbb"}, {**begun, "versions": {"numpy": "2.2"}}) == (
        "begun with numpy 2.1; continued with numpy 2.2"
    )


def test_the_hash_of_the_sources_follows_code_and_weights_alone(tmp_path, monkeypatch):
    root = tmp_path / "softgym_envs"
    linked = tmp_path / "agents"  # as in a checkout
    (root / "configs").mkdir(parents=True)
    (linked / "results").mkdir(parents=True)
    (root / "agents").symlink_to(linked)
    monkeypatch.setattr(runs, "__file__", str(root / "runs.py"))

    def hashed(path, text):
        path.write_text(text)
        return runs._source_hash.__wrapped__()

    first = hashed(root / "config.py", "a = 1")
    for other in (root / "configs" / "x.json", linked / "results" / "y.json", linked / "notes.md"):
        assert hashed(other, "new") == first
    found = [hashed(root / "config.py", "a = 2"), hashed(linked / "learner.py", ""), hashed(root / "w.safetensors", "")]
    assert len({first, *found}) == 4


def test_continuing_with_other_code_is_recorded_once(tmp_path):
    assert continue_with_code(tmp_path) == ""  # nothing was begun
    path, begun = tmp_path / "provenance.json", provenance()
    write_signed(path, begun)
    assert continue_with_code(tmp_path) == "" and read_signed(path) == begun
    begun["versions"]["softgym-envs"] = "0.0.1"
    write_signed(path, begun)
    texts = {continue_with_code(tmp_path) for _ in range(2)}
    assert texts == {f"begun with softgym-envs 0.0.1; continued with softgym-envs {__version__}"}
    stored = read_signed(path)
    (continued,) = stored.pop("continued")
    assert stored == begun and continued["versions"]["softgym-envs"] == __version__

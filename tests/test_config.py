"""Provenance: the commit of a clone and of a source archive."""

from __future__ import annotations

import subprocess

from softgym_envs.config import commit_of


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


def test_no_commit_where_none_is_known(tmp_path):
    assert commit_of(tmp_path) is None
    (tmp_path / ".git_archival.txt").write_text("node: $Format:%H$\n")  # copied, not exported
    assert commit_of(tmp_path) is None

"""Every verb takes --json and prints one line of JSON."""

from __future__ import annotations

import json

import click
import pytest

from softgym_envs.cli.app import VERBS, cli


def verbs():
    """Names of all verbs, those of groups with the name of the group."""
    for name, command in VERBS.items():
        if isinstance(command, click.Group):
            yield from ((name, inner) for inner in command.commands)
        else:
            yield (name,)


def own(verb):
    command = cli.get_command(click.Context(cli), verb[0])
    for name in verb[1:]:
        command = command.get_command(click.Context(command), name)
    return any("--json" in parameter.opts for parameter in command.params)


@pytest.mark.parametrize("verb", list(verbs()), ids=" ".join)
def test_every_verb_takes_the_flag(softgym, verb):
    status, out, _ = softgym(*verb, "--help", "--json")
    assert status == 0
    if not own(verb):
        assert json.loads(out)["lines"][0].startswith(f"Usage: softgym {' '.join(verb)}")


def test_what_a_verb_returns_and_says(softgym, tmp_path):
    status, out, _ = softgym("rollout", "SoftGym/FingerReach-v0", "--json", "--glb", tmp_path / "a.glb")
    found = json.loads(out)
    assert status == 0 and out.count("\n") == 1
    assert found["verb"] == "rollout" and found["result"]["success"] is True and found["result"]["steps"] == 50
    assert found["lines"][-1] == f"wrote {tmp_path / 'a.glb'}"
    status, out, err = softgym("--json", "configs")
    assert status == 0 and "finger_reach" in json.loads(out)["result"]["codesign"]


def test_errors_stay_one_line(softgym):
    status, out, err = softgym("rollout", "SoftGym/FingersReach-v0", "--json")
    assert status == 2 and out == "" and err.startswith("softgym: error: ")

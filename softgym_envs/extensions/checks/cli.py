"""Verb that examines a robot before work is spent on it."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

import click

from softgym_envs.cli import options

MARKS = {"good": "ok", "note": "note", "fault": "FAULT"}


@click.command()
@click.argument("robot", shell_complete=options.complete_robot)
@options.robot_option
@click.option("--bodies", default=16, show_default=True, help="Corners of the design box to build.")
@click.option("--commands", default=24, show_default=True, help="Random commands to solve for.")
@click.option("--seed", default=0, show_default=True, help="Seed of corners and commands.")
@options.quiet
@options.as_json
def check(
    robot: str, options_: tuple[str, ...], bodies: int, commands: int, seed: int, quiet: bool, as_json: bool
) -> None:
    """Examine a robot, such as your own (my_module:MyRobot), before you train or fit anything.

    Builds its bodies, solves for random commands, compares meshes and efforts, and says what to do about each finding.
    Ends with status 1 if there is a fault.
    """
    from softgym_envs.extensions.checks.checkup import check_robot

    body = options.robot_of(robot, options_)

    def show_progress(subject: str) -> None:
        if not (quiet or as_json):
            click.echo(f"... {subject}", err=True)

    findings = []
    for finding in check_robot(body, bodies=bodies, commands=commands, seed=seed, progress=show_progress):
        findings.append(finding)
        if not as_json:
            click.echo(f"{MARKS[finding.verdict]:5}  {finding.subject}: {finding.text}")
            if finding.remedy:
                click.echo(f"       -> {finding.remedy}")
    if as_json:
        click.echo(json.dumps([asdict(finding) for finding in findings]))
    if any(finding.verdict == "fault" for finding in findings):
        sys.exit(1)

"""Verb for robots: show."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError
from softgym_envs.storage import atomic_write


@click.command()
@click.argument("robot", shell_complete=options.complete_robot)
@options.robot_option
@options.design
@click.option("--picture", type=options.PATH, help="Write a PNG image of the body to this file.")
@options.as_json
def show(robot: str, options_: tuple[str, ...], design: tuple[str, ...], picture: Path | None, as_json: bool) -> None:
    """Show a robot: its design variables, actuators and mesh."""
    from softgym_envs.robots.gmsh_robot import GmshRobot

    if picture is not None and picture.suffix.lower() != ".png":
        raise ConfigError(f"picture '{picture}' must end with .png")
    body = options.robot_of(robot, options_)
    chosen = options.design_of(design)
    model = body.build(chosen)
    mesh = body.body(chosen) if isinstance(body, GmshRobot) else None
    values = body.design_space.complete(chosen)
    if as_json:
        description = {
            "robot": robot,
            "weights_name": body.learning.weights,
            "design_variables": [asdict(each) | {"value": values[each.name]} for each in body.design_space],
            "actuators": [
                asdict(each) | {"max_effort": each.max_effort if math.isfinite(each.max_effort) else None}
                for each in body.actuators
            ],
            "effectors": list(body.effectors),
            "nodes": None if mesh is None else len(mesh.nodes),
            "tetrahedra": None if mesh is None else len(mesh.tetrahedra),
            "equations": model.equations,
            "volume": model.volume,
            "mass": model.mass,
        }
        click.echo(json.dumps(description))
    else:
        click.echo(f"{robot} ({body.learning.weights})\n\ndesign variables:")
        for variable in body.design_space:
            unit = "" if variable.unit == "1" else f" {variable.unit}"
            bounds = f"[{variable.low:g}, {variable.high:g}]{unit}"
            click.echo(f"  {variable.name:16s} {values[variable.name]:<10g} {bounds:24s} {variable.description}")
        click.echo("\nactuators:")
        for actuator in body.actuators:
            (low, high), rate, unit = actuator.command_range, actuator.command_rate, actuator.command_unit
            text = f"  {actuator.name:16s} {low:g} to {high:g} {unit}, at most {rate:g} {unit} per step"
            if actuator.by_effort:
                text += f"; displacements {actuator.low:g} to {actuator.high:g} {actuator.unit}"
            click.echo(text)
        if mesh is not None:
            text = f"mesh: {len(mesh.nodes)} nodes, {len(mesh.tetrahedra)} tetrahedra ({mesh.origin})"
        else:
            text = f"model: {model.equations} equations"
        click.echo(f"\n{text}, volume {1e9 * model.volume:.0f} mm3, mass {1e3 * model.mass:.1f} g")
    if picture is not None:
        from PIL import Image

        from softgym_envs.viewer.image import render_body

        with atomic_write(picture) as stream:
            Image.fromarray(render_body(body, chosen, size=(960, 960))).save(stream, "PNG")
        click.echo(f"wrote {picture}", err=as_json)

"""Verbs for robots: show, export."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError


@click.command()
@click.argument("robot")
@options.robot_option
@options.design
@click.option("--picture", type=options.PATH, help="Write a PNG image of the body to this file.")
def show(robot: str, options_: tuple[str, ...], design: tuple[str, ...], picture: Path | None) -> None:
    """Show a robot: its design variables, actuators and mesh."""
    from softgym_envs.robots.base import MeshedRobot

    body = options.robot_of(robot, options_)
    click.echo(f"{robot} ({body.weights_name})\n\ndesign variables:")
    for variable in body.design_space:
        unit = "" if variable.unit == "1" else f" {variable.unit}"
        bounds = f"[{variable.low:g}, {variable.high:g}]{unit}"
        click.echo(f"  {variable.name:16s} {variable.baseline:<10g} {bounds:24s} {variable.description}")
    click.echo("\nactuators:")
    for actuator in body.actuators:
        click.echo(
            f"  {actuator.name:16s} {actuator.low:g} to {actuator.high:g} {actuator.unit}, "
            f"at most {actuator.rate:g} {actuator.unit} per step"
        )
    chosen = options.design_of(design)
    model = body.build(chosen)
    if isinstance(body, MeshedRobot):
        mesh = body.body(chosen)
        text = f"mesh: {len(mesh.nodes)} nodes, {len(mesh.tetrahedra)} tetrahedra ({mesh.origin})"
    else:
        text = f"model: {model.equations} equations"
    click.echo(f"\n{text}, volume {1e9 * model.volume:.0f} mm3, mass {1e3 * model.mass:.1f} g")
    if picture is not None:
        from PIL import Image

        from softgym_envs.viewer.image import render_body

        Image.fromarray(render_body(body, chosen, size=(960, 960))).save(picture)
        click.echo(f"wrote {picture}")


@click.command()
@click.argument("robot")
@click.argument("files", nargs=-1, type=options.PATH)
@options.robot_option
@options.design
@click.option("--moulds", type=options.PATH, help="Write the parts of a finger's mould to this folder.")
def export(
    robot: str, files: tuple[Path, ...], options_: tuple[str, ...], design: tuple[str, ...], moulds: Path | None
) -> None:
    """Write a body to STEP or STL files, or the moulds to cast it in.

    FILES end with .step or .stl; all lengths are in millimetres.
    """
    from softgym_envs.robots.geometry.export import export_body
    from softgym_envs.robots.geometry.moulds import export_moulds

    if not files and moulds is None:
        raise ConfigError("nothing to write: pass a file ending with .step or .stl, or a folder with --moulds")
    body = options.robot_of(robot, options_)
    chosen = options.design_of(design)
    written = [export_body(body, file, chosen) for file in files]
    if moulds is not None:
        written += export_moulds(body, moulds, chosen)
    for path in written:
        click.echo(f"wrote {path} (millimetres)")

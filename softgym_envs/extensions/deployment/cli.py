"""Verbs of deployment: export, deploy, deploy-policy."""

from __future__ import annotations

from pathlib import Path

import click

from softgym_envs.cli import options
from softgym_envs.errors import ConfigError


@click.command()
@click.argument("robot", shell_complete=options.complete_robot)
@click.argument("files", nargs=-1, type=options.PATH)
@options.robot_option
@options.design
@click.option("--weights", type=options.PATH, help="Folder of the weights (default: the shipped weights).")
@click.option("--members", type=int, help="Number of ensemble members to average (default: all).")
@click.option("--name", default="softgym", show_default=True, help="Prefix of the names that a header defines.")
@click.option("--controller", type=options.PATH, help="Write controller.h and an example main.c to this folder.")
@click.option(
    "--max-effort", type=float, help="Controller: command efforts up to this [N, Pa, ...] instead of displacements."
)
@click.option(
    "--effort-rate",
    type=float,
    help="Controller: largest change of an effort per step (default: 1/40 of --max-effort).",
)
@click.option("--gains", type=float, nargs=2, help="Controller: proportional and integral gain per step.")
def deploy(
    robot: str,
    files: tuple[Path, ...],
    options_: tuple[str, ...],
    design: tuple[str, ...],
    weights: Path | None,
    members: int | None,
    name: str,
    controller: Path | None,
    max_effort: float | None,
    effort_rate: float | None,
    gains: tuple[float, float] | None,
) -> None:
    """Write a surrogate as a C header or an ONNX graph, or a whole controller in C.

    FILES end with .h (a C header of one body) or .onnx (a graph that takes the design as an input).

    --controller FOLDER writes controller.h, with the model, the inverse QP and its PI correction, and main.c, a program
    that steps it. For the sensorized finger, unless it is commanded by efforts, the folder also gets estimator.h, which
    finds the tip from the volumes of the cavities and the touched cell, and loop.c, the closed loop of both.
    """
    from softgym_envs.extensions.deployment.common import FORMATS
    from softgym_envs.extensions.deployment.surrogate_c import export_c
    from softgym_envs.extensions.deployment.surrogate_onnx import export_onnx
    from softgym_envs.surrogate.pretrained import pretrained_model

    if not files and controller is None:
        raise ConfigError("nothing to write: name FILES that end with .h or .onnx, or --controller FOLDER")
    if controller is None and not (max_effort is effort_rate is gains is None):
        raise ConfigError("--max-effort, --effort-rate and --gains need --controller FOLDER")
    if effort_rate is not None and max_effort is None:
        raise ConfigError("--effort-rate needs --max-effort: without it the controller commands displacements")
    for file in files:
        if file.suffix not in FORMATS:
            raise ConfigError(f"'{file}' must end with {' or '.join(FORMATS)}")
    if design and files and controller is None and all(file.suffix == ".onnx" for file in files):
        raise ConfigError("--design applies to C headers (.h) only: an .onnx graph takes the design as an input")
    body = options.robot_of(robot, options_)
    touch = body.learning.touch
    learned = body if touch is None else touch.variant()
    model = pretrained_model(learned, weights)
    chosen = options.design_of(design)
    for file in files:
        if file.suffix == ".h":
            export_c(model, chosen, file, members=members, name=name, robot=body)
        else:
            export_onnx(model, file, members=members)
        click.echo(f"wrote {file}")
    if controller is None:
        return
    from softgym_envs.control.inverse_qp import InverseQP
    from softgym_envs.control.pi_correction import PICorrection
    from softgym_envs.extensions.deployment.controller_c import COMPILE, export_controller_c

    qp = InverseQP.for_robot(body)
    if max_effort is not None:
        qp = InverseQP.by_efforts(body, max_effort, effort_rate or max_effort / 40.0)
    correction = None if gains is None else PICorrection(*gains)
    paths = [
        *export_controller_c(
            model, chosen, controller, controller=qp, correction=correction, members=members, name=name, robot=body
        )
    ]
    commands = [COMPILE]
    if learned is not body and max_effort is None:
        from softgym_envs.extensions.deployment.common import exportable
        from softgym_envs.extensions.deployment.estimator_c import COMPILE_LOOP, export_estimator_c
        from softgym_envs.extensions.sensing import finger_grid
        from softgym_envs.extensions.sensing.learned import LearnedEstimator

        estimator = LearnedEstimator(body, design=chosen, model=exportable(model, members))
        paths += export_estimator_c(estimator, finger_grid(), controller, name=name)
        commands += [COMPILE_LOOP]
    for path in paths:
        click.echo(f"wrote {path}")
    for command in commands:
        click.echo(f"compile with: cd {controller} && {command}")


@click.command("deploy-policy")
@click.argument("policy")
@click.argument("files", nargs=-1, required=True, type=options.PATH)
@click.option("--name", default="softgym_policy", show_default=True, help="Prefix of the names that a header defines.")
def deploy_policy(policy: str, files: tuple[Path, ...], name: str) -> None:
    """Write a policy as a C header or an ONNX graph.

    POLICY is a file or the name of a shipped policy. FILES end with .h or .onnx. Both map sensor values in SI units to
    commands.
    """
    from softgym_envs.extensions.deployment.policy_c import export_policy_c
    from softgym_envs.extensions.deployment.policy_onnx import export_policy_onnx

    for file in files:
        if file.suffix not in (".h", ".onnx"):
            raise ConfigError(f"'{file}' must end with .h or .onnx")
    for file in files:
        if file.suffix == ".h":
            export_policy_c(policy, file, name=name)
        else:
            export_policy_onnx(policy, file)
        click.echo(f"wrote {file}")


@click.command()
@click.argument("robot", shell_complete=options.complete_robot)
@click.argument("files", nargs=-1, type=options.PATH)
@options.robot_option
@options.design
@click.option("--moulds", type=options.PATH, help="Write the parts of the body's mould to this folder.")
@click.option("--joints", default=9, show_default=True, help="Joints of the chain in an .xml file.")
def export(
    robot: str,
    files: tuple[Path, ...],
    options_: tuple[str, ...],
    design: tuple[str, ...],
    moulds: Path | None,
    joints: int,
) -> None:
    """Write a body to STEP, STL, glTF or MuJoCo files, or the moulds to cast it in.

    FILES end with .step or .stl, in millimetres, or, in metres, with .glb for Blender and browsers or .xml: a chain of
    rigid links for MuJoCo.
    """
    from softgym_envs.extensions.deployment.cad import export_body
    from softgym_envs.extensions.deployment.mjcf import export_mjcf
    from softgym_envs.extensions.deployment.moulds import export_moulds
    from softgym_envs.extensions.recordings.gltf import write_glb

    if not files and moulds is None:
        raise ConfigError("nothing to write: pass a file ending with .step, .stl, .glb or .xml, or --moulds FOLDER")
    body = options.robot_of(robot, options_)
    chosen = options.design_of(design)
    for file in files:
        if file.suffix == ".xml":
            click.echo(f"wrote {export_mjcf(body, file, chosen, joints=joints)} (metres)")
        elif file.suffix == ".glb":
            click.echo(f"wrote {write_glb(body, file, chosen)} (metres)")
        else:
            click.echo(f"wrote {export_body(body, file, chosen)} (millimetres)")
    for path in export_moulds(body, moulds, chosen) if moulds is not None else ():
        click.echo(f"wrote {path} (millimetres)")

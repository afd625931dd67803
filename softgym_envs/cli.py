"""The command line: ``softgym <verb>``. Every verb calls a Python function of the same meaning."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from softgym_envs.errors import ConfigError, SoftGymError
from softgym_envs.version import __version__

if TYPE_CHECKING:
    from softgym_envs.robots.base import Robot

__all__ = ["main"]


def _fail(message: str) -> NoReturn:
    click.echo(f"softgym: error: {' '.join(str(message).split())}", err=True)
    sys.exit(2)


class _Resumable(click.Abort):
    """A verb was stopped that goes on where it was when it is called again."""


@contextmanager
def _resumable() -> Iterator[None]:
    """Around work that loses nothing when it is stopped by Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        raise _Resumable from None


def main() -> None:
    """Entry point: errors of the user's input end with one line and status 2."""
    import gymnasium
    from threadpoolctl import threadpool_limits

    # One thread per process; more only slow these small problems down. The variables reach libraries loaded later and
    # worker processes, the limit those that are here already.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    threadpool_limits(1)
    try:
        cli(standalone_mode=False)
    except click.exceptions.Exit as leave:
        sys.exit(leave.exit_code)
    except (click.Abort, KeyboardInterrupt) as stop:
        more = "; the same command goes on where it was" if isinstance(stop, _Resumable) else ""
        click.echo(f"stopped{more}", err=True)
        sys.exit(130)
    except click.ClickException as error:
        _fail(error.format_message())
    except (SoftGymError, ValueError, OSError, gymnasium.error.Error) as error:
        _fail(str(error))


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="softgym")
def cli() -> None:
    """Soft robots whose body and controller are optimised together."""


def _assignments(pairs: tuple[str, ...], what: str) -> dict[str, float]:
    """Read ``name=number`` options."""
    values = {}
    for pair in pairs:
        name, separator, text = pair.partition("=")
        try:
            if not separator:
                raise ValueError
            values[name] = float(text)
        except ValueError:
            raise ConfigError(f"--{what} '{pair}' must look like name=number") from None
    return values


_config = click.option("--config", "config", type=click.Path(path_type=Path), required=True, help="YAML file.")
_folder = click.option("--folder", type=click.Path(path_type=Path), required=True, help="Where results go.")
_overrides = click.argument("overrides", nargs=-1)
_quiet = click.option("--quiet", is_flag=True, help="No progress bars.")


@cli.command("list")
def list_() -> None:
    """List environments, robots, backends and tasks."""
    from softgym_envs.backends import BACKENDS
    from softgym_envs.envs.registration import ENVIRONMENTS
    from softgym_envs.envs.tasks.registry import TASKS
    from softgym_envs.robots import ROBOTS

    click.echo("environments:")
    for identifier, row in ENVIRONMENTS.items():
        click.echo(f"  {identifier:28s} robot {row.robot}, task {row.task}, {row.max_episode_steps} steps")
    for title, table in (("robots", ROBOTS), ("backends", BACKENDS), ("tasks", TASKS)):
        click.echo(f"{title}: {', '.join(table)}")


def _robot(name: str, options: tuple[str, ...]) -> Robot:
    """Make a robot from ``name=value`` options."""
    from softgym_envs.config import read_value
    from softgym_envs.robots import make_robot

    parsed = {}
    for option in options:
        key, separator, text = option.partition("=")
        if not separator:
            raise ConfigError(f"--option '{option}' must look like name=value")
        parsed[key] = read_value(text)
    return make_robot(name, **parsed)


@cli.command()
@click.argument("robot")
@click.option("--option", "options", multiple=True, help="Robot option, name=value (repeat).")
@click.option("--design", "design", multiple=True, help="Design variable, name=value in SI (repeat).")
@click.option("--picture", type=click.Path(path_type=Path), help="Write a PNG of the body.")
def show(robot: str, options: tuple[str, ...], design: tuple[str, ...], picture: Path | None) -> None:
    """Show a robot: its design space, actuators and mesh."""
    from softgym_envs.robots.base import MeshedRobot

    body = _robot(robot, options)
    click.echo(f"{robot} ({body.weights_name})\n\ndesign variables:")
    for variable in body.design_space.variables.values():
        unit = "" if variable.unit == "1" else f" {variable.unit}"
        bounds = f"[{variable.low:g}, {variable.high:g}]{unit}"
        click.echo(f"  {variable.name:16s} {variable.baseline:<10g} {bounds:24s} {variable.description}")
    click.echo("\nactuators:")
    for actuator in body.actuators:
        click.echo(
            f"  {actuator.name:16s} {actuator.low:g} to {actuator.high:g} {actuator.unit}, "
            f"at most {actuator.rate:g} {actuator.unit} a step"
        )
    chosen = _assignments(design, "design")
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


@cli.command()
@click.argument("robot")
@click.argument("files", nargs=-1, type=click.Path(path_type=Path))
@click.option("--option", "options", multiple=True, help="Robot option, name=value (repeat).")
@click.option("--design", "design", multiple=True, help="Design variable, name=value in SI (repeat).")
@click.option("--moulds", type=click.Path(path_type=Path), help="Write the parts of a finger's mould to this folder.")
def export(
    robot: str, files: tuple[Path, ...], options: tuple[str, ...], design: tuple[str, ...], moulds: Path | None
) -> None:
    """Write a body to FILES ending with .step or .stl (in millimetres), or the moulds it is cast in."""
    from softgym_envs.robots.geometry.export import export_body
    from softgym_envs.robots.geometry.moulds import export_moulds

    if not files and moulds is None:
        raise ConfigError("nothing to write: name a file ending with .step or .stl, or a folder with --moulds")
    body = _robot(robot, options)
    chosen = _assignments(design, "design")
    written = [export_body(body, file, chosen) for file in files]
    if moulds is not None:
        written += export_moulds(body, moulds, chosen)
    for path in written:
        click.echo(f"wrote {path} (millimetres)")


@cli.command()
@click.argument("robot")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--option", "options", multiple=True, help="Robot option, name=value (repeat).")
@click.option("--design", "design", multiple=True, help="Design variable of a header, name=value in SI (repeat).")
@click.option("--weights", type=click.Path(path_type=Path), help="Folder of weights (default: those that ship).")
@click.option("--members", type=int, help="Members of the ensemble that are averaged (default: all).")
@click.option("--name", default="softgym", show_default=True, help="Prefix of what a header defines.")
def deploy(
    robot: str,
    files: tuple[Path, ...],
    options: tuple[str, ...],
    design: tuple[str, ...],
    weights: Path | None,
    members: int | None,
    name: str,
) -> None:
    """Write a learned model to FILES: .h, one body as a C header, or .onnx, a graph that takes the design."""
    from softgym_envs.surrogate.export import FORMATS, export_c, export_onnx
    from softgym_envs.surrogate.pretrained import pretrained_model

    for file in files:
        if file.suffix not in FORMATS:
            raise ConfigError(f"'{file}' must end with {' or '.join(FORMATS)}")
    if design and all(file.suffix == ".onnx" for file in files):
        raise ConfigError("--design is for a header (.h); an .onnx graph takes the design as an input")
    model = pretrained_model(_robot(robot, options), weights)
    chosen = _assignments(design, "design")
    for file in files:
        if file.suffix == ".h":
            export_c(model, chosen, file, members=members, name=name)
        else:
            export_onnx(model, file, members=members)
        click.echo(f"wrote {file}")


@cli.command("deploy-policy")
@click.argument("policy")
@click.argument("file", type=click.Path(path_type=Path))
def deploy_policy(policy: str, file: Path) -> None:
    """Write POLICY, a file or the name of a shipped one, to FILE (.onnx): sensor values in SI in, commands out."""
    from agents.export import export_policy_onnx

    click.echo(f"wrote {export_policy_onnx(policy, file)}")


@cli.command()
@click.argument("environment")
@click.option("--agent", default="qp", show_default=True, help="qp, qp_static, qp_model, qp_pi, random or a policy.")
@click.option("--backend", help="surrogate or fem; default that of the environment.")
@click.option("--design", "design", multiple=True, help="Design variable, name=value in SI (repeat).")
@click.option("--seed", default=0, show_default=True)
@click.option("--record", type=click.Path(path_type=Path), help="Write a rerun recording (.rrd).")
def rollout(
    environment: str, agent: str, backend: str | None, design: tuple[str, ...], seed: int, record: Path | None
) -> None:
    """Run one episode and print what happened."""
    import softgym_envs  # noqa: F401 - registers the IDs
    from agents.config import EnvironmentConfig
    from agents.evaluation import AGENTS, make_agent
    from agents.policy import Policy
    from softgym_envs.config import check_config

    act = make_agent(agent, seed)
    chosen = _assignments(design, "design")
    # A policy sees and does what it was trained to see and do.
    policy = None if agent in AGENTS else Policy(agent)
    trained = {} if policy is None else policy.environment.model_dump()
    config = check_config(EnvironmentConfig, {**trained, "id": environment}, "rollout")
    if policy is not None:
        policy.check_environment(config)
    if backend is not None:
        config = config.on(backend)
    env = config.make(**({"design": chosen} if chosen else {}))
    if record is not None:
        from softgym_envs.viewer.recording import record_rollout

        summary = record_rollout(env, act, record, seed=seed)
        click.echo(json.dumps(summary, indent=2))
        click.echo(f"wrote {record}; look at it with 'softgym view {record}'")
        return
    observation, info = env.reset(seed=seed)
    total, step, ended = 0.0, 0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act(observation, env.unwrapped))
        total, step, ended = total + float(reward), step + 1, terminated or truncated
    click.echo(f"{environment} on {config.backend}, agent {agent}: {step} steps, return {total:.2f}")
    click.echo(f"final distance {1e3 * info['distance']:.3f} mm, success {info['is_success']}")
    env.close()


@cli.command()
@click.argument("recording", type=click.Path(path_type=Path))
def view(recording: Path) -> None:
    """Open a rerun recording in the viewer."""
    import subprocess

    if not recording.is_file():
        raise ConfigError(f"recording '{recording}' does not exist; make one with 'softgym rollout ... --record'")
    sys.exit(subprocess.call([sys.executable, "-m", "rerun", str(recording)]))


@cli.command()
@_config
@_folder
@_quiet
@_overrides
def dataset(config: Path, folder: Path, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Generate the datasets of a surrogate (train, validation, test), or finish interrupted ones."""
    from softgym_envs.config import load_config
    from softgym_envs.surrogate.training import FitConfig, generate

    with _resumable():
        data = generate(load_config(config, FitConfig, overrides), folder, progress=not quiet)
    for split, columns in data.items():
        click.echo(f"{split}: {len(columns['rest'])} states of {int(columns['rest'].sum())} designs")


@cli.command()
@_config
@_folder
@click.option("--data", type=click.Path(path_type=Path), help="Folder of the datasets (default: FOLDER/data).")
@_quiet
@_overrides
def fit(config: Path, folder: Path, data: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Make a surrogate: data, training, test; resumes what is there."""
    from softgym_envs.config import load_config
    from softgym_envs.surrogate.training import FitConfig
    from softgym_envs.surrogate.training import fit as run

    with _resumable():
        errors = run(load_config(config, FitConfig, overrides), folder, data or folder / "data", progress=not quiet)
    click.echo(json.dumps(errors, indent=2))


@cli.command()
@_config
@_folder
@click.option("--initial", type=click.Path(path_type=Path), help="Policy to start from.")
@_quiet
@_overrides
def train(config: Path, folder: Path, initial: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Train a SAC policy; resumes from its checkpoint."""
    from agents.config import TrainConfig
    from agents.training import train as run
    from softgym_envs.config import load_config

    with _resumable():
        path = run(load_config(config, TrainConfig, overrides), folder, initial=initial, progress=not quiet)
    click.echo(f"wrote {path}")


@cli.command()
@_config
@click.option(
    "--agent",
    "agents",
    multiple=True,
    default=("qp", "random"),
    show_default=True,
    help="qp, qp_static, qp_model, qp_pi, random or a policy (repeat).",
)
@click.option("--backend", "backends", multiple=True, help="Default that of the environment; repeat for several.")
@click.option("--design", "design", multiple=True, help="Design variable, name=value in SI (repeat).")
@click.option("--goals", default=200, show_default=True, help="Number of unseen goals.")
@click.option("--seed", default=2_000_003, show_default=True, help="Seed of the goals.")
@click.option("--output", type=click.Path(path_type=Path), help="Write everything as JSON.")
@_overrides
def evaluate(
    config: Path,
    agents: tuple[str, ...],
    backends: tuple[str, ...],
    design: tuple[str, ...],
    goals: int,
    seed: int,
    output: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Evaluate agents on the same unseen goals; CONFIG is the one they were trained with."""
    from agents.config import TrainConfig
    from agents.evaluation import AGENTS, sample_goals
    from agents.evaluation import evaluate as run
    from agents.policy import Policy
    from softgym_envs.config import load_config, provenance
    from softgym_envs.storage import write_json

    environment = load_config(config, TrainConfig, overrides).environment
    chosen = _assignments(design, "design") or None
    if goals < 1:
        raise ConfigError(f"--goals {goals} must be at least 1")
    for agent in agents:  # before time is spent on the others
        if agent not in AGENTS:
            Policy(agent).check_environment(environment)
    points = sample_goals(environment.model_copy(update={"sample_design": False}), goals, seed, chosen)
    results: list[dict[str, Any]] = []
    click.echo(f"{'agent':34s} {'backend':10s} {'success':>8s} {'mean mm':>9s} {'worst mm':>9s} {'return':>8s}")
    for backend in backends or (environment.backend,):
        for agent in agents:
            outcome = run(agent, environment.on(backend), points, design=chosen, seed=seed)
            results.append({"agent": agent, "backend": backend, **outcome.to_json()})
            click.echo(
                f"{agent[-34:]:34s} {backend:10s} {outcome.success_rate:8.1%} {1e3 * outcome.mean_distance:9.3f} "
                f"{1e3 * outcome.worst_distance:9.3f} {outcome.mean_return:8.2f}"
            )
    if output is not None:
        asked = {"environment": environment.model_dump(mode="json"), "goals": goals, "seed": seed, "design": chosen}
        write_json(output, {**asked, **provenance(), "results": results})
        click.echo(f"wrote {output}")


@cli.command()
@click.option("--folder", type=click.Path(path_type=Path), help="Stored runs (default: those that ship).")
@click.option("--output", type=click.Path(path_type=Path), help="Write the table here (.md) instead of showing it.")
@click.option("--curves", type=click.Path(path_type=Path), help="Draw the learning curves here (.png, .svg, .pdf).")
def results(folder: Path | None, output: Path | None, curves: Path | None) -> None:
    """Make the table of agents, and their learning curves, from stored runs; see python -m agents.sweep."""
    from agents.results import RESULTS, draw_curves, load_runs, table
    from softgym_envs.storage import atomic_write

    runs = load_runs(folder or RESULTS)
    text = table(runs)
    if output is None:
        click.echo(text)
    else:
        with atomic_write(output, "w") as stream:
            stream.write(text)
        click.echo(f"wrote {output}")
    if curves is not None:
        click.echo(f"wrote {draw_curves(runs, curves)}")


@cli.command()
@_config
@click.option("--folder", type=click.Path(path_type=Path), help="Where results go (default: results/<name>).")
@click.option("--workers", type=int, help="Worker processes (default: the config's).")
@click.option("--storage", help="PostgreSQL database that machines share (default: the config's, or the folder).")
@_quiet
@_overrides
def codesign(
    config: Path,
    folder: Path | None,
    workers: int | None,
    storage: str | None,
    quiet: bool,
    overrides: tuple[str, ...],
) -> None:
    """Optimise body and controller together; resumes, and ends with a report."""
    from codesign.config import StudyConfig
    from codesign.report.page import write_report
    from codesign.study import run_study
    from softgym_envs.config import load_config

    study = load_config(config, StudyConfig, (*overrides, *([f"storage={storage}"] if storage else [])))
    folder = Path("results") / study.name if folder is None else folder
    with _resumable():
        run_study(study, folder, workers=workers, progress=not quiet)
        report = write_report(folder)
    click.echo(f"report: {report}")


_results = click.option("--folder", type=click.Path(path_type=Path), help="Where results go (default: results/<name>).")


@cli.command()
@_config
@_results
@_quiet
@_overrides
def sensitivity(config: Path, folder: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Show which design variables matter: one at a time, Morris or Sobol; resumes."""
    from codesign.tools.config import SensitivityConfig
    from codesign.tools.sensitivity import analyse
    from softgym_envs.config import load_config

    study = load_config(config, SensitivityConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    with _resumable():
        result = analyse(study, folder, progress=not quiet)
    for metric, table in result["indices"].items():
        keys = list(next(iter(table.values())))
        click.echo(f"\n{metric:24s} " + " ".join(f"{key:>16s}" for key in keys))
        for variable, row in table.items():
            click.echo(f"  {variable:22s} " + " ".join(f"{row[key]:16.5g}" for key in keys))
    kept = f" ({100 * result['groups_kept']:.0f} % of the groups of samples are left)" if result["infeasible"] else ""
    click.echo(f"\n{result['designs']} designs, {result['infeasible']} infeasible{kept}; wrote {folder}")


@cli.command()
@_config
@_results
@_quiet
@_overrides
def optimise(config: Path, folder: Path | None, quiet: bool, overrides: tuple[str, ...]) -> None:
    """Search the best bodies without a controller, by Optuna (resumes) or along gradients."""
    from codesign.tools import gradient
    from codesign.tools.config import OptimiseConfig
    from codesign.tools.search import search
    from softgym_envs.config import load_config

    study = load_config(config, OptimiseConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    if study.solver.method == "gradient":
        result = gradient.optimise(study, folder)
        click.echo(json.dumps(result["best"], indent=2))
        click.echo(f"{len(result['descents'])} descents, {result['seconds']:.2f} s; wrote {folder}")
        return
    with _resumable():
        found = search(study, folder, progress=not quiet)
    ends = found.front[:1] if len(study.objectives) == 1 else [found.front[0], found.front[-1]]
    for row in ends:
        click.echo(json.dumps(asdict(row)))
    click.echo(
        f"{len(found.front)} designs on the front of {found.feasible} feasible and {found.infeasible} infeasible "
        f"ones; wrote {folder}"
    )


@cli.command()
@_config
@_results
@_overrides
def calibrate(config: Path, folder: Path | None, overrides: tuple[str, ...]) -> None:
    """Fit design variables to measured states in a CSV or JSON file."""
    from codesign.tools.calibration import calibrate as run
    from codesign.tools.config import CalibrationConfig
    from softgym_envs.config import load_config

    study = load_config(config, CalibrationConfig, overrides)
    folder = Path("results") / study.name if folder is None else folder
    result = run(study, folder)
    for name in study.fit:
        value, ends = result["design"][name], (result["interval"] or {}).get(name)
        text = f"{name} = {value:.6g}"
        if ends is not None and ends[1] > ends[0]:
            # As many digits as tell the ends apart.
            digits = max(6, 2 - math.floor(math.log10((ends[1] - ends[0]) / (abs(value) or 1.0))))
            text += f", {100 * result['level']:g} % interval {ends[0]:.{digits}g} to {ends[1]:.{digits}g}"
        elif ends is not None:
            text += ", no interval: the model fits the data exactly"
        if name in result["at_bound"]:
            text += "; at its bound: the data ask for more than the bounds allow"
        click.echo(text)
    errors = ", ".join(f"{name} {value:.3g}" for name, value in result["errors"].items())
    click.echo(f"root mean square errors: {errors} [SI]; {result['seconds']:.1f} s; wrote {folder}")


@cli.command()
@click.option("--output", type=click.Path(path_type=Path), default=Path("results/bench.json"), show_default=True)
@click.argument("names", nargs=-1)
def bench(output: Path, names: tuple[str, ...]) -> None:
    """Measure speed and accuracy (all benchmarks, or those named); needs a source checkout."""
    try:
        from benchmarks.run import run
    except ImportError:
        raise ConfigError("benchmarks ship with the source checkout only; run this in its root") from None
    run(names, output)


if __name__ == "__main__":
    main()

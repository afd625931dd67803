"""Why meshes are moved: one entry of W along a design line, on moved and on new meshes.

``python -m benchmarks.morphing PICTURE.png`` draws the curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

MESHINGS = ("remesh", "morph")
POINTS = 81
COMMAND = 0.010  # of all cables [m]


@dataclass(frozen=True)
class Line:
    """A design variable from its lower to its upper bound, the others at the baseline, and the entry to look at."""

    robot: str
    variable: str
    axis: int

    @property
    def label(self) -> str:
        """Name of the line."""
        return f"{self.robot}, {self.variable.replace('_', ' ')}"


LINES = (Line("finger", "length", 1), Line("diamond", "elbow_radius", 2))


def follow(line: Line, meshing: str, points: int = POINTS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values of the variable, W between the effector and the first cable, and the numbers of nodes."""
    from softgym_envs.mechanics.solvers.statics import Statics
    from softgym_envs.robots.registry import make_robot

    robot = make_robot(line.robot, meshing=meshing)
    variable = robot.design_space[line.variable]
    values = np.linspace(variable.low, variable.high, points)
    entries, nodes = [], []
    for value in values:
        model = robot.build({line.variable: float(value)})
        state = Statics(model).solve(np.full(len(robot.actuators), COMMAND))
        entries.append(state.condensed.W.ea[line.axis, 0])
        nodes.append(len(model.nodes))
    return values, np.array(entries), np.array(nodes)


def morphing() -> dict[str, object]:
    """Roughness of W_ea along design lines, all cables pulled by 10 mm: moved meshes against new ones."""
    return _numbers({(line, meshing): follow(line, meshing) for line in LINES for meshing in MESHINGS})


Curves = dict[tuple[Line, str], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _numbers(curves: Curves) -> dict[str, object]:
    """Measures of the curves, relative to the range of the one on moved meshes.

    The roughness is the root mean square of the second differences; the jump is the largest step between neighbours.
    """
    result: dict[str, object] = {}
    for (line, meshing), (_, entries, nodes) in curves.items():
        label = f"{line.label}, {meshing}, {len(nodes)} designs"
        whole = np.ptp(curves[line, "morph"][1])
        result[f"{label}: roughness [%]"] = 100.0 * float(np.sqrt(np.mean(np.diff(entries, 2) ** 2)) / whole)
        result[f"{label}: largest jump [%]"] = 100.0 * float(np.abs(np.diff(entries)).max() / whole)
        steps = np.diff(entries) * np.sign(curves[line, "morph"][1][-1] - curves[line, "morph"][1][0])
        result[f"{label}: steps against the trend"] = int((steps < 0.0).sum())
        result[f"{label}: nodes"] = f"{nodes.min()} to {nodes.max()}, {len(set(nodes.tolist()))} different"
    return result


def draw(curves: Curves, path: Path, lines: Sequence[Line] = LINES) -> None:
    """Draw the curves, and the numbers of nodes below them."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from softgym_envs.robots.registry import make_robot

    styles = {
        "remesh": {
            "color": "#c44e52",
            "linewidth": 0.9,
            "marker": ".",
            "markersize": 4,
            "label": "new mesh per design",
        },
        "morph": {"color": "#1f4e79", "linewidth": 1.8, "label": "reference mesh moved (default)"},
    }
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(10.0, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(2, len(lines), sharex="col", height_ratios=(3, 1), squeeze=False)
        for (top, bottom), line in zip(grid.T, lines, strict=True):
            robot = make_robot(line.robot)
            for meshing, style in styles.items():
                values, entries, nodes = curves[line, meshing]
                top.plot(1e3 * values, 1e3 * entries, **style)
                bottom.plot(1e3 * values, nodes, **style)
            top.set_title(f"{line.robot}: all cables pulled by {1e3 * COMMAND:g} mm")
            effector, cable = robot.effectors[0], robot.actuators[0].name
            top.set_ylabel(f"W: {effector} {'xyz'[line.axis]}, {cable} [mm/N]")
            bottom.set_ylabel("nodes")
            bottom.set_xlabel(f"{line.variable.replace('_', ' ')} [mm]")
        grid[0, 0].legend(frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


@click.command()
@click.argument("picture", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--points", default=POINTS, show_default=True, help="Designs along each line.")
def main(picture: Path, points: int) -> None:
    """Draw W along design lines to PICTURE (PNG), and print its measures."""
    curves = {(line, meshing): follow(line, meshing, points) for line in LINES for meshing in MESHINGS}
    for key, value in _numbers(curves).items():
        click.echo(f"{key:68s} {value:.4g}" if isinstance(value, float) else f"{key:68s} {value}")
    draw(curves, picture)
    click.echo(f"wrote {picture}")


if __name__ == "__main__":
    main()

"""Tables and picture of the page on convergence, from the recorded results of `benchmarks.convergence`."""

from __future__ import annotations

import numpy as np

from benchmarks.convergence import STUDIES
from benchmarks.recorded import records, results
from benchmarks.tables import markdown
from softgym_envs.robots.registry import make_robot
from softgym_envs.surrogate.correction import fit_correction
from softgym_envs.surrogate.features import Features

TITLES = {
    "finger": "Soft Finger, 2 cables",
    "finger_sideways": "Soft Finger, unequal cables",
    "finger_1cable": "Soft Finger, 1 cable",
    "diamond": "Diamond",
    "cable_trunk": "cable trunk",
    "two_finger_gripper": "gripper, two fingers",
    "two_finger_gripper_taut": "gripper, two fingers, taut cables",
    "three_finger_gripper": "gripper, three fingers",
    "contact_aided_finger": "contact-aided finger",
    "trunk": "Stiff-Flop trunk",
    "tetrapod": "Tetrapod",
}
"""Readable names of the studies."""


def studied() -> list[str]:
    """Return the studies that have recorded results."""
    return [name for name in STUDIES if f"convergence_{name}" in records()]


def percent(share: float) -> str:
    """Write a share with two significant digits, or as a whole number of percent."""
    return f"{100.0 * share:.2g}%" if abs(share) < 0.1 else f"{share:.0%}"


def convergence() -> str:
    """Errors of each robot on each mesh, against the converged value: baseline, and the worst of all bodies."""
    rows = []
    for name in studied():
        found = results(f"convergence_{name}")
        baseline = [row for row in found["rows"] if row["body"] == "baseline"]
        for k, row in enumerate(baseline):
            errors = found["errors"]
            cells = []
            for quantity in ("tip", "effort"):
                all_bodies = [
                    body["meshes"][row["mesh"]][quantity]
                    for body in errors.values()
                    if np.isfinite(body["meshes"][row["mesh"]][quantity])
                ]
                own = errors.get("baseline", {}).get("meshes", {}).get(row["mesh"], {}).get(quantity, np.nan)
                worst = max(all_bodies, key=abs, default=np.nan)
                cells += [percent(own), f"{percent(worst)} of {len(all_bodies)}"]
            title = "" if k else TITLES[name]
            rows.append([title, row["mesh"], f"{row['unknowns']:,}", *cells, f"{row['seconds']:.2g}"])
    head = ["robot", "mesh", "unknowns", "tip", "worst body", "effort", "worst body", "CPU [s]"]
    return markdown(head, rows, "llrrrrrr")


def convergence_limits() -> str:
    """Converged values of each robot's baseline with the observed orders, and the bodies that failed."""
    rows = []
    for name in studied():
        found = results(f"convergence_{name}")
        failed = [row for row in found["rows"] if row["failure"]]
        body = found["errors"].get("baseline")
        if body is None:
            continue
        tip = ", ".join(f"{x:.2f}" for x in body["tip [mm]"])
        orders = [f"{body[f'{quantity}, order']:.1f}" for quantity in ("tip", "effort")]
        rows.append([TITLES[name], f"({tip})", orders[0], f"{body['effort']:.4g}", orders[1], str(len(failed))])
    head = ["robot", "tip, converged [mm]", "order", "effort, converged", "order", "failures"]
    return markdown(head, rows, "llrrrr")


def convergence_corrections() -> str:
    """Tension of the finger on the mesh `accurate`, before and after a correction by the other bodies."""
    found = results("convergence_finger")
    robot = make_robot("finger", mesh="accurate")
    bodies = list(found["errors"])
    designs = np.array([robot.design_space.complete(found["designs"][body]).array for body in bodies])
    features = Features(robot).design(designs)
    efforts = {(row["mesh"], row["body"]): row["effort"] for row in found["rows"]}

    def level(mesh: str, chosen: np.ndarray) -> dict[str, np.ndarray]:
        return {
            "design": designs[chosen],
            "displacement": np.full((len(chosen), 1), found["command"][0]),
            "effort": np.array([[efforts[mesh, bodies[k]]] for k in chosen]),
            "rest": np.zeros(len(chosen), dtype=bool),
        }

    rows = []
    for k, body in enumerate(bodies):
        others = np.delete(np.arange(len(bodies)), k)
        levels = [level(mesh, others) for mesh in ("coarser", "accurate", "finer")]
        correction = fit_correction(levels, found["sizes"], features[others])
        before = found["errors"][body]["meshes"]["accurate"]["effort"]
        after = (1.0 + before) * float(correction.factor(features[k : k + 1])[0, 0]) - 1.0
        design = found["designs"][body]
        rows.append(
            [
                body,
                f"{1e3 * design['joint_height']:.1f} mm",
                f"{design['poisson_ratio']:.2f}",
                percent(before),
                percent(after),
            ]
        )
    head = ["body", "hinge", "Poisson's ratio", "accurate", "accurate, corrected"]
    return markdown(head, rows, "lrrrr")


def convergence_guides() -> str:
    """Compliance of a cable against the mesh, for single points and averaged guides."""
    found = results("convergence_guides")
    rows = [
        [f"cube, guide of {radius}", *(f"{1e3 * value:.4f}" for value in values), ""]
        for radius, values in found["cube [m/N]"].items()
    ]
    table = markdown(
        ["W_aa [mm/N]", *(f"{cells} cells" for cells in found["cube, cells"])], [row[:-1] for row in rows], "lrrrr"
    )
    finger = [
        [f"finger, guides of {radius}", *(f"{1e3 * value:.3f}" for value in values)]
        for radius, values in found["finger [m/N]"].items()
    ]
    head = ["W_aa [mm/N]", *(f"{count:,} unknowns" for count in found["finger, unknowns"])]
    return f"{table}\n\n{markdown(head, finger, 'lrrr')}"


def convergence_fillets() -> str:
    """Tension and tip of the finger against the radius of its re-entrant edges."""
    rows = [
        [row["body"], f"{row['effort']:.2f}", f"{row['tip'][1]:.2f}, {row['tip'][2]:.2f}", f"{row['unknowns']:,}"]
        for row in results("convergence_fillets")["rows"]
    ]
    return markdown(["radius", "tension of each cable [N]", "tip y, z [mm]", "unknowns"], rows, "rrrr")


def convergence_scatter() -> str:
    """Deviations of the finger's tension and tip from a smooth function of the segments' length."""
    found = results("convergence_scatter")
    rows = [
        [
            title,
            *(
                percent(found[f"{meshing}: {name}, {kind} deviation"])
                for name in ("tension", "tip")
                for kind in ("standard", "largest")
            ),
        ]
        for meshing, title in (("morph", "mesh moved"), ("remesh", "new mesh for each design"))
    ]
    head = ["meshing", "tension, standard", "tension, largest", "tip, standard", "tip, largest"]
    return markdown(head, rows, "lrrrr")


def finger_costs() -> str:
    """Speed and errors of the accurate finger against the size of its elements."""
    rows = []
    for row in results("convergence_finger_costs")["rows"]:
        cells = []
        for quantity in ("tip", "effort"):
            own, *others = row[quantity]
            cells += [percent(own), percent(float(np.median(others))), percent(max(others, key=abs))]
        rows.append([row["elements"], f"{row['unknowns']:,}", f"{row['steps per CPU second']:.1f}", *cells])
    head = ["elements", "unknowns", "control steps per CPU second"]
    head += [f"{quantity}, {of}" for quantity in ("tip", "tension") for of in ("baseline", "median body", "worst")]
    return markdown(head, rows, "lrrrrrrrr")


def point_meshes() -> str:
    """What small elements at guides and contact points change on the mesh `accurate`, by the guide radius."""
    rows = []
    for row in results("point_meshes")["rows"]:
        before, tip = (", ".join(f"{x + 0.0:.2f}" for x in np.round(row[k], 2)) for k in ("tip before", "tip"))
        cells = [f"{row['effort']:.2f}", percent(row["effort changed"])]
        moved = percent(row["tip moved"])
        if row["failure"]:
            tip, moved, cells = "no equilibrium", "", ["", ""]
        names = [TITLES[row["study"]], f"{1e3 * row['radius [m]']:g} mm"]
        rows.append([*names, before, f"{row['effort before']:.2f}", tip, moved, *cells])
    head = ["robot", "radius", "tip [mm]", "effort [N]", "tip, small elements", "moved", "effort", "changed"]
    return markdown(head, rows, "lrrrrrrr")


CONVERGENCE_TABLES = {
    "convergence": convergence,
    "finger_costs": finger_costs,
    "point_meshes": point_meshes,
    "convergence_limits": convergence_limits,
    "convergence_corrections": convergence_corrections,
    "convergence_guides": convergence_guides,
    "convergence_fillets": convergence_fillets,
    "convergence_scatter": convergence_scatter,
}
"""Tables of the page by name."""


def draw() -> np.ndarray:
    """Return a picture (h, w, 3) of the errors of tip and effort over the number of unknowns, a panel per robot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    names = studied()
    columns = min(len(names), 4)
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.8 * lines), layout="constrained", dpi=110)
    canvas = FigureCanvasAgg(figure)
    for place, name in enumerate(names):
        axes = figure.add_subplot(lines, columns, place + 1)
        found = results(f"convergence_{name}")
        for body, errors in found["errors"].items():
            rows = [row for row in found["rows"] if row["body"] == body]
            strong = body == "baseline"
            for quantity, colour in (("tip", "tab:blue"), ("effort", "tab:red")):
                values = [100.0 * abs(errors["meshes"][row["mesh"]][quantity]) for row in rows]
                unknowns = [row["unknowns"] for row in rows]
                # The published mesh of solids has other elements than the levels: no line leads to it.
                first = 1 if len(rows) > 3 else 0
                style = {"color": colour, "alpha": 1.0 if strong else 0.5, "markersize": 4 if strong else 2}
                width = 1.8 if strong else 0.6
                label = quantity if strong else None
                axes.loglog(unknowns[first:], values[first:], marker="o", linewidth=width, label=label, **style)
                axes.loglog(unknowns[:first], values[:first], marker="s", linestyle="none", **style)
        axes.axhline(2.0, color="grey", linewidth=0.8, linestyle=":")
        axes.set_title(TITLES[name], fontsize=9)
        axes.set_xlabel("unknowns", fontsize=8)
        axes.set_ylabel("error [%]", fontsize=8)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.tick_params(labelsize=7, which="both")
        axes.legend(fontsize=7)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()

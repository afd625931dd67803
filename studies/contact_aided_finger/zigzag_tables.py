"""Tables of the page on the measured contact-aided fingers and their design study."""

from __future__ import annotations

from typing import Any

from benchmarks.recorded import results
from benchmarks.tables import markdown

UNITS = {"m": (1e3, "mm"), "Pa": (1e-6, "MPa"), "1": (1.0, ""), "rad": (57.29577951308232, "deg")}
"""Factor to the shown unit, and its name."""


def zigzag_measured() -> str:
    """Measured fingers: published values, both meshes, and the band of all tolerances."""
    rows = []
    for name in ("A", "B"):
        found = results("zigzag_gap")[name]
        meshes = found["meshes"]
        for k, key in enumerate(("force", "resistance", "energy")):
            band = found["sample"][key]
            digits = 2 if key != "resistance" else 3
            values = [
                found["measured"][k],
                found["published"][k],
                meshes["published, linear, 3 mm"][key],
                meshes["quadratic, 12 mm"][key],
                meshes["quadratic, 8 mm"][key],
            ]
            shown = [f"{value:.{digits}f}" for value in values]
            label = {"force": "contact force [N]", "resistance": "resistance [m]", "energy": "energy [N m]"}[key]
            rows.append([f"{name}, {label}", *shown, f"{band['low']:.{digits}f} to {band['high']:.{digits}f}"])
    head = ["finger", "measured", "thesis", "linear, 3 mm", "quadratic, 12 mm", "quadratic, 8 mm", "all tolerances"]
    return markdown(head, rows, "lrrrrrr")


def zigzag_effects() -> str:
    """Finger B with one quantity at a time at the ends of its tolerance."""
    found = results("zigzag_gap")
    nominal = found["B"]["nominal"]
    rows = []
    for name, effect in found["effects"].items():
        ends = [row for label, row in found["B"]["ends"].items() if label.startswith(f"{name} ")] + [nominal]
        scale, unit = UNITS.get(effect["unit"], (1.0, effect["unit"]))
        limits = f"{scale * effect['low']:.3g} to {scale * effect['high']:.3g} {unit}".strip()
        spans = [_span([row[key] for row in ends]) for key in ("force", "energy")]
        rows.append([name.replace("_", " "), limits, *spans, effect["source"]])
    return markdown(["quantity", "from, to", "force [N]", "energy [N m]", "source"], rows, "llrrl")


def _span(values: list[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"


def zigzag_force() -> str:
    """Contact force of finger 203 over the angle of the servo."""
    band = results("zigzag_gap")["203"]["force"]
    rows = [
        [f"{label} [N]", *(f"{value:.2f}" for value in band[key][4:])]
        for label, key in (("measured", "measured"), ("5 %", "low"), ("median", "median"), ("95 %", "high"))
    ]
    return markdown(["angle [deg]", *(str(angle) for angle in band["angle"][4:])], rows, "lrrrrrr")


def zigzag_front() -> str:
    """Chosen designs of the search and the fingers that were built, on both meshes."""
    values: dict[str, dict[str, Any]] = {}
    for row in results("zigzag_study")["values"]:
        values.setdefault(row["design"], {})[row["mesh"]] = row
    rows = [
        [
            name,
            *(
                _value(row[mesh], key)
                for key in ("force", "energy", "resistance")
                for mesh in ("accurate", "published")
            ),
        ]
        for name, row in values.items()
    ]
    head = ["finger", "force [N]", "3 mm", "energy [N m]", "3 mm", "resistance [m]", "3 mm"]
    return markdown(head, rows, "lrrrrrr")


def zigzag_robust() -> str:
    """Means of fingers over several objects and frictions."""
    rows = [
        [label.split(":")[0], *(f"{value:.{digits}f}" for value, digits in zip(values, (2, 2, 3), strict=True))]
        for label, values in results("zigzag_robust").items()
    ]
    return markdown(["finger", "force [N]", "energy [N m]", "resistance [m]"], rows, "lrrr")


def zigzag_sensitivity() -> str:
    """Finger B with one design variable at a time at both ends, most important variables for the force first."""
    found = results("zigzag_sensitivity")
    spans: dict[str, list[list[float]]] = {}
    for label, span in found.items():
        spans.setdefault(label.split(", ")[1].removesuffix(": low"), []).append(span)
    order = sorted(spans, key=lambda name: spans[name][0][0] - spans[name][0][1])
    rows = [
        [
            name,
            *(
                f"{low:.{digits}f} to {high:.{digits}f}"
                for (low, high), digits in zip(spans[name], (2, 2, 3), strict=True)
            ),
        ]
        for name in order
    ]
    return markdown(["variable", "force [N]", "energy [N m]", "resistance [m]"], rows, "lrrr")


def zigzag_step() -> str:
    """Design B and the design one step further, on both meshes."""
    found = results("zigzag_step")
    rows = [
        [
            "B" if design == "B" else "one step further",
            *(
                f"{found[f'{design}, {mesh}: force, resistance, energy'][k]:.{digits}f}"
                for k, digits in ((0, 2), (2, 2), (1, 3))
                for mesh in ("accurate", "published")
            ),
        ]
        for design in ("B", "step")
    ]
    head = ["finger", "force [N]", "3 mm", "energy [N m]", "3 mm", "resistance [m]", "3 mm"]
    return markdown(head, rows, "lrrrrrr")


def _value(row: dict[str, Any], key: str) -> str:
    if row["status"] != "ok":
        return "-"
    return f"{row[key]:.3f}" if key == "resistance" else f"{row[key]:.2f}"


ZIGZAG_TABLES = {
    table.__name__: table
    for table in (
        zigzag_measured,
        zigzag_effects,
        zigzag_force,
        zigzag_front,
        zigzag_robust,
        zigzag_sensitivity,
        zigzag_step,
    )
}
"""Tables by the name in a marked place."""

"""Generated parts of the robots' pages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import groupby
from typing import Any

from site_writing import code, environment_pages, first_sentence, number, options_of, quantity, span, summary, table

from softgym_envs import make_robot
from softgym_envs.backends import make_backend
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.errors import WeightsError
from softgym_envs.extensions.beams.beam import Beam
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock
from softgym_envs.robots import ROBOTS, Actuator, Robot
from softgym_envs.units import effort_unit

MOVES = {
    "m": "shortening of a cable",
    "m3": "growth of a chamber's volume",
    "rad": "angle of a servo",
}


@cache
def robot_of(name: str, options: tuple[tuple[str, Any], ...] = ()) -> Robot:
    """Return a robot of the registry, made once."""
    return make_robot(name, **dict(options))


def groups_of(actuators: Sequence[Actuator]) -> list[tuple[str, list[Actuator]]]:
    """Actuators that differ by their names only, with their indices as a text."""
    result, start = [], 0
    for _, same in groupby(actuators, lambda a: (a.low, a.high, a.rate, a.unit, a.unilateral)):
        members = list(same)
        result.append((str(start) if len(members) == 1 else f"{start}-{start + len(members) - 1}", members))
        start += len(members)
    return result


def actuator_table(robot: Robot) -> str:
    """Actuators with their ranges and rates."""
    limited = any(math.isfinite(actuator.max_effort) for actuator in robot.actuators)
    rows = [
        [
            index,
            ", ".join(f"`{member.name}`" for member in members),
            MOVES.get(members[0].unit, "displacement"),
            span(members[0].low, members[0].high, members[0].unit),
            quantity(members[0].rate, members[0].unit),
            "no" if members[0].unilateral else "yes",
            quantity(members[0].max_effort, effort_unit(members[0].unit)) if limited else "",
        ]
        for index, members in groups_of(robot.actuators)
    ]
    head = ["index", "actuator", "displacement", "range", "largest change a step", "pushes", "largest effort"]
    return table(head if limited else head[:-1], rows if limited else [row[:-1] for row in rows])


def design_table(robot: Robot) -> str:
    """The design space, in SI as it is given to the code."""
    rows = [
        [
            f"`{v.name}`",
            number(v.low),
            number(v.baseline),
            number(v.high),
            "" if v.unit == "1" else v.unit,
            v.description + (" (sampled on a logarithmic scale)" if v.log else ""),
        ]
        for v in robot.design_space
    ]
    return table(["variable", "low", "baseline", "high", "unit", "meaning"], rows)


def model_facts(robot: Robot) -> list[list[str]]:
    """What the finite-element model of the baseline body consists of."""
    model = robot.build()
    rows = [["nodes", f"{len(model.nodes) - 4 * len(model.frames):,}"]]
    for block_class in dict.fromkeys(type(block) for block in model.blocks):
        blocks = [block for block in model.blocks if type(block) is block_class]
        elements = [elements_of(block) for block in blocks]
        words = " ".join(re.findall(r"[A-Z][a-z]+", block_class.__name__)).lower()
        times = f" ({len(blocks)} x {elements[0]:,})" if len(blocks) > 1 and len(set(elements)) == 1 else ""
        rows.append(["beam elements" if block_class is Beam else words, f"{sum(elements):,}{times}"])
    if len(model.frames):
        rows.append(["frames of beams and rigid parts", f"{len(model.frames)}"])
    rows.append(["degrees of freedom", f"{model.equations:,}"])
    for role, word in (("e", "effectors"), ("s", "sensors"), ("c", "contact points"), ("b", "bonds")):
        if model.constraints[role]:
            rows.append([word, ", ".join(f"`{constraint.name}`" for constraint in model.constraints[role])])
    if model.volume > 0.0:
        rows.append(["volume", f"{1e9 * model.volume:,.0f} mm³"])
    if model.mass > 0.0:
        rows.append(["mass", f"{1e3 * model.mass:.1f} g"])
    rows.append(["effector of the baseline body at rest", point(robot.effector_rest)])
    rows.append(
        [
            "efforts scale exactly with",
            f"`{robot.learning.stiffness_variable}`" if robot.learning.stiffness_variable else "-",
        ]
    )
    return rows


def elements_of(block: ElementBlock) -> int:
    """Number of elements of a block; a rigid body is one."""
    if isinstance(block, Beam):
        return len(block.rows)
    return len(block.connectivity) if isinstance(block, SolidBlock) else 1


def point(values: Iterable[float]) -> str:
    """Write a point in millimetres."""
    return f"({', '.join(number(round(1e3 * float(v), 6)) for v in values)}) mm"


@cache
def has_surrogate(name: str, options: tuple[tuple[str, Any], ...] = ()) -> bool:
    """Whether environments of a robot run on a surrogate: by making its backend."""
    try:
        make_backend("surrogate", robot_of(name, options))
    except (WeightsError, ValueError):  # none ships, or it does not suffice without the rest of a gripper
        return False
    return True


def robot_sections(name: str) -> dict[str, Callable[[], str]]:
    """Template of a robot's page."""
    robot = robot_of(name)

    def model() -> str:
        facts = table(["baseline body", "value"], model_facts(robot))
        path = type(robot).reference_path
        text = "" if path is Robot.reference_path else f"\n\nReference path: {code(first_sentence(path.__doc__ or ''))}"
        return facts + text

    def weights() -> str:
        if has_surrogate(name) and "surrogate" in robot.backends:
            return "Its surrogate consists of learned parts, which ship."
        if has_surrogate(name):
            return f"Weights of a surrogate ship for the default options (`{robot.learning.weights}`)."
        return "With the default options no surrogate ships that environments run on: they run on finite elements."

    def environments() -> str:
        rows = [
            [f"[`{identifier}`](../environments/{page}.md)", summary(identifier)]
            for page, identifier in environment_pages().items()
            if ENVIRONMENTS[identifier].robot == name
        ]
        return f"{table(['ID', 'task'], rows)}\n\n{weights()}" if rows else weights()

    return {
        "Description": lambda: "",
        "Comparison with published values": lambda: "",
        "Design space": lambda: design_table(robot),
        "Actuators": lambda: actuator_table(robot),
        "Model": model,
        "Options": lambda: (
            f'Of `make_robot("{name}", ...)`, and `robot_options` of an environment:\n\n'
            + table(["option", "default", "meaning"], options_of(ROBOTS[name]))
        ),
        "Environments": environments,
    }

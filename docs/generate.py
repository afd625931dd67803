"""The generated parts of the documentation: a hook of mkdocs that fills pages from the registries.

A page of an environment or a robot is written by hand as far as it is particular; every section of the template that
it leaves out is made from the registry here, in the order of the template. Where a page has such a section itself,
its text is used, and what would have been generated goes to the line ``<!-- generated -->`` in it, if there is one.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs.backends import BACKENDS
from softgym_envs.envs.env import SoftRobotEnv
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.base import Task
from softgym_envs.envs.tasks.registry import TASKS
from softgym_envs.mechanics.elements.beams import Beam
from softgym_envs.mechanics.elements.block import ElementBlock
from softgym_envs.mechanics.elements.tetrahedra import SolidBlock
from softgym_envs.robots import ROBOTS, make_robot
from softgym_envs.robots.base import Actuator, Robot
from softgym_envs.surrogate.pretrained import pretrained_folder

ROOT = Path(__file__).resolve().parent
HERE = "<!-- generated -->"

# -- names ----------------------------------------------------------------------------------------------------------


def page_name(identifier: str) -> str:
    """Name of the page of an environment: ``finger_reach`` for ``SoftGym/FingerReach-v0``."""
    stem = identifier.split("/")[-1].rsplit("-v", 1)[0]
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", stem).lower()


def environment_pages() -> dict[str, str]:
    """Page name to ID of every registered environment; of several versions the last."""
    return {page_name(identifier): identifier for identifier in ENVIRONMENTS}


def missing_pages() -> list[str]:
    """Pages that the registries ask for and `docs` does not have, or that say nothing."""
    wanted = [f"environments/{name}.md" for name in environment_pages()] + [f"robots/{name}.md" for name in ROBOTS]
    return [page for page in wanted if not (ROOT / page).is_file() or not describes((ROOT / page).read_text())]


def describes(page: str) -> bool:
    """Whether a page has a description written by hand, of a paragraph at least."""
    text = re.sub(r"<!--.*?-->", "", dict(split(page)).get("Description", ""), flags=re.DOTALL)
    return len(text.split()) >= 30


@cache
def robot_of(name: str, options: tuple[tuple[str, Any], ...] = ()) -> Robot:
    """Return a robot of the registry, made once."""
    return make_robot(name, **dict(options))


# -- writing --------------------------------------------------------------------------------------------------------

SHOWN = {
    "m": (1e3, "mm"),
    "m3": (1e9, "mm³"),
    "Pa": (1e-3, "kPa"),
    "rad": (180.0 / math.pi, "°"),
}
"""Units of the code and what people read them in."""
EFFORT = {"m": "N", "m3": "Pa", "rad": "N m"}
"""Unit of the effort conjugate to a displacement."""
MOVES = {
    "m": "shortening of a cable",
    "m3": "growth of a chamber's volume",
    "rad": "angle of a servo",
}


def number(value: float) -> str:
    """Write a number as short as it is exact to six digits: ``3e6``, not ``3e+06``."""
    return re.sub(r"e([+-])0*(\d+)", lambda m: f"e{m[1].strip('+')}{m[2]}", f"{value:.6g}")


def quantity(value: float, unit: str) -> str:
    """Write an SI value in the unit that people read."""
    factor, shown = SHOWN.get(unit, (1.0, unit))
    return f"{number(value * factor)} {shown}".strip()


def span(low: float, high: float, unit: str) -> str:
    """Write a range in the unit that people read."""
    factor, shown = SHOWN.get(unit, (1.0, unit))
    return f"{number(low * factor)} to {number(high * factor)} {shown}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def first_sentence(text: str) -> str:
    """Return the first sentence of a text, on one line."""
    flat = " ".join(text.split())
    return re.split(r"(?<=[.])\s(?=[A-Z`(])", flat, maxsplit=1)[0]


def code(text: str) -> str:
    """Turn the double backticks of docstrings into Markdown's."""
    return text.replace("``", "`")


# -- sections of a page ---------------------------------------------------------------------------------------------


def split(page: str) -> list[tuple[str, str]]:
    """Split a page at its second-level headings; what precedes them has the heading ``""``."""
    sections: list[tuple[str, list[str]]] = [("", [])]
    fenced = False
    for line in page.splitlines():
        fenced ^= line.startswith("```")
        if line.startswith("## ") and not fenced:
            sections.append((line[3:].strip(), []))
        else:
            sections[-1][1].append(line)
    return [(heading, "\n".join(lines).strip()) for heading, lines in sections]


def compose(page: str, top: str, template: Mapping[str, Callable[[], str]]) -> str:
    """Complete a page by the sections of a template; its own further sections stay behind the one they follow.

    Args:
        page: Markdown, with a title.
        top: what comes under the title.
        template: heading to the function that writes the section, in order.
    """
    own: dict[str, str] = {}
    followers: dict[str, list[str]] = {}
    last = ""
    (_, head), *rest = split(page)
    for heading, text in rest:
        if heading in template:
            own[heading] = text
            last = heading
        else:
            followers.setdefault(last, []).append(f"## {heading}\n\n{text}")
    parts = [head, top, *followers.get("", [])]
    for heading, write in template.items():
        text = own.get(heading, HERE)
        if HERE in text:
            text = text.replace(HERE, write())
        if text.strip():
            parts.append(f"## {heading}\n\n{text.strip()}")
        parts += followers.get(heading, [])
    return "\n\n".join(part for part in parts if part.strip()) + "\n"


def picture(*names: str, alt: str) -> str:
    """Show the first picture of ``docs/images`` that exists, or nothing."""
    for name in names:
        if (ROOT / "images" / f"{name}.png").is_file():
            return f"![{alt}](../images/{name}.png){{ .robot }}"
    return ""


# -- docstrings -----------------------------------------------------------------------------------------------------


def described_arguments(cls: type) -> dict[str, str]:
    """Texts of the ``Args:`` of a class, its bases' after its own."""
    texts: dict[str, str] = {}
    for base in cls.__mro__:
        found = re.search(r"^Args:\n((?:[ ]+.*\n?|\n)+)", inspect.cleandoc(base.__doc__ or ""), flags=re.MULTILINE)
        if base is object or found is None:
            continue
        for name, text in re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", found[1], flags=re.MULTILINE):
            texts.setdefault(name, code(" ".join(text.split())))
    return texts


def options_of(cls: type, given: Mapping[str, Any] | None = None) -> list[list[str]]:
    """Rows of a table of the keyword arguments of a class: name, default (or what is given), meaning."""
    texts, rows, seen, given = described_arguments(cls), [], set(), given or {}
    for base in cls.__mro__:
        if "__init__" not in vars(base) or base is object:
            continue
        parameters = inspect.signature(base).parameters.values()
        for parameter in parameters:
            if parameter.kind is parameter.KEYWORD_ONLY and parameter.name not in seen:
                seen.add(parameter.name)
                value = given.get(parameter.name, parameter.default)
                rows.append([f"`{parameter.name}`", f"`{value!r}`", texts.get(parameter.name, "")])
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return rows


# -- robots ---------------------------------------------------------------------------------------------------------


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
            quantity(members[0].max_effort, EFFORT.get(members[0].unit, "")) if limited else "",
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
    rows.append(["efforts scale exactly with", f"`{robot.stiffness_variable}`" if robot.stiffness_variable else "-"])
    return rows


def elements_of(block: ElementBlock) -> int:
    """Number of elements of a block; a rigid body is one."""
    if isinstance(block, Beam):
        return len(block.rows)
    return len(block.connectivity) if isinstance(block, SolidBlock) else 1


def point(values: Iterable[float]) -> str:
    """Write a point in millimetres."""
    return f"({', '.join(number(round(1e3 * float(v), 6)) for v in values)}) mm"


def robot_sections(name: str) -> dict[str, Callable[[], str]]:
    """Template of a robot's page."""
    robot = robot_of(name)

    def model() -> str:
        facts = table(["baseline body", ""], model_facts(robot))
        path = type(robot).reference_path
        text = "" if path is Robot.reference_path else f"\n\nReference path: {code(first_sentence(path.__doc__ or ''))}"
        return facts + text

    def weights() -> str:
        if pretrained_folder(robot).is_dir():
            return f"Weights of a surrogate ship for the default options (`{robot.weights_name}`)."
        return "No surrogate ships for the default options: environments run on FEM; `softgym fit` makes one."

    def environments() -> str:
        rows = [
            [f"[`{identifier}`](../environments/{page}.md)", summary(identifier)]
            for page, identifier in environment_pages().items()
            if ENVIRONMENTS[identifier].robot == name
        ]
        return f"{table(['ID', 'task'], rows)}\n\n{weights()}" if rows else weights()

    return {
        "Description": lambda: "",
        "Published beside ours": lambda: "",
        "Design space": lambda: design_table(robot),
        "Actuators": lambda: actuator_table(robot),
        "Model": model,
        "Options": lambda: (
            f'Of `make_robot("{name}", ...)`, and `robot_options` of an environment:\n\n'
            + table(["option", "default", "meaning"], options_of(ROBOTS[name]))
        ),
        "Environments": environments,
    }


# -- environments ---------------------------------------------------------------------------------------------------


def summary(identifier: str) -> str:
    """What the task of an environment is, in a line."""
    task = TASKS[ENVIRONMENTS[identifier].task]
    text = inspect.getmodule(task).__doc__ or task.__doc__ or ""
    sentence = code(first_sentence(text.partition(":")[2].strip() or text))
    return sentence[:1].upper() + sentence[1:]


def observation_scales(robot: Robot) -> dict[str, float]:
    """Scales of positions, errors [m] and speeds [m/s] in the observation (a test compares them with the real one)."""
    return {"position": 1.25 * robot.size, "error": robot.workspace_scale / 2.5, "speed": robot.size}


def environment_sections(identifier: str) -> dict[str, Callable[[], str]]:
    """Template of an environment's page."""
    row = ENVIRONMENTS[identifier]
    spec = gymnasium.spec(identifier)
    robot = robot_of(row.robot, tuple(sorted(row.robot_options.items())))
    task_class: Any = TASKS[row.task]
    task: Task = task_class(robot, **row.task_options)
    moving = bool(row.backend_options.get("dynamics"))
    spaces = AgentSpaces(robot, action_mode="increment", design_names=(), axes=task.axes, moving=moving)
    scales = observation_scales(robot)
    along = "" if task.axes.all() else " along " + " and ".join(np.array(list("xyz"))[task.axes > 0.0])
    unit = robot.actuators[0].unit
    effort_unit = EFFORT.get(unit, "")
    effort_scale = quantity(float(robot.effort_scale[0]), effort_unit)
    effector = robot.effectors[0]

    def actions() -> str:
        rows = [
            [
                index,
                f"increment of the commanded displacement of {', '.join(f'`{a.name}`' for a in members)} "
                f"({MOVES.get(members[0].unit, 'displacement')})",
                "[-1, 1]",
                f"at most {quantity(members[0].rate, members[0].unit)} a step, "
                f"inside {span(members[0].low, members[0].high, members[0].unit)}",
                members[0].unit,
            ]
            for index, members in groups_of(robot.actuators)
        ]
        return (
            table(["index", "action", "control range", "moves", "unit"], rows)
            + '\n\nWith `action_mode="absolute"` -1 and 1 are the ends of the range, approached at no more than that '
            "change a step. Values outside [-1, 1] are clipped; a value that is not finite raises `ValueError`."
        )

    def observations() -> str:
        n = len(robot.actuators)
        scale = effort_scale if len(set(robot.effort_scale)) == 1 else "its scale"
        what = {
            "m": ("cable", "tension", "clipped for slack cables beyond it"),
            "m3": ("chamber", "pressure", "clipped for open chambers beyond it"),
        }
        word, effort, clipped = what.get(unit, ("actuator", "effort", "clipped"))
        reach, error = quantity(scales["position"], "m"), quantity(scales["error"], "m")
        parts = [
            (n, f"commanded displacement of each {word}", "range to [-1, 1]", unit),
            (n, f"reached displacement of each {word}", f"range to [-1, 1], {clipped}", unit),
            (n, f"{effort} of each {word}", f"x / (1 + abs(x)) of the {effort} over {scale}", effort_unit),
            (3, f"position x, y, z of the effector `{effector}`", reach, "m"),
            (3, "goal position x, y, z", reach, "m"),
            (3, f"goal minus effector{along and f',{along} only'}", f"x / (1 + abs(x)) of it over {error}", "m"),
        ]
        if moving:
            speed = f"x / (1 + abs(x)) of it over {quantity(scales['speed'], 'm')}/s"
            parts.append((3, "velocity x, y, z of the effector", speed, "m/s"))
        rows, start = [], 0
        for size, *cells in parts:
            rows.append([str(start) if size == 1 else f"{start}-{start + size - 1}", *cells])
            start += size
        if (start,) != spaces.observation_space.shape:
            raise ValueError(f"the table of observations has {start} rows, not {spaces.observation_space.shape}")
        rows.append([f"{start}-", "design variables, if `design_in_observation`", "bounds to [-1, 1]", ""])
        return table(["index", "observation", "scaled by", "unit"], rows)

    def rewards() -> str:
        if task_class.reward_terms is not Task.reward_terms:
            return code(inspect.cleandoc(task_class.reward_terms.__doc__ or "")).partition("\nArgs:")[0]
        near, far = quantity(task.success_distance, "m"), quantity(robot.workspace_scale, "m")
        terms = (
            f"* distance: `(t(d, {near}) + t(d, {far})) / 2` with `t(d, m) = 1 / (1 + 9 (d / m)^2)` and `d` the "
            f"distance of the effector to the goal{along};\n"
            f"* effort: `1 - 0.05 min(1, mean effort / {effort_scale})`."
        )
        return (
            '`reward = distance term x effort term`, each in [0, 1] and reported in `info["reward_terms"]`:\n\n' + terms
        )

    def start() -> str:
        still = ", in equilibrium and without velocity" if moving else ""
        rest = f"The body at rest, all actuators at zero displacement{still}. "
        if row.task == "reach":
            return rest + (
                f"The goal is the position of `{effector}` under a uniformly drawn command of the present body "
                '(`task_options={"goals": "reachable"}`), or one of a fixed set of points '
                '(`task_options={"goals": array}`), which makes bodies comparable, or '
                '`reset(options={"goal": [x, y, z]})` in metres.'
            )
        path = getattr(task, "path", None)
        if row.task == "track" and path is not None:
            return rest + (
                f"The goal is at the first of the {len(path)} points of the path, which are spread over "
                f'{task.horizon} steps. `task_options={{"path": array}}` gives another path [m], shape (p, 3); '
                '`task_options={"jitter": 0.005}` shifts it randomly by up to 5 mm along each axis in each episode; '
                '`reset(options={"goal": array})` gives the path of one episode.'
            )
        return rest + code(inspect.cleandoc(task_class.__doc__ or "")).partition("\nArgs:")[0]

    def end() -> str:
        held = (
            " There is no termination: the goal has to be held." if task.horizon == 1 else " There is no termination."
        )
        return (
            f"Truncation after {spec.max_episode_steps} steps.{held} If no equilibrium is found the episode is "
            'truncated with `info["converged"] = False` and a reward of 0.'
        )

    def information() -> str:
        return (
            f"`effector` and `goal` [m], `distance`{along} [m], `is_success` (`distance` < "
            f"{quantity(task.success_distance, 'm')}), `reward_terms`, `displacement` [{unit}], `effort` "
            f"[{effort_unit}], `stable` (FEM: the tangent is positive definite), `converged`. `env.unwrapped.state` is "
            "the whole mechanical state, with the condensed model at `env.unwrapped.state.condensed` (`W.ea`, "
            "`delta_free.e`, ...)."
        )

    def arguments() -> str:
        fixed = {name: value for name, value in spec.kwargs.items() if name != "defaults"}
        fixed |= {name: getattr(row, name) for name in ("robot_options", "task_options", "backend_options")}
        given = {name: value for name, value in fixed.items() if value not in (None, {})}
        shown = [line for line in options_of(SoftRobotEnv, given) if "`defaults`" not in line[0]]
        parts = [table(["argument", "default", "meaning"], shown)]
        for argument, kind, cls in (
            ("task_options", f"task `{row.task}`", task_class),
            ("robot_options", f"robot [`{row.robot}`](../robots/{row.robot}.md)", type(robot)),
            ("backend_options", f"backend `{row.backend}`", BACKENDS[row.backend]),
        ):
            options = options_of(cls, given.get(argument))
            if options:
                parts.append(f"`{argument}`, {kind}:\n\n{table(['option', 'default', 'meaning'], options)}")
        parts.append(f"Design variables, in SI:\n\n{design_table(robot)}")
        if fixed["backend"] == "surrogate":
            parts.append(
                f'`gymnasium.make_vec("{identifier}", num_envs=1024)` gives the natively batched environment on the '
                "surrogate (same-step autoreset)."
            )
        else:
            parts.append(
                "No surrogate ships for this robot: the default backend is FEM. "
                f'`gymnasium.make_vec("{identifier}", ...)` steps single environments one after the other.'
            )
        return "\n\n".join(parts)

    return {
        "Description": lambda: "",
        "Action space": actions,
        "Observation space": observations,
        "Rewards": rewards,
        "Starting state": start,
        "Episode end": end,
        "Information": information,
        "Arguments": arguments,
        "Version history": lambda: "* v0: first version.",
    }


def environment_top(identifier: str) -> str:
    """ID, picture and spaces of an environment."""
    row = ENVIRONMENTS[identifier]
    robot = robot_of(row.robot, tuple(sorted(row.robot_options.items())))
    n, name = len(robot.actuators), page_name(identifier)
    moving = bool(row.backend_options.get("dynamics"))
    size = 3 * n + 9 + 3 * moving
    rows = [
        ["Action space", f"`Box(-1, 1, ({n},), float32)`"],
        ["Observation space", f"`Box(-1, 1, ({size} + k,), float32)`, `k` = design variables shown"],
        ["Robot", f"[`{row.robot}`](../robots/{row.robot}.md)"],
        ["Task", f"`{row.task}`, {row.max_episode_steps} steps"],
        ["Import", f'`import softgym_envs; gymnasium.make("{identifier}")`'],
    ]
    shown = picture(name, row.robot, alt=f"{identifier} in a finite-element simulation")
    return f"`{identifier}`\n\n{shown}\n\n{table(['', ''], rows)}"


# -- lists ----------------------------------------------------------------------------------------------------------


def title_of(page: str) -> str:
    """Title of a page of `docs`."""
    return (ROOT / page).read_text().partition("\n")[0].removeprefix("# ").strip()


def cards(entries: Iterable[tuple[str, Sequence[str], str]]) -> str:
    """A grid of cards: page, names of pictures, text."""
    items = []
    for page, images, text in entries:
        shown = next((n for n in images if (ROOT / "images" / f"{n}.png").is_file()), None)
        image = f"[![](../images/{shown}.png)]({Path(page).name})\n\n    " if shown else ""
        items.append(f"-   {image}**[{title_of(page)}]({Path(page).name})**\n\n    {text}")
    return '<div class="grid cards" markdown>\n\n' + "\n\n".join(items) + "\n\n</div>"


def environment_list() -> str:
    """Cards of all environments that have a page."""
    return cards(
        (f"environments/{name}.md", (name, ENVIRONMENTS[identifier].robot), f"`{identifier}`<br>{summary(identifier)}")
        for name, identifier in environment_pages().items()
        if (ROOT / f"environments/{name}.md").is_file()
    )


def robot_list() -> str:
    """Cards of all robots that have a page."""
    entries = []
    for name in ROBOTS:
        if (ROOT / f"robots/{name}.md").is_file():
            robot = robot_of(name)
            count = len(robot.actuators)
            numbers = f"{count} actuator{'s' * (count > 1)}, {len(robot.design_space)} design variables"
            text = code(first_sentence(type(robot).__doc__ or ""))
            entries.append((f"robots/{name}.md", (name,), f"`{name}`<br>{text}<br>{numbers}"))
    return cards(entries)


# -- API reference --------------------------------------------------------------------------------------------------

ROOMS = {
    "softgym_envs.designs": "Design spaces",
    "softgym_envs.mechanics": "Mechanics",
    "softgym_envs.robots": "Robots",
    "softgym_envs.surrogate": "Surrogates",
    "softgym_envs.backends": "Backends",
    "softgym_envs.control": "Control",
    "softgym_envs.envs": "Environments",
    "softgym_envs.viewer": "Viewer",
    "softgym_envs.errors": "Errors",
    "agents": "Agents",
    "codesign": "Co-design",
}
"""Packages and modules of the reference, from the bottom to the top, and their titles."""


def modules_of(room: str) -> list[str]:
    """Modules of a room that say what is public in ``__all__`` and define some of it themselves."""
    base = ROOT.parent / room.replace(".", "/")
    if base.with_suffix(".py").is_file():
        return [room]
    found = []
    for path in sorted(base.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        text = path.read_text()
        if "__all__" in text and (parts[-1] != "__init__" or re.search(r"^def |^class ", text, re.MULTILINE)):
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found


def reference_page(room: str) -> str:
    """Reference of a room, drawn from the docstrings."""
    modules = "\n\n".join(f"## {module}\n\n::: {module}" for module in modules_of(room))
    return f"# {ROOMS[room]}\n\n{modules}\n"


def reference_list() -> str:
    """Rooms of the reference with what is public in them."""
    rows = []
    for room, title in ROOMS.items():
        names = [name for module in modules_of(room) for name in import_module(module).__all__]
        rows.append([f"[{title}]({room}.md)", f"`{room}`", ", ".join(f"`{name}`" for name in names)])
    return table(["", "import from", "public names"], rows)


# -- events of mkdocs -----------------------------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    """Put the pages of the registries into the navigation, behind the index of their section."""
    if pages := missing_pages():
        raise SystemExit(f"docs: pages that are missing, or have no description: {', '.join(pages)}")
    generated = {
        "Environments": [f"environments/{name}.md" for name in environment_pages()],
        "Robots": [f"robots/{name}.md" for name in ROBOTS],
        "API reference": [f"reference/{room}.md" for room in ROOMS],
    }
    for entry in config.nav:
        for title, pages in entry.items():
            if title in generated:
                pages += generated[title]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the reference; leave out pages of environments that are not registered."""
    from mkdocs.structure.files import File

    index = f"# API reference\n\nDrawn from the docstrings of the source; units are SI.\n\n{reference_list()}\n"
    files.append(File.generated(config, "reference/index.md", content=index))
    for room in ROOMS:
        files.append(File.generated(config, f"reference/{room}.md", content=reference_page(room)))
    known = {f"environments/{name}.md" for name in (*environment_pages(), "index")}
    for file in list(files):
        if file.src_uri.startswith("environments/") and file.src_uri.endswith(".md") and file.src_uri not in known:
            files.remove(file)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Complete a page from the registries."""
    folder, _, name = page.file.src_uri.removesuffix(".md").rpartition("/")
    if not folder:
        page.meta.setdefault("hide", ["navigation"])  # it has no siblings
    if name == "index":
        lists = {"environments": environment_list, "robots": robot_list}
        return markdown.replace(HERE, lists[folder]()) if folder in lists else markdown
    if folder == "environments":
        identifier = environment_pages()[name]
        return compose(markdown, environment_top(identifier), environment_sections(identifier))
    if folder == "robots" and name in ROBOTS:
        facts = dict(model_facts(robot_of(name)))
        markdown = re.sub(r"\{\{ (\w+) \}\}", lambda match: facts[match[1]], markdown)
        shown = picture(name, alt=f"The {title_of(page.file.src_uri)} at rest and actuated")
        return compose(markdown, f"`{name}`\n\n{shown}", robot_sections(name))
    return markdown

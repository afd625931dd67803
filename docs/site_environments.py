"""Generated parts of the environments' pages."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from site_robots import MOVES, design_table, groups_of, has_surrogate, robot_of
from site_writing import code, options_of, page_name, picture, quantity, span, table

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs import ENVIRONMENTS
from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.backends.registry import BACKENDS
from softgym_envs.envs import SoftRobotEnv, Task
from softgym_envs.envs.options import EnvironmentOptions
from softgym_envs.envs.spaces import AgentSpaces
from softgym_envs.envs.tasks.registry import TASKS
from softgym_envs.robots import Robot
from softgym_envs.units import effort_unit


def observation_scales(robot: Robot) -> dict[str, float]:
    """Scales of positions, errors [m] and speeds [m/s] in the observation (a test compares them with the real one)."""
    return {"position": 1.25 * robot.size, "error": robot.workspace_scale / 2.5, "speed": robot.size}


def surrogate_and_batches(identifier: str) -> str:
    """Whether a surrogate ships for the robot of an ID, and how ``gymnasium.make_vec`` steps many environments."""
    row = ENVIRONMENTS[identifier]
    config = EnvironmentConfig(id=identifier)
    learned = has_surrogate(row.robot, tuple(sorted(row.robot_options.items())))
    default = f"The default backend is `{config.backend!r}`".replace("'", '"')
    other = "" if config.backend == "surrogate" else '; `backend="surrogate"` works too'
    first = f"{default}{other}." if learned else f"{default}: no surrogate ships for this robot."
    how = (
        "steps all environments in one call (same-step autoreset)"
        if config.batched
        else "steps each environment in a process of its own"
    )
    return f'{first} `gymnasium.make_vec("{identifier}", num_envs=...)` {how}.'


def environment_sections(identifier: str) -> dict[str, Callable[[], str]]:
    """Template of an environment's page."""
    row = ENVIRONMENTS[identifier]
    spec = gymnasium.spec(identifier)
    robot = robot_of(row.robot, tuple(sorted(row.robot_options.items())))
    task_class: Any = TASKS[row.task]
    task: Task = task_class(robot, **row.task_options)
    moving = bool(row.backend_options.get("dynamics"))
    spaces = AgentSpaces(
        robot,
        action_mode="increment",
        design_names=(),
        axes=task.axes,
        moving=moving,
        sensors=0 if task.sensors is None else task.sensors.count,
    )
    scales = observation_scales(robot) | {"position": task.goal_scale, "error": task.error_scale}
    goal_unit = task.distance_scale.goal_unit
    forces = goal_unit == "N"
    along = "" if task.axes.all() else " along " + " and ".join(np.array(list("xyz"))[task.axes > 0.0])
    unit = robot.actuators[0].unit
    force_unit = effort_unit(unit)
    effort_scale = quantity(float(robot.effort_scale[0]), force_unit)
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
        reach, error = quantity(scales["position"], goal_unit), quantity(scales["error"], goal_unit)
        measured = "force x, y, z on the object" if forces else f"position x, y, z of the effector `{effector}`"
        wanted = "wanted force x, y, z" if forces else "goal position x, y, z"
        difference = f"{'wanted minus present force' if forces else 'goal minus effector'}{along and f',{along} only'}"
        parts = [
            (n, f"commanded displacement of each {word}", "range to [-1, 1]", unit),
            (n, f"reached displacement of each {word}", f"range to [-1, 1], {clipped}", unit),
            (n, f"{effort} of each {word}", f"x / (1 + abs(x)) of the {effort} over {scale}", force_unit),
            (3, measured, reach, goal_unit),
            (3, wanted, reach, goal_unit),
            (3, difference, f"x / (1 + abs(x)) of it over {error}", goal_unit),
        ]
        if task.sensors is not None and task.sensors.parts:
            parts = [parts[0], *task.sensors.parts, (3, "wanted velocity x, y, z", reach, goal_unit)]
        elif task.sensors:
            count = len(robot.sensing.scale)
            unit_seen = robot.sensing.unit
            volumes = f"x / (1 + abs(x)) of it over {quantity(float(robot.sensing.scale[0]), unit_seen)}"
            parts = [
                parts[0],
                (count, "change of the volume of each cavity since the body was undeformed", volumes, unit_seen),
                (1, "whether a cell of the grid is touched", "1 or -1", ""),
                (2, "touched cell across and along the body", "grid to [-1, 1], 0 without a touch", ""),
                parts[4],
            ]
        elif moving:
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
        if forces:
            return code(inspect.cleandoc(task_class.__doc__ or "")).partition("\nArgs:")[0]
        if task_class.reward_terms is not Task.reward_terms:
            return code(inspect.cleandoc(task_class.reward_terms.__doc__ or "")).partition("\nArgs:")[0]
        near, far = quantity(task.success_distance, "m"), quantity(robot.workspace_scale, "m")
        terms = (
            f"* distance: `(t(d, {near}) + t(d, {far})) / 2` with `t(d, m) = 1 / (1 + 9 (d / m)^2)` and `d` the "
            f"distance of the effector to the goal{along};\n"
            f"* effort: `1 - 0.05 min(1, mean effort / {effort_scale})`."
        )
        return (
            "`reward = distance term x effort term`, each in [0, 1] and reported in `info` as `reward_distance` and "
            "`reward_effort`:\n\n" + terms
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
        if row.task == "sensed_reach":
            return rest + (
                f"The goal is the position of `{effector}` under a uniformly drawn command of the untouched body, or "
                '`reset(options={"goal": [x, y, z]})` in metres. A touch begins at a random one of the first '
                f"{task.touch.window} steps, with a force of up to {quantity(task.touch.largest, 'N')}, and stays."
            )
        path = getattr(task, "path", None)
        if row.task == "track" and path is not None:
            return rest + (
                f"The goal is at the first of the {len(path)} points of the path, which are spread over "
                f'{task.horizon} steps. `task_options={{"path": array}}` gives another path [m], shape (p, 3); '
                '`task_options={"jitter": 0.005}` shifts it randomly by up to 5 mm along each axis in each episode. '
                "The observation shows the goal that the next action is rated by; "
                '`task_options={"lookahead": 0}` shows the one before; '
                '`reset(options={"goal": array})` gives the path of one episode.'
            )
        return rest + code(inspect.cleandoc(task_class.__doc__ or "")).partition("\nArgs:")[0]

    def end() -> str:
        held = (
            " There is no termination: the goal has to be held." if task.horizon == 1 else " There is no termination."
        )
        if task_class.is_failed is not Task.is_failed:
            held = f" Termination when the task has failed: {inspect.cleandoc(task_class.is_failed.__doc__ or '')}"
        return (
            f"Truncation after {spec.max_episode_steps} steps.{held} If no equilibrium is found the episode is "
            'truncated with `info["converged"] = False` and a reward of 0.'
        )

    def information() -> str:
        error = "relative error of the force" if forces else f"{along} [{goal_unit}]"
        limit = f"{task.success_distance:g}" if forces else quantity(task.success_distance, goal_unit)
        counted = f", {', '.join(f'`{name}`' for name in task.tallies)} (what the task counts)" if task.tallies else ""
        return (
            f"`effector` [m], `goal` [{goal_unit}], `measured` [{goal_unit}] (what is compared with the goal), "
            f"`distance` ({error.strip()}), `is_success` (`distance` < "
            f"{limit}), `is_failed`, `reward_*` (the terms of the reward), `displacement` [{unit}], `effort` "
            f"[{force_unit}]{counted}, `stable` (FEM: the tangent is positive definite), `converged`. "
            "`env.unwrapped.state` is the whole mechanical state, with the condensed model at "
            "`env.unwrapped.state.condensed` (`W.ea`, `delta_free.e`, ...)."
        )

    def arguments() -> str:
        fixed = {name: value for name, value in spec.kwargs.items() if name != "defaults"}
        fixed |= {name: getattr(row, name) for name in ("robot_options", "task_options", "backend_options")}
        given = {name: value for name, value in fixed.items() if value not in (None, {})}
        options = options_of(SoftRobotEnv, given) + options_of(EnvironmentOptions, given)
        shown = [line for line in options if "`defaults`" not in line[0]]
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
        parts.append(surrogate_and_batches(identifier))
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
    task: Any = TASKS[row.task]
    sensors = task(robot, **row.task_options).sensors
    size = 3 * n + 9 + 3 * moving if sensors is None else n + sensors.count + 3
    rows = [
        ["Action space", f"`Box(-1, 1, ({n},), float32)`"],
        ["Observation space", f"`Box(-1, 1, ({size} + k,), float32)`, `k` = design variables shown"],
        ["Robot", f"[`{row.robot}`](../robots/{row.robot}.md)"],
        ["Task", f"`{row.task}`, {row.max_episode_steps} steps"],
        ["Import", f'`import softgym_envs; gymnasium.make("{identifier}")`'],
    ]
    shown = picture(name, row.robot, alt=f"{identifier} in a finite-element simulation")
    return f"`{identifier}`\n\n{shown}\n\n{table(['', ''], rows)}"

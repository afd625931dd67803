"""Variables of a study or a search: design variables, and options of robot or task with bounds.

An option is named ``robot.<option>`` or ``task.<option>``, an entry of a vector ``robot.<option>[<index>]``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import Field

from softgym_envs.agents.config import EnvironmentConfig
from softgym_envs.config import Config
from softgym_envs.designs import DesignSpace, DesignVariable

_OPTION = re.compile(r"(robot|task)\.([A-Za-z_]\w*)(?:\[(\d+)\])?")


class OptionRange(Config):
    """Bounds and baseline [unit] of an option that is optimised like a design variable."""

    low: float
    high: float
    baseline: float
    unit: str = Field(default="1", description="SI unit, 1 for a pure number")
    log: bool = Field(default=False, description="whether to sample on a logarithmic scale")
    description: str = Field(default="", description="meaning of the option, for reports")

    def variable(self, name: str) -> DesignVariable:
        """Return the option as a variable."""
        return DesignVariable(name, self.low, self.high, self.baseline, self.unit, self.description, self.log)


def is_option(name: str) -> bool:
    """Return whether a variable is an option of robot or task, and not a design variable."""
    return "." in name


def make_variables(
    names: Sequence[str], ranges: Mapping[str, OptionRange], space: DesignSpace
) -> dict[str, DesignVariable]:
    """Return the variables that are optimised, by name.

    Args:
        names: design variables of the robot, and options of robot or task.
        ranges: bounds of those options.
        space: design variables of the robot.

    Raises:
        ValueError: for a repeated or unknown name, or an option without bounds.
    """
    repeated = [name for name in names if list(names).count(name) > 1]
    if repeated:
        raise ValueError(f"variables: '{repeated[0]}' is named twice")
    unused = sorted(set(ranges) - set(names))
    if unused:
        raise ValueError(f"ranges: '{unused[0]}' is not in 'variables'")
    found = {}
    for name in names:
        if not is_option(name):
            if name in ranges:
                raise ValueError(f"ranges: '{name}' is a design variable; the robot defines its bounds")
            found[name] = space[name]
        elif _OPTION.fullmatch(name) is None:
            raise ValueError(f"variable '{name}' must look like robot.option, robot.option[0] or task.option")
        elif name not in ranges:
            raise ValueError(f"variable '{name}' is an option: give its low, high and baseline in 'ranges'")
        else:
            found[name] = ranges[name].variable(name)
    return found


def split_values(values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Split values by variable into those of the design and those of options."""
    options = {name: value for name, value in values.items() if is_option(name)}
    return {name: value for name, value in values.items() if name not in options}, options


def change_options(
    options: Mapping[str, Mapping[str, Any]], values: Mapping[str, float], where: str = ""
) -> dict[str, dict[str, Any]]:
    """Return options of robot and task with other values.

    Args:
        options: options by owner, ``"robot"`` or ``"task"``.
        values: values by variable, ``{"robot.<option>": value}``.
        where: prefix of the configuration key of the options, for messages: ``"environment."``.

    Raises:
        ValueError: if a value is for an entry of a vector that the options do not contain.
    """
    changed = {owner: dict(given) for owner, given in options.items()}
    for name, value in values.items():
        match = _OPTION.fullmatch(name)
        assert match is not None  # `make_variables` checked it
        owner, option, index = match.groups()
        if index is None:
            changed[owner][option] = value
            continue
        vector = changed[owner].get(option)
        if not isinstance(vector, Sequence) or isinstance(vector, str) or int(index) >= len(vector):
            raise ValueError(f"variable '{name}': give all of {option} in {where}{owner}_options first")
        changed[owner][option] = [value if k == int(index) else entry for k, entry in enumerate(vector)]
    return changed


def with_options(environment: EnvironmentConfig, values: Mapping[str, float]) -> EnvironmentConfig:
    """Return an environment with other values of options of robot and task.

    Raises:
        ValueError: if a value is for an entry of a vector that the environment's options do not contain.
    """
    if not values:
        return environment
    options = {"robot": environment.robot_options, "task": environment.task_options}
    changed = change_options(options, values, "environment.")
    return environment.model_copy(update={f"{owner}_options": given for owner, given in changed.items()})

"""Configuration: YAML files checked against pydantic models, with overrides from the command line."""

from __future__ import annotations

import copy
import functools
import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import ErrorDetails

from softgym_envs.errors import ConfigError, unknown_name
from softgym_envs.registry import ALLOW_CODE, code_is_allowed, is_place


class Config(BaseModel):
    """Base class of all configurations: immutable, without unknown keys, finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=False, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _name_unknown_keys(cls, data: Any) -> Any:
        """Say which keys are allowed where one is unknown, as pydantic does not, unless required ones are missing."""
        if not isinstance(data, dict):
            return data
        missing = any(field.is_required() and name not in data for name, field in cls.model_fields.items())
        unknown = next((name for name in data if name not in cls.model_fields), None)
        if unknown is not None and not missing:
            raise ValueError(unknown_name("key", str(unknown), cls.model_fields))
        return data


@dataclass(frozen=True)
class BesideConfig:
    """Marks a key whose value, or each string in a mapping, may be a path relative to the configuration's file."""


class _Loader(yaml.SafeLoader):
    """YAML with the numbers of YAML 1.2 and JSON: ``1e-3`` is a number, although PyYAML reads it as a string.

    What YAML 1.1 reads otherwise than people is refused: ``024`` (octal), ``1:30`` (base 60), and a key given twice.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key '{key.value}' is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """Return the number of a node, unless it is read in another base than people read it."""
        if _MISREAD.match(node.value):
            problem = f"'{node.value}' is no decimal number; write it without leading zeros and colons, or in quotes"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        if node.tag.endswith("int"):
            return self.construct_yaml_int(node)
        return self.construct_yaml_float(node)


_MISREAD = re.compile(r"[-+]?(0[0-9_]|[0-9][0-9_]*:)")
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_number)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_number)

_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$"),
    list("-+0123456789."),
)


def read_value(text: str) -> Any:
    """Return the value of YAML text.

    Raises:
        yaml.YAMLError: if the text is not valid YAML, or an alias stands for what it is in.
    """
    value = yaml.load(text, Loader=_Loader)
    _check_cycles(value, set(), set())
    return value


def _check_cycles(node: Any, around: set[int], checked: set[int]) -> None:
    if not isinstance(node, dict | list) or id(node) in checked:
        return
    if id(node) in around:
        raise yaml.constructor.ConstructorError(problem="an alias stands for what it is in")
    around.add(id(node))
    for part in [*node, *node.values()] if isinstance(node, dict) else node:
        _check_cycles(part, around, checked)
    around.remove(id(node))
    checked.add(id(node))


CONFIGS = Path(__file__).parent / "configs"
"""Folder of the shipped configurations."""

ENTRIES = "configurations"
"""Key of a file with several configurations, by name; the key ``defaults`` beside it holds what they share."""

_ADDRESS = re.compile(r"([A-Za-z][\w+.-]*://).*", re.DOTALL)
"""An address, which may hold a password in many forms; none of it must appear in a message or log."""


def masked(text: str) -> str:
    """Return a text without what follows the scheme of an address, such as ``postgresql://``."""
    return _ADDRESS.sub(r"\1***", text)


_IN_YAML = (
    (re.compile(r"must be a valid (tuple|list)"), "must be a list"),
    (re.compile(r"must be a valid dictionary( or instance of \w+)?"), "must be a mapping of keys to values"),
)
"""What pydantic says in Python's terms, and the same in those of a configuration file."""

ModelT = TypeVar("ModelT", bound=Config)


def load_config(path: str | Path | None, model: type[ModelT], overrides: Sequence[str] = ()) -> ModelT:
    """Return the configuration in a YAML file, with overrides.

    ``FILE/NAME`` is one of several configurations in a file: an entry of its ``configurations`` holds what differs from
    its ``defaults``, or from the entry named by the key ``like``.

    Paths in the file are relative to the file, or to the working directory where nothing is found beside the file;
    paths in overrides are relative to the working directory.

    Args:
        path: the file, or None to start from the defaults.
        model: class of the configuration.
        overrides: assignments ``a.b=value``, whose values are YAML.

    Raises:
        ConfigError: one line with the key, its value and what is allowed.
    """
    data: Any = {}
    if path is not None:
        path = Path(path)
        file, name = (path.parent, path.name) if path.parent.is_file() else (path, None)
        data = _read_file(file)
        if several := data.get(ENTRIES):
            groups = isinstance(several, dict) and all(isinstance(own, dict | None) for own in several.values())
            if not groups or not isinstance(data.get("defaults"), dict | None):
                raise ConfigError(f"config '{file}': {ENTRIES} and defaults must be groups of keys and values")
            several = {str(key): own for key, own in several.items()}
            data = {**data, ENTRIES: several}
            allowed = ", ".join(several)
            if name is None:
                raise ConfigError(f"config '{path}' holds several: add the name of one; allowed: {allowed}")
            if name not in several:
                raise ConfigError(f"config '{file}': {unknown_name('configuration', name, several)}")
            data = _entry(file, data, name)
        elif name is not None:
            raise ConfigError(f"config '{path}' cannot be read: '{file}' holds one configuration, without a name")
        _find_files(model, data, file.parent)
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key:
            raise ConfigError(f"override '{masked(override)}' must look like key=value or part.key=value")
        node = data
        *parents, last = key.split(".")
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise ConfigError(f"override '{masked(override)}': '{parent}' is a value, not a group of keys")
        try:
            node[last] = read_value(text)
        except (yaml.YAMLError, RecursionError) as error:
            reason = f": {error.problem}" if isinstance(error, yaml.constructor.ConstructorError) else ""
            raise ConfigError(f"override '{masked(override)}': the value is not valid YAML{reason}") from None
    return check_config(model, data, f"config '{path}'" if path is not None else "config")


def _read_file(path: Path) -> dict[str, Any]:
    """Return the keys and values of a YAML file; ConfigError if it cannot be read or holds something else."""
    try:
        data = read_value(path.read_text())
    except OSError as error:
        inside = path / "config.yaml"
        reason = f"it is a folder; its file is {inside}" if inside.exists() else error.strerror or error
        raise ConfigError(f"config '{path}' cannot be read: {reason}") from None
    except RecursionError:
        raise ConfigError(f"config '{path}' is nested too deeply") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        place = f", line {where.line + 1}" if where is not None else ""
        raise ConfigError(f"config '{path}' is not valid YAML{place}: {getattr(error, 'problem', error)}") from None
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ConfigError(f"config '{path}' must be a mapping of keys to values, got a {type(data).__name__}")
    return data


def _entry(file: Path, data: dict[str, Any], name: str) -> dict[str, Any]:
    """Return one of several configurations of a file: its defaults, or the entry that it is like, with its own keys."""
    entries = list(data[ENTRIES])
    own = dict(data[ENTRIES][name] or {})
    like = own.pop("like", None)
    if like is None:
        return _merged(data.get("defaults") or {}, own)
    before = entries[: entries.index(name)]
    if like not in before:
        message = unknown_name("configuration", like, before)
        raise ConfigError(f"config '{file / name}' is like none of those above it: {message}")
    return _merged(_entry(file, data, like), own)


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``own``; groups of keys are merged, everything else is replaced."""
    pairs = {key: _merged(base[key], value) for key, value in own.items() if isinstance(value, dict) and key in base}
    return copy.deepcopy({**base, **own, **pairs})


@functools.cache
def shipped_configs(kind: str) -> dict[str, Path]:
    """Return the shipped configurations of one kind by name, each as the path that `load_config` takes.

    Args:
        kind: ``"agents"``, ``"codesign"``, ``"design"`` or ``"surrogate"``.
    """
    found: dict[str, Path] = {}
    for file in (CONFIGS / kind).glob("*.yaml"):
        several = _read_file(file).get(ENTRIES)
        found |= {file.stem: file} if several is None else {name: file / name for name in several}
    return dict(sorted(found.items()))


def config_text(path: Path) -> str:
    """Return a configuration of `shipped_configs` as the text of a file of its own."""
    if path.is_file():
        return path.read_text()
    return yaml.safe_dump(_entry(path.parent, _read_file(path.parent), path.name), sort_keys=False)


def _find_files(model: type[BaseModel], data: dict[str, Any], folder: Path) -> None:
    """Replace paths in plain data that are relative to a folder, and exist there, by absolute ones."""
    for name, field in model.model_fields.items():
        value = data.get(name)
        if value is None:
            continue
        if any(isinstance(mark, BesideConfig) for mark in field.metadata):
            if isinstance(value, dict):
                data[name] = {key: _resolve_relative(folder, each) for key, each in value.items()}
            else:
                data[name] = _resolve_relative(folder, value)
        elif isinstance(value, dict) and isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            _find_files(field.annotation, value, folder)


def _resolve_relative(folder: Path, value: Any) -> Any:
    """Return the absolute path of a file in a folder; any other value, such as a name, unchanged."""
    if not isinstance(value, str) or not ("/" in value or Path(value).suffix):
        return value
    path = (folder / value).resolve()
    return str(path) if path.exists() else value


def check_config(model: type[ModelT], data: dict[str, Any], where: str) -> ModelT:
    """Return a configuration made from plain data.

    Args:
        model: class of the configuration.
        data: keys and values.
        where: source of the data, for the message: ``"config 'x.yaml'"``.

    Raises:
        ConfigError: one line that describes the first problem.
    """
    refuse_code(data, where)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_problem(error)}") from None


def refuse_code(data: Any, where: str, key: str = "") -> None:
    """Refuse plain data that names code, ``"module:name"``, which the user did not allow (`allow_code`).

    Whoever uses a file would otherwise run what its author wrote.

    Args:
        data: keys and values.
        where: source of the data, for the message.
        key: dotted key of the data, for the message.

    Raises:
        ConfigError: one line with the key and the code.
    """
    if isinstance(data, Mapping):
        for name, value in data.items():
            refuse_code(name, where, key)
            if name != "title":
                refuse_code(value, where, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list | tuple):
        for value in data:
            refuse_code(value, where, key)
    elif is_place(data) and not code_is_allowed(data):
        raise ConfigError(
            f"{where}: {key} = {data!r} names code, which using this file would run; allowed: registered names, or "
            f"code that you trust with --allow-code (in Python {ALLOW_CODE}=1)"
        )


def first_problem(error: ValidationError) -> str:
    """Return one line that names all missing keys, or else describes the first problem, and counts the others."""
    problems = error.errors(include_url=False)
    missing = [_dotted(problem) for problem in problems if problem["type"] == "missing"]
    if missing:
        plural = "s" if len(missing) > 1 else ""
        message, count = f"missing required key{plural} {', '.join(missing)}", len(missing)
    else:
        message, count = _describe(problems[0]), 1
    others = len(problems) - count
    more = f" (and {others} more problem{'s' if others > 1 else ''})" if others else ""
    return message + more


def _dotted(problem: ErrorDetails) -> str:
    return ".".join(map(str, problem["loc"]))


def _describe(problem: ErrorDetails) -> str:
    key = _dotted(problem)
    message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be").replace("\n", " ")
    for pattern, plain in _IN_YAML:
        message = pattern.sub(plain, message)
    value = problem["input"]
    shown = masked(repr(value))
    # A text stands in quotes, but a bound in the message may be the same number as the value.
    named = shown in message if isinstance(value, str) else f"= {shown}" in message or f"got {shown}" in message
    if not isinstance(value, dict) and not named:
        message += f", got {shown}"
    return f"{key}: {message}" if problem["loc"] else message


def difference(old: Config, new: Config, *, ignore: Sequence[str] = ()) -> str | None:
    """Describe the first value in which two configurations of one class differ: ``"sac.gamma = 0.9, got 0.95"``.

    Args:
        old: the configuration so far.
        new: the requested configuration.
        ignore: dotted keys that may differ.

    Returns:
        Dotted key and both values, long ones abridged; None if there is no difference.
    """
    return _difference(old.model_dump(mode="json"), new.model_dump(mode="json"), "", frozenset(ignore))


def _difference(old: Any, new: Any, key: str, ignore: frozenset[str]) -> str | None:
    if key in ignore:
        return None
    # Sections of different learners differ in their names.
    if isinstance(old, dict) and isinstance(new, dict) and (not key or old.keys() == new.keys()):
        names = {**old, **new}
        parts = (_difference(old.get(name), new.get(name), f"{key}.{name}" if key else name, ignore) for name in names)
        return next((part for part in parts if part is not None), None)
    return None if old == new else f"{key} = {reprlib.repr(old)}, got {reprlib.repr(new)}"

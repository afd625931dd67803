"""Registries: objects and classes found by name, registered in code or through entry points of installed packages.

The suite's own extensions (`softgym_envs.extensions`) are found through the same entry points as packages of others.
"""

from __future__ import annotations

import ast
import inspect
import os
import re
import types
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_type_hints

from softgym_envs.arguments import described, is_a
from softgym_envs.errors import unknown_name
from softgym_envs.wording import brief


def _class_of_file(name: str) -> str:
    """Return ``"module:Class"`` for a name of a file of the current folder, such as ``module.py`` or ``module.Class``.

    The file is read, not run. It is empty if there is no such file, or one without classes.
    """
    module, _, given = name.removesuffix(".py").partition(".")
    try:
        tree = ast.parse(Path(f"{module}.py").read_bytes()) if module.isidentifier() else ast.Module([], [])
    except (OSError, SyntaxError, ValueError):
        return ""
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    return f"{module}:{given if given in classes else classes[-1]}" if classes else ""


class Table(Mapping[str, Any]):
    """Objects by name: those given here, and those that installed packages add; each is imported when first used.

    Installed packages add objects through entry points; the name of the entry point is the name in the table.

    Args:
        kind: what the table holds, for messages: ``"robot"``, ...
        entries: name -> object, or ``"module:object"``.
        group: group of entry points; none by default.
    """

    _other = ""
    """What may be given in place of a name, for messages."""

    def __init__(self, kind: str, entries: Mapping[str, Any], *, group: str = "") -> None:
        self.kind = kind
        self._entries: dict[str, Any] = dict(entries)
        self._group = group
        self._discovered = not group

    def find(self, name: str) -> Any:
        """Return the object with a name.

        Raises:
            ValueError: for an unknown name, one that two packages claim, or an object of the wrong kind.
        """
        if name not in self:
            raise ValueError(unknown_name(self.kind, name, self, other=self._other))
        return self[name]

    def place(self, name: str) -> str:
        """Return where the object with a name is, ``"module:object"``, without importing it."""
        self._discover()
        return _path(self._entries[name])

    def __getitem__(self, name: str) -> Any:
        if name not in self:
            raise KeyError(name)
        found = self._entries[name]
        return self._checked(import_object(self.kind, found) if isinstance(found, str) else found)

    def __contains__(self, name: object) -> bool:
        self._discover()
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        self._discover()
        return iter(self._entries)

    def __len__(self) -> int:
        self._discover()
        return len(self._entries)

    def _checked(self, found: Any) -> Any:
        """Return an object of the table, or raise ValueError for one of the wrong kind."""
        return found

    def _discover(self) -> None:
        """Add the entry points of installed packages, once; they are not imported.

        Raises:
            ValueError: for a name that belongs to another object.
        """
        if self._discovered:
            return
        for point in entry_points(group=self._group):
            existing = self._entries.setdefault(point.name, point.value)
            if _path(existing) != point.value:
                owner = point.dist.name if point.dist is not None else "unknown"
                raise ValueError(
                    f"{self.kind} '{point.name}' is {_path(existing)} and also {point.value}, an entry point of the "
                    f"package '{owner}': rename or remove one of them"
                )
        self._discovered = True


class Registry(Table):
    """A table of classes by name, which makes their objects.

    Args:
        kind: what the table holds, for messages: ``"robot"``, ...
        entries: name -> ``"module:class"``.
        base: ``"module:class"`` that every entry must be derived from.
        group: group of entry points; none by default.
    """

    _other = "one of your own as 'module:Class'"

    def __init__(self, kind: str, entries: Mapping[str, str], *, base: str, group: str = "") -> None:
        super().__init__(kind, entries, group=group)
        self._base = base

    def register(self, name_or_class: Any = None, entry: str | type | None = None) -> Any:
        """Add a class: ``register(Arm)``, ``register("arm", Arm)``, or a decorator with or without the name.

        Args:
            name_or_class: the name, or a class whose attribute ``name`` is the name.
            entry: the class, or ``"module:class"`` to import it when it is used.

        Returns:
            The class or path, or a decorator that takes the class.

        Raises:
            ValueError: for an entry of the wrong kind, a missing or conflicting name, or a name that is taken.
        """
        if name_or_class is None:
            return self.register
        if isinstance(name_or_class, str) and entry is None:
            return partial(self.register, name_or_class)
        name, cls = (name_or_class, entry) if isinstance(name_or_class, str) else ("", name_or_class)
        if isinstance(cls, str):
            if ":" not in cls:
                raise ValueError(f"{self.kind} '{name}': '{cls}' must look like module:class")
        else:
            cls = self._checked(cls)
            name = self._name_of(cls, name)
        self._discover()
        existing = self._entries.get(name, cls)
        if _path(existing) != _path(cls):
            raise ValueError(f"{self.kind} '{name}' is already registered: {_path(existing)}")
        self._entries[name] = cls
        return cls

    def resolve(self, name_or_class: str | type) -> type:
        """Return the class for a registered name or a path ``"module:class"``; a class is returned unchanged.

        Raises:
            ValueError: for an unknown name, or a class of the wrong kind.
        """
        if not isinstance(name_or_class, str):
            return self._checked(name_or_class)
        if ":" in name_or_class and name_or_class not in self:
            return self._checked(import_place(self.kind, name_or_class))
        if name_or_class not in self and (place := _class_of_file(name_or_class)):
            raise ValueError(f"unknown {self.kind} '{name_or_class}'; did you mean '{place}'?")
        found: type = self.find(name_or_class)
        return found

    def class_of(self, source: object) -> Any:
        """Return the class for a registered name, a path, a class or an object, see `resolve`."""
        return self.resolve(source if isinstance(source, str | type) else type(source))

    def make(self, name_or_class: object, *arguments: object, **options: object) -> Any:
        """Return an object of a class of this registry.

        Args:
            name_or_class: registered name, path ``"module:class"``, class, or an object, which is returned unchanged.
            *arguments: positional arguments of the class, which are not options.
            **options: keyword arguments of the class.

        Raises:
            ValueError: for an unknown name, an option that the class does not take, or a value of the wrong type.
        """
        if not isinstance(name_or_class, str | type):
            made = name_or_class
            if not isinstance(made, self._base_class()):
                raise ValueError(
                    f"a {self.kind} must be a registered name, 'module:class', a subclass of "
                    f"{self._base.replace(':', '.')} or an object of one, got {brief(made)}"
                )
            if options:
                raise ValueError(
                    f"{self.kind} '{_shown(type(made))}' is already an object: it cannot take {', '.join(options)}"
                )
            return made
        cls = self.resolve(name_or_class)
        shown = name_or_class if isinstance(name_or_class, str) else _shown(cls)
        check_options(f"{self.kind} '{shown}'", cls, len(arguments), options)
        return cls(*arguments, **options)

    # -- details ----------------------------------------------------------------------------------------------------

    def _base_class(self) -> type:
        module, _, name = self._base.partition(":")
        return getattr(import_module(module), name)

    def _checked(self, cls: object) -> type:
        if not (isinstance(cls, type) and issubclass(cls, self._base_class())):
            raise ValueError(f"a {self.kind} must be a subclass of {self._base.replace(':', '.')}, got {cls!r}")
        return cls

    def _name_of(self, cls: type, name: str) -> str:
        """Return the name to register a class under, and assign it to a class without a name."""
        own: str = vars(cls).get("name", "")
        name = name or own or getattr(cls, "name", "")
        if not name:
            raise ValueError(f"{self.kind} class {_path(cls)} has no name: define its attribute 'name'")
        if own and own != name:
            raise ValueError(f"{self.kind} class {_path(cls)} is named '{own}': it cannot be registered as '{name}'")
        cls.name = name  # type: ignore[attr-defined]
        return name


def import_object(kind: str, path: str) -> Any:
    """Return the object at a path ``"module:name"``, or the module at a path without a name.

    Args:
        kind: what the object should be, for messages: ``"robot"``, ...
        path: the path.

    Raises:
        ValueError: if there is no such module, or no such name in it.
    """
    name_of_module, _, name = path.partition(":")
    try:
        module = import_module(name_of_module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name_of_module}.".startswith(f"{error.name}."):
            raise  # the module exists, but one that it imports does not
        raise ValueError(f"{kind} '{path}': there is no module '{name_of_module}'") from None
    if not name:
        return module
    if not hasattr(module, name):
        near = get_close_matches(name, [each for each in vars(module) if not each.startswith("_")], n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ValueError(f"{kind} '{path}': module '{name_of_module}' has no '{name}'{hint}")
    return getattr(module, name)


ALLOW_CODE = "SOFTGYM_ALLOW_CODE"
"""Environment variable: places of code that files may name, separated by commas; ``1`` for all."""

_PLACE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_place(text: object) -> bool:
    """Return whether a value names code by its place, ``"module:name"``."""
    return isinstance(text, str) and _PLACE.fullmatch(text) is not None


def allow_code(*places: str) -> None:
    """Let files name code at some places ``"module:name"``, also in processes started from now on; ``"1"`` for all."""
    known = [place for place in os.environ.get(ALLOW_CODE, "").split(",") if place]
    if places:
        os.environ[ALLOW_CODE] = ",".join(dict.fromkeys([*known, *places]))


def code_is_allowed(place: str) -> bool:
    """Return whether a file may name the code at a place ``"module:name"``, see `allow_code`."""
    return not {"1", place}.isdisjoint(os.environ.get(ALLOW_CODE, "").split(","))


def import_place(kind: str, place: str) -> Any:
    """Return the object at a place ``"module:name"`` that the user named; files may name it from now on.

    What files name is checked where they are read (`softgym_envs.config.refuse_code`).

    Raises:
        ValueError: as `import_object`.
    """
    found = import_object(kind, place)
    allow_code(place)
    return found


@cache  # looking up the types of a constructor takes milliseconds
def options_of(cls: type) -> Mapping[str, tuple[inspect.Parameter, Any]]:
    """Return the keyword arguments of a class by name, each with its resolved type.

    A constructor that takes ``**options`` passes them on to the next base class with its own constructor.
    """
    found: dict[str, tuple[inspect.Parameter, Any]] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base) or base is object:
            continue
        init = vars(base)["__init__"]
        try:
            types_of = get_type_hints(init)
        except NameError:  # an annotation that only type checkers import
            types_of = {}
        parameters = list(inspect.signature(init).parameters.values())[1:]
        for p in parameters:
            if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY):
                found.setdefault(p.name, (p, types_of.get(p.name, Any)))
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    return types.MappingProxyType(found)


def check_options(owner: str, cls: type, positional: int, options: Mapping[str, object]) -> None:
    """Check the options of a class against its signature and the type annotations in it.

    Args:
        owner: what takes the options, for messages: ``"robot 'finger'"``.
        cls: the class.
        positional: number of leading arguments that are not options.
        options: keyword arguments.

    Raises:
        ValueError: for an unknown or missing option, or a value of the wrong type.
    """
    allowed = dict(list(options_of(cls).items())[positional:])
    for name, value in options.items():
        if name not in allowed:
            raise ValueError(f"{owner}: {unknown_name('option', name, allowed)}")
        _, annotation = allowed[name]
        if not is_a(value, annotation):
            raise ValueError(f"{owner}: option {name} = {brief(value)} must be {described(annotation)}")
    missing = [name for name, (p, _) in allowed.items() if p.default is p.empty and name not in options]
    if missing:
        raise ValueError(f"{owner} needs the option {' and '.join(missing)}")


def class_path(cls: type) -> str:
    """Return the path ``"module:class"`` from which other processes import a class.

    The module of a class in the running script is the script's file, as if it were imported.

    Raises:
        ValueError: for a class that cannot be imported: one defined inside a function or in an interactive session.
    """
    module = cls.__module__
    if module == "__main__":
        import __main__

        spec, file = getattr(__main__, "__spec__", None), getattr(__main__, "__file__", None)
        module = spec.name if spec is not None else Path(file).stem if file else "__main__"
    if module == "__main__" or "." in cls.__qualname__:
        raise ValueError(f"class {_path(cls)} cannot be imported by other processes: define it at the top of a module")
    return f"{module}:{cls.__qualname__}"


def _shown(cls: type) -> str:
    return getattr(cls, "name", cls.__name__)


def _path(entry: Any) -> str:
    if isinstance(entry, str):
        return entry
    owner = entry if hasattr(entry, "__qualname__") else type(entry)
    return f"{owner.__module__}:{owner.__qualname__}"

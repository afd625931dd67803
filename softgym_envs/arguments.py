"""Arguments of the wrong kind, such as a text for numbers: one line that names the argument, whatever failed inside."""

from __future__ import annotations

import functools
import inspect
import linecache
import numbers
import traceback
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from softgym_envs.errors import SoftGymError
from softgym_envs.wording import brief, counted

T = TypeVar("T")
Annotation: TypeAlias = Any

FOREIGN = (TypeError, ValueError, AttributeError, IndexError, KeyError, ArithmeticError)
"""What code raises that meets a value of the wrong kind."""

_KNOWN = frozenset({"softgym_envs", "numpy", "scipy", "pathlib", "meshio"})
"""Packages whose code runs inside of calls; all other code is the caller's."""

_OWN = ("self", "cls")

_KINDS: tuple[type, ...] = (str, bool, int, float)
PLAIN: dict[Any, type] = {**{kind: kind for kind in _KINDS}, **{kind.__name__: kind for kind in _KINDS}}
"""Annotations that are checked at each call, also as they stand in a source with postponed annotations."""


def explained(target: T) -> T:
    """Name the argument of the wrong kind where a function, or any public method of a class, fails because of one.

    Texts, flags and single numbers are checked at each call. After an exception that no code of the suite raised on
    purpose, all arguments are compared with the annotations of the function. If they fit, the line has all of them and
    what was raised inside. Exceptions of code that the caller passed are left as they are.
    """
    if isinstance(target, type):
        for name, member in list(vars(target).items()):
            if name.startswith("_") and name not in ("__init__", "__post_init__"):
                continue
            if isinstance(member, classmethod | staticmethod):
                setattr(target, name, type(member)(_explained(member.__func__, f"{target.__name__}.{name}")))
            elif inspect.isfunction(member) and name != "__post_init__":
                owner = target.__name__ if name == "__init__" else f"{target.__name__}.{name}"
                setattr(target, name, _explained(member, owner))
        return target
    return _explained(target, target.__name__)  # type: ignore[arg-type, attr-defined, return-value]


def _explained(function: Callable[..., Any], owner: str) -> Callable[..., Any]:
    names = list(inspect.signature(function).parameters)
    simple = {name: PLAIN[given] for name, given in function.__annotations__.items() if given in PLAIN}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        for name, value in (*zip(names, args, strict=False), *kwargs.items()) if simple else ():
            if name in simple and not is_a(value, simple[name]):
                raise ValueError(f"{owner}: {name} = {brief(value)} must be {described(simple[name])}")
        try:
            return function(*args, **kwargs)
        except SoftGymError:
            raise
        except FOREIGN as error:
            frames = list(traceback.walk_tb(error.__traceback__))[1:]
            if not frames:  # of the call itself: too many, missing or unknown arguments, which Python names
                raise
            if _is_raised(error):
                if isinstance(error, ValueError) and "\n" in str(error):
                    raise ValueError(" ".join(str(error).split())) from None
                raise
            if any(_package(frame) not in _KNOWN for frame, _ in frames):
                raise
            given = inspect.signature(function).bind(*args, **kwargs).arguments
            if (wrong := _wrong_argument(function, given)) is not None:
                raise ValueError(f"{owner}: {wrong}") from None
            shown = ", ".join(f"{name} = {_shape(value)}" for name, value in given.items() if name not in _OWN)
            raise ValueError(f"{owner} cannot take {shown}: {' '.join(str(error).split())}") from error

    return call


def _is_raised(error: BaseException) -> bool:
    """Whether a statement ``raise`` of the suite raised an exception, and not an operation that failed."""
    for frame, line in [*traceback.walk_tb(error.__traceback__)][-1:]:
        source = linecache.getline(frame.f_code.co_filename, line, frame.f_globals)
        return _package(frame) == "softgym_envs" and source.lstrip().startswith("raise ")
    return False


def _package(frame: types.FrameType) -> str:
    return str(frame.f_globals.get("__name__", "")).split(".")[0]


def _wrong_argument(function: Callable[..., Any], given: Mapping[str, Any]) -> str | None:
    """Return which argument does not fit its annotation; None if all fit."""
    for name, value in given.items():
        annotation = _resolved(function, name)
        if not is_a(value, annotation):
            return f"{name} = {brief(value)} must be {described(annotation)}"
    return None


def _shape(value: object) -> str:
    """Return a value in few words, of a large array its shape."""
    if isinstance(value, np.ndarray) and value.size > 6:
        return f"an array of shape {value.shape}"
    return brief(value, 60)


def _resolved(function: Callable[..., Any], name: str) -> Annotation:
    """Return the annotation of an argument; Any where there is none, or only type checkers know it."""
    given = function.__annotations__.get(name, Any)
    if not isinstance(given, str):
        return given
    try:
        return eval(given, {"ArrayLike": ArrayLike, **function.__globals__})  # noqa: S307 - the function's own source
    except (NameError, TypeError, AttributeError):
        return Any


def is_a(value: Any, annotation: Annotation) -> bool:
    """Whether a value matches an annotated type; annotations that say nothing about kinds accept everything."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation is ArrayLike or annotation is np.ndarray or origin is np.ndarray:
        return _is_numeric(value)
    if origin in (Union, types.UnionType):
        return any(is_a(value, each) for each in arguments)
    if origin is Literal:
        return isinstance(value, str | int | type(None)) and value in arguments
    if annotation is None or annotation is type(None):
        return value is None
    if annotation is float:
        single = isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
        return single or (isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf")
    if annotation is int:
        return isinstance(value, numbers.Integral) and not isinstance(value, bool | np.bool_)
    if annotation is bool:
        return isinstance(value, bool | np.bool_)
    if annotation is str:
        return isinstance(value, str)
    if origin is tuple and Ellipsis not in arguments:
        # Lists are accepted: configuration files have no tuples.
        return _is_sequence(value) and len(value) == len(arguments) and all(map(is_a, value, arguments))
    if origin in (Sequence, Iterable) or (origin is tuple and Ellipsis in arguments):
        inner = arguments[0] if arguments else Any
        return _is_sequence(value) and all(is_a(each, inner) for each in value)
    if origin is Mapping or annotation is Mapping:
        return isinstance(value, Mapping)
    if origin is Callable or annotation is Callable:
        return callable(value)
    if isinstance(annotation, type) and annotation is not object and annotation.__module__.startswith("softgym_envs"):
        return isinstance(value, annotation)
    return True


def _is_sequence(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Sequence | Iterable) and not isinstance(value, str | bytes | Mapping)


def _is_numeric(value: object) -> bool:
    """Whether a value is one number, or numbers in rows of equal lengths."""
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except (ValueError, TypeError, OverflowError):
        return False


def described(annotation: Annotation) -> str:
    """Return what a value of an annotated type is, in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation is ArrayLike or annotation is np.ndarray or origin is np.ndarray:
        return "numbers in rows of equal lengths"
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(described, arguments)))
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin is tuple and set(arguments) <= {int, float}:
        return counted(len(arguments), "number")
    if origin in (Sequence, Iterable, tuple):
        if not arguments or arguments[0] is Any:
            return "a list"
        plural = {str: "strings", int: "integers", float: "numbers"}.get(arguments[0])
        return f"a list of {plural}" if plural else f"a list, each of which is {described(arguments[0])}"
    if origin is Mapping or annotation is Mapping:
        return "a mapping from names to values"
    if origin is Callable or annotation is Callable:
        return "a function"
    words = {float: "a number", int: "an integer", bool: "true or false", str: "a string", type(None): "none"}
    return str(words.get(annotation) or getattr(annotation, "__name__", annotation))


def choice(name: str, value: object, allowed: Iterable[str]) -> str:
    """Return the value of an argument, which must be one of some words.

    Raises:
        ValueError: for another word, or no word at all.
    """
    allowed = list(allowed)
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name} = {brief(value)} is unknown; allowed: {', '.join(map(repr, allowed))}")
    return value

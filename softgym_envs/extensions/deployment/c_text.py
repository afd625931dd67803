"""Numbers, arrays and comments as C source."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from string import Template

import numpy as np

_HERE = Path(__file__).parent


def check_identifier(name: str) -> None:
    """Raise ``ValueError`` unless a name can be the prefix of C identifiers."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(
            f"name = {name!r} is not a C identifier; allowed: a letter, then letters, digits and underscores"
        )


def number(value: float) -> str:
    """Return the shortest decimal that a compiler reads as this float32."""
    single = np.float32(value)
    plain = np.format_float_positional(single, unique=True, trim="0")
    short = np.format_float_scientific(single, unique=True, trim="0", exp_digits=1)
    return (plain if len(plain) <= len(short) else short) + "f"


def initialiser(array: np.ndarray, indent: str = "    ") -> str:
    """Return an array as a C initialiser, in lines of at most 120 characters."""
    if array.ndim > 1:
        return "{\n" + ",\n".join(indent + initialiser(part, indent + "    ") for part in array) + "}"
    lines, line = [], ""
    for text in map(number, array):
        if line and len(indent) + len(line) + len(text) > 114:
            lines.append(line)
            line = ""
        line += f"{text}, "
    return "{" + f"\n{indent}".join(each.rstrip() for each in [*lines, line.rstrip(", ")]) + "}"


def comment(lines: Iterable[str]) -> str:
    """Return a C comment; ``/*`` and ``*/`` in the text are separated by a space."""
    text = "\n".join(f" * {line}".rstrip() for line in (x.replace("*/", "* /").replace("/*", "/ *") for x in lines))
    return f"/*\n{text}\n */\n"


def names_of(name: str, many: bool = False) -> dict[str, str]:
    """Return what templates call their prefix and, for functions of ``many`` bodies, the argument that holds one."""
    names = {"p": name, "P": name.upper(), "of": f"{name}_", "takes": "", "gives": ""}
    if many:
        names |= {"of": "body->", "takes": f"const {name}_body *body, ", "gives": "body, "}
    return names


def functions(file: str, names: Mapping[str, object]) -> str:
    """Return C functions from a template of this folder."""
    return Template((_HERE / f"{file}.h.in").read_text()).substitute(names)


def definitions(constants: Mapping[str, tuple[str, np.ndarray]], sizes: Mapping[str, str], name: str) -> list[str]:
    """Return constants in single precision as C.

    Args:
        constants: name to shape and values; a shape names its sizes by letters, ``"[N][H]"``.
        sizes: letter to the macro, without prefix.
        name: prefix.
    """
    lines = []
    for key, (shape, array) in constants.items():
        value = initialiser(array) if array.ndim else number(float(array))
        lines.append(f"static const float {name}_{key}{dimensions(shape, sizes, name)} = {value};")
    return lines


def dimensions(shape: str, sizes: Mapping[str, str], name: str) -> str:
    """Return a shape with its sizes by their macros."""
    return re.sub(r"\w", lambda letter: f"{name.upper()}_{sizes[letter.group()]}", shape)


def single_precision(
    constants: Mapping[str, tuple[str, np.ndarray]], sizes: Mapping[str, int]
) -> dict[str, tuple[str, np.ndarray]]:
    """Return constants in single precision.

    Raises:
        ValueError: for values that are not finite then.
    """
    singles = {}
    with np.errstate(over="ignore"):
        for key, (shape, array) in constants.items():
            single = np.asarray(array).astype(np.float32)
            if not np.isfinite(single).all():
                raise ValueError(f"'{key}' holds values that are not finite in single precision")
            assert single.shape == tuple(sizes[letter] for letter in re.findall(r"\w", shape)), key
            singles[key] = (shape, single)
    return singles

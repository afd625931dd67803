"""Numbers, arrays and comments as C source."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np


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

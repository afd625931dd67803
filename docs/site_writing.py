"""How the generated parts of the documentation are written: names, numbers, tables, sections, docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs import ENVIRONMENTS
from softgym_envs.envs.tasks.registry import TASKS
from softgym_envs.units import display

DOCS = Path(__file__).resolve().parent
HERE = "<!-- generated -->"
"""Where a page's own section takes the generated text."""


def page_name(identifier: str) -> str:
    """Return the name of an environment's page: ``finger_reach`` for ``SoftGym/FingerReach-v0``."""
    stem = identifier.split("/")[-1].rsplit("-v", 1)[0]
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", stem).lower()


def environment_pages() -> dict[str, str]:
    """Return the ID of every environment by the name of its page; of several versions, the last."""
    return {page_name(identifier): identifier for identifier in ENVIRONMENTS}


def summary(identifier: str) -> str:
    """Return the task of an environment in one sentence."""
    task = TASKS[ENVIRONMENTS[identifier].task]
    text = inspect.getmodule(task).__doc__ or task.__doc__ or ""
    sentence = code(first_sentence(text.partition(":")[2].strip() or text))
    return sentence[:1].upper() + sentence[1:]


def describes(page: str) -> bool:
    """Return whether a page has a hand-written description of at least one paragraph."""
    text = re.sub(r"<!--.*?-->", "", dict(split(page)).get("Description", ""), flags=re.DOTALL)
    return len(text.split()) >= 30


# -- writing --------------------------------------------------------------------------------------------------------


def number(value: float) -> str:
    """Write a number with up to six digits: ``3e6``, not ``3e+06``."""
    return re.sub(r"e([+-])0*(\d+)", lambda m: f"e{m[1].strip('+')}{m[2]}", f"{value:.6g}")


def written(unit: str) -> str:
    """Write the unit in which people read quantities in an SI unit: mm, cm³, °."""
    return display(unit).unit.replace("deg", "°").replace("m3", "m³")


def quantity(value: float, unit: str) -> str:
    """Write an SI value in the unit that people read."""
    return f"{number(value * display(unit).factor)} {written(unit)}".strip()


def span(low: float, high: float, unit: str) -> str:
    """Write a range in the unit that people read."""
    factor = display(unit).factor
    return f"{number(low * factor)} to {number(high * factor)} {written(unit)}"


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
    """Split a page at its second-level headings; the text before them has the heading ``""``."""
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
    """Complete a page with the sections of a template; further sections of the page keep their place.

    Args:
        page: Markdown, with a title.
        top: text under the title.
        template: function that writes each section, by heading, in order.
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


def picture_file(*names: str) -> str:
    """Return the first file of ``docs/images`` that exists, films before pictures, or an empty text."""
    files = (f"{name}{ending}" for name in names for ending in (".webp", ".png"))
    return next((file for file in files if (DOCS / "images" / file).is_file()), "")


def picture(*names: str, alt: str) -> str:
    """Show the first film or picture of ``docs/images`` that exists, or nothing."""
    file = picture_file(*names)
    return f"![{alt}](../images/{file}){{ .robot }}" if file else ""


# -- docstrings -----------------------------------------------------------------------------------------------------


def described_arguments(cls: type) -> dict[str, str]:
    """Return the texts of the ``Args:`` of a class and its bases (or ``Attributes:``, of records), by argument."""
    texts: dict[str, str] = {}
    for base in cls.__mro__:
        found = re.search(
            r"^(?:Args|Attributes):\n((?:[ ]+.*\n?|\n)+)", inspect.cleandoc(base.__doc__ or ""), flags=re.MULTILINE
        )
        if base is object or found is None:
            continue
        for name, words in re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", found[1], flags=re.MULTILINE):
            texts.setdefault(name, code(" ".join(words.split())))
    return texts


def options_of(cls: type, given: Mapping[str, Any] | None = None) -> list[list[str]]:
    """Return a row for each keyword argument of a class: name, default or given value, meaning."""
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

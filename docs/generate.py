"""Hook of mkdocs that completes pages from the registries.

The page of an environment or a robot contains what is particular to it. Every section of the template that the page
leaves out is generated here, in the order of the template. Where a page has such a section itself, its text is used,
and the generated text replaces the line ``<!-- generated -->`` in it, if there is one.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from site_api import PACKAGES, api_index, api_page
from site_benchmark import benchmark_page
from site_environments import environment_sections, environment_top
from site_notebooks import PAGES, notebooks
from site_robots import model_facts, robot_of, robot_sections
from site_writing import (
    DOCS,
    HERE,
    code,
    compose,
    describes,
    environment_pages,
    first_sentence,
    picture,
    picture_file,
    summary,
)

from softgym_envs import ENVIRONMENTS
from softgym_envs.robots import ROBOTS


def missing_pages() -> list[str]:
    """Return the pages of registered environments and robots that are missing or have no description."""
    wanted = [f"environments/{name}.md" for name in environment_pages()] + [f"robots/{name}.md" for name in ROBOTS]
    return [page for page in wanted if not (DOCS / page).is_file() or not describes((DOCS / page).read_text())]


# -- lists ----------------------------------------------------------------------------------------------------------


def title_of(page: str) -> str:
    """Return the title of a page of `docs`."""
    return (DOCS / page).read_text().partition("\n")[0].removeprefix("# ").strip()


def cards(entries: Iterable[tuple[str, Sequence[str], str]]) -> str:
    """Return a grid of cards, each from a page, names of pictures or films and a text."""
    items = []
    for page, images, text in entries:
        shown = picture_file(*images)
        alt = f"{title_of(page)}, in motion" if shown.endswith(".webp") else title_of(page)
        image = f"[![{alt}](../images/{shown})]({Path(page).name})\n\n    " if shown else ""
        items.append(f"-   {image}**[{title_of(page)}]({Path(page).name})**\n\n    {text}")
    return '<div class="grid cards" markdown>\n\n' + "\n\n".join(items) + "\n\n</div>"


def environment_list() -> str:
    """Return the cards of all environments that have a page."""
    return cards(
        (f"environments/{name}.md", (name, ENVIRONMENTS[identifier].robot), f"`{identifier}`<br>{summary(identifier)}")
        for name, identifier in environment_pages().items()
        if (DOCS / f"environments/{name}.md").is_file()
    )


def gallery() -> str:
    """Return the cards of the films of all environments, for a page in the folder of the documentation."""
    entries = ((f"environments/{page}.md", (page,), f"`{name}`") for page, name in environment_pages().items())
    text = cards(entry for entry in entries if picture_file(*entry[1]).endswith(".webp"))
    return re.sub(r"\]\((\w+\.md)\)", r"](environments/\1)", text).replace("(../images/", "(images/")


def robot_list() -> str:
    """Return the cards of all robots that have a page."""
    entries = []
    for name in ROBOTS:
        if (DOCS / f"robots/{name}.md").is_file():
            robot = robot_of(name)
            count = len(robot.actuators)
            numbers = f"{count} actuator{'s' * (count > 1)}, {len(robot.design_space)} design variables"
            text = code(first_sentence(type(robot).__doc__ or ""))
            entries.append((f"robots/{name}.md", (name,), f"`{name}`<br>{text}<br>{numbers}"))
    return cards(entries)


# -- studies --------------------------------------------------------------------------------------------------------

ROOT = DOCS.parent
OUTSIDE = ("studies", "benchmarks")
"""Folders beside the documentation whose pages, pictures and results are part of the site."""


def study_files() -> list[Path]:
    """Return pages, pictures and results of the folders outside, relative to the root, the index of studies first."""
    kinds = ("md", "png", "svg", "json")
    files = [path for folder in OUTSIDE for kind in kinds for path in (ROOT / folder).rglob(f"*.{kind}")]
    return sorted(
        (path.relative_to(ROOT) for path in files), key=lambda path: (path != Path("studies/README.md"), path)
    )


def site_links(markdown: str, uri: str) -> str:
    """Return a page whose links to and from the folders outside are those of the site.

    On disk pages of the documentation stand in ``docs``, and the folders outside beside it; on the site, all stand
    under one root.

    Args:
        markdown: the page.
        uri: its path on the site.
    """
    here = os.path.dirname(uri)
    outside = uri.startswith(OUTSIDE)

    def replace(match: re.Match[str]) -> str:
        target = os.path.normpath(os.path.join("" if outside else "docs", here, match[1]))
        if not outside and not target.startswith(OUTSIDE):
            return match[0]
        return f"]({os.path.relpath(target.removeprefix('docs/'), here or '.')}"

    return re.sub(r"\]\(((?:\.\./)+[\w/.-]+)", replace, markdown)


# -- events of mkdocs -----------------------------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    """Put the pages of the registries into the navigation, behind the index of their section."""
    if pages := missing_pages():
        raise SystemExit(f"docs: pages that are missing, or have no description: {', '.join(pages)}")
    generated = {
        "Environments": [f"environments/{name}.md" for name in environment_pages()],
        "Robots": [f"robots/{name}.md" for name in ROBOTS],
        "API reference": [f"reference/{package}.md" for package in PACKAGES],
        "Studies": [str(path) for path in study_files() if path.suffix == ".md" and path.parts[1] != "README.md"],
    }
    _complete(config.nav, generated)
    return config


def _complete(entries: list[Any], generated: dict[str, list[str]]) -> None:
    """Add generated pages to the sections of their titles, at any depth."""
    for entry in entries:
        for title, pages in entry.items() if isinstance(entry, dict) else ():
            if isinstance(pages, list):
                _complete(pages, generated)
                pages += generated.get(title, [])


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the reference; leave out pages of environments that are not registered."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "reference/index.md", content=api_index()))
    for package in PACKAGES:
        files.append(File.generated(config, f"reference/{package}.md", content=api_page(package)))
    for path, content in notebooks().items():
        files.append(File.generated(config, path, content=content))
    for path in study_files():
        files.append(File.generated(config, str(path), abs_src_path=str(ROOT / path)))
    known = {f"environments/{name}.md" for name in (*environment_pages(), "index")}
    for file in list(files):
        if file.src_uri.startswith("environments/") and file.src_uri.endswith(".md") and file.src_uri not in known:
            files.remove(file)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Complete a page from the registries, and its links to studies."""
    return site_links(completed(markdown, page), page.file.src_uri)


def completed(markdown: str, page: Any) -> str:
    """Return a page with what comes from the registries."""
    folder, _, name = page.file.src_uri.removesuffix(".md").rpartition("/")
    if name == "index":
        lists = {"environments": environment_list, "robots": robot_list}
        return markdown.replace(HERE, lists[folder]()) if folder in lists else markdown
    if page.file.src_uri.removesuffix(".md") in PAGES:
        return f"{markdown}\n\n[This page as a notebook]({name}.ipynb){{ download }}\n"
    if page.file.src_uri == "benchmark.md":
        return benchmark_page(markdown)
    if page.file.src_uri == "gallery.md":
        return markdown.replace(HERE, gallery())
    if folder == "environments":
        identifier = environment_pages()[name]
        return compose(markdown, environment_top(identifier), environment_sections(identifier))
    if folder == "robots" and name in ROBOTS:
        facts = dict(model_facts(robot_of(name)))
        markdown = re.sub(r"\{\{ (\w+) \}\}", lambda match: facts[match[1]], markdown)
        shown = picture(name, alt=f"The {title_of(page.file.src_uri)} at rest and actuated")
        return compose(markdown, f"`{name}`\n\n{shown}", robot_sections(name))
    return markdown

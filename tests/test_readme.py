"""The README and the documentation: files they name exist, and their numbers are those of the recorded results."""

import re
from pathlib import Path

import pytest

from benchmarks import page as bench
from benchmarks import recorded as results
from softgym_envs.errors import DataError

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_exist_and_nothing_is_left_to_fill_in(page):
    text = page.read_text()
    assert not re.search(r"@[A-Z]{3,}@|TODO|TBD", text)
    for target in re.findall(r"\]\(([^)#]+)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target
    for target in re.findall(r"configs/[\w/]+\.yaml", text):
        assert (ROOT / target).exists(), target


def test_the_readme_is_a_landing_page():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    for line in lines:
        assert len(line) <= 120 or line.startswith("|"), line
        assert all(len(cell) <= 200 for cell in line.split("|")), "a paragraph in a cell"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_numbers_are_those_of_the_results(page):
    """`python -m benchmarks.page` would change nothing."""
    text = page.read_text()
    assert bench.fill(text) == text, f"run python -m benchmarks.page ({page.name})"
    # A comment at the start of a line begins a block of raw HTML, which would split a paragraph.
    assert not re.search(r"^ *<!-- bench: [^\n]+? :: ", text, flags=re.MULTILINE)
    assert (
        len(re.findall("<!-- bench: ", text))
        == len(re.findall("<!-- /bench -->", text))
        == len(bench.MARKER.findall(text))
    )


@pytest.fixture
def recorded(monkeypatch):
    entry = {"results": {"a: error [mm]": 0.00018, "b: error [mm]": 2.5, "pair": [1.0, 2.0], "text": "3 of 4"}}
    monkeypatch.setattr(results, "records", lambda: {"speed": entry})
    results.results.cache_clear()
    yield
    results.results.cache_clear()


@pytest.mark.parametrize(
    ("marker", "text"),
    [
        ("speed :: b: error [mm] :: .2f", "2.50"),
        ("speed :: a: error [mm] :: .1e", "1.8e-4"),
        ("speed :: *: error [mm] :: max.1f", "2.5"),
        ("speed :: *: error [mm] :: min.1e", "1.8e-4"),
        ("speed :: pair :: [1].0f", "2"),
        ("speed :: text", "3 of 4"),
    ],
)
def test_a_marker_is_filled_with_its_result(recorded, marker, text):
    page = f"before <!-- bench: {marker} -->stale<!-- /bench --> after"
    assert bench.fill(page) == f"before <!-- bench: {marker} -->{text}<!-- /bench --> after"


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        ("speed :: c", "0 results named 'c'"),
        ("speed :: *: error [mm] :: .1f", r"2 results named '\*: error \[mm\]'"),
        ("spede :: a", "no results of benchmark 'spede'; recorded: speed"),
        ("headline", "no table 'headline'; allowed: headlines"),
    ],
)
def test_a_wrong_marker_is_refused(recorded, marker, message):
    with pytest.raises(DataError, match=message):
        bench.fill(f"<!-- bench: {marker} --><!-- /bench -->")

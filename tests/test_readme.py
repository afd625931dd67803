"""The README and the documentation: files they name exist, and their numbers are those of the recorded results."""

import importlib.util
import re
from pathlib import Path

import pytest

from softgym_envs.errors import DataError

ROOT = Path(__file__).resolve().parent.parent
SPEC = importlib.util.spec_from_file_location("docs_figures", ROOT / "docs" / "figures.py")
figures = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(figures)
GUIDES = figures.pages()
STUDIES = sorted((ROOT / "studies").rglob("*.md"))


def name_of(page):
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", [*GUIDES, *STUDIES], ids=name_of)
def test_links_exist_and_nothing_is_left_to_fill_in(page):
    text = page.read_text()
    assert not re.search(r"@[A-Z]{3,}@|TODO|TBD", text)
    for target in re.findall(r"\]\(([^)#]+)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target
    for target in re.findall(r"configs/[\w/]+\.yaml", text) if page in GUIDES else ():  # studies are frozen
        assert (ROOT / target).exists(), target


def test_the_readme_is_a_landing_page():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    for line in lines:
        assert len(line) <= 120 or line.startswith("|"), line
        assert all(len(cell) <= 200 for cell in line.split("|")), "a paragraph in a cell"


@pytest.mark.parametrize("page", GUIDES, ids=name_of)
def test_numbers_are_those_of_the_results(page):
    """`python docs/figures.py` would change nothing."""
    text = page.read_text()
    assert figures.fill(text) == text, f"run python docs/figures.py ({page.name})"
    # A comment at the start of a line begins a block of raw HTML, which would split a paragraph.
    assert not re.search(r"^ *<!-- figure: [^\n]+? :: ", text, flags=re.MULTILINE)
    assert (
        len(re.findall("<!-- figure: ", text))
        == len(re.findall("<!-- /figure -->", text))
        == len(figures.MARKER.findall(text))
    )


@pytest.mark.parametrize("study", [path.parent for path in STUDIES if path.parent.name != "studies"], ids=name_of)
def test_a_study_says_what_it_is(study):
    """A question, the commit at which it is frozen, and the command that makes its results."""
    text = (study / "README.md").read_text()
    assert text.startswith("# ") and "<!-- figure: " not in text
    for heading in ("Question", "Answer", "Frozen at"):
        assert f"\n**{heading}" in text, heading
    assert f"({study.name}/README.md)" in (ROOT / "studies" / "README.md").read_text(), "not in studies/README.md"


@pytest.fixture
def recorded(monkeypatch):
    entry = {"results": {"a: error [mm]": 0.00018, "b: error [mm]": 2.5, "pair": [1.0, 2.0], "text": "3 of 4"}}
    monkeypatch.setattr(figures, "records", lambda: {"speed": entry})


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
    page = f"before <!-- figure: {marker} -->stale<!-- /figure --> after"
    assert figures.fill(page) == f"before <!-- figure: {marker} -->{text}<!-- /figure --> after"


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        ("speed :: c", "0 results named 'c'"),
        ("speed :: *: error [mm] :: .1f", r"2 results named '\*: error \[mm\]'"),
        ("spede :: a", "no record 'spede'; allowed: speed"),
        ("headline", "'headline' is no table; allowed: headlines, trust"),
    ],
)
def test_a_wrong_marker_is_refused(recorded, marker, message):
    with pytest.raises(DataError, match=message):
        figures.fill(f"<!-- figure: {marker} --><!-- /figure -->")

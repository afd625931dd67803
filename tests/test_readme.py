"""The README keeps its promises about files."""

import re
from pathlib import Path

import pytest

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

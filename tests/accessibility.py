"""What a page owes to users of keyboards and screen readers, as far as its HTML tells."""

from __future__ import annotations

from collections import Counter
from html.parser import HTMLParser

VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}
NAMED = ("a", "button", "h1", "h2", "h3", "h4")
"""Elements that need a text, or a label."""


def defects(html: str) -> list[str]:
    """Return the defects of a page, one line each."""
    page = _Page()
    page.feed(html)
    found = list(page.found)
    if not page.language:
        found.append("the page has no language")
    if not page.title:
        found.append("the page has no title")
    if page.headings.count(1) != 1 or page.headings[0] != 1:
        found.append(f"the levels of the headings are {page.headings}: one heading of level 1 comes first")
    jumps = [(a, b) for a, b in zip(page.headings, page.headings[1:], strict=False) if b > a + 1]
    found += [f"a heading of level {b} follows one of level {a}" for a, b in jumps]
    found += [f"{n} regions are called '{label}'" for label, n in Counter(page.regions).items() if n > 1]
    return found


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.headings: list[int] = []
        self.regions: list[str] = []
        self.language = self.title = ""
        self._cells: list[str] = []
        self._open: list[tuple[str, dict[str, str | None], list[str]]] = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "html":
            self.language = given.get("lang")
        if tag == "img":
            if not given.get("alt"):
                self.found.append(f"an image has no alternative text: {str(given.get('src'))[:60]}")
            self.handle_data(given.get("alt") or "")
        if given.get("role") == "region":
            self.regions.append(given.get("aria-label") or "")
        if len(tag) == 2 and tag[0] == "h" and tag[1].isdigit():
            self.headings.append(int(tag[1]))
        if tag not in VOID:
            self._open.append((tag, given, []))

    def handle_data(self, data):
        for _, _, texts in self._open:
            texts.append(data)

    def handle_endtag(self, tag):
        if not any(name == tag for name, _, _ in self._open):
            return
        name, given, texts = self._open.pop()
        while name != tag:  # elements without an end, such as <p>
            name, given, texts = self._open.pop()
        text = "".join(texts).strip()
        if tag == "title":
            self.title = self.title or text
        if tag == "th":
            self._cells.append(text)
        if tag == "tr":
            # A row of empty cells only, as Markdown makes it for a table without a head, is not shown. The corner above
            # the names of the rows may be empty.
            if any(self._cells) and not all(self._cells[1:]):
                self.found.append(f"a column has no title: {self._cells}")
            self._cells = []
        linked = tag != "a" or "href" in given
        if tag in NAMED and linked and not (text or given.get("aria-label") or given.get("title")):
            self.found.append(f"an element <{tag}> has no text: {given}")

"""The site of docs/ is built strictly, needs nothing of the network, and has every public name with its docstring."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from documented import PAGES, ROOT, SITE, prose

import bbfit

# Elements that a browser loads something for, with the attribute that says what.
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "video": "src", "object": "data"}
CONFIGS = [name for name in bbfit.__all__ if dataclasses.is_dataclass(getattr(bbfit, name))]


@dataclass
class Html(HTMLParser):
    """What a test looks at in a page."""

    loaded: list[str] = field(default_factory=list)
    """Addresses that the browser loads when the page is opened."""
    links: list[str] = field(default_factory=list)
    """Where its links lead."""
    ids: list[str] = field(default_factory=list)
    """Anchors."""
    text: str = ""
    """All text but scripts."""
    sections: dict[str, str] = field(default_factory=dict)
    """The text from each anchor on to the next of a heading."""
    inside: str = ""
    """The element whose text is read."""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.inside = tag
        if tag in LOADED and given.get("rel") not in ("next", "prev", "canonical") and (address := given.get(LOADED[tag])):
            self.loaded.append(address)
        if tag == "a" and (address := given.get("href")):
            self.links.append(address)
        if name := given.get("id"):
            self.ids.append(name)
            if re.fullmatch("h[1-6]", tag):
                self.sections[name] = ""

    def handle_data(self, data: str) -> None:
        if self.inside in ("script", "style"):
            return
        self.text += data
        if self.sections:
            self.sections[next(reversed(self.sections))] += data


def parsed(path: Path) -> Html:
    page = Html()
    page.feed(path.read_text(encoding="utf-8"))
    return page


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    command = [sys.executable, "-m", "mkdocs", *SITE, "--site-dir", str(folder)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Html]:
    """Every page of the site by its file."""
    return {path: parsed(path) for path in sorted(site.rglob("*.html"))}


@pytest.fixture(scope="module")
def entries(pages: dict[Path, Html]) -> dict[str, str]:
    """The text of every entry of the API pages by its full name."""
    return {name: " ".join(text.split()) for path, page in pages.items() if "api" in path.parts for name, text in page.sections.items()}


def plain(docstring: str) -> str:
    """The words of a docstring, without what marks them up."""
    return " ".join(re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", docstring).replace("`", "").replace("*", "").split())


@pytest.mark.parametrize("name", bbfit.__all__)
def test_every_public_name_has_an_entry_with_its_docstring(name: str, entries: dict[str, str]) -> None:
    item = getattr(bbfit, name)
    said = entries[f"{item.__module__}.{name}"]
    assert said.startswith(f"bbfit.{name}") or f"bbfit.{name} " in said
    first = inspect.getdoc(item).partition("\n\n")[0]
    assert plain(first) in said
    for title in re.findall(r"^(\w+)\n---", inspect.getdoc(item), re.MULTILINE):
        assert title in said


@pytest.mark.parametrize("name", CONFIGS)
def test_every_field_has_an_entry(name: str, entries: dict[str, str]) -> None:
    item = getattr(bbfit, name)
    for one in dataclasses.fields(item):
        if not one.name.startswith("_"):
            assert len(entries[f"{item.__module__}.{name}.{one.name}"].split()) > 2, one.name


def test_docstrings_are_rendered_and_not_shown_as_they_are_written(entries: dict[str, str]) -> None:
    for name, said in entries.items():
        assert not re.search(r":\w+:`|``|-{4,}|\*\*", said), name


def test_no_page_loads_anything_from_elsewhere(site: Path, pages: dict[Path, Html]) -> None:
    assert len(pages) > len(PAGES) - 2
    for path, page in pages.items():
        assert page.loaded
        for address in page.loaded:
            assert not urlsplit(address).netloc and not urlsplit(address).scheme.startswith("http"), f"{path.name} loads {address}"
    for path in site.rglob("*.css"):
        loaded = re.findall(r"url\(\s*['\"]?([^)'\"]+)|@import\s+['\"]([^'\"]+)", path.read_text(encoding="utf-8"))
        assert not [address for pair in loaded for address in pair if re.match(r"(https?:)?//", address)], path.name


def test_every_link_of_the_site_leads_somewhere(site: Path, pages: dict[Path, Html]) -> None:
    followed = 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or path.name == "404.html":
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file() and target.is_relative_to(site), f"{path.relative_to(site)}: {link}"
            if parts.fragment and target.suffix == ".html":
                assert unquote(parts.fragment) in pages[target].ids, f"{path.relative_to(site)}: {link}"
            followed += 1
    assert followed > 1000


def slug(heading: str) -> str:
    """The anchor that a heading gets on the site and on the web page of the repository."""
    words = re.sub(r"[^\w\s-]", "", heading.replace("`", "").lower()).strip()
    return re.sub(r"\s+", "-", words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_in_the_sources_lead_to_files_and_headings(page: Path) -> None:
    """So that they work in the repository too."""
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        parts = urlsplit(link)
        if parts.scheme:
            continue
        target = (page.parent / parts.path).resolve() if parts.path else page
        assert target.is_file() and target.is_relative_to(ROOT), link
        if parts.fragment:
            headings = re.findall(r"^#+ (.*)$", prose(target), re.MULTILINE)
            assert parts.fragment in {slug(heading) for heading in headings}, link


def test_the_readme_is_short_and_its_lines_are_too() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert not [line for line in lines if len(line) > 120 and not line.startswith(("|", "!["))]


def test_the_readme_s_figures_are_those_of_the_results() -> None:
    """Decibels, FLIP and numbers of vertices in its tables stand in docs/results.md."""
    results = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Results")[2].partition("## Limits")[0]
    figures = [figure for row in re.findall(r"^\|.*\|$", text, re.MULTILINE) for figure in re.findall(r"\d[\d.,]*\d", row)]
    assert len(figures) > 20
    assert not [figure for figure in figures if figure not in results]


def test_lines_of_a_field_s_help_end_where_a_sentence_does() -> None:
    """The command line breaks help where the source does."""
    for name in CONFIGS:
        item = getattr(bbfit, name)
        if not name.endswith("Config"):
            continue
        for text in re.findall(r'^    """(.*?)"""$', inspect.getsource(item), re.MULTILINE | re.DOTALL):
            for line in text.splitlines()[:-1] if text != item.__doc__ else []:
                assert line.rstrip()[-1:] in ".;:", f"{name}: {line}"

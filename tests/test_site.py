"""The documentation site: built strictly, whole, and without another host."""

import re
import runpy
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

REPOSITORY = Path(__file__).parents[1]


class Addresses(HTMLParser):
    """What a page loads by itself, and what it links to."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag in ("script", "img", "iframe", "source", "video", "embed") and "src" in given:
            self.loaded.append(given["src"])
        if tag == "link" and "canonical" not in given.get("rel", ""):
            self.loaded.append(given["href"])
        if tag == "a" and "href" in given:
            self.linked.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Build the site apart from the working tree."""
    root = tmp_path_factory.mktemp("site")
    shutil.copytree(REPOSITORY / "docs", root / "docs")
    shutil.copytree(REPOSITORY / "src", root / "src", ignore=shutil.ignore_patterns("__pycache__", "*.keepout"))
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        shutil.copy(REPOSITORY / name, root / name)
    answer = subprocess.run([sys.executable, str(root / "docs" / "site.py")], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return root / "out" / "site"


@pytest.mark.long
@pytest.mark.xdist_group("site")
def test_every_page_is_there_and_nothing_comes_from_another_host(site: Path):
    docs = REPOSITORY / "docs"
    pages = {page.relative_to(docs).with_suffix(".html") for page in docs.rglob("*.md")}
    pages.discard(Path("assets/katex/README.html"))
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}
    assert not list(site.rglob("*.py"))
    for page in site.rglob("*.html"):
        found = Addresses()
        found.feed(page.read_text(encoding="utf-8"))
        for address in found.loaded:
            assert not re.match(r"(https?:)?//", address), f"{page.name} loads {address}"
        base = site if page.name == "404.html" else page.parent
        for address in found.loaded + found.linked:
            local = unquote(re.split(r"[?#]", address)[0])
            if local and not re.match(r"[a-z]+:", local):
                path = site / local.lstrip("/") if local.startswith("/") else base / local
                assert path.exists(), f"{page.name}: {address}"


@pytest.mark.long
@pytest.mark.xdist_group("site")
def test_mathematics_needs_no_other_host(site: Path):
    style = (site / "assets" / "katex" / "katex.min.css").read_text(encoding="utf-8")
    fonts = re.findall(r"url\(([^)]+)\)", style)
    assert fonts
    for font in fonts:
        assert (site / "assets" / "katex" / font).is_file()
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//|@import", sheet.read_text(encoding="utf-8")), sheet.name


def nav(configuration: str, folder: Path) -> str:
    """The completed nav of a folder of pages."""
    shutil.copy(REPOSITORY / "docs" / "site.py", folder / "site.py")
    completed = runpy.run_path(str(folder / "site.py"))["completed"]
    return completed(f"nav = [\n{configuration}\n]\n\n[rest]\n")


def test_the_nav_has_each_page_once(tmp_path: Path):
    for name in ("index.md", "own/b.md", "own/a.md", "stray.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("# A page\n", encoding="utf-8")
    text = nav('{ "Start" = "index.md" },\n{ "Later" = "later.md" },\n"own/*.md",\n"*.md",', tmp_path)
    assert re.findall(r'"([^"]+\.md)"', text) == ["index.md", "own/a.md", "own/b.md", "stray.md"]


def test_a_page_that_no_line_matches_is_named(tmp_path: Path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "page.md").write_text("# A page\n", encoding="utf-8")
    with pytest.raises(SystemExit, match=re.escape("no line of the nav matches deep/page.md")):
        nav('"*.md",', tmp_path)

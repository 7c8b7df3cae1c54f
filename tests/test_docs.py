"""The pages: tables are of the kept results, links lead somewhere, blocks are what they say and name what there is."""

import ast
import html
import importlib
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
import typer

import keepout
from keepout import cli
from keepout.core.mission.scenario import Scenario

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
PAGES = sorted([REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
LANGUAGES = {"", "console", "text", "python", "toml", "yaml", "json", "bash"}


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of each fenced block of a page."""
    found = re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return [(language.strip(), text) for language, text in found]


def named(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


@pytest.mark.long
def test_the_tables_of_results_are_of_this_version():
    answer = subprocess.run([sys.executable, str(DOCS / "results.py"), "--check"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


def test_the_reference_of_entries_and_commands_is_of_this_version():
    answer = subprocess.run([sys.executable, str(DOCS / "reference.py"), "--check"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_and_pictures_are_there_and_blocks_have_a_language(page: Path):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for address in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", text)):
        if not re.match(r"https?://|#", address):
            assert (page.parent / address.partition("#")[0]).is_file(), f"{named(page)}: {address}"
    assert {language for language, _ in blocks(page)} <= LANGUAGES


def test_each_scenario_is_one(tmp_path: Path):
    path = tmp_path / "mission.toml"
    for page in PAGES:
        for language, text in blocks(page):
            if language == "toml":
                path.write_text(text, encoding="utf-8")
                Scenario.load(path)


def commands(page: Path) -> list[str]:
    """Give every line of a page that calls the command line."""
    texts = [text.replace("\\\n", " ") for language, text in blocks(page) if language in ("", "console")]
    lines = [line for text in texts for line in text.splitlines()]
    calls = [re.sub(r"^(\$ )?(\S*/)?(?=keepout )", "", line.split("  #")[0].strip()) for line in lines]
    return [call for call in calls if re.match(r"keepout [a-z]", call)]


def test_each_command_has_these_arguments():
    calls = sorted({call for page in PAGES for call in commands(page)})
    assert len(calls) > 30
    for call in calls:
        command = typer.main.get_command(cli.app)
        context = command.make_context("keepout", shlex.split(call)[1:])
        while hasattr(command, "resolve_command"):
            name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
            assert command is not None, call
            context = command.make_context(name, rest, parent=context)


@pytest.mark.parametrize("page", [page for page in PAGES if any(b[0] == "python" for b in blocks(page))], ids=named)
def test_the_python_of_a_page_compiles_and_names_what_there_is(page: Path):
    tree = ast.parse("\n".join(text for language, text in blocks(page) if language == "python"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("keepout"):
            module = importlib.import_module(str(node.module))
            assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)
            assert not any(alias.name.startswith("_") for alias in node.names), ast.unparse(node)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "keepout":
            assert node.attr in keepout.__all__, ast.unparse(node)


def test_the_reference_has_every_public_name():
    stub = (REPOSITORY / "src" / "keepout" / "__init__.pyi").read_text(encoding="utf-8")
    public = {f"keepout.{module}.{name}" for module, name in re.findall(r"from \.(\S+) import (\w+) as", stub)}
    page = (DOCS / "reference" / "keepout.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^::: (\S+)$", page, flags=re.MULTILINE)) == public


def test_no_line_installs_the_other_program_called_keepout():
    """On the package index `keepout` is a stranger's; pages, refusals and image recipes name `keepout-gnc`."""
    folders = (REPOSITORY / name for name in ("src", "docs", "benchmarks", "examples", "tests", ".github"))
    files = [
        *PAGES,
        *(file for folder in folders for file in folder.rglob("*") if file.suffix in (".py", ".yml", ".toml")),
    ]
    installs = re.compile(r"(?<![\w-])keepout\\?\[[a-z]|install (-\S+ )*[\"']?keepout(?![\w-])")
    found = [
        f"{named(file)}: {line}"
        for file in files
        for line in file.read_text("utf-8").splitlines()
        if installs.search(line)
    ]
    assert not found


def test_the_citation_is_of_this_version():
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {keepout.__version__}\n" in citation.replace('"', "")


@pytest.mark.slow  # the tests of links and blocks read the pages themselves
def test_the_site_is_whole_and_nothing_comes_from_another_host(tmp_path: Path):
    """It is built strictly, apart from the working tree."""
    shutil.copytree(DOCS, tmp_path / "docs")
    left_out = shutil.ignore_patterns("__pycache__", "*.keepout")
    shutil.copytree(REPOSITORY / "src", tmp_path / "src", ignore=left_out)
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        shutil.copy(REPOSITORY / name, tmp_path / name)
    built = subprocess.run([sys.executable, str(tmp_path / "docs" / "site.py")], capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    site = tmp_path / "out" / "site"
    pages = {page.relative_to(DOCS).with_suffix(".html") for page in DOCS.rglob("*.md")}
    pages.discard(Path("assets/katex/README.html"))
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}
    assert not list(site.rglob("*.py"))
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe|source|video|embed)\b[^>]*\bsrc="([^"]*)"', text)
        loaded += re.findall(r'<link\b(?![^>]*canonical)[^>]*\bhref="([^"]*)"', text)
        for address in loaded:
            assert not re.match(r"(https?:)?//", address), f"{page.name} loads {address}"
        base = site if page.name == "404.html" else page.parent
        for address in loaded + re.findall(r'<a\b[^>]*\bhref="([^"]*)"', text):
            local = unquote(re.split(r"[?#]", html.unescape(address))[0])
            if local and not re.match(r"[a-z]+:", local):
                path = site / local.lstrip("/") if local.startswith("/") else base / local
                assert path.exists(), f"{page.name}: {address}"
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert not re.search(r"url\([\"']?(https?:)?//|@import", text), sheet.name

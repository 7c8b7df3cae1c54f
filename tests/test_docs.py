"""The pages: their tables are of the kept results, their links lead somewhere, their blocks are what they say."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import yaml

from keepout import cli
from keepout.mission.scenario import Scenario

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
PAGES = sorted([REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
GENERATED = {"results.md", "changelog.md", "architecture.md"}
LANGUAGES = {"", "console", "text", "python", "toml", "yaml", "json", "bash"}


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of each fenced block of a page."""
    found = re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return [(language.strip(), text) for language, text in found]


def named(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


def test_the_tables_are_of_the_kept_results():
    answer = subprocess.run([sys.executable, str(DOCS / "results.py"), "--check"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_and_pictures_are_there(page: Path):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for address in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", text)):
        if not re.match(r"https?://|#", address):
            assert (page.parent / address.partition("#")[0]).is_file(), f"{named(page)}: {address}"


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=named)
def test_a_page_is_named_by_a_link(page: Path):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r"docs/[\w/-]+\.md", text) == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_blocks_have_a_language_that_is_known(page: Path):
    assert {language for language, _ in blocks(page)} <= LANGUAGES


SCENARIOS = [(page, text) for page in PAGES for language, text in blocks(page) if language == "toml"]


@pytest.mark.parametrize(("page", "text"), SCENARIOS, ids=lambda part: named(part) if isinstance(part, Path) else "")
def test_each_scenario_is_one(page: Path, text: str, tmp_path: Path):
    path = tmp_path / "mission.toml"
    path.write_text(text, encoding="utf-8")
    Scenario.load(path)


def commands(page: Path) -> list[str]:
    """Give every line of a page that calls the command line."""
    texts = [text.replace("\\\n", " ") for language, text in blocks(page) if language in ("", "console")]
    lines = [line for text in texts for line in text.splitlines()]
    calls = [re.sub(r"^(\$ )?(\S*/)?(?=keepout )", "", line.split("  #")[0].strip()) for line in lines]
    return [call for call in calls if re.match(r"keepout (--version|[a-z])", call)]


CALLS = sorted({call for page in PAGES for call in commands(page)})


@pytest.mark.parametrize("call", CALLS)
def test_each_command_has_these_arguments(call: str):
    command = typer.main.get_command(cli.app)
    arguments = shlex.split(call)[1:]
    if arguments == ["--version"]:
        return
    context = command.make_context("keepout", arguments)
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert command is not None, call
        context = command.make_context(name, rest, parent=context)


@pytest.mark.parametrize("page", [page for page in PAGES if page.name not in GENERATED], ids=named)
def test_prose_has_no_history(page: Path):
    """Commits and dates stand in the tables of results and in the changelog."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"https?://\S+|`[^`\n]*`", "", text)
    assert re.findall(r"\b20\d\d-\d\d-\d\d\b|\b\d{1,2} (?:November|December) 20\d\d\b", text) == []
    assert re.findall(r"(?<![\w.-])(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,10}(?![\w.-])", text) == []


def test_the_reference_has_every_public_name():
    stub = (REPOSITORY / "src" / "keepout" / "__init__.pyi").read_text(encoding="utf-8")
    public = {f"keepout.{module}.{name}" for module, name in re.findall(r"from \.(\S+) import (\w+) as", stub)}
    page = (DOCS / "reference" / "keepout.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^::: (\S+)$", page, flags=re.MULTILINE)) == public


def test_the_citation_can_be_read():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors", "version", "license", "abstract", "references"} <= set(citation)
    project = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{citation["version"]}"' in project
    assert all("name" in author or {"family-names", "given-names"} <= set(author) for author in citation["authors"])
    paper = citation["references"][0]
    assert {"type", "title", "authors", "identifiers"} <= set(paper)
    assert paper["identifiers"][0] == {"type": "other", "value": "arXiv:2507.13672"}


def test_the_changelog_is_kept():
    """https://keepachangelog.com: versions, newest first, each with groups of these names, none empty."""
    lines = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# Changelog"
    versions = [line for line in lines if line.startswith("## ")]
    assert versions[0] == "## [Unreleased]"
    assert all(re.fullmatch(r"## \[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", version) for version in versions[1:])
    groups = [line.removeprefix("### ") for line in lines if line.startswith("### ")]
    assert set(groups) <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    for number, line in enumerate(lines):
        if line.startswith("### "):
            assert lines[number + 2].startswith("- ")

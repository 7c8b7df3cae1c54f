"""The pages: tables are of the kept results, links lead somewhere, blocks are what they say and name what there is."""

import ast
import html
import importlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin
from urllib.parse import unquote

import pytest
import typer

import keepout
from keepout import cli
from keepout.apps.inspection.passive import DriftsFlown, DriftsPlanned
from keepout.core.flight.loop import FlightLog
from keepout.core.mission import surroundings
from keepout.core.mission.scenario import COMPONENTS, Scenario, entries_and_tables, is_table
from keepout.flights.campaign.table import _KINDS

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
def test_the_tables_of_results_are_of_this_version(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    monkeypatch.setattr(sys, "argv", ["results.py", "--check"])
    runpy.run_path(str(DOCS / "results.py"), run_name="__main__")


def test_the_reference_of_entries_and_commands_is_of_this_version():
    answer = subprocess.run([sys.executable, str(DOCS / "reference.py"), "--check"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


def prose(page: Path) -> str:
    """Give the text of a page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Give the anchors of a page's headings, as Python-Markdown makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.*?)(?: \{.*\})?$", prose(page), flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "")
        plain = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
        name = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        found.add(next(one for one in (name, *(f"{name}_{count}" for count in range(1, 99))) if one not in found))
    return found | set(re.findall(r'\bid="([^"]+)"', prose(page)))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_and_pictures_are_there_and_blocks_have_a_language(page: Path):
    for address in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page))):
        if not re.match(r"https?:", address):
            name, _, anchor = address.partition("#")
            place = (page.parent / name).resolve() if name else page
            assert place.is_file(), f"{named(page)}: {address}"
            if anchor and place.suffix == ".md":
                assert anchor in anchors(place), f"{named(page)}: {address}"
    assert {language for language, _ in blocks(page)} <= LANGUAGES


def code(page: Path) -> list[str]:
    """Give what stands between backticks in the text of a page."""
    return re.findall(r"`([^`\n]+)`", prose(page))


def entry_names() -> set[str]:
    """Give every entry and table of a scenario by dotted name, with those of lists of tables."""
    names = {name for name, _ in entries_and_tables()}
    for key, field in Scenario.model_fields.items():
        if get_origin(field.annotation) is tuple and is_table(get_args(field.annotation)[0]):
            names |= {name for name, _ in entries_and_tables(get_args(field.annotation)[0], f"{key}.")}
    return names


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_entries_files_and_options_that_a_page_names_are_there(page: Path):
    entries, tables = entry_names(), {name for name in Scenario.model_fields}
    commands = dict(commands_of(typer.main.get_command(cli.app), "keepout"))
    for said in code(page):
        entry = said.partition(" = ")[0]
        if re.fullmatch(r"[a-z_]+(\.[a-z_]+)+", entry) and entry.partition(".")[0] in tables:
            table, _, last = entry.rpartition(".")
            of_program = page.name == "on-board.md" and entry.startswith("chaser.")
            there = entry in entries or (last in COMPONENTS and table in entries)
            assert there or of_program or last in ENDINGS, f"{named(page)}: {said}"
        if re.fullmatch(r"(src|tests|docs|benchmarks|examples|viewer)/[\w./*-]+", said):
            assert list(REPOSITORY.glob(said.rstrip("/"))), f"{named(page)}: {said}"
        words = said.split()
        called = next((name for name in commands if words[: len(name.split())] == name.split()), None)
        if called is not None:
            there = {option for param in commands[called].params for option in (*param.opts, *param.secondary_opts)}
            for word in words:
                if re.fullmatch(r"--[a-z-]+", word):
                    assert word in there | {"--help"}, f"{named(page)}: {said}"


ENDINGS = {"toml", "json", "md", "py", "ipynb", "png", "svg", "html", "csv", "parquet", "keepmap", "keepout", "log"}


def commands_of(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Give every command with its full name; that of a group for the one that is meant without a name too."""
    if not hasattr(command, "list_commands"):
        yield name, command
        return
    context = typer.Context(command)
    for key in command.list_commands(context):
        yield from commands_of(command.get_command(context, key), f"{name} {key}")
    if name == "keepout campaign":
        yield name, command.get_command(context, "fly")


def test_a_reader_who_has_only_the_checkout_meets_no_other_folder():
    for page in PAGES:
        assert page.name == "results.md" or "../shared" not in page.read_text(encoding="utf-8"), named(page)


def test_the_pages_stay_few_and_short():
    """Without those that are generated from results and examples, and those for developers."""
    apart = {"results.md", "changelog.md", "contributing.md", "architecture.md"}
    pages = [page for page in DOCS.glob("*.md") if page.name not in apart]
    assert len(pages) <= MOST_PAGES
    assert sum(page.stat().st_size for page in pages) <= MOST_BYTES


MOST_PAGES, MOST_BYTES = 26, 200_000

KEYS_MADE = {
    "core/mission/flight.py": ("summary", "zone_figures", "_approach_figures", "navigation_figures"),
    "verbs/check.py": ("summary",),
    "core/mission/surroundings.py": ("guard_numbers",),
    "flights/pages/folder.py": ("write_flight",),
    "flights/requirements.py": ("judged", "judged_campaign"),
    "flights/campaign/table.py": ("summary", "_figures", "table_of"),
    "flights/rare_events/event.py": ("summary",),
    "flights/rare_events/subset.py": ("summary",),
    "flights/pages/rare_page.py": ("write_rare",),
    "flights/pages/campaign_page.py": ("report_campaign", "compare_campaigns"),
    "flights/exchange/audited.py": ("audit_files", "_assumptions", "_verdict"),
    "apps/unknown/exploration.py": ("summary",),
    "apps/unknown/exploration_page.py": ("write_exploration",),
    "apps/inspection/inspection.py": ("summary", "shares"),
    "apps/inspection/inspection_page.py": ("write_inspection",),
    "apps/inspection/limits.py": ("summary", "drifts_flown"),
    "apps/inspection/passive.py": ("summary",),
    "apps/inspection/circumnavigation.py": ("summary",),
    "apps/led/driver.py": ("contact_figures",),
    "verbs/campaigns.py": ("complete",),
    "cli/mesh.py": ("describe_targets", "_fitted", "_certified", "_checked"),
    "cli/scenario.py": ("_drafted",),
    "cli/campaign.py": ("replay_run",),
}
"""Functions, below the package, in which keys of summaries and columns of tables are made."""


def keys_made() -> set[str]:
    """Give the keys that these functions write as text, and those that they make of names of their own."""
    found: set[str] = set()
    for file, functions in KEYS_MADE.items():
        tree = ast.parse((REPOSITORY / "src" / "keepout" / file).read_text(encoding="utf-8"))
        bodies = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert set(functions) <= set(bodies), file
        for one in ast.walk(tree):
            if isinstance(one, ast.FunctionDef) and one.name in functions:
                for node in ast.walk(one):
                    keys = node.keys if isinstance(node, ast.Dict) else []
                    if isinstance(node, ast.Assign):
                        keys = [of.slice for of in node.targets if isinstance(of, ast.Subscript)]
                    found |= {key.value for key in keys if isinstance(key, ast.Constant) and isinstance(key.value, str)}
    found |= {f"{name}_{unit}".removesuffix("_") for name, unit in surroundings._ASSUMED}
    found |= {f"{key}_s" for key in ("begun", "reached", "left", "held")} | {"largest_error_m", "kept"}
    found |= {f"{name}_{of}" for name in ("passive", "passive_pushed") for of in PASSIVE}
    found |= {*DriftsPlanned().summary(), *DriftsFlown().summary()}
    return found | set(FlightLog.__annotations__) | {name for name in _KINDS if "_steps." not in name}


PASSIVE = ("safe_share", "clearance_m", "spread_m")
INNER = {"position", "velocity", "below", "chaser_radius", "prove_slope"}
INNER |= {"duration", "least_duration", "largest_error", "way"}
"""Written as text in these functions, and keys of no summary."""


def test_every_key_of_a_summary_and_every_column_is_explained():
    told = set(code(DOCS / "files.md"))
    assert not sorted(keys_made() - told - INNER)


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
    public = {f"keepout.{name}" for name in re.findall(r"import (\w+) as", stub)}
    public.add("keepout.apps.gym.environment.ApproachEnv")  # which Gymnasium makes
    page = (DOCS / "python.md").read_text(encoding="utf-8")
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

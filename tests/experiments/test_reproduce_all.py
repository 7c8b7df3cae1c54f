"""`reproduce all --quick`, end to end: every part's tables, figures and page; a second run computes nothing anew."""

import contextlib
import csv
import json

import pytest
from truths.command_line import keepout_command
from truths.results import Page, check_picture

from keepout.experiments import PARTS
from keepout.report import terminal

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("reproduce_all")]

TABLES = {
    "table1": {"errors", "gradient_error"},
    "surfaces": {"surfaces"},
    "volumes": {"volumes"},
    "case1": {"flights", "map"},
    "case2": {"observers"},
    "runtime": {"step-times", "true-cone"},
    "case3": {"flights"},
}
"""Those that every quick run has; `case3` has one more for each campaign."""


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


def run(out, done):
    """Run it, and note every fraction of its progress."""

    @contextlib.contextmanager
    def noted(_title):
        yield lambda fraction, _message: done.append(fraction)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(terminal, "progress", noted)
        return keepout_command("reproduce", "all", "--quick", "--json", "-o", out).json


@pytest.fixture(scope="module")
def progress():
    return []


@pytest.fixture(scope="module")
def rows(out, progress):
    return run(out, progress)


def files(out, pattern):
    return {str(path.relative_to(out)): path.read_bytes() for path in out.glob(pattern)}


def test_progress_ends_once_at_its_end(rows, progress):
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert max(progress[:-1]) < 1.0


def test_every_part_has_rows_tables_and_figures(out, rows):
    assert json.loads((out / "summary.json").read_text(encoding="utf-8")) == rows
    assert list(dict.fromkeys(row["experiment"] for row in rows)) == list(PARTS) == list(TABLES)
    tables = json.loads((out / "tables.json").read_text(encoding="utf-8"))
    assert tables["quick"] is True
    assert [section["name"] for section in tables["sections"]] == list(PARTS)
    for section in tables["sections"]:
        folder = out / section["name"]
        assert section["paper"]
        assert section["ours"]
        named = {table["name"]: table["rows"] for table in section["tables"]}
        assert set(named) >= TABLES[section["name"]]
        assert {path.stem for path in folder.glob("*.csv")} == set(named)
        for name, entries in named.items():
            assert entries
            with (folder / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
                read = list(csv.DictReader(stream))
            assert [list(entry) for entry in read] == [list(entry) for entry in entries]
        pictures = {path.stem for path in folder.glob("*.png")}
        assert {path.stem for path in folder.glob("*.svg")} == pictures
        assert bool(pictures) is (section["name"] not in ("table1", "volumes"))  # table1 draws fits, volumes nothing
        for picture in pictures:
            check_picture(folder / f"{picture}.png")
            assert (folder / f"{picture}.svg").stat().st_size > 1000


def test_the_page_links_only_to_what_is_there(out, rows):
    page = Page.read(out / "index.html")
    assert page.unclosed == []
    linked = {address for address in page.outside if not address.startswith("#")}
    assert {address[1:] for address in page.outside if address.startswith("#")} == set(PARTS)
    for address in linked:
        assert (out / address).stat().st_size > 10
    assert linked == {*files(out, "*/*.csv"), *files(out, "*/*.svg"), *files(out, "*/replay.html")}
    # Counted, as figures of two parts may have one name.
    assert (out / "index.html").read_text(encoding="utf-8").count("<img ") == len(files(out, "*/*.png"))


def test_a_second_run_computes_nothing_and_gives_the_same(out, rows):
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/kept/*")}
    tables = files(out, "*/*.csv")
    assert kept
    assert run(out, []) == rows
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/kept/*")} == kept
    assert files(out, "*/*.csv") == tables

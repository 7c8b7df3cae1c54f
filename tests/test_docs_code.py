"""The Python of the pages, run page by page in one process as it stands, but for the time that it takes."""

import re
from pathlib import Path

import pytest
from test_docs import PAGES, blocks, named
from test_explore_command import MISSION as SMALL
from test_inspect_command import MISSION as LOOK

from keepout.mission.scenario import Scenario

pytestmark = pytest.mark.long

ELSEWHERE = {"README.md", "docs/control.md", "docs/export.md"}
"""Pages whose Python other tests run, with what comes of it: tests/test_readme.py and tests/exchange/test_pages.py."""
COMPILED_ONLY = {"docs/clusters.md"}
"""Pages whose Python needs what no test has: a SLURM cluster."""
QUICKER = {
    # Its field, instead of one that is learned as tests/test_readme.py has it: the grid of exact distances.
    "docs/tutorial.md": [
        (
            'keepout.certify(keepout.fit(target, profile="quick"), target, chaser_radius=0.5)',
            "guard_field(target, 0.5)",
        ),
        ("duration=500.0", "duration=60.0"),
    ],
    "docs/own/law.md": [("duration=300.0", "duration=240.0")],
    "docs/campaigns.md": [
        ('"runs": 1000', '"runs": 2'),
        ("Scenario().replace(campaign=", 'Scenario().replace(duration=20.0, guard={"enabled": False}, campaign='),
    ],
    "docs/explore.md": [("examples/explore.toml", "mission.toml")],
    "docs/inspection.md": [
        ('keepout.inspect("examples/inspect.toml")', 'keepout.inspect("mission.toml")'),
        ('Scenario.load("examples/inspect.toml")', 'Scenario.load("mission.toml")'),
        ("range(3)", "range(1)"),
    ],
    "docs/rare.md": [("below=0.0", "below=0.3, runs=2, flights=64, most_levels=2")],
}
"""What is written, and what the test writes instead."""
BEFORE = {
    "docs/inspection.md": "from pathlib import Path\n"
    "from keepout.commands.inspect import inspect_to_folder, mission_of\n"
    "inspect_to_folder(mission_of(Path('mission.toml')), Path('out/inspect'), figures=False)\n",
    "docs/tutorial.md": "from keepout.guard.field import guard_field\n",
    "docs/rare.md": "import keepout, numpy\n"
    "from keepout.rare_events.tape import Tape\n"
    "scenario = keepout.Scenario.load('mission.toml')\n"
    "tape = numpy.zeros(Tape.of(scenario).numbers)\n",
}
"""What a page has told in words before its first block, and what the test's own words need."""
MISSION = """
duration = 30.0
start.position = [0.0, 3.5, 0.0]
faults.position_noise_std = 0.01
"""
MISSIONS = {
    "docs/explore.md": SMALL,
    "docs/inspection.md": LOOK,
    "docs/rare.md": """
name = "near"
duration = 40.0
start.position = [8.0, 1.5, 1.2]
goal.position = [8.0, -1.5, 1.2]
guard.enabled = false
control.guidance = "straight"
faults = {position_noise_std = 0.05, velocity_noise_std = 0.02, noise_correlation_time = 10.0}
""",
}
"""Missions that other tests fly, too: tests/rare_events/test_flights.py and tests/test_explore_command.py."""


def runnable(page: Path) -> list[str]:
    return [text for language, text in blocks(page) if language == "python"]


@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page) and named(page) not in ELSEWHERE], ids=named)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    tutorial = next(other for other in PAGES if other.name == "tutorial.md")
    exec(runnable(tutorial)[0], {})  # the mesh that the others name
    (tmp_path / "mission.toml").write_text(MISSIONS.get(named(page), MISSION), encoding="utf-8")
    names: dict = {}
    exec(BEFORE.get(named(page), ""), names)
    code = "\n".join(runnable(page))
    for written, quicker in QUICKER.get(named(page), []):
        assert code.count(written) == 1, written
        code = code.replace(written, quicker)
    compiled = compile(code, str(page), "exec")
    if named(page) in COMPILED_ONLY:
        return
    exec(compiled, names)
    check = globals().get("check_" + re.sub(r"\W", "_", page.stem))
    if check is not None:
        check(names)


def check_tutorial(names: dict) -> None:
    summary = names["flight"].summary()
    assert summary["contact"] is False
    assert summary["start_certified"] is True


def check_own_law(names: dict) -> None:
    summary = names["flight"].summary()
    assert summary["contact"] is False
    assert summary["guard_interventions"] > 0
    assert summary["reached"] is False


def check_my_thrusters(names: dict) -> None:
    assert isinstance(names["mission"].scenario, Scenario)
    assert names["force"].shape == (3,)


def check_reading_a_certificate(names: dict) -> None:
    certificate = names["certificate"]
    assert certificate.kind == "certified"
    assert certificate.sampled_maximum <= certificate.error_bound

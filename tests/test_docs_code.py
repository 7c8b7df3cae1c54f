"""The Python of the pages, run page by page in one process as it stands, but for the time that it takes.

Those that take long run in `make test-all`; tests/test_docs.py says of all of them that they name what there is.
"""

from pathlib import Path

import pytest
from test_docs import PAGES, blocks, named

pytestmark = pytest.mark.long

ELSEWHERE = {"README.md"}
"""Run by tests/test_commands.py."""
QUICK = {"docs/tutorial.md"}
QUICKER = {
    "docs/reproduce.md": [("duration=300.0", "duration=240.0")],
    "docs/own-parts.md": [("num_envs=1024, guard=False", "num_envs=1")],
    "docs/on-board.md": [("examples/approach.toml", "mission.toml")],
    # Its field, instead of one that is learned: the grid of exact distances.
    "docs/python.md": [("keepout.fit(target, certify=True)", "guard_field(target, 0.5)"), ("runs=200", "runs=4")],
}
"""What is written, and what the test writes instead."""
BEFORE = {
    "docs/python.md": "from keepout.core.guard.field import guard_field\n",
    "docs/flights-out.md": "import keepout\n"
    "from pathlib import Path\n"
    "Path('out/case1').mkdir(parents=True)\n"
    "keepout.fly('mission.toml').save('out/case1/case1.parquet')\n",
}
"""What a page has told in words before its first block, and what the test's own words need."""
MISSION = """
duration = 30.0
start.position = [0.0, 3.5, 0.0]
faults.position_noise_std = 0.01
"""
MISSIONS = {
    "docs/on-board.md": """
target.source = "box"
field.source = "grid"
start.position = [9.0, 0.0, 0.0]
leg = [{position = [7.0, 0.0, 0.0], until = "go", go_at = 9.0}, {position = [5.0, 0.0, 0.0]}]
""",
    "docs/python.md": """
duration = 20.0
target = {source = "satellite.glb", units = "m"}
field.source = "grid"
guard.enabled = false
start.position = [0.0, 1.0, 5.3]
goal.position = [0.0, -0.6, -5.0]
""",
}


def runnable(page: Path) -> list[str]:
    return [text for language, text in blocks(page) if language == "python"]


# Pages of the gallery show files that tests/test_examples.py and tests/test_gallery.py run.
RUN = [p for p in PAGES if runnable(p) and named(p) not in ELSEWHERE and p.parent.name != "gallery"]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=named(page), marks=[] if named(page) in QUICK else pytest.mark.slow) for page in RUN],
)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    if "satellite.glb" in "".join(runnable(page)):
        tutorial = next(other for other in PAGES if other.name == "tutorial.md")
        exec(runnable(tutorial)[0], {})  # the mesh that the others name
    (tmp_path / "mission.toml").write_text(MISSIONS.get(named(page), MISSION), encoding="utf-8")
    names: dict = {}
    exec(BEFORE.get(named(page), ""), names)
    code = "\n".join(runnable(page))
    for written, quicker in QUICKER.get(named(page), []):
        assert code.count(written) == 1, written
        code = code.replace(written, quicker)
    exec(compile(code, str(page), "exec"), names)

"""The gallery and the examples' list are of the examples' present text, and the notebooks' cells run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import keepout

REPOSITORY = Path(__file__).parents[1]
EXAMPLES = REPOSITORY / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))


def code(path: Path) -> list[str]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_pages_are_of_the_examples():
    program = [sys.executable, str(REPOSITORY / "docs" / "gallery.py"), "--check"]
    answer = subprocess.run(program, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


def test_every_example_has_a_page():
    pages = "".join(page.read_text(encoding="utf-8") for page in (REPOSITORY / "docs" / "gallery").glob("*.md"))
    for path in EXAMPLES.rglob("*"):
        if path.suffix in (".py", ".toml", ".ipynb") and "__pycache__" not in path.parts:
            assert f"examples/{path.relative_to(EXAMPLES).as_posix()}" in pages, path


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_one_of_format_4_5_with_its_outputs(path: Path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    names = [cell["id"] for cell in notebook["cells"]]
    assert len(set(names)) == len(names)
    assert any(cell.get("outputs") for cell in notebook["cells"])
    assert path.stat().st_size < 200_000


@pytest.mark.slow  # tests/core/mission/test_own.py flies laws of one's own, tests/test_docs_code.py the same names
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_cells_of_a_notebook_run(path: Path):
    """They fly for 20 s only."""
    import matplotlib

    matplotlib.use("agg")
    names: dict = {}
    longest = {"duration=500.0": "duration=20.0", "duration=600.0": "duration=20.0"}
    whole = "\n".join(code(path))
    for written, quicker in longest.items():
        whole = whole.replace(written, quicker)
    assert "duration=20.0" in whole
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)  # the paper's law says which conditions it breaks
        exec(compile(whole, str(path), "exec"), names)
    flights = [value for value in names.values() if isinstance(value, keepout.Flight)]
    flights += list(names.get("flights", {}).values())
    assert flights
    assert all(str(flight.audit.contact) == "no" for flight in flights)

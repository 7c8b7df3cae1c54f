"""Pages that are written from results are of those results."""

import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]


def test_the_page_of_results_is_of_the_kept_results():
    program = [sys.executable, str(REPOSITORY / "docs" / "results.py"), "--check"]
    answer = subprocess.run(program, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr

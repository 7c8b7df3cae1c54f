"""The command line, run in this process or in one of its own, and what it left behind."""

import contextlib
import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from keepout import cli


@dataclass
class Answer:
    """What a command left behind: its exit code and its two streams."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        assert self.code == 0, self.err
        return json.loads(self.out)


def keepout_command(*arguments: object) -> Answer:
    """Run a command in this process, as the console script does."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["keepout", *(str(argument) for argument in arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return Answer(int(stop.value.code or 0), out.getvalue(), err.getvalue())


def told_by_process(folder: Path, *arguments: object, program: str = "from keepout.cli import main; main()") -> str:
    """Run a command in a process of its own, as a user does, and give what it wrote to standard output.

    What a library writes past Python to the file descriptor is seen so, and not by a command run in this process.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, "-c", program, *(str(argument) for argument in arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def never(word: str) -> Any:
    raise AssertionError(f"{word} is no JSON")


def keepout_process(folder: Path, *arguments: object, **program: str) -> Any:
    """Run a command in a process of its own, as a program does, and give the one JSON object that it answers with."""
    said = json.loads(told_by_process(folder, *arguments, **program), parse_constant=never)
    assert isinstance(said, dict | list)
    return said

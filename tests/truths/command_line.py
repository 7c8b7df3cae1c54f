"""The command line, run in this process, and what it left behind."""

import contextlib
import io
import json
import sys
from dataclasses import dataclass
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

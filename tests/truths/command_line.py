"""The command line, run in this process or in one of its own, and what it left behind."""

import contextlib
import functools
import io
import json
import os
import subprocess
import sys
import tempfile
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


FORKING = """
import gc, json, os, resource, sys
import equinox, jax, matplotlib.pyplot, numba, pyarrow.parquet, pydantic, scipy.optimize, scipy.stats, trimesh, typer
gc.freeze()
for line in sys.stdin:
    arguments, folder, environment, program, streams = json.loads(line)
    child = os.fork()
    if not child:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        for number, name in enumerate([os.devnull, *streams]):
            os.dup2(os.open(name, os.O_RDWR), number)
        jax.config.update("jax_compilation_cache_dir", environment.get("JAX_COMPILATION_CACHE_DIR"))  # read by now
        sys.argv = ["keepout", *arguments]
        exec(program)
        sys.exit()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(code, used.ru_utime + used.ru_stime, flush=True)
"""
"""Has imported the libraries, 2 s of every command, but nothing of Keepout; each line is a process forked from it."""


FORKED = {"seconds": 0.0}
"""Of processor, that the forked processes have used."""


def environment() -> dict[str, str]:
    paths = os.pathsep.join(path for path in sys.path if path)
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPATH": paths}


@functools.cache
def forking() -> subprocess.Popen:
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", FORKING], env=environment(), text=True, **pipes)


def told_by_process(
    folder: Path, *arguments: object, program: str = "from keepout.cli import main; main()", **variables: str
) -> str:
    """Run a command in a process of its own, and give what it wrote to standard output.

    What a library writes past Python to the file descriptor is seen so, and not by a command run in this process.
    The process has the environment of this one, and what `variables` set there.
    """
    server = forking()
    assert server.stdin is not None
    assert server.stdout is not None
    with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
        told = [str(each) for each in arguments], str(folder), environment() | variables, program, (out.name, err.name)
        server.stdin.write(json.dumps(told) + "\n")
        server.stdin.flush()
        code, used = server.stdout.readline().split()
        FORKED["seconds"], said = float(used), err.read()
        assert code == "0", said
        assert "Traceback" not in said
        return out.read()


def never(word: str) -> Any:
    raise AssertionError(f"{word} is no JSON")


def keepout_process(folder: Path, *arguments: object, **program: str) -> Any:
    """Run a command in a process of its own, as a program does, and give the one JSON object that it answers with."""
    said = json.loads(told_by_process(folder, *arguments, **program), parse_constant=never)
    assert isinstance(said, dict | list)
    return said

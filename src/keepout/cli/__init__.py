"""The command line: reads arguments, calls the package, shows the answer. No logic lives here."""

import gc
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

import keepout

# Each adds its commands to the application.
from keepout.cli import campaign, exchange, flight, mesh, scenario  # noqa: F401
from keepout.cli.options import app
from keepout.core.errors import KeepoutError, UsageError


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Print the version and stop.")] = False,
) -> None:
    if version:
        sys.stdout.write(f"keepout {keepout.__version__}\n")
        raise typer.Exit


def _show_each_once() -> Callable[..., None]:
    """Give what writes a warning as one line, and the same warning no second time, however many flights it is of."""
    said: set[str] = set()

    def show(message: Warning | str, *_: Any) -> None:
        if str(message) not in said:
            said.add(str(message))
            sys.stderr.write(f"keepout: warning: {message}\n")

    return show


def main() -> None:
    """Run the command line: a refusal is one line on standard error, and so is a warning.

    The exit code is 0 where the command did its work, 1 where it refused or failed, 2 where it cannot be meant, and 130
    where it was interrupted.
    """
    warnings.showwarning = _show_each_once()
    # Tracing a program makes many objects that live on; looking through them for garbage took a tenth of a start.
    gc.set_threshold(1_000_000, 50, 100)
    try:
        code = app(standalone_mode=False, prog_name="keepout")
        if code == 130:  # typer turns an interrupt into this code, without a word
            raise KeyboardInterrupt
    except KeepoutError as error:
        sys.stderr.write(f"keepout: {error}\n")
        code = 2 if isinstance(error, UsageError) else 1
    except TyperException as error:
        said = error.format_message().replace("\n", " ").rstrip()
        if said:  # without arguments the help has been shown, and there is nothing to add
            sys.stderr.write(f"keepout: {said}\n")
        code = 2
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        sys.stderr.write(f"keepout: {place}{error.strerror or error}\n")
        code = 1
    except MemoryError as error:
        said = " ".join(str(error).split())
        sys.stderr.write(f"keepout: out of memory{said and f' ({said})'}; a smaller or coarser target would fit\n")
        code = 1
    except KeyboardInterrupt:
        sys.stderr.write("keepout: stopped\n")
        code = 130
    gc.freeze()  # what is left goes with the process; looking through it took longest of all
    sys.exit(code if isinstance(code, int) else 0)

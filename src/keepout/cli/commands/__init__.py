"""Each command of the command line as a function from its arguments to its JSON summary, a module for each group.

Each imports what it needs when it is called: who lists targets does not wait for what flies and draws. Each tries where
its results are to go before it works, and leaves nothing behind where it refuses.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from keepout.core.errors import KeepoutError, UsageError


@contextmanager
def usage() -> Iterator[None]:
    """Turn the refusals of what reads an option's value into those of a command that cannot be meant.

    Raises:
        UsageError: for any `KeepoutError`.

    """
    try:
        yield
    except KeepoutError as error:
        raise UsageError(str(error)) from None

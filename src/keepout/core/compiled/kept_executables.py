"""What a process takes from the disk instead of making it again: programs, without tracing them, and arrays.

JAX keeps compiled programs itself and finds one by what it was lowered to, and so traces and lowers the function at
every start, which takes longer than loading what comes of it. Here a call's lowered program is kept too, as written by
`jax.export`. It is found by all that tracing depends on: the function's name, every source file of Keepout, the
versions of Python and of the libraries that trace, JAX's settings, the shapes and types of the arguments' arrays,
everything in the arguments that is no array, and the numbers at the top of Keepout's modules.

What cannot be told apart that way is not kept: arguments that hold functions or classes of others, Keepout changed
while it runs (a function replaced, a source file edited), programs that `jax.export` refuses since they call back into
Python, and anything but a CPU. It is then compiled as by `equinox.filter_jit`. Where and for whom all this is kept: see
`kept_programs`. How an answer's arrays are put together is kept as a pickle, which only such a folder may hold.
"""

import collections
import functools
import hashlib
import importlib.metadata
import io
import pickle
import platform
import sys
import sysconfig
import threading
import time
import types
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import export
from jax.core import Tracer
from jaxtyping import PyTree

from keepout.core.compiled.kept_programs import entries, folder_in_use, read_entry, write_entry
from keepout.core.kept import Form, packed, unpacked

P = ParamSpec("P")
T = TypeVar("T")
Arrays = dict[str, np.ndarray]

_PACKAGE = Path(__file__).parents[2]
_STARTED = time.time() - time.process_time()
_KNOWN = ("keepout", "jax", "jaxlib", "equinox", "numpy", "builtins")
"""Packages whose functions and classes are told by a version or by source files."""
_TRACED = (
    *(f"keepout.core.{room}" for room in ("compiled", "control", "fields", "flight", "guard", "motion")),
    "keepout.flights.navigation",
    "keepout.flights.thrusters",
    "keepout.apps",
)
"""Rooms of Keepout whose functions are traced."""
_AT_HAND = 16
"""Programs of a function that a process has at hand; those used longest ago go back to the disk.

One program takes hundreds of pieces of memory, and a process may have 65,530 of them on Linux: without a limit, a
process that flew fifty different missions would die.
"""


class _UnknownError(Exception):
    """Something is not told by a version or a source file."""


class _Place:
    """Stands for one of a program's arrays in what the function gives."""

    def __init__(self, number: int):
        self.number = number


def _is_place(leaf: Any) -> bool:
    return isinstance(leaf, _Place)


# ---- programs


def kept_jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function as `equinox.filter_jit` does, and keep its programs from one process to the next.

    Results are the same bits whether a program was kept or not.

    Args:
        function: pure, at the top level of a module of Keepout; what it gives holds arrays and what pickles.

    """
    plain = eqx.filter_jit(function)
    programs: collections.OrderedDict[Any, Callable[[list[Any]], Any] | None] = collections.OrderedDict()
    lock = threading.Lock()

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        folder = folder_in_use()
        arrays, still = eqx.partition((args, kwargs), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        if folder is None or _watched() or any(isinstance(x, Tracer) for x in leaves):
            return plain(*args, **kwargs)
        shapes = tuple((x.shape, str(x.dtype), getattr(x, "weak_type", False)) for x in leaves)
        rest, rest_structure = jax.tree.flatten(still)
        known = structure, shapes, tuple((type(x), x) for x in rest), rest_structure, _settings()
        with lock:
            if known not in programs:
                programs[known] = _program(folder, function, structure, shapes, still, leaves)
            programs.move_to_end(known)
            program = programs[known]
            if len(programs) > _AT_HAND:
                programs.popitem(last=False)
        return plain(*args, **kwargs) if program is None else program(leaves)

    return called


def _watched() -> bool:
    """Whether programs are to run as only JAX runs them: elsewhere than on a CPU, or to look for errors."""
    asked = (getattr(jax.config, f"jax_{name}") for name in ("disable_jit", "debug_nans", "debug_infs"))
    return jax.default_backend() != "cpu" or any(asked)


def _program(
    folder: Path,
    function: Callable[..., Any],
    structure: Any,
    shapes: tuple[Any, ...],
    still: PyTree,
    leaves: list[Any],
) -> Callable[[list[Any]], Any] | None:
    """Take a call's program from the folder, or export it and keep it; None where it cannot be kept."""
    try:
        _require_own(function)
        where = jax.tree.unflatten(structure, [True] * len(leaves))
        told = _pickled((where, still)) + repr((shapes, _constants(), _settings())).encode()
        named = f"{function.__module__}.{function.__qualname__} {_sources()}".encode()
        make = functools.partial(_exported, function, structure, still, leaves)
        exported, outline, _ = entries(folder).take(f"call_{function.__name__}", named + told, make, _PROGRAM)
    except _UnknownError:
        return None
    # The same text whether it was kept or not, so that JAX finds in its folder what XLA made of it.
    run = jax.jit(exported.call).lower(*leaves).compile()
    answers, places = jax.tree.flatten(outline, is_leaf=_is_place)

    def program(leaves: list[Any]) -> Any:
        arrays = run(*leaves)
        return jax.tree.unflatten(places, [arrays[leaf.number] if _is_place(leaf) else leaf for leaf in answers])

    return program


_Program = tuple[export.Exported, PyTree, bytes]
"""What is kept of a call: the program, the outline of its answer, and both as they stand in a file."""


def _loaded(path: Path) -> _Program:
    content = read_entry(path)
    try:
        exported, outline = pickle.loads(content)
        found = export.deserialize(exported), outline, content
    except Exception as error:  # neither has one kind for what it cannot load
        raise ValueError(str(error)) from error
    jax.monitoring.record_event("/keepout/kept_program_loaded")
    return found


def _exported(function: Callable[..., Any], structure: Any, still: PyTree, leaves: list[Any]) -> _Program:
    """Trace and lower a program.

    Raises:
        _UnknownError: it cannot be kept.

    """
    outlines: list[PyTree] = []

    def flat(*leaves: Any) -> tuple[Any, ...]:
        args, kwargs = eqx.combine(jax.tree.unflatten(structure, leaves), still)
        answer, rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
        arrays, places = jax.tree.flatten(answer)
        placed = jax.tree.unflatten(places, [_Place(number) for number in range(len(arrays))])
        outlines.append(eqx.combine(placed, rest, is_leaf=_is_place))
        return tuple(arrays)

    flat.__name__ = flat.__qualname__ = f"kept_{function.__name__}"
    try:
        exported = export.export(jax.jit(flat))(*leaves)
        return exported, outlines[-1], pickle.dumps((bytes(exported.serialize()), outlines[-1]))
    # What calls back into Python, or gives what does not pickle; what the function itself refuses, it refuses again.
    except (ValueError, NotImplementedError, TypeError, AttributeError, pickle.PicklingError) as error:
        raise _UnknownError(str(error)) from error


def _write_program(path: Path, made: _Program) -> None:
    with suppress(_UnknownError):
        if _sources() == _sources.__wrapped__():
            write_entry(path, made[2])


_PROGRAM = Form("-cache", _loaded, _write_program)


# ---- arrays


def kept_arrays(name: str, made_from: Any, make: Callable[[], Arrays], *, libraries: Sequence[str] = ()) -> Arrays:
    """Take arrays from the folder of kept programs, or make them and keep them there.

    They are found by everything that they were computed from: all that `made_from` holds, arrays and the rest, and what
    a program is found by. Where something cannot be told apart that way, such as a field that is a function of the
    user's, nothing is kept. Last bits depend on the processor, and so does the folder.

    Args:
        name: of what the arrays are, a word for the file's name.
        made_from: a tree of all that `make` depends on.
        make: gives the arrays, by name.
        libraries: distributions, by name, whose version matters beside those that Keepout's programs depend on.

    Returns:
        The arrays, the same bits whether they were kept or not.

    """
    folder = folder_in_use()
    told = _told_apart(made_from) if folder is not None else None
    if folder is None or told is None:
        return make()
    versions = [(library, importlib.metadata.version(library)) for library in libraries]
    return entries(folder).take(name, told + repr(versions).encode(), make, _ARRAYS)


_ARRAYS = Form("-cache", lambda path: unpacked(read_entry(path)), lambda path, made: write_entry(path, packed(made)))


# ---- what programs and arrays depend on


def _told_apart(tree: PyTree) -> bytes | None:
    """Tell a tree from every other: by its arrays, all else in it, Keepout's source and constants, JAX's settings.

    Returns:
        A digest; None where the tree holds what cannot be told apart, or Keepout was changed while it runs.

    """
    arrays, still = eqx.partition(tree, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    try:
        where = jax.tree.unflatten(structure, [True] * len(leaves))
        whole = hashlib.sha256(_pickled((where, still)))
        whole.update(repr((_sources(), _constants(), _settings())).encode())
    except _UnknownError:
        return None
    for leaf in leaves:
        array = np.asarray(leaf)
        whole.update(repr((array.shape, str(array.dtype))).encode() + np.ascontiguousarray(array).tobytes())
    return whole.digest()


class _Pickler(pickle.Pickler):
    """Refuses functions and classes, and objects of classes, that no version and no source file tells."""

    def reducer_override(self, obj: Any) -> Any:
        for named in (obj, type(obj)):
            module = getattr(named, "__module__", None)
            package = module.partition(".")[0] if isinstance(module, str) else "builtins"
            if package not in _KNOWN and package not in sys.stdlib_module_names:
                raise _UnknownError(module)
        return NotImplemented


def _pickled(tree: PyTree) -> bytes:
    stream = io.BytesIO()
    try:
        _Pickler(stream, protocol=5).dump(tree)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise _UnknownError(str(error)) from error
    return stream.getvalue()


def _settings() -> tuple[Any, ...]:
    """JAX's settings as they hold in this thread, and the mesh of devices that it traces under."""
    return *(getattr(jax.config, name) for name in _names_of_settings()), str(jax.sharding.get_abstract_mesh())


@functools.cache
def _names_of_settings() -> list[str]:
    return [name for name in sorted(jax.config.values) if hasattr(jax.config, name)]


def _constants() -> list[tuple[str, str]]:
    """Numbers and words at the top of the traced rooms' modules, as they are now.

    Raises:
        _UnknownError: a function there is not the source's: it was replaced.

    """
    found = []
    for name, module in sorted(sys.modules.items()):
        if module is None or name == __name__ or not name.startswith(_TRACED):
            continue
        for key, value in sorted(vars(module).items()):
            if key.startswith("__"):
                continue
            if isinstance(value, bool | int | float | str | tuple):
                found.append((f"{name}.{key}", repr(value)))
            _require_own(value)
            if isinstance(value, type) and value.__module__ == name:
                for attribute in vars(value).values():
                    _require_own(attribute)
    return found


def _require_own(value: Any) -> None:
    """Refuse a function that was written outside of Keepout and of what is installed."""
    if isinstance(value, property):
        value = value.fget
    value = getattr(value, "__func__", value)
    value = getattr(value, "__wrapped__", value)
    if not isinstance(value, types.FunctionType):
        return
    file = value.__code__.co_filename
    if not file.startswith(("<", *_places())):
        raise _UnknownError(f"{value.__qualname__} of {file}")


@functools.cache
def _places() -> tuple[str, ...]:
    return (str(_PACKAGE), *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")))


@functools.cache
def _sources() -> str:
    """Tell Keepout's source and the versions of all that traces it.

    Raises:
        _UnknownError: there are none, or one is younger than this process, which may run what stood there before.

    """
    whole = hashlib.sha256(repr((platform.python_version(), jax.__version__, eqx.__version__, np.__version__)).encode())
    paths = sorted(_PACKAGE.rglob("*.py"))
    if not paths:
        raise _UnknownError("Keepout has no source files")
    for path in paths:
        if path.stat().st_mtime >= _STARTED:
            raise _UnknownError(f"{path} was written after the start")
        whole.update(f"{path.relative_to(_PACKAGE)}\n".encode() + path.read_bytes())
    return whole.hexdigest()

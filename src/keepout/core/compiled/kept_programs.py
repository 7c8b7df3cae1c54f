"""Compiled programs kept on disk from one process to the next: for one user, one processor and one compiler.

What lies in such a folder is machine code that JAX runs unseen, so that whoever may write there may run anything in
the user's name. And XLA may take code made for another processor. Therefore the folder is the user's alone (mode 0700,
no link, out of others' reach), and below it every processor, number of cores, jaxlib and set of compiler flags has its
own. A folder that is not private is refused with one warning, and programs are then compiled as if there were none.
"""

import functools
import hashlib
import os
import platform
import re
import stat
import subprocess
import sys
import warnings
from contextlib import suppress
from pathlib import Path

import jax
import jaxlib.version

from keepout.core.cores import available_cores
from keepout.core.kept import Store, digest
from keepout.core.whole_file import write_whole

VARIABLE = "KEEPOUT_COMPILE_CACHE"
"""Environment variable: "off", or a private folder of one's own instead of the one in the user's folder for caches."""

MOST_BYTES = 256 * 2**20
"""Programs that were not used for the longest time go where all together take more than this."""

_NAME = "programs-"
_ENTRIES = "*-cache"
_PROCESSOR_LINES = re.compile(
    # x86; then ARM and RISC-V.
    r"(?:vendor_id|cpu family|model|model name|stepping|flags"
    r"|Features|CPU implementer|CPU architecture|CPU variant|CPU part|CPU revision|isa|uarch)\s*:.*"
)


class KeptProgramsWarning(UserWarning):
    """Programs are not kept, and why: every start of Keepout compiles anew."""


@functools.cache
def keep_programs() -> Path | None:
    """Have JAX keep what this process compiles, and take what an earlier one has compiled.

    Called by what compiles much: `prepare` (so by `fly` and `campaign`), `OnBoard`, `fit`, `certify`, and by what draws
    surfaces, `keepout replay` and `keepout report`. Importing Keepout changes nothing. Later calls do nothing. JAX has
    one such folder a process, so that other programs compiled in it from then on are kept there too. A folder that JAX
    was already given (`jax_compilation_cache_dir`), or keeping switched off there (`jax_enable_compilation_cache`), is
    left as it is.

    Returns:
        The folder in use; None where it is left to JAX, switched off or refused.

    """
    chosen = os.environ.get(VARIABLE, "")
    given = getattr(jax.config, "jax_compilation_cache_dir", None)
    if chosen == "off" or given or not getattr(jax.config, "jax_enable_compilation_cache", True):
        return None
    try:
        folder = _private_folder(chosen)
    except OSError as error:
        warnings.warn(
            f"compiled programs are not kept: {error.filename}: {error.strerror} "
            f'({VARIABLE} names another folder; "off" keeps none and says nothing)',
            KeptProgramsWarning,
            stacklevel=2,
        )
        return None
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder


def folder_in_use() -> Path | None:
    """Give the folder that `keep_programs` has set up and that JAX still uses; None before that call, and without."""
    folder = keep_programs() if keep_programs.cache_info().currsize else None
    used = getattr(jax.config, "jax_compilation_cache_dir", None)
    return folder if used == str(folder) else None


def _private_folder(chosen: str) -> Path | None:
    """Give the folder for this processor and compiler, made and found private; None where nothing says who may write.

    Raises:
        OSError: it cannot be made, or is not private; `filename` and `strerror` say which and why.

    """
    if not hasattr(os, "getuid"):
        return None
    if chosen:
        base = Path(chosen)
    else:
        import platformdirs

        base = platformdirs.user_cache_path("keepout", appauthor=False, opinion=False) / "compiled"
    # Links on the way are followed once, and what they lead to is checked; the folder itself must not be one.
    base = base.parent.resolve() / base.name
    for parent in reversed(base.parents):
        if not parent.exists():
            parent.mkdir(0o700, exist_ok=True)
    folder = base / (_NAME + digest("\n".join(identity()))[:32])
    for each in (base, folder):
        with suppress(FileExistsError):
            each.mkdir(0o700)
        _require_private(each)
    _require_out_of_reach(base)
    for entry in folder.iterdir():
        if entry.is_symlink() or entry.stat().st_uid != os.getuid():
            raise OSError(0, "belongs to another user, or is a link", str(entry))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(0, "cannot be written to", str(folder))
    _forget_oldest(base)
    return folder


def _require_private(folder: Path) -> None:
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode):
        raise OSError(0, "is no folder, or a link to one", str(folder))
    if state.st_uid != os.getuid():
        raise OSError(0, f"belongs to another user ({state.st_uid}, not {os.getuid()})", str(folder))
    if state.st_mode & 0o077:
        raise OSError(0, f"is open to others (mode {state.st_mode & 0o777:04o}; it must be 0700)", str(folder))


def _require_out_of_reach(folder: Path) -> None:
    """Refuse a folder that another user could put another one in place of: by a folder above that others may write."""
    for parent in reversed(folder.parents):
        state = parent.stat()
        if state.st_uid not in (0, os.getuid()):
            raise OSError(0, "belongs to another user, and programs would be kept below it", str(parent))
        if state.st_mode & 0o022 and not state.st_mode & stat.S_ISVTX:
            raise OSError(0, "may be written by others, and programs would be kept below it", str(parent))
        if not state.st_mode & 0o011:
            return  # nobody else comes further


def identity() -> tuple[str, ...]:
    """Name all that compiled code depends on beside the program: compiler, its flags, processor, cores it may use."""
    compiler = f"jaxlib {jaxlib.version.__version__}", f"flags {os.environ.get('XLA_FLAGS', '')}"
    return (*compiler, f"{platform.system()} {platform.machine()}", f"{available_cores()} cores", *_processors())


@functools.cache
def processor() -> str:
    """Name this machine's kind of processor: model, and a digest of all that compiled code may depend on."""
    told = "\n".join(_processors())
    named = ("model name", "CPU part", "uarch", "machdep.cpu.brand_string")
    models = [line.split(":", 1)[1].strip() for line in told.splitlines() if line.startswith(named)]
    return f"{platform.machine()} {' '.join(models) or 'processor'} ({digest(told)[:8]})"


def _processors() -> tuple[str, ...]:
    """Tell the processors' models and instruction sets."""
    if sys.platform == "darwin":
        told = subprocess.run(["/usr/sbin/sysctl", "machdep.cpu", "hw.optional"], capture_output=True, text=True)
        return (told.stdout,)
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return tuple(sorted({line for line in lines if _PROCESSOR_LINES.fullmatch(line)}))
    return (platform.processor(),)


def _forget_oldest(base: Path) -> None:
    """Remove the programs that were not used for the longest time, of any processor, until `MOST_BYTES` are left."""
    kept = []
    for entry in base.glob(f"{_NAME}*/{_ENTRIES}"):
        with suppress(FileNotFoundError):  # another process may be at the same
            state = entry.stat()
            kept.append((max(state.st_atime, state.st_mtime), state.st_size, entry))
    total = sum(size for _, size, _ in kept)
    for _, size, entry in sorted(kept):
        if total <= MOST_BYTES:
            return
        entry.unlink(missing_ok=True)
        total -= size


# ---- files of the folder


def entries(folder: Path) -> Store:
    """Give the files of the folder: what cannot be used or kept is one warning."""
    return Store(folder, 64, _warn, _warn)


def read_entry(path: Path) -> bytes:
    """Read what `write_entry` wrote; raises a `ValueError` where it is damaged."""
    whole = path.read_bytes()
    check, content = whole[:32], whole[32:]
    if hashlib.sha256(content).digest() != check:
        raise ValueError("it is damaged")
    with suppress(OSError):
        path.touch()  # what is used stays when the folder is full
    return content


def write_entry(path: Path, content: bytes) -> None:
    """Write a file of the folder, whole and with its own checksum."""
    write_whole(path, hashlib.sha256(content).digest() + content)


def _warn(path: Path, error: Exception) -> None:
    why = error.strerror if isinstance(error, OSError) else str(error).partition("\n")[0]
    warnings.warn(f"compiled programs are not all kept: {path}: {why}", KeptProgramsWarning, stacklevel=2)

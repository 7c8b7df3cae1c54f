"""A folder for kept programs that is a test's own."""

import jax
import pytest

from keepout.core.compiled.kept_programs import VARIABLE, keep_programs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A process as a user starts it, with a folder of its own, that has compiled nothing yet."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "kept"))
    keep_programs.cache_clear()
    yield keep_programs()
    keep_programs.cache_clear()
    jax.config.update("jax_compilation_cache_dir", before)

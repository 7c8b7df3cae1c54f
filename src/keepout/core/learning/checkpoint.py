"""The state of an unfinished fit on disk, so that a killed run goes on where it stopped."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from keepout.core.errors import FieldError
from keepout.core.whole_file import write_whole


def save(path: Path, state: Any, fingerprint: str) -> None:
    """Write a pytree of arrays, whole or not at all.

    Raises:
        FieldError: the place cannot be written to.

    """
    leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
    write_whole(path, safetensors.numpy.save(leaves, {"fingerprint": fingerprint}), refusal=FieldError)


def load(path: Path, like: Any, fingerprint: str) -> Any:
    """Read a pytree shaped as `like`.

    Raises:
        FieldError: the file is damaged, or belongs to a fit with other settings.

    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            if (file.metadata() or {}).get("fingerprint") != fingerprint:
                raise FieldError(
                    f"{path}: a checkpoint of another fit (target, profile or seed); delete it to start anew"
                )
            leaves, structure = jax.tree.flatten(like)
            restored = [jnp.asarray(file.get_tensor(f"{i:04d}")) for i in range(len(leaves))]
    except (OSError, safetensors.SafetensorError) as error:
        raise FieldError(f"{path}: a damaged checkpoint ({error}); delete it to start anew") from None
    return jax.tree.unflatten(structure, restored)

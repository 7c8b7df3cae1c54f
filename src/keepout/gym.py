"""Environments for Gymnasium: `import keepout.gym` registers `keepout/Approach-v0` (docs/own-parts.md)."""

from importlib.util import find_spec

from keepout.core.errors import KeepoutError

if find_spec("gymnasium") is None:
    raise KeepoutError("keepout.gym: gymnasium is not installed; pip install 'keepout-gnc[gym]'")

import gymnasium

from keepout.apps.gym.environment import ApproachEnv, ApproachVectorEnv

__all__ = ["ApproachEnv", "ApproachVectorEnv"]

_AT = "keepout.apps.gym.environment"
gymnasium.register(
    "keepout/Approach-v0", entry_point=f"{_AT}:ApproachEnv", vector_entry_point=f"{_AT}:ApproachVectorEnv"
)

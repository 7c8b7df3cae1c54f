"""What a replay's page holds, read back without the code that wrote it."""

import base64
import json
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class ReplayPage:
    """told: the page's JSON; content: the bytes that its references point into."""

    told: dict[str, Any]
    content: bytes

    @classmethod
    def read(cls, path: Path) -> "ReplayPage":
        text = path.read_text(encoding="utf-8")
        told = re.search(r'<script type="application/json" id="scene">(.*?)</script>', text, re.DOTALL)
        content = re.search(r'<script type="text/plain" id="content">(.*?)</script>', text, re.DOTALL)
        return cls.of(json.loads(told[1]), content[1])

    @classmethod
    def of(cls, told: dict[str, Any], text: str) -> "ReplayPage":
        """The page whose bytes are this text."""
        return cls(told, zlib.decompress(base64.b64decode(text, validate=True)))

    def array(self, reference: dict[str, Any]) -> np.ndarray:
        """The numbers that a reference stands for."""
        kind = np.dtype(reference["type"])
        count = int(np.prod(reference["shape"]))
        stored = np.frombuffer(self.content, kind, count, reference["offset"]).reshape(reference["shape"])
        return stored * reference["scale"] + reference["origin"] if "scale" in reference else stored

    def flights(self) -> dict[str, dict[str, Any]]:
        """The flights by name."""
        return {flight["name"]: flight for flight in self.told["flights"]}

    def positions(self, name: str) -> np.ndarray:
        """The path of a flight, m."""
        return self.array(self.flights()[name]["arrays"]["position"])

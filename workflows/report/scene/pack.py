"""Arrays as text in a page: rounded to a step, differences from row to row, byte by byte, deflated, in base64.

The browser inflates them by itself (`DecompressionStream`) and adds the differences up again (viewer.js).
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from forward.model import FloatArray


@dataclass
class Packer:
    """Arrays that travel together."""

    told: list[dict[str, Any]] = field(default_factory=list)
    planes: list[bytes] = field(default_factory=list)

    def add(self, values: Any, step: float = 1.0) -> int:
        """Add an array (n,) or (n, m), rounded to multiples of a step (NaN: missing); return its number."""
        array = np.asarray(values, dtype=float)
        array = array.reshape(len(array), -1)
        missing = np.isnan(array)
        whole = np.rint(np.where(missing, 0.0, array) / step).astype(np.int64)
        differences = np.diff(whole, axis=0, prepend=0).T.ravel()
        zigzag = ((differences << 1) ^ (differences >> 63)).astype(np.uint64)
        count = max(1, -(-int(zigzag.max(initial=0)).bit_length() // 8))
        for k in range(count):
            self.planes.append((zigzag >> np.uint64(8 * k)).astype(np.uint8).tobytes())
        kept = {"n": array.shape[0], "m": array.shape[1], "step": step, "planes": count}
        if missing.any():
            kept["missing"] = np.flatnonzero(missing.any(axis=1)).tolist()
        self.told.append(kept)
        return len(self.told) - 1

    def field(self, values: FloatArray, relative: float) -> int:
        """Add an array, rounded to a part of its largest number."""
        finite = np.abs(values[np.isfinite(values)])
        size = float(finite.max(initial=0.0))
        return self.add(values, relative * size if size > 0 else 1.0)

    def text(self) -> str:
        """Return all arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self.planes), 9)).decode()

"""Binary glTF 2.0: a JSON document and one buffer in one file."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
VERTICES, INDICES = 34962, 34963  # what a buffer view is for


class Glb:
    """A glTF document that grows: `add` appends to a list and gives the index, `accessor` stores
    an array.
    """

    def __init__(self, generator: str = "hoigs") -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": generator}}
        self._data = bytearray()

    def add(self, kind: str, **entry: Any) -> int:
        """Append to the list `kind` ("nodes", "meshes" …) and give the index of the entry."""
        entries: list[dict[str, Any]] = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def accessor(
        self, array: np.ndarray, target: int | None = None, *, normalized: bool = False
    ) -> int:
        """Store an array [N] or [N, k]; gives the index of its accessor.

        Args:
            target: VERTICES or INDICES for what a mesh reads.
            normalized: integers stand for [0, 1].
        """
        array = np.ascontiguousarray(array)
        width = 1 if array.ndim == 1 else int(np.prod(array.shape[1:]))
        view: dict[str, Any] = {
            "buffer": 0, "byteOffset": len(self._data), "byteLength": array.nbytes,
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        self._data += array.tobytes()
        self._data += b"\0" * (-len(self._data) % 4)
        entry: dict[str, Any] = {
            "bufferView": self.add("bufferViews", **view),
            "componentType": COMPONENTS[array.dtype.name],
            "count": len(array),
            "type": SHAPES[width],
        }
        if normalized:
            entry["normalized"] = True
        if (array.dtype == np.float32 and width <= 4) or width == 1:
            flat = array.reshape(len(array), width)
            entry["min"], entry["max"] = flat.min(0).tolist(), flat.max(0).tolist()
        return self.add("accessors", **entry)

    def bytes(self) -> bytes:
        """The file."""
        if self._data:
            self.document["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self._data), 0x004E4942) + bytes(self._data)
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks

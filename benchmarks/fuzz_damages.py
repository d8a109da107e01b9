"""Damages to files by their kind: a value, a tensor, an array's header, a line, or bytes."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import math
import pickle
import random
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

MARK = "code-was-run"
ODD_NUMBERS = (0, -1, 1, 2**31, 10**12, -(10**18), 1e30, math.inf, -math.inf, math.nan, 0.5)
ODD_TEXTS = ("", "x" * 5000, "../../x", "/etc/passwd", "a\0b", "\x1b[31m", "body:anny", "é\u202e")
YAML = ("&a [*a]", "!!python/object/apply:os.system [x]", "<<: {a: 1}", "\t")
ODD_BYTES = (b"", b"\0" * 64, b"\xff\xfe\x00", b"[" * 60_000, b"{}", b"PK\x03\x04", b"\x93NUMPY")


class _Payload:
    """A pickle that writes a file when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return (open, (str(self.mark), "w"))


def damaged(path: Path, data: bytes, rng: random.Random, mark: Path) -> bytes:
    """The content of a file after a random damage of its kind, or of its bytes."""
    kinds: list[Callable[[], bytes]] = [lambda: _bytes(data, rng, mark)]
    if path.suffix in (".json", ".jsonl"):
        kinds += 4 * [lambda: _json(data, rng)]
    elif path.suffix == ".npz":
        kinds += 4 * [lambda: _npz(data, rng, mark)]
    elif path.suffix == ".safetensors":
        kinds += 4 * [lambda: _safetensors(path, rng)]
    elif path.suffix == ".npy":
        kinds += 4 * [lambda: _npy(data, rng, mark)]
    elif path.suffix == ".pkl":
        kinds += 4 * [lambda: _pickle(data, rng, mark)]
    elif path.suffix in (".yaml", ".toml", ".ply", ".obj", ".txt"):
        kinds += 4 * [lambda: _words(data, rng)]
    return rng.choice(kinds)()


def _bytes(data: bytes, rng: random.Random, mark: Path) -> bytes:
    at = rng.randrange(len(data) + 1)
    choice = rng.randrange(6)
    if choice == 0:
        return data[:at]
    if choice == 1:
        return rng.choice(ODD_BYTES)
    if choice == 2:
        return pickle.dumps(_Payload(mark))
    if choice == 3:
        return data[:at] + rng.randbytes(rng.randint(1, 40)) + data[at:]
    if choice == 4:
        return data[:at] + data[at + rng.randint(1, 40) :]
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _odd(rng: random.Random) -> Any:
    deep: Any = []
    for _ in range(rng.choice((3, 500))):
        deep = [deep]
    return rng.choice(
        (*ODD_NUMBERS, *ODD_TEXTS, None, True, [], {}, [1, "x"], {"use": 3}, deep,
         list(range(20_000)))
    )  # fmt: skip


def _json(data: bytes, rng: random.Random) -> bytes:
    """JSON with a value replaced, removed or doubled under another key."""
    lines = (
        data.decode().splitlines() if data[:1] == b"{" and data.count(b"}\n{") else [data.decode()]
    )
    number = rng.randrange(len(lines))
    tree = json.loads(lines[number])
    for _ in range(rng.choice((1, 1, 1, 3))):
        places = list(_places(tree))
        if not places:
            break
        holder, key = rng.choice(places)
        action = rng.randrange(4)
        if action == 0:
            del holder[key]
        elif action == 1 and isinstance(holder, dict):
            with contextlib.suppress(RecursionError):  # an earlier damage may be this deep
                holder[rng.choice(ODD_TEXTS)] = copy.deepcopy(holder[key])
        else:
            holder[key] = _odd(rng)
    lines[number] = json.dumps(tree if rng.random() > 0.03 else _odd(rng))
    return "\n".join(lines).encode() + b"\n"


def _places(tree: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    todo = [tree]
    while todo and len(found) < 3000:
        node = todo.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node))
        if isinstance(node, dict | list):
            for key in keys:
                found.append((node, key))
                if isinstance(node[key], dict | list):
                    todo.append(node[key])
    return found


def _words(data: bytes, rng: random.Random) -> bytes:
    """Text with a word or a line replaced, removed or moved."""
    lines = data.decode("utf-8", "replace").split("\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    choice = rng.randrange(5)
    if choice == 0:
        lines[at] = rng.choice(
            ("&a [*a]", "!!python/object/apply:os.system [x]", "<<: {a: 1}", "\t")
        )
    elif choice == 1:
        del lines[at]
    elif choice == 2:
        lines.insert(rng.randrange(len(lines)), lines[at])
    else:
        odd = rng.choice((*ODD_NUMBERS, *ODD_TEXTS, "[", "{", ":", ".inf", "999999999999"))
        words[rng.randrange(len(words))] = str(odd)
        lines[at] = " ".join(words)
    return "\n".join(lines).encode("utf-8", "replace")


def _npz(data: bytes, rng: random.Random, mark: Path) -> bytes:
    """An npz with an array of other values, shape or dtype, a header that lies, or a pickle."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(list(arrays))
    choice = rng.randrange(9)
    array = arrays[name]
    raw: bytes | None = None
    if choice == 0:
        del arrays[name]
    elif choice == 1 and array.size and array.dtype.kind == "f":
        arrays[name] = array.copy()
        arrays[name].flat[rng.randrange(array.size)] = rng.choice(ODD_NUMBERS[:3] + ODD_NUMBERS[6:])
    elif choice == 2:
        arrays[name] = array.astype(rng.choice(("U8", "i8", "f2", "c16", "?"))) if (
            array.dtype.kind in "fb") else np.array(7.0)  # fmt: skip
    elif choice == 3:
        arrays[name] = array[..., None]
    elif choice == 4 and array.ndim:
        arrays[name] = array[: rng.randrange(len(array) + 1)]
    elif choice == 5:
        arrays[name] = np.array([_Payload(mark)], dtype=object)
    elif choice == 6:
        arrays[rng.choice(("../x", "extra", "a/b"))] = array
    elif choice == 7:
        shape = rng.choice(((10**12,), (-1, 3), (10**9, 10**9), (2**70,), ()))
        raw = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            raw, {"descr": "<f4", "fortran_order": False, "shape": shape}
        )
        raw = raw.getvalue() + b"\0" * 64
    else:
        arrays[name] = np.zeros((0, *array.shape[1:]), array.dtype)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, values in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, values, allow_pickle=True)
            archive.writestr(f"{key}.npy", raw if raw and key == name else buffer.getvalue())
    return out.getvalue()


def _npy(data: bytes, rng: random.Random, mark: Path) -> bytes:
    """An array of other values, shape or dtype; in a pickled dictionary, another value."""
    array = np.load(io.BytesIO(data), allow_pickle=True)
    if array.dtype == object:
        tree = array.item()
        _tree(tree, rng, mark)
        out = io.BytesIO()
        try:
            np.save(out, np.array(tree, dtype=object), allow_pickle=True)
        except RecursionError:  # as in `_pickle`
            return data[: len(data) // 2]
        return out.getvalue()
    packed = io.BytesIO()
    np.savez(packed, a=array)
    with zipfile.ZipFile(io.BytesIO(_npz(packed.getvalue(), rng, mark))) as archive:
        return archive.read(archive.namelist()[0]) if archive.namelist() else b""


def _pickle(data: bytes, rng: random.Random, mark: Path) -> bytes:
    """A pickled dictionary, or joblib's, with another value, in the same form."""
    try:
        tree, dump = pickle.loads(data), pickle.dumps  # of the fuzzer's own file
    except (pickle.UnpicklingError, KeyError, EOFError, ValueError, IndexError):
        import joblib

        def dump(tree: Any) -> bytes:
            out = io.BytesIO()
            joblib.dump(tree, out)
            return out.getvalue()

        tree = joblib.load(io.BytesIO(data))
    _tree(tree, rng, mark)
    try:
        return dump(tree)
    except RecursionError:  # of a depth that a reader has to refuse, but pickle cannot write
        return data[: len(data) // 2]


def _tree(tree: Any, rng: random.Random, mark: Path) -> None:
    """Replace a value of nested dictionaries, lists and arrays."""
    holder, key = rng.choice(_places(tree))
    value = holder[key]
    odds = [_odd(rng), np.zeros((2, 3)), np.full((4, 4), np.nan), _Payload(mark)]
    if isinstance(value, np.ndarray) and value.size:
        broken = value.astype(float) if value.dtype.kind in "iuf" else value
        broken.flat[rng.randrange(value.size)] = rng.choice(ODD_NUMBERS)
        odds += [broken, value[None], value.astype(str)]
    holder[key] = rng.choice(odds)


def _safetensors(path: Path, rng: random.Random) -> bytes:
    """A checkpoint with a tensor of other values, shape or dtype, or without it."""
    tensors = load_file(path)
    name = rng.choice(list(tensors))
    value, choice = tensors[name].clone(), rng.randrange(6)
    if choice == 0:
        del tensors[name]
    elif choice == 1 and value.numel():
        odd = rng.choice(ODD_NUMBERS) if value.is_floating_point() else rng.randrange(256)
        value.view(-1)[rng.randrange(value.numel())] = odd
        tensors[name] = value
    elif choice == 2:
        tensors[name] = value.to(rng.choice((torch.int64, torch.float16, torch.bool)))
    elif choice == 3:
        tensors[name] = value[None].contiguous()
    elif choice == 4 and value.dim():
        tensors[name] = value[: rng.randrange(len(value) + 1)].contiguous()
    else:
        tensors["model.other"] = value
    with tempfile.TemporaryDirectory() as folder:
        save_file(tensors, Path(folder) / "x")
        return (Path(folder) / "x").read_bytes()

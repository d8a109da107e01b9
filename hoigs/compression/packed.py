"""A set of tensors in one safetensors file of zlib streams, described by JSON values.

Every tensor is a stream of bytes. Floating-point tensors are quantised first, with the high bytes
of 16-bit levels before the low ones, which compresses better; all others are lossless. The JSON
holds the shape, dtype, bits and CRC-32 of each.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoigs.compression.levels import Bits, Levels, bits_of, quantise, restore
from hoigs.core.errors import CheckpointError

ZLIB_LEVEL = 9
FLOATS = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16,
          "float64": torch.float64}  # fmt: skip
EXACT = {"int64": torch.int64, "int32": torch.int32, "int16": torch.int16, "int8": torch.int8,
         "uint8": torch.uint8, "bool": torch.bool}  # fmt: skip


def pack(
    tensors: Mapping[str, Tensor], bits: Callable[[str], Bits] = bits_of
) -> tuple[dict[str, Tensor], dict[str, dict[str, Any]]]:
    """Compressed streams, as uint8 tensors by name, and their descriptions, as JSON values.

    Float64 tensors (times of keyframes) and integers are lossless.

    Args:
        bits: number of bits for a tensor of a name.

    Raises:
        ValueError: a value is not finite, or a dtype is not supported.
    """
    streams: dict[str, Tensor] = {}
    described: dict[str, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        kind = str(tensor.dtype).removeprefix("torch.")
        record: dict[str, Any] = {"shape": list(tensor.shape), "dtype": kind}
        if kind in FLOATS and kind != "float64":
            try:
                levels = quantise(tensor, bits(name))
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            data = _bytes(levels)
            record |= {"bits": levels.bits}
        elif kind in FLOATS | EXACT:
            data = tensor.numpy().tobytes()
        else:
            raise ValueError(f"{name}: tensors of {kind} cannot be packed")
        described[name] = {**record, "crc32": zlib.crc32(data)}
        squeezed = np.frombuffer(zlib.compress(data, ZLIB_LEVEL), np.uint8)
        streams[name] = torch.from_numpy(squeezed.copy())
    return streams, described


def unpack(
    streams: Mapping[str, Tensor], described: Mapping[str, Mapping[str, Any]]
) -> dict[str, Tensor]:
    """The tensors of `pack`, floating-point ones quantised.

    Raises:
        CheckpointError: a stream is absent, damaged, or differs from its description.
    """
    found = {}
    for name, record in described.items():
        if name not in streams:
            raise CheckpointError(f"{name}: described, but not in the file")
        try:
            data = _decompressed(streams[name].numpy().tobytes(), _size(record))
        except zlib.error as error:
            raise CheckpointError(f"{name}: damaged: {error}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{name}: does not match its description: {error}") from error
        if zlib.crc32(data) != record["crc32"]:
            raise CheckpointError(f"{name}: damaged: its checksum differs")
        try:
            found[name] = _tensor(data, record)
        except (KeyError, ValueError) as error:
            raise CheckpointError(f"{name}: does not match its description: {error}") from error
    return found


def _size(record: Mapping[str, Any]) -> int:
    """Bytes of a tensor's stream when it is decompressed."""
    shape = [int(size) for size in record["shape"]]
    count = math.prod(shape)
    if record["dtype"] not in FLOATS | EXACT:
        raise ValueError(f"unknown dtype {record['dtype']!r}")
    if record.get("bits") is None:
        return count * np.dtype(record["dtype"] if record["dtype"] != "bfloat16" else "f2").itemsize
    channels = shape[-1] if len(shape) > 1 else 1
    return 16 * channels + count * record["bits"] // 8


def _decompressed(data: bytes, size: int) -> bytes:
    """Exactly `size` bytes, however many the stream would give.

    Raises:
        zlib.error, ValueError: it is damaged, or of another size.
    """
    stream = zlib.decompressobj()
    found = stream.decompress(data, size + 1)
    if len(found) != size or not (stream.eof or stream.decompress(b"") == b""):
        raise ValueError(f"not the {size} bytes that its shape needs")
    return found


def _bytes(levels: Levels) -> bytes:
    """Ranges of the channels (float64), then the levels, one byte plane after the other."""
    ranges = torch.stack((levels.low, levels.step)).numpy().tobytes()
    codes = levels.codes.numpy()
    # channel by channel: levels of one channel are similar, which compresses better
    columns = codes.reshape(-1, codes.shape[-1]).T if codes.ndim > 1 else codes.reshape(1, -1)
    flat = np.ascontiguousarray(columns).reshape(-1)
    if levels.bits == 8:
        return ranges + flat.astype(np.uint8).tobytes()
    return ranges + (flat >> 8).astype(np.uint8).tobytes() + (flat & 255).astype(np.uint8).tobytes()


def _tensor(data: bytes, record: Mapping[str, Any]) -> Tensor:
    shape = [int(size) for size in record["shape"]]
    if 0 in shape:
        return torch.zeros(shape, dtype=(FLOATS | EXACT)[record["dtype"]])
    if "bits" not in record:
        dtype = (FLOATS | EXACT)[record["dtype"]]
        kind = np.dtype(record["dtype"])
        return torch.from_numpy(np.frombuffer(data, kind).copy().reshape(shape)).to(dtype)
    channels = shape[-1] if len(shape) > 1 else 1
    count = int(np.prod(shape, dtype=np.int64))
    low, step = torch.from_numpy(
        np.frombuffer(data, np.float64, 2 * channels).copy().reshape(2, channels)
    )
    planes = np.frombuffer(data, np.uint8, offset=16 * channels).astype(np.int32)
    if len(planes) != count * record["bits"] // 8:
        raise ValueError(f"{len(planes)} bytes of levels for {count} of {record['bits']} bits")
    flat = planes if record["bits"] == 8 else (planes[:count] << 8) + planes[count:]
    codes = np.ascontiguousarray(flat.reshape(channels, -1).T).reshape(shape)
    levels = Levels(torch.from_numpy(codes), low, step, record["bits"])
    return restore(levels, FLOATS[record["dtype"]])

"""A model's tensors as a compact checkpoint, which every reader of checkpoints accepts."""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor

from hoigs.core.errors import CheckpointError

# Min-max quantisation: values as 8 or 16 bits between the minimum and maximum of a channel.

Bits = Literal[8, 16]

# names of tensors with 8 bits, by the last part or by any part of the name: 1/510 of their range is
# not visible in an image. Positions and network weights need 16: 1/131070 of 1 m is 0.01 mm
EIGHT = ("quats", "keyframe_quats", "log_scales", "opacity_logits", "sh", "embedding", "mixture")
EIGHT_IN = ("planes.",)


def bits_of(name: str) -> Bits:
    """The number of bits for a tensor of this name."""
    last = name.rpartition(".")[2]
    return 8 if last in EIGHT or any(part in name for part in EIGHT_IN) else 16


@dataclass(frozen=True)
class Levels:
    """A quantised tensor.

    Attributes:
        codes: of the tensor's shape, 0 to 2^bits - 1, int32.
        low, step: float64, of each channel: value = low + step * code. Channels are the last axis;
            a tensor of fewer than two axes is one channel.
    """

    codes: Tensor
    low: Float[Tensor, " C"]
    step: Float[Tensor, " C"]
    bits: Bits

    @property
    def bound(self) -> Float[Tensor, " C"]:
        """The largest error in each channel, before rounding to the tensor's dtype."""
        return self.step / 2


def quantise(values: Float[Tensor, "..."], bits: Bits) -> Levels:
    """Quantise to the nearest levels.

    Raises:
        ValueError: a value is not finite.
    """
    if not torch.isfinite(values).all():
        raise ValueError("values that are not finite cannot be quantised")
    exact = values.detach().cpu().to(torch.float64)
    channels = exact.reshape(-1, exact.shape[-1]) if exact.dim() > 1 else exact.reshape(-1, 1)
    if channels.numel() == 0:
        low = step = torch.zeros(channels.shape[1], dtype=torch.float64)
        return Levels(exact.to(torch.int32), low, step, bits)
    low, high = channels.amin(0), channels.amax(0)
    step = (high - low) / (2**bits - 1)
    codes = ((channels - low) / torch.where(step > 0, step, 1.0)).round()
    return Levels(codes.clamp(0, 2**bits - 1).to(torch.int32).reshape(exact.shape), low, step, bits)


def restore(levels: Levels, dtype: torch.dtype) -> Tensor:
    """The values of quantised levels."""
    codes = levels.codes.to(torch.float64)
    if codes.dim() > 1:
        return (levels.low + levels.step * codes).to(dtype)
    return (levels.low[:1] + levels.step[:1] * codes.reshape(-1)).reshape(codes.shape).to(dtype)


# A set of tensors in one safetensors file of zlib streams, described by JSON values.
#
# Every tensor is a stream of bytes. Floating-point tensors are quantised first, with the high bytes
# of 16-bit levels before the low ones, which compresses better; all others are lossless. The JSON
# holds the shape, dtype, bits and CRC-32 of each.

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


FORMAT = "hoigs-compact"
VERSION = 2
READABLE = (1, VERSION)
COMPOSED = "composed"  # key of the tensors that are not written, since spec and clip determine them


def write_compact(
    folder: Path,
    state: Mapping[str, Tensor],
    composed: Mapping[str, Tensor],
    meta: Mapping[str, Any],
    extra: Mapping[str, Tensor] | None = None,
) -> int:
    """Write `step_000123.safetensors` and `.json`; the JSON comes last and completes it.

    Args:
        state: of the trained model. composed: state of the untrained model of spec and clip, with
            as many Gaussians; tensors that are equal in both are not written.
        meta: of the model's checkpoint (step, counts, spec_name, model_hash).
        extra: other tensors, lossless, by full name ("cameras.…").

    Returns:
        Bytes of both files.

    Raises:
        ValueError: a value is not finite.
    """
    same = [k for k, v in state.items() if k in composed and _equal(v, composed[k])]
    again = set(same)
    mine = {f"model.{k}": v for k, v in state.items() if k not in again}
    kept = {k: v.to(torch.float64) if v.is_floating_point() else v
            for k, v in (extra or {}).items()}  # fmt: skip
    streams, described = pack(mine | kept)
    record = {
        **{key: meta[key] for key in ("step", "time_s", "counts", "spec_name", "model_hash")},
        "format": FORMAT,
        "version": VERSION,
        "tensors": described,
        COMPOSED: same,
    }
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"step_{meta['step']:06d}"
    weights, page = folder / f"{stem}.safetensors", folder / f"{stem}.json"
    temporary = weights.with_suffix(f".{os.getpid()}.part")
    save_file(streams, temporary)
    temporary.replace(weights)
    temporary = page.with_suffix(f".{os.getpid()}.part")
    temporary.write_text(json.dumps(record))
    temporary.replace(page)
    return weights.stat().st_size + page.stat().st_size


def read_compact(streams: Mapping[str, Tensor], meta: Mapping[str, Any]) -> dict[str, Tensor]:
    """Tensors of a compact checkpoint, by their names in an ordinary one.

    Raises:
        CheckpointError: damaged, or of another version.
    """
    if meta.get("version") not in READABLE:
        expected = " or ".join(map(str, READABLE))
        raise CheckpointError(f"{FORMAT} version {meta.get('version')!r}, expected {expected}")
    found = unpack(streams, meta["tensors"])
    return {
        name: value.float() if name.startswith("cameras.") and value.dtype == torch.float64
        else value
        for name, value in found.items()
    }  # fmt: skip


def _equal(a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and bool(torch.equal(a.cpu(), b.cpu()))

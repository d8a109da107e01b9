"""Run by the Python of an environment with ONNX Runtime; it imports nothing of hoigs.

Answers requests from standard input, a line of JSON and then raw bytes each, on standard output:

- `{"image": [height, width]}` and RGB bytes, the longer side 1024: the picture is encoded, which
  takes about a second; nothing is answered.
- `{"points": [[x, y], ...], "labels": [...]}`: the last picture's four masks, as a line with their
  expected overlaps and float16 logits [4, 256, 256] of a square whose side the picture's longer one
  is. Labels: 1 inside, 0 outside, 2 and 3 the corners of a box, -1 nothing.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

SIDE, CELLS = 1024, 256
MEAN = np.array((123.675, 116.28, 103.53), np.float32)  # of the network's training pictures
STD = np.array((58.395, 57.12, 57.375), np.float32)
# The published decoder chooses one of its masks; these are what it chooses from.
LOGITS, OVERLAPS = "/Reshape_9_output_0", "/iou_prediction_head/layers.2/Gemm_output_0"


def main() -> None:
    import onnxruntime

    settings = json.loads(sys.argv[1])
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = settings["threads"]
    options.inter_op_num_threads = 1
    providers = ["CPUExecutionProvider"]
    encoder = onnxruntime.InferenceSession(settings["encoder"], options, providers=providers)
    decoder = onnxruntime.InferenceSession(
        with_outputs(Path(settings["decoder"]).read_bytes(), (LOGITS, OVERLAPS)),
        options, providers=providers,
    )  # fmt: skip
    seen, out = None, sys.stdout.buffer
    while line := sys.stdin.buffer.readline():
        request = json.loads(line)
        if "image" in request:
            height, width = request["image"]
            image = np.frombuffer(read(height * width * 3), np.uint8).reshape(height, width, 3)
            padded = np.zeros((1, 3, SIDE, SIDE), np.float32)
            padded[0, :, :height, :width] = ((image - MEAN) / STD).transpose(2, 0, 1)
            (seen,) = encoder.run(None, {"input": padded})
            continue
        masks, overlaps = answered(decoder, seen, request)
        out.write(json.dumps({"overlaps": overlaps[0].tolist()}).encode() + b"\n")
        out.write(masks[0].astype(np.float16).tobytes())
        out.flush()


def answered(decoder: Any, seen: Any, request: dict[str, Any]) -> Any:
    return decoder.run(
        [LOGITS, OVERLAPS],
        {
            "image_embeddings": seen,
            "point_coords": np.array([request["points"]], np.float32),
            "point_labels": np.array([request["labels"]], np.float32),
            "mask_input": np.zeros((1, 1, CELLS, CELLS), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array((CELLS, CELLS), np.float32),
        },
    )


def read(count: int) -> bytes:
    found = sys.stdin.buffer.read(count)
    if len(found) != count:
        sys.exit("a request ended early")
    return found


def with_outputs(model: bytes, names: tuple[str, ...]) -> bytes:
    """An ONNX model that gives the named values, too.

    A message of Protocol Buffers may follow itself, and is then merged: ModelProto has its graph in
    field 7, GraphProto its outputs in field 12, ValueInfoProto its name in field 1.
    """
    outputs = b"".join(_field(12, _field(1, name.encode())) for name in names)
    return model + _field(7, outputs)


def _field(number: int, content: bytes) -> bytes:
    return bytes((number << 3 | 2,)) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes((*found, value))


if __name__ == "__main__":
    main()

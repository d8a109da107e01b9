"""Outlines by a segmentation network that is asked by points and boxes, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.plugins.estimators.tools import DECODER, ENCODER, MEDIAPIPE, TAIL

SCRIPT = Path(__file__).with_name("outlines_script.py")
SIDE, CELLS, PER_CELL = 1024, 256, 4  # pixels of what the network sees, cells of its masks
INSIDE, OUTSIDE, LOW, HIGH, NOTHING = 1, 0, 2, 3, -1  # labels of points
LARGEST = 20.0  # log-odds of a mask

Box = tuple[float, float, float, float]  # x0, y0, x1, y1


@dataclass(frozen=True)
class Outline:
    """A mask of a frame.

    Attributes:
        odds: log-odds of its pixels, -LARGEST beyond what was looked at.
        quality: the network's own estimate of its overlap with a true mask, about 0 to 1.
    """

    odds: Float[np.ndarray, "h w"]
    quality: float

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        return self.odds > 0

    @property
    def soft(self) -> Float[np.ndarray, "h w"]:
        """Probabilities."""
        return 1 / (1 + np.exp(-self.odds))


@dataclass(frozen=True)
class _View:
    """What the network has been shown: the part of a frame from x, y on, in pixels of `shape`,
    its width and height there, and the network's pixels a pixel there."""

    x: int
    y: int
    width: int
    height: int
    zoom: float

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of masks that are of this part."""
        rows, columns = (round(side * self.zoom / PER_CELL) for side in (self.height, self.width))
        return min(CELLS, max(1, rows)), min(CELLS, max(1, columns))


class Outlines:
    """A network that knows what things look like, but not which one is meant (Kirillov et al. 2023,
    "Segment Anything"). It runs in the environment of MediaPipe, which holds its files.

    Use it as a context, with which the process ends.

    Args:
        shape: height and width of the frames to whose pixels all refers.
        read: number of a frame of the video to its RGB, at any size.
    """

    def __init__(
        self, shape: tuple[int, int], read: Callable[[int], UInt8[np.ndarray, "H W 3"]]
    ) -> None:
        self.shape, self._read = shape, read
        self._frame: tuple[int, np.ndarray] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._open = ExitStack()
        self._view: _View | None = None

    @staticmethod
    def installed() -> bool:
        return None not in (MEDIAPIPE.file(ENCODER), MEDIAPIPE.file(DECODER))

    def __enter__(self) -> Outlines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None:
            self._process.kill()
            with suppress(BrokenPipeError):  # of a request that nobody read
                self._open.close()
            self._process = None

    def look(self, number: int, box: Box | None = None) -> None:
        """Shows a frame of the video, or the part of it in a box."""
        if self._frame is None or self._frame[0] != number:
            self._frame = (number, self._read(number))
        image = self._frame[1]
        h, w = self.shape
        x0, y0, x1, y1 = (0, 0, w, h) if box is None else (round(v) for v in box)
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, w), min(y1, h)
        zoom = SIDE / max(x1 - x0, y1 - y0)
        self._view = _View(x0, y0, x1 - x0, y1 - y0, zoom)
        scale = image.shape[1] / w
        size = max(1, round((x1 - x0) * zoom)), max(1, round((y1 - y0) * zoom))
        part = Image.fromarray(image).resize(
            size, Image.Resampling.BILINEAR, (x0 * scale, y0 * scale, x1 * scale, y1 * scale)
        )
        shown = np.asarray(part)
        self._ask({"image": shown.shape[:2]}, shown.tobytes())

    def found(self, points: Sequence[tuple[float, float]], labels: Sequence[int]) -> list[Outline]:
        """Four masks in what was shown: the first where the question is clear, as by a box, and
        else what is meant as a part, a whole or a group.

        Args:
            points: pixels of `shape`. labels: what each is, as INSIDE.
        """
        assert self._view is not None
        view = self._view
        at = [((x - view.x) * view.zoom, (y - view.y) * view.zoom) for x, y in points]
        labels = list(labels)
        if LOW not in labels:
            at, labels = [*at, (0.0, 0.0)], [*labels, NOTHING]
        self._ask({"points": at, "labels": labels})
        assert self._process is not None and self._process.stdout is not None
        line = self._process.stdout.readline()
        size = 4 * CELLS * CELLS * 2
        content = self._process.stdout.read(size) if line else b""
        if len(content) != size:
            self._failed()
        masks = np.frombuffer(content, np.float16).reshape(4, CELLS, CELLS).astype(np.float32)
        pairs = zip(masks, json.loads(line)["overlaps"], strict=True)
        return [Outline(self._odds(cells), quality) for cells, quality in pairs]

    def _odds(self, cells: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "h w"]:
        """A mask of the network as one of a frame."""
        view = self._view
        assert view is not None
        rows, columns = view.cells
        part = Image.fromarray(cells[:rows, :columns])
        odds = np.full(self.shape, -LARGEST, np.float32)
        odds[view.y : view.y + view.height, view.x : view.x + view.width] = np.asarray(
            part.resize((view.width, view.height), Image.Resampling.BILINEAR)
        )
        return odds.clip(-LARGEST, LARGEST)

    def _ask(self, request: dict[str, Any], raw: bytes = b"") -> None:
        process = self._process or self._started()
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n" + raw)
            process.stdin.flush()
        except BrokenPipeError:
            self._failed()

    def _started(self) -> subprocess.Popen[bytes]:
        with ExitStack() as stack:
            self._said = stack.enter_context(tempfile.TemporaryFile())
            process = subprocess.Popen(
                _command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said
            )
            self._process = stack.enter_context(process)
            self._open = stack.pop_all()
        return self._process

    def _failed(self) -> None:
        assert self._process is not None and self._said is not None
        code = self._process.wait()
        self._said.seek(0)
        last = self._said.read().decode(errors="replace").strip().splitlines()[-TAIL:]
        raise HoigsError(
            f"estimator:object-tracker: the process that outlines objects ended with code {code}; "
            "`network: false` does without it. Its last output:\n"
            + "\n".join(f"  {line}" for line in last)
        )


def _command() -> list[str]:
    files = {"encoder": MEDIAPIPE.file(ENCODER), "decoder": MEDIAPIPE.file(DECODER)}
    settings = {name: str(path) for name, path in files.items()} | {"threads": os.cpu_count() or 1}
    return [str(MEDIAPIPE.python()), "-I", str(SCRIPT), json.dumps(settings)]

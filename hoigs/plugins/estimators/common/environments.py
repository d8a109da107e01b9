"""The environments in which estimators of this package run programs."""

from __future__ import annotations

from pathlib import Path

from hoigs.core.environments.managed import ManagedEnvironment
from hoigs.core.environments.npm_file import NpmFile

HEAVY = NpmFile(
    package="@mediapipe/pose",
    version="0.5.1675469404",
    member="pose_landmark_heavy.tflite",
    sha256="59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    to="mediapipe/modules/pose_landmark/pose_landmark_heavy.tflite",
    without="complexity 1 is used in place of 2",
)
MEDIAPIPE = ManagedEnvironment(
    name="mediapipe",
    summary="MediaPipe 0.10.21 and OpenCV, both Apache-2.0: 180 MB to download, 500 MB on disk",
    requirements=Path(__file__).parents[1] / "mediapipe" / "requirements.txt",
    pythons=("3.12", "3.11", "3.10", "3.9"),
    trial=(
        "import cv2, numpy, mediapipe; mediapipe.solutions.pose.Pose; "
        "print('mediapipe', mediapipe.__version__, 'opencv', cv2.__version__, "
        "'numpy', numpy.__version__)"
    ),
    files=(HEAVY,),
)

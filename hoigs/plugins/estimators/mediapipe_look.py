"""Read by `mediapipe_script.py`: who is in a frame, by the detector alone, which is fast.

MediaPipe follows one person; its detector finds several. It imports nothing of hoigs.
"""

from __future__ import annotations

import numpy as np
from mediapipe_guided import KEPT, landmark_graph, score, seen_in

GRAPH = """
input_stream: "image"
output_stream: "detections"
node {
  calculator: "PoseDetectionCpu"
  input_stream: "IMAGE:image"
  output_stream: "DETECTIONS:detections"
}
"""
ROUND = 2.5  # side of the square about a person, in distances of the detector's two points


class Look:
    """Everybody whom detector and model of landmarks agree on."""

    def __init__(self, complexity) -> None:
        from google.protobuf import text_format
        from mediapipe.framework import calculator_pb2
        from mediapipe.python.solution_base import SolutionBase

        config = text_format.Parse(GRAPH, calculator_pb2.CalculatorGraphConfig())
        self.detector = SolutionBase(graph_config=config)
        self.landmarks = landmark_graph(complexity)

    def people(self, image):
        """How sure, the hips' middle and the side of the square, pixels, of each."""
        height, width = image.shape[:2]
        found = []
        for one in self.detector.process({"image": image}).detections or []:
            points = one.location_data.relative_keypoints[:2]
            hips, rim = (np.array((p.x * width, p.y * height)) for p in points)
            side = ROUND * float(np.linalg.norm(hips - rim))
            seen = seen_in(*self.landmarks, image, (*hips, side))
            if seen is not None and score(seen[0][:, 3]) >= KEPT:
                found.append((float(one.score[0]), float(hips[0]), float(hips[1]), side))
        return found

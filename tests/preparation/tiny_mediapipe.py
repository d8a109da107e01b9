"""A module `mediapipe` that knows the tiny scene; KNOWN stands for the file of its landmarks."""

from __future__ import annotations

from tiny import HEIGHT, WIDTH

FAKE = f"""
from types import SimpleNamespace as Box
import numpy as np
known = np.load("KNOWN")
class Selfie:
    def __init__(self, **settings):
        pass
    def process(self, image):
        near = abs(image.astype(int) - (90, 30, 110)).max(-1) < 30
        return Box(segmentation_mask=near.astype("float32"))
class Pose:
    def __init__(self, **settings):
        self.frame = -1
    def reset(self):
        pass
    def process(self, image):
        self.frame += 1
        points = [
            [Box(x=p[0] / size[0], y=p[1] / size[1], z=p[2] / size[0], visibility=p[3])
             for p in rows]
            for rows, size in (
                (known["image_xyzv"][self.frame], ({WIDTH}, {HEIGHT})),
                (known["world_xyzv"][self.frame], (1, 1)),
            )
        ]
        own = Selfie().process(image).segmentation_mask
        return Box(pose_landmarks=Box(landmark=points[0]), segmentation_mask=own,
                   pose_world_landmarks=Box(landmark=points[1]))
solutions = Box(pose=Box(Pose=Pose), selfie_segmentation=Box(SelfieSegmentation=Selfie))
"""

# people whom a quick look finds in each frame: how sure, hips, side of the square
FAKE_LOOK = """
class Look:
    def __init__(self, complexity):
        pass
    def people(self, image):
        return PEOPLE
    def with_small(self, image, found):
        return found
    def faceless(self, image, found):
        return []
"""

# the model of landmarks alone, which the tiny scene does without: by name of the module
FAKE_MODEL = {
    "mediapipe_guided": """
def landmark_graph(complexity):
    return None, None
class GuidedPose:
    def __init__(self, graph, rect, check):
        pass
    def process(self, image, wide):
        return None
""",
    "mediapipe_check": """
class Check:
    most, since = 1.0, 0
    def __init__(self, graph, rect):
        pass
    def seen(self, image, points, space, square=None):
        return 0.0, points, space
    def believes(self, off):
        return True
    def lose(self):
        pass
""",
}

# what the script takes of OpenCV
FAKE_CV2 = """
import numpy
BORDER_REPLICATE = "edge"
CC_STAT_AREA = 0
MORPH_ELLIPSE = 2
def getStructuringElement(kind, size):
    return numpy.ones(size, bool)
def erode(mask, kernel):
    from scipy.ndimage import binary_erosion
    return binary_erosion(mask, kernel, border_value=1).astype("uint8")
def dilate(mask, kernel):
    from scipy.ndimage import binary_dilation
    return binary_dilation(mask, kernel).astype("uint8")
def connectedComponentsWithStats(mask):
    from scipy.ndimage import label
    parts, count = label(mask)
    return count + 1, parts, numpy.bincount(parts.ravel(), minlength=count + 1)[:, None], None
def GaussianBlur(image, size, sigma):
    return image
def imencode(kind, image):
    return True, image.copy()
def imdecode(encoded, flags):
    return encoded
def copyMakeBorder(image, above, below, left, right, kind):
    return numpy.pad(image, ((above, below), (left, right), (0, 0)), kind)
"""

"""What no camera of a clip shows: its scene points, a person or an object."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.diagnostics import Diagnostic
from hoigs.core.values.camera import pinhole_pixels
from hoigs.core.values.clip import Clip

MOST_POINTS = 20_000  # of the scene, looked at
BODY_REACH = 2.0  # metres from a body's root, within which all of it lies
LEAST_REACH = 0.05  # of an object from its centre, metres
LEAST_PIXELS = 0.5  # of that reach in a picture; what is smaller shows nothing
DO = (
    "check that the cameras have world_to_camera (not camera_to_world) in metres, x right, y down, "
    "z forward, and that {} lies in the same world; nothing is learned of it"
)


def unseen(clip: Clip) -> Iterator[Diagnostic]:
    """A diagnostic of severity "bad" for each of scene, people and objects that no camera sees."""
    points = clip.points[:: max(1, len(clip.points) // MOST_POINTS)]
    if len(points) and not any(c.shows(*c.project(points)).any() for c in clip.cameras):
        middle = clip.cameras[0].to_camera(points).median(0).values
        yield _fault("the scene", "none of its points lies in a picture", middle)
    tracks = {name: (body.poses.transl, BODY_REACH) for name, body in clip.bodies.items()}
    for name, track in clip.objects.items():
        reach = track.points.norm(dim=-1).amax() if len(track.points) else 0.0
        tracks[name] = (track.translations, max(float(reach), LEAST_REACH))
    for name, (path, reach) in tracks.items():
        places = torch.stack([c.to_camera(x) for c, x in zip(clip.cameras, path, strict=True)])
        if not _in_sight(clip, places, reach):
            yield _fault(
                f'"{name}"', "it is too far off to be seen, or outside of all pictures", places[0]
            )


def _in_sight(clip: Clip, places: Float[Tensor, "F 3"], reach: float) -> bool:
    """Whether a ball lies at least partly in the picture of any frame.

    Args:
        places: its centre in the coordinates of each frame's camera, metres.
        reach: its radius, metres.
    """
    K = torch.stack([c.K for c in clip.cameras])
    size = torch.tensor([[c.width, c.height] for c in clip.cameras])
    radius = K[:, 0, 0] * reach / places[:, 2].clamp_min(1e-6)
    pixels, about = pinhole_pixels(K, places, near=1e-6), radius[:, None]
    overlaps = ((pixels > -about) & (pixels < size + about)).all(-1)
    seen = overlaps & (places[:, 2] > 0) & (radius > LEAST_PIXELS)
    return bool((seen | (places.norm(dim=-1) < reach)).any())


def _fault(who: str, what: str, place: Float[Tensor, " 3"]) -> Diagnostic:
    x, y, z = place.tolist()
    return Diagnostic(
        "unseen",
        f"no camera sees {who}: {what}; in the first frame it is at "
        f"x {x:,.4g}, y {y:,.4g}, z {z:,.4g} m of the camera",
        DO.format(who),
        severity="bad",
    )

"""A built-in clip as a user with good 2D tools has it: frames, masks, landmarks, cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

REFERENCE_WIDTH = 512  # of the image whose pixels the noise is given in


def write_source(
    clip: Any, body: Any, folder: Path, noise: tuple[float, float], seed: int, *, cameras: bool
) -> None:
    """Frames, masks and landmarks of a clip as `hoigs prepare` reads them.

    Args:
        noise: of landmarks, in pixels of an image 512 wide, and centimetres.
        cameras: also cameras and scene points, in cameras.npz.
    """
    for name in ("frames", "masks/human", "masks/object"):
        (folder / name).mkdir(parents=True)
    for i, frame in enumerate(clip):
        Image.fromarray(frame.image.numpy()).save(folder / f"frames/{i:05d}.png")
        for name in ("human", "object"):
            path = folder / f"masks/{name}/{i:05d}.png"
            Image.fromarray(frame.masks[name].numpy()).save(path)
    np.savez(folder / "pose_mediapipe.npz", **landmarks(clip, body, noise, seed))
    if cameras:
        np.savez(
            folder / "cameras.npz",
            K=np.stack([c.K.numpy() for c in clip.cameras]),
            world_to_camera=np.stack([c.world_to_camera.numpy() for c in clip.cameras]),
            points=clip.points.numpy(),
            colors=clip.point_colors.numpy(),
        )


def landmarks(clip: Any, body: Any, noise: tuple[float, float], seed: int) -> dict[str, np.ndarray]:
    """pose_mediapipe.npz of the true body: MediaPipe's landmarks that have a place on it."""
    import torch

    from hoigs.core.maths.skinning import skin
    from hoigs.preparation.body.landmarks import points_of, towards

    points, rng = points_of(body), np.random.default_rng(seed)
    poses = clip.bodies["human"].poses
    vertices, joints = body.shaped(poses.betas)
    weights = torch.cat(
        (torch.eye(len(joints))[points.joints], body.skinning_weights[points.vertices])
    )
    canonical = torch.cat((joints[points.joints], vertices[points.vertices]))
    joint_transforms = body.skinning_transforms(poses)
    world = skin(canonical, joint_transforms, weights).numpy()
    marks = list(points.landmarks)
    image = np.full((len(clip), 33, 4), np.nan, np.float32)
    space = np.full((len(clip), 33, 4), np.nan, np.float32)
    hips = [marks.index(23), marks.index(24)]
    for i, camera in enumerate(clip.cameras):
        xy, depth = camera.project(torch.from_numpy(world[i]))
        seen = camera.to_camera(torch.from_numpy(world[i])).numpy()
        xy = xy.numpy() + rng.normal(size=(len(marks), 2)) * noise[0] * (
            camera.width / REFERENCE_WIDTH
        )
        image[i, marks] = np.concatenate((xy, depth[:, None], np.ones((len(marks), 1))), 1)
        # as MediaPipe gives them: of a camera that looks at the hips
        turn = towards(camera.K[None], torch.from_numpy(xy[hips].mean(0))[None])[0].double()
        seen = (seen - seen[hips].mean(0)) @ turn.numpy()
        seen = seen + rng.normal(size=seen.shape) * noise[1] / 100
        space[i, marks] = np.concatenate((seen, np.ones((len(marks), 1))), 1)
    return {"image_xyzv": image, "world_xyzv": space}


def write_video(clip: Any, file: Path) -> None:
    """The clip's frames as an H.264 mp4 of good quality, and nothing else."""
    import av

    with av.open(str(file), "w") as out:
        stream = out.add_stream("libx264", rate=round(clip.fps))
        stream.width, stream.height = clip.cameras[0].width, clip.cameras[0].height
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "16"}
        for frame in clip:
            picture = av.VideoFrame.from_ndarray(frame.image.numpy(), format="rgb24")
            out.mux(stream.encode(picture))
        out.mux(stream.encode())

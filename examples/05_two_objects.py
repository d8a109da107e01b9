"""A person with two objects: attention couples the person with both, and corrects all three.

The built-in clip has one box; the second is a copy of it, half a metre to the side.
Run: python examples/05_two_objects.py [CLIP]
"""

import sys
from dataclasses import replace

import torch

import hoigs as h

clip = h.read_clip(sys.argv[1] if sys.argv[1:] else "builtin:lift-and-swing?width=128")
box = clip.objects["object"]
copy = replace(box, translations=box.translations + torch.tensor([0.5, 0.0, 0.0]))
body = h.AnnyBody()


def moving(track):
    points = h.Gaussians.from_points(track.points, track.colors, opacity=0.8)
    motion = h.CubicHermite(h.CubicHermite.Config(keyframes=9), track=track)
    return h.Entity(points, motion, h.SplineMotionFeatures())


torch.manual_seed(0)
interaction = h.CrossAttention()
model = h.SceneModel(
    {
        "human": h.Entity(
            body.canonical(2000),
            h.HexPlaneSkinning(body=body, num_frames=clip.num_frames),
            h.BodyPartFeatures(),
            kind="human",
        ),
        "box": moving(box),
        "copy": moving(copy),
    },
    interaction=interaction,
    rasterizer=h.WarpRasterizer(),
)

# corrections start at zero; with other weights both objects and the person are corrected
torch.nn.init.normal_(interaction.means_head[-1].get_parameter("weight"), std=0.1)
torch.nn.init.normal_(interaction.pose_head[-1].get_parameter("weight"), std=0.1)
frame = clip[len(clip) // 2]
moment = frame.moment.with_pose("human", next(iter(frame.moment.poses.values())))
with torch.no_grad():
    state = model(moment)
    image = model.rasterizer.render(state.joined(), frame.camera).color
for name, residual in state.residuals.items():
    part = residual.pose if residual.means is None else residual.means
    what = "radians" if residual.means is None else "metres"
    print(f"{name:<6} corrected by up to {float(part.abs().max()):.4f} {what}")
print(f"drawn as {tuple(image.shape)}")

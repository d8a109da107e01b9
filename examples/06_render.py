"""Render a model from your own cameras, with alpha and depth, and write an animated GIF.

Run: python examples/06_render.py [CLIP [OUT.gif]]
"""

import math
import sys

import torch
from PIL import Image

import hoigs as h

clip = h.read_clip(sys.argv[1] if sys.argv[1:] else "builtin:lift-and-swing?width=128")
target = sys.argv[2] if sys.argv[2:] else "orbit.gif"
model = h.compose(h.Spec.load("hoigs"), clip)  # or h.open_run("runs/mine").model

frame = clip[len(clip) // 2]
camera, center = frame.camera, clip.objects["object"].translations[frame.moment.index]
up = -camera.world_to_camera[1, :3]  # the picture's own upright, in the world
pictures = []
with torch.no_grad():
    for i in range(8):
        angle = math.radians(10) * math.sin(2 * math.pi * i / 8)
        aside = torch.linalg.cross(up, camera.center - center)
        eye = camera.center + math.tan(angle) * aside
        view = h.Camera.look_at(
            eye, center, width=camera.width, height=camera.height, fov_y=0.8, up=tuple(up.tolist())
        )
        out = model.render(frame.moment, view)
        pictures.append(Image.fromarray((out.color.clamp(0, 1) * 255).byte().numpy()))
pictures[0].save(target, save_all=True, append_images=pictures[1:], duration=80, loop=0)
seen = out.alpha > 0.5
print(
    f"{target}: {len(pictures)} pictures, {100 * float(seen.float().mean()):.0f} % covered, ",
    end="",
)
print(f"depth {float(out.expected_depth[seen].min()):.2f} m and more")

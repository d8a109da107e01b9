"""Load a spec by name, change one setting, compose its model for a clip, and render it.

Run: python examples/03_from_spec.py [CLIP]
"""

import sys

import torch

import hoigs as h

clip = h.read_clip(sys.argv[1] if sys.argv[1:] else "builtin:lift-and-swing?width=128")

spec = h.Spec.load("hoigs", overrides=["model.object.deformation.keyframe_step=2"])
model = h.compose(spec, clip)
for place, key in spec.components().items():
    print(f"{place:<28} {key}")

frame = clip[0]
with torch.no_grad():
    image = model.render(frame.moment, frame.camera).color
error = float((image - frame.rgb).abs().mean())
print(f"{spec.name} before any training: mean error {error:.3f} of 1, splats {model.count()}")

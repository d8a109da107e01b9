"""Terms of the training objective.

- `terms`: image, mask, scene and depth losses, and their weights.
- `face.face_loss`: the facial consistency term.
- `crops.crop_around`: a frame cut out around one entity.
"""

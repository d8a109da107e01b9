"""Terms of the training objective.

- `comparison.image_losses`: L1 and D-SSIM of a render against boxes of a frame.
- `terms`: the depth loss, and the weights of all terms.
- `face.face_loss`: the facial consistency term.
- `crops.crop_around`: a frame cut out around one entity.
"""

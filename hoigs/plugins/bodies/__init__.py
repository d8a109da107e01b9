"""Body models: linear blend skinning by a BodyPose of SMPL-X.

- `anny`: body:anny, the built-in body.
- `smplx`, `smplh`: body:smplx, body:smplh and body:smpl, from the user's own model files.
- `linear`, `corrected`: their base classes.
"""

"""The values that pass between components; frozen dataclasses.

- `gaussians`: Gaussians in raw space, GaussianDelta.
- `camera`, `lens`, `undistortion`: pinhole cameras, lens distortion and its removal.
- `moment`, `moment_layout`: a time with its body poses, also as one row of numbers.
- `clip`: Clip, Frame, BodyTrack, ObjectTrack.
- `tokens`: input and output of the interaction module.
- `topology`: index maps for changes of the number of Gaussians or knots.
"""

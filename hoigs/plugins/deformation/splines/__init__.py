"""Motions in which each Gaussian follows a curve of its own over keyframes.

- `chs`: deformation:chs, cubic Hermite splines, the object of HOIGS.
- `tracked_chs`: deformation:tracked-chs, the same about the tracked pose of every frame.
- `linear_displacement`: deformation:linear-displacement, straight lines.
- `ex4dgs`: deformation:ex4dgs, Ex4DGS.
- `keyframed`, `knot_schedule`: the base class of motions over keyframes, and adaptive keyframes.
- `rigid_track`: the motion of an ObjectTrack at any time.
- `temporal_opacity`: Ex4DGS's opacity over time.
"""

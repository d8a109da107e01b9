"""Motions of a whole object.

- `rigid_spline`: deformation:rigid-spline, one SE(3) spline.
- `rigid_residual`: deformation:rigid-residual, the same with a small offset for each Gaussian.
- `rigid_frames`: deformation:rigid-frames, a corrected track, as in HOLD.
- `articulated`: deformation:articulated, two rigid parts about a joint.
- `object_bone`: deformation:object-bone, an object attached to a wrist, as in HOSNeRF.
- `object_states`: when an object's state changes, for `object_bone`.
- `track_guide`: the distance of a motion from the object's track, for `rigid_spline`.
"""

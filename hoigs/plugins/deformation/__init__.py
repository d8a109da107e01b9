"""Deformations: canonical Gaussians and a moment in, Gaussians at that moment out.

- `static`: deformation:static, no motion.
- `shared_harmonics`: deformation:shared-harmonics, no motion, and a compact view-dependent colour.
- `splines`: a curve for each Gaussian, the object of HOIGS among them.
- `rigid`: one motion for a whole object.
- `fields`: fields over space and time, for a whole scene.
- `avatars`: humans that a body model poses, the human of HOIGS among them.
"""

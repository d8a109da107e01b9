"""A body fitted to landmarks.

- `fit`, `fit_problem`: `fit_body`, the entry, and the energy that it minimises.
- `fit_start`, `flat_start`, `limb_start`, `placing`: where the fit starts.
- `landmarks`: MediaPipe's landmarks and the points of a body that they stand for.
- `mask_fit`, `joint_limits`: terms of the energy.
- `ground_scale`: metres a unit of the world, from the ground at the feet.
- `silhouette`: the outline of a posed body in an image.
"""

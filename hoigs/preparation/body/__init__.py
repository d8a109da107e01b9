"""A body fitted to landmarks.

- `fit`, `windowed_fit`: `fit_body`, the entry, of a clip at once or window by window.
- `fit_problem`, `fit_values`: the energy that it minimises; settings, unknowns and result.
- `gauss_newton`, `normal_equations`, `kinematics`: how it is minimised.
- `start`: where the fit starts. `priors`: what is known before anything is seen.
- `landmarks`: MediaPipe's landmarks and the points of a body that they stand for.
- `mask_fit`: masks as a term of the energy. `silhouette`: the outline of a posed body.
- `ground_scale`: metres a unit of the world, from the ground at the feet.
"""

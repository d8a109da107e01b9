"""A body fitted to landmarks.

- `fit`: `fit_body`, the entry, of a clip at once or window by window.
- `fit_problem`: settings, unknowns, result, and the energy that is minimised.
- `kinematics`: derivatives of points on a body, and the normal equations of a clip.
- `start`: where the fit starts. `priors`: what is known before anything is seen.
- `landmarks`: MediaPipe's landmarks and the points of a body that they stand for.
- `mask_fit`: masks as a term of the energy, and the outline of a posed body.
- `body_files`: bodies that other programs have fitted.
"""

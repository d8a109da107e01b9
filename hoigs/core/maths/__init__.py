"""Mathematics without state.

- `rotations`: quaternions (wxyz), matrices and axis-angle.
- `splines`, `knots`, `rotation_splines`: cubic Hermite curves of values and of rotations.
- `skinning`: linear blend skinning. `projection`: EWA projection and drawing rules of Gaussians.
- `spherical_harmonics`: view-dependent colours.
- `feature_planes`, `networks`: feature planes and initial values of layers.
- `nearest`: nearest neighbours. `series`: gaps and noise of values over time.
"""

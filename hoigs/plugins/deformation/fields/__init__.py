"""Fields over space and time that move the Gaussians of a whole scene.

- `hexplane_field`: deformation:hexplane-field, 4DGS and K-Planes.
- `mlp`: deformation:mlp, Deformable-3DGS.
- `embedded`: deformation:embedded, E-D3DGS.
- `se3_field`: deformation:se3-field, Nerfies and HyperNeRF.
- `static_dynamic`: deformation:static-dynamic, D2NeRF.
"""

"""Initializers: the first points and poses of an object.

- `depth`: initializer:depth, masked depth, back-projected.
- `points`: initializer:points, a point cloud of any generator.
- `mesh`: initializer:mesh, points on the surface of a mesh.
- `sfm`: initializer:sfm, the clip's scene points that lie on the object.
- `sds`: initializer:sds, score distillation from a diffusion model.
- `alignment`, `shape_files`, `outliers`: placing a shape in the clip, reading it, cleaning it.
"""

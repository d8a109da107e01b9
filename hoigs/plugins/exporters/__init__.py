"""Exporters: what other programs read, one file a format. `hoigs export RUN --format NAME`.

- `ply`, `ply_sequence`, `gaussforge`, `gltf_splat`: Gaussians.
- `bvh`, `smpl_npz`, `gltf_body`: the body. `tracks`: objects, cameras and contacts.
- `mesh_sequence`: surfaces. `usd`: all of these in one stage.
"""

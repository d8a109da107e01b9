"""Exporters: what other programs read, one file a format. `hoigs export RUN --format NAME`.

- `ply`, `ply_sequence`, `gaussforge`, `glb`: Gaussians. `gltf_4d`: Gaussians that move (`carried`).
- `bvh`, `smpl_npz`, `glb`: the body. `tracks`: objects, cameras and contacts.
- `mesh_sequence`: surfaces. `usd`: all of these in one stage.
"""

"""Cameras and lenses that others have found, one file format a module.

- `calibration`: lenses. `given_cameras`: cameras.npz. `megasam`, `vggt`: with depth.
"""

"""Cameras of a video: static, from a COLMAP model, or by structure from motion.

- `choose`: `choose_cameras`, the entry.
- `camera_track`: CameraTrack, from a COLMAP model or of a static camera; how far views differ.
- `calibration`, `known`: lenses and cameras from files beside the video.
- `sfm`: structure from motion by COLMAP.
- `turning_cameras`: whether the camera moves, and cameras of one that only turns on its spot.
- `focal`: the focal length of a static camera.
"""

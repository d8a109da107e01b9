"""Cameras of a video: static, from a COLMAP model, or by structure from motion.

- `choose`: `choose_cameras`, the entry.
- `camera_track`: CameraTrack, from a COLMAP model or of a static camera.
- `known`: lenses and cameras from files beside the video, one format a module.
- `sfm`, `colmap_log`: structure from motion by COLMAP.
- `turning`, `turning_cameras`: a camera that only turns on its spot.
- `motion`: whether the camera moves.
- `focal`: the focal length of a static camera.
- `multiview`: DyCheck's effective multi-view factors.
"""

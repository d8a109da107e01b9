"""Cameras of a video: static, from a COLMAP model, or by structure from motion.

- `choose`: `choose_cameras`, the entry.
- `camera_track`: CameraTrack, from a COLMAP model or of a static camera.
- `given_cameras`, `megasam`: cameras from files beside the video.
- `sfm`, `colmap_log`: structure from motion by COLMAP.
- `motion`: whether the camera moves.
- `static_focal`, `focal`, `focal_metadata`: the focal length of a static camera.
- `multiview`: DyCheck's effective multi-view factors.
"""

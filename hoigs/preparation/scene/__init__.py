"""Points and depth of the scene, in metres.

- `scene_points`: `camera_scene` and `static_scene`, the points that start the background.
- `dense_points`: more points between those of COLMAP.
- `background_points`: a floor and a wall for a camera that never moves.
- `depth`: `fit_depth`, an estimator's depth in metres.
"""

"""Scores of trained models, each stored with its protocol.

- `evaluate.score`: entry point; scores a model on a clip, as a `scores.Evaluation`.
- `protocol.Protocol`: the conditions of a score. `protocol.NotComputed`: why one is absent.
- `posing.posed_clip`: body poses and cameras of test frames: interpolated, blended or fitted.
- `blending`, `interpolation`: poses between training frames and a test frame's own.
- `geometry.measure_geometry`: errors in space. `truth.read_truth`: the geometry of synthetic clips.
- `measure`: model size and render time. `orbits.orbit_cameras`: camera paths around a scene.
- `report.write_report`: the HTML report of a run.
"""

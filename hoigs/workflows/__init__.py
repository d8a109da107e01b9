"""Commands that use several parts of hoigs in a row, as functions.

- `train.train`: from a clip and a spec to a run folder with scores and a report.
- `evaluate.evaluate`: the scores and the report of a run folder.
- `refine_poses.refine_poses`: body poses of a clip, corrected by drawing all its frames.
- `demo.demo`: `train` on the built-in clip, with a static model for comparison.
- `bug_report.bug_report`: what helps to find a fault, in a zip.
- `doctor.doctor`: versions and devices of this machine, and the rasterizers that work on it.
"""

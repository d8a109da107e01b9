"""Synthetic inputs of the checks.

- `body.TinyBody`: a body model. `motion.TinyMotion`: a deformation.
- `clip.tiny_clip`, `clip.write_tiny_clip`: a clip in memory and as a folder.
"""

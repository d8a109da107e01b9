"""Viewing trained models.

- `films.render`: writes an mp4 of a run.
- `playback.Playback`: renders a model at any moment, by a CUDA graph where possible.
"""

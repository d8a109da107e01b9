"""Fitting a SceneModel to a Clip: losses, schedules, density, checkpoints, run folder."""

"""The loop that fits a SceneModel to a Clip: losses, schedules, density, checkpoints, run folder."""

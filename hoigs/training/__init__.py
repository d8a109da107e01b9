"""Fitting a SceneModel to a Clip.

- `session.Session`: entry point; a trainer from a clip, a spec and options, all checked first.
- `trainer.Trainer`: the training loop, with its logs and checkpoints.
- `objective.JointObjective`: the loss of one frame. `losses`: its terms.
- `views.TrainingViews`: the frames of a clip on the device, with their crops.
- `optimizer.GroupedAdam`: Adam with a schedule for each role of a parameter.
- `density_update`: density control applied to entities and optimizer.
- `graphs`: the model's part of a step by CUDA graphs.
"""

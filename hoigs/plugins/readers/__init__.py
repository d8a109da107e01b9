"""Clip readers, one module for each dataset layout.

- `clip`: reader:clip, the project's own clip folder.
- `arctic`, `behave`, `hold`, `hosnerf`, `neuman`, `exavatar`: readers of people and
  objects, by the names of their datasets.
- `dnerf`, `hypernerf`: dynamic scenes. `colmap`, `nerfstudio`: your own captures.
- `common`: what several readers share.
"""

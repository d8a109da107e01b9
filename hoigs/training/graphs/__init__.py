"""CUDA graphs in training: the model's part of a step is captured once and replayed.

- `graphed_scene.GraphedScene`: entry point; the model at a moment with its penalties, by graphs
  where possible.
- `graphed_step.GraphedStep`: any computation and its gradient as two graphs.
- `graph_key.GraphKey`: what a captured graph depends on.
"""

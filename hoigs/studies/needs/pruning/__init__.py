"""Pruning and compression of trained models.

- `prune.Pruning`: removes what changes no image: tokens, time planes, knots, Gaussians.
- `compact_run.compress`: a copy of a run with a quantised model.
"""

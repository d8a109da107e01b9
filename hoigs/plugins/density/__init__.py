"""Density control: which Gaussians are cloned, split, pruned or relocated, and when.

These classes decide; `hoigs.training.density` applies a decision to a model in training.

- `adc.AdaptiveDensity`: clone, split and prune (3DGS). `absgrad.AbsoluteGradientDensity`: the same
  by absolute screen gradients (AbsGS).
- `mcmc.McmcDensity`: relocation, growth and noise (3DGS-MCMC).
- `budget.BudgetDensity`: a given count, reached along a curve (Taming 3DGS).
- `none.NoDensity`: the count stays.
"""

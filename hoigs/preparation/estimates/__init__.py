"""What estimators find in the frames.

- `plan`: which estimator gives what, and whether all that they need is there.
- `reader`: EstimateReader, which runs them, and what it returns.
"""

"""What estimators find in the frames.

- `plan`: which estimator gives what. `readiness`: whether all that they need is there.
- `reader`: EstimateReader, which runs them. `given`: landmarks and masks as they come.
"""

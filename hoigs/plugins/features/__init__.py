"""Tokens of an entity for the interaction (HOIGS, Sec. "Feature Extraction").

- `body_parts`: features:body-parts, 16 tokens of a human (Eq. 7).
- `spline_motion`: features:spline-motion, one token for each Gaussian of an object (Eq. 8).
- `embedding`: features:embedding, the ablation "w/o human feature".
"""

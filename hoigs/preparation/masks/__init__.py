"""Masks of the person and the object.

- `separate`: `separate`, the entry: one mask of both, separated by the fitted body and by colour.
- `mask_stack`: the masks of all frames, kept as bits.
- `outlines`: middle, length and direction of a mask.
"""

"""Estimators that run models of the transformers library.

- `sam2`: estimator:transformers-sam2, masks from a point or a box.
- `vitpose`: estimator:transformers-pose, landmarks in the boxes of a person.
- `depth_anything`: estimator:transformers-depth, depth or disparity of each frame.
- `detector`: boxes of people and objects, for the first two.
- `models`: loading a model, and the settings that all of them share.
"""

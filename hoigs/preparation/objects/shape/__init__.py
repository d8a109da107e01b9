"""Shapes of objects.

- `first_points`: of a sphere or of an inflated outline, and their colours.
- `surface`: the visual hull. `unseen_side`: what no frame shows.
"""

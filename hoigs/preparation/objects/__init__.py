"""The object's track and points.

- `make_object`: `make_object`, the entry.
- `ball`: a tracked ball of known radius. `sphere`: a ball that is known by its round masks.
- `tracked`: a held object, from hands, outlines and texture: `hands` (grasps and rests), `crops`
  (small images), `surface` (the hull), `alignment` (all frames at once), `search` (flights).
- `track`: a held object, from its mask and the hands alone.
- `shape`: points of a sphere or of an inflated outline, and their colours.
"""

"""The object's track and points.

- `make_object`: `make_object`, the entry, and what the report warns of.
- `ball`: balls, by a track or by their masks alone.
- `tracked`: a held object, from hands, outlines and texture: `hands` (grasps and rests),
  `alignment` (all frames at once, on small images), `search` (grasps and throws).
- `shape`: the points and the surface that an object starts from, and its place by mask and hands.
- `registered`: how it moves and turns in the image, against one frame.
- `explained`: how well a track explains masks and held-back frames.
"""

"""The object's track and points.

- `make_object`: `make_object`, the entry.
- `ball`: balls, by a track or by their masks alone.
- `tracked`: a held object, from hands, outlines and texture: `hands` (grasps and rests), `crops`
  (small images), `alignment` (all frames at once), `search` (grasps) and `flights` (throws).
- `doubts`: what the report warns of, and the overlap of outline and mask.
- `track`, `rests`: a held object, from its mask and the hands alone.
- `shape`: the points and the surface that an object starts from.
"""

"""The object's track and points.

- `make_object`: `make_object`, the entry.
- `ball`: a tracked ball of known radius.
- `track`: a held object, from its mask and the hands.
- `shape`: points of a sphere or of an inflated outline, and their colours.
"""

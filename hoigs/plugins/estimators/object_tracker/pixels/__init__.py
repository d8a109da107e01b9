"""The frames that the tracker works on, and what single pixels of them say.

- `footage`: the frames, reduced, and the person's masks of them; `held`: the thing within these.
- `camera_motion`: how the picture of the scene moves. `scene`: what differs from the scene behind.
- `colors`, `walker`, `transfer`, `windows`: masks of pixels, by colours, edges and other frames.
"""

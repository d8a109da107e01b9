"""Reading a source, a video or a folder of frames.

- `source`: `find_source`, where each input lies.
- `frames`: `open_frames`, the chosen frames, streamed.
- `container`: where frames and times are in a file.
- `pictures`: one frame as RGB or grey, how sharp it is, images and masks at another size.
"""

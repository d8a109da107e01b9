"""Reading a source, a video or a folder of frames.

- `source`: `find_source`, where each input lies.
- `frames`: `open_frames`, the chosen frames, streamed.
- `packet_index`: where frames are in a file.
- `pictures`, `resizing`: one frame as RGB or grey, images and masks at another size.
- `sharpness`, `blank`: how sharp a frame is, and its pixels that hold no picture.
"""

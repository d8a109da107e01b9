"""`hoigs annotate`: click on people and objects of a video in a local page, and prepare it.

- `annotate.annotate`: serves the page until it is interrupted.
- `server`: addresses of the page, and who may use them. `page.html`: the page.
- `session`: what the addresses do. `video`: any frame of a video. `marks`: clicks and options.
- `clicks`: the mask of one frame, at once. `people`: the person's. `tracked`: those of all frames.
- `jobs`: preparations in a process of their own, `worker`.
"""

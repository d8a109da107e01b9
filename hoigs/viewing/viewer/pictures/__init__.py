"""What the viewer draws.

- `run_drawing`: a run. `clip_drawing`: a clip. `panes`: two of them in one canvas.
- `bodies`, `overlays`: meshes, skeletons, tracks and cameras as nodes of the browser.
- `fitting`, `resolution`: into a canvas of another size, in time.
"""

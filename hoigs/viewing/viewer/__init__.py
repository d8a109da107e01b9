"""The viewer in the browser, on viser.

- `viewer.Viewer`: the server's panel and the loop that draws for every browser.
- `drawing.RunDrawing`, `clip_drawing.ClipDrawing`: what is drawn.
- `hoigs.viewing.view.view`: opens all of it.
"""

"""The viewer in the browser, on viser.

- `viewer.Viewer`: the server's panel and the loop that draws for every browser.
- `pictures`: what is drawn, of a run or of a clip.
- `hoigs.viewing.view.view`: opens all of it.
"""

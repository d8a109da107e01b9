"""The common style of the studies' figures.

- `style.STYLE`: matplotlib's settings, beside the palette, the markers and number formats.
- `files.figure_files`: a figure as the bytes of a PNG and an SVG.
"""

"""The common style of the studies' figures.

- `style.STYLE`: matplotlib's settings, beside the palette, the markers and number formats.
"""

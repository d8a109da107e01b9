"""Balls.

- `track`: an image disc a frame, of known radius. `sphere`: known by its round masks alone.
"""

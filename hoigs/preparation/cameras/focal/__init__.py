"""The focal length of a still camera.

- `still_camera`: which it gets. `metadata`: what the file says. `from_person`: what a body says.
"""

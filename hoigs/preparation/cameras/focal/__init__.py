"""The focal length of a still camera: `still_camera.py` chooses."""

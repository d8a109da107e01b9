"""Bodies that another program has fitted to the video: files in, landmarks and rotations out.

- `body_file`: recognises and reads the file of GVHMR or WHAM.
- `as_landmarks.BodyFileEstimator`: where the landmarks of that body are.
"""

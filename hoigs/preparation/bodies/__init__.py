"""Bodies that another program has fitted to the video: files in, landmarks and rotations out.

- `body_file`: finds the file beside a video and recognises it.
- `programs`: the layouts of GVHMR, WHAM, TRAM, PHALP (4D-Humans) and PromptHMR.
- `file_body`: what is taken of a file.
- `as_landmarks.BodyFileEstimator`: where the landmarks of that body are.
"""

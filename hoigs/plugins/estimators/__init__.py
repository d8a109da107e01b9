"""Estimators: masks, landmarks and depth of a video, from files, tools or networks.

- `masks_files`: estimator:masks-files, masks that a segmenter has written.
- `landmarks_files`: estimator:landmarks-files, landmarks that an estimator has written.
- `depth_files`: estimator:depth-files, depth maps that an estimator has written.
- `command`: estimator:command, a tool with a command line, whose files are then read.
- `mediapipe`: estimator:mediapipe, MediaPipe Pose in an environment of its own.
- `object_tracker`: estimator:object-tracker, masks of objects from clicks or motion.
- `transformers`: SAM 2, ViTPose and Depth Anything by the transformers library.
- `common`: files, images and subprocesses that several of them use.
"""

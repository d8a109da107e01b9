"""People by MediaPipe: landmarks and masks.

- `estimator.MediapipeEstimator` runs `mediapipe_script.py` in an environment with mediapipe, which
  `requirements.txt` pins; the script and the modules that it reads import nothing of hoigs.
- `masks`: what becomes of the bits of masks that the script writes.
"""

"""What several estimators use.

- `frame_files`: which file belongs to which frame, and `FileDiagnostics` of what does not fit.
- `mask_images`: masks from images, label images and videos.
- `depth_images`: depth from 16-bit PNG and EXR.
- `steady_masks`: masks of a still camera that agree wherever its frames do.
- `keypoints`: keypoints of several formats as MediaPipe's 33 landmarks.
- `subprocess`: running a tool of another environment.
"""

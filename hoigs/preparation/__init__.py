"""From a video, and what estimators find in it, to a clip folder.

- `prepare`: `prepare`, and `prepare_until` for some of its stages.
- `pipeline`: runs the stages in order.
- `options`, `settings`: PrepareOptions, and reading them from files and flags.
- `estimates`, `given`: runs the estimators on the chosen frames, and what they give.
- `person`, `entity_masks`: the body fitted to that, and the final masks.
- `saved`: results of the stages as JSON and arrays, and back.
- `clip_writing`: writes and checks the clip.
- `video`, `cameras`, `masks`, `body`, `objects`, `scene`, `report`: the work of the stages.
- `stages`: their order, work folder and progress.
"""

"""From a video, and what estimators find in it, to a clip folder.

- `prepare`: `prepare`, and `prepare_until` for some of its stages.
- `pipeline`: runs the stages in order. `kept_stages`: makes each, or reads back its result.
- `options`, `settings`: PrepareOptions, and reading them from files and flags.
- `estimates`, `given`: runs the estimators on the chosen frames, and what they give.
- `person`: the body fitted to that. `entity_masks`, `final_masks`: masks without common pixels.
- `saved`: results of the stages as JSON and arrays, and back.
- `clip_writing`: writes and checks the clip.
- `video`, `cameras`, `masks`, `body`, `objects`, `scene`, `report`: the work of the stages.
- `stages`: their order, work folder and progress.
"""

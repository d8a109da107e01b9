"""From a video, and what estimators find in it, to a clip folder.

- `prepare`: `prepare`, and `prepare_until` for some of its stages.
- `pipeline`: runs the stages in order. `kept_stages`: makes each, or reads back its result.
- `choose_frames`: which frames become the clip, and how wide.
- `saved`: results of the stages as JSON and arrays, and back.
- `clip_writing`: writes and checks the clip.
- `options`: PrepareOptions, and reading them from files and flags.
- `estimates`: runs the estimators on the chosen frames.
- `entities`: everybody and every object, a stage each; by `body`, `masks` and `objects`.
- `video`, `cameras`, `scene`, `report`: the work of the other stages.
- `stages`: their order, work folder and progress.
"""

"""From a video, and what estimators find in it, to a clip folder.

- `prepare`: `prepare`, and `prepare_until` for some of its stages.
- `draft`: Draft, everything that is known of the clip so far. `stages`: one function each, from a
  draft to one with more in it. `kept`: what they are made from, and their results in the work
  folder.
- `choose_frames`: which frames become the clip, and how wide.
- `clip_writing`: writes and checks the clip.
- `options`: PrepareOptions, and reading them from files and flags.
- `estimates`: runs the estimators on the chosen frames.
- `entities`: everybody and every object, a stage each; by `body`, `masks` and `objects`.
- `video`, `cameras`, `scene`, `report`: the work of the other stages.
"""

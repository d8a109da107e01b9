"""From a video, and what estimators find in it, to a clip folder.

- `prepare`: `prepare`, and `prepare_until` for some of its stages.
- `draft`: Draft, everything that is known of the clip so far. `stages`: one function each, from a
  draft to one with more in it. `kept`, `work_folder`: what they are made from, and their results.
- `options`, `prompts`: PrepareOptions and clicks, from files and flags.
- `video`, `estimates`, `cameras`, `body`, `objects`: the work of the stages.
- `people`, `mask_stack`, `final_masks`, `depth`, `scene_points`: likewise, a module each.
- `clip_writing`, `report`: the clip folder and what is said of it.
"""

"""What a preparation is to do.

- `prepare_options`: PrepareOptions. `prompts`: clicks, boxes and words.
- `option_files`: options from a file and from KEY=VALUE. `prompt_file`: the clicks of a video.
"""

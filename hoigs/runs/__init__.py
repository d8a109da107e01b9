"""Run folders: what training writes, and reading it back.

- `loaded_run.open_run`: a trained model with its clip.
- `clip_source.read_clip`: a clip alone, from a folder or a built-in name.
- `run_folder.RunFolder`: the files of a run.
- `checkpoint.load_checkpoint`: the tensors of a training state.
"""

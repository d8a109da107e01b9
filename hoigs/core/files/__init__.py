"""Files: whole or not at all, without pickles, one writer at a time.

- `whole_files`: written under another name, then renamed. `safe_replace`: what may be replaced.
- `folder_lock`: one holder at a time. `json_file`, `npz`, `video_files`: reading and writing.
- `regular_file`: whether reading a path ends. `pixel_cache`: decoded frames within a budget.
"""

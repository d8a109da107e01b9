"""The clip folder on disk.

- `format`: its files, arrays and header.
- `write.ClipWriter`, `write.write_clip`: write a clip folder.
- `check.check_clip`, `check.require_clip`: check its files; `diagnostics` has their messages.
- `health.examine`: examines the content of a clip that has been read.
"""

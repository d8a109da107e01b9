"""ExAvatar folders.

- `reader.ExavatarReader`: reader:exavatar.
- `files`: the files of such a folder, by frame number.
"""

"""The stages of a preparation.

- `plan`: their order, and what each depends on.
- `work_folder`: WorkFolder, which keeps their results.
- `progress`: their times and one progress number.
- `cleanup`: removes what a killed run left.
"""

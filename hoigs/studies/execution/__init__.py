"""Where the processes of `batch`, `tables`, `chart` and `stress` run.

- `executor.make_executor`: an executor by name: "local", "ray" or "MODULE:CLASS".
- `executor.Executor`, `executor.Process`: what an executor of your own implements.
- `command`: the process of every job, which ends with its parent and with its lease.
"""

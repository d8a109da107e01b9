"""Where and how the processes of `batch`, `compare` and `stress` run.

- `queue.Queue`: tasks, several at a time, on `concurrent.futures`; each runs its processes.
- `local.make_executor`: an executor by name: "local", "ray" or "MODULE:CLASS".
- `local.Executor`, `local.Process`: what an executor of your own implements.
- `command`: the process of every job, which ends with its parent and with its lease.
"""

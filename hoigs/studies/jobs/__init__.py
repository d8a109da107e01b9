"""Trainings as jobs, which every study shares.

- `job.make_job`: one training with its run folder. `run_jobs.run_jobs`: several at a time.
- `cost.read_cost`: time and energy of a training, and the machines that ran it.
- `results`: the specs that `--specs` declares, and the numbers and protocol of a run.
"""

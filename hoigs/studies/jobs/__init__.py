"""Trainings as jobs, which every study shares.

- `job.make_job`: one training with its run folder. `run_jobs.run_jobs`: several at a time.
- `variants.parse_variants`: the specs that `--specs` declares.
- `cost.read_cost`: time and energy of a training, and the machines that ran it.
- `results.TableResult`: means and spreads of scores over seeds.
- `protocol.protocol_of`: how the numbers of a run were measured, in sentences.
"""

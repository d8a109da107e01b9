"""Tables of scores over rows, clips and seeds: `hoigs tables`.

- `run.run_study`: trains and scores what is not done yet, and returns the results.
- `sets.choose_sets`: the named tables and their rows.
- `write.write_tables`: the result files.
- `paper.published`: the numbers that the paper reports, for comparison.
"""

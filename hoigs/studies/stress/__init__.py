"""Failure cases of methods, each with a trigger, a sweep and a criterion: `hoigs study stress`.

- `run.run_stress`: runs the cases of a `run.StressStudy`. `case.choose_cases`: by id or family.
- `report.write_stress`: the result files.
"""

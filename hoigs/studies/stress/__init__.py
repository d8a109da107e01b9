"""Failure cases of methods, each with a trigger, a sweep and a criterion.

- `run.run_stress`: runs the cases of a `plan.StressStudy`, for the CLI `hoigs study stress`.
- `case.choose_cases`: cases by id or family.
- `report.write.write_stress`: the result files.
"""

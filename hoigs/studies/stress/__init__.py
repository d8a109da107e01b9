"""Failure cases of methods: 56, each with a trigger and a criterion.

- `run.run_stress`: runs the cases of a `plan.StressStudy`, for the CLI `hoigs stress`.
- `case.choose_cases`: cases by id or family.
- `report.write.write_stress`: the result files.
"""

"""Studies: many trainings, compared.

- `compare.run.run_comparison`: accuracy against cost of specs, rasterizers and budgets, and the
  paper's tables.
- `stress.run.run_stress`: failure cases, each with a trigger and a criterion.
- `needs.needs.needs`: how much of a spec a clip needs. `needs.auto.auto`: also trains the answer.
- `batch.batch`: many videos or clips. `jobs`, `execution`: the trainings, and where they run.
"""

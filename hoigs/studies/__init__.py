"""Studies: many trainings, compared.

- `chart.run.run_chart`: accuracy against cost of specs, rasterizers and budgets.
- `tables.run.run_study`: tables of scores, such as those of the paper.
- `stress.run.run_stress`: failure cases, each with a trigger and a criterion.
- `needs.needs.needs`: how much of a spec a clip needs. `needs.auto.auto`: also trains the answer.
- `jobs`: trainings as jobs in processes. `plotting`: the style of all figures.
"""

"""Accuracy against cost of specs, rasterizers, budgets and clips: `hoigs chart`.

- `run.run_chart`: trains what is not trained yet; returns one cell a training.
- `write.write_chart`: writes the tables, the figures and the interactive page of these cells.
- `data.load_chart`: reads the cells back from a chart.json.
"""

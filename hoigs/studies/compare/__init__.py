"""Accuracy against cost of specs, rasterizers, budgets and clips: `hoigs study compare`.

- `run.run_comparison`: trains and scores what is not done yet, and returns cells as plain data.
- `write.write_chart`: tables and figures of cells.
- `paper.TABLES`: the rows of the paper's tables; `paper.published`: the numbers that it prints.
"""

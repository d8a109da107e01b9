"""Files of an answer.

- `write.write_needs`: spec.yaml, needs.md, needs.json and the plot.
- `spec.spec_text`: the answer as a spec with reasons. `plot.draw`: error against parameters.
"""

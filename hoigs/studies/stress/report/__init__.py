"""Result files of a stress study.

- `write.write_stress`: stress.md, stress.csv, stress.json and the figures.
- `table.make_table`: the verdicts as a table, from which all of these are made.
"""

"""How much of a spec a clip needs, chosen on training frames that are held back.

- `needs.needs`: searches, and writes the answer as a spec and a page.
- `search.Search`: the search itself; it returns a `result.Needs`.
- `auto.auto`: searches, trains the answer, prunes it and compresses it.
- `pruning.compact_run.compress`: quantises a trained run.
"""

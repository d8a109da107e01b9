"""Specs: a method as a YAML or TOML file.

- `schema.Spec`: reads, checks and resolves a spec. `train_schema.TrainSpec`: its training settings.
- `files`: built-in specs, what a spec extends, and its profiles.
- `loader`: YAML and TOML with the position of every value. `errors`: messages of invalid values.
"""

"""BEHAVE sequences.

- `reader.BehaveReader`: reader:behave.
- `calibration`, `fits`: its JSON files, and its registrations of bodies and objects.
"""

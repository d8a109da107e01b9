"""Pickles of other programs, read without running any code in them.

- `pickles`: files of pickle.dump, and of numpy.save with objects in them.
- `joblib_file`: files of joblib.dump.
"""

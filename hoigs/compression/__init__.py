"""Trained models in few bytes: quantised, squeezed, and read back. Never pickle."""

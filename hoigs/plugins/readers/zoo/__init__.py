"""Readers of single data sets."""

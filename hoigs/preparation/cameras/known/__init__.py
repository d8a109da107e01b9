"""Cameras and lenses that others have found: one file format a module."""

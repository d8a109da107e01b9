"""Errors in written clips: `noise` (values) and `damage` (whole files and frames)."""

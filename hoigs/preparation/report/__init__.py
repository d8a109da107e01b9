"""The report of a preparation.

- `report`: PrepareReport, written as report.json, report.md and report.html; how good it is.
- `overlay`: overlay.mp4, what was prepared over the frames.
"""

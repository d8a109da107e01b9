"""The report of a preparation.

- `report`: PrepareReport, written as report.json, report.md and report.html.
- `measures`, `diagnostics`: what is measured, and how good it is.
- `page`: report.html.
- `overlay`, `mesh_overlay`, `video_out`: overlay.mp4, what was prepared over the frames.
"""

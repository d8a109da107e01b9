"""Many videos or clips: prepare, train, evaluate and export each, on any number of machines.

- `batch.batch`: a manifest to reconstructions. `batch.work`: help another machine's batch.
- `manifest.each_row`: YAML or CSV to rows. `folder.BatchFolder`: rows and stages on disk.
- `summary.write_summary`: scores, times and pictures of all rows.
"""

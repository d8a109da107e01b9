"""Many videos or clips: prepare, train, evaluate and export each, on any number of machines.

- `batch.batch`: a manifest to reconstructions. `batch.work`: help another machine's batch.
- `manifest.each_row`: YAML or CSV to rows. `folder.BatchFolder`: where they lie.
- `stages.stages_of`: the `hoigs` commands of a row. `states.State`: which of them are done.
- `drive.drive`: runs what is not done; each row is locked by the one driver that works on it.
- `summary.write_summary`: scores, times and pictures of all rows.
"""

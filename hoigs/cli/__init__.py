"""The `hoigs` command: one verb a file; heavy imports wait until a verb runs."""

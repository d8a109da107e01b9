"""Files, locks, downloads, foreign files, threads and memory: what the machine offers."""

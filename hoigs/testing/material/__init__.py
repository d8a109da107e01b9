"""What subjects are built from: a tiny body, a tiny clip, made here and read from no file."""

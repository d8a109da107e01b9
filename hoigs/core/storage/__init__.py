"""Files and folders that are named by URL, such as s3://bucket/clips/a, through fsspec."""

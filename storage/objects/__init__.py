"""The object store: folders and S3 alike, with checksums and retries."""

"""The coordinator: takes queued jobs and runs their steps on the cluster."""

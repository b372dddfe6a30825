"""The command `envmatte`, one file for each group of commands.

What a command imports besides click and the client it imports when it runs: `envmatte --help` and the commands that
only talk to a service load no numpy, dask, numba or zarr.

Exit codes: 0 done; 1 the service refused, a job failed, a file can't be written, or something stored is damaged;
2 wrong command line or settings; 3 the service can't be reached, or asks to try again later; 4 another process has the
port; 130 interrupted, and nothing is left half done.
"""

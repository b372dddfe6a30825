"""The command `envmatte`, one file for each group of commands."""

"""`python -m services` is the command `envmatte`, where that is not on the path."""

from services.cli.main import run

run()

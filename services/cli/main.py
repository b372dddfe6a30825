"""The command `envmatte`.

Exit codes: 0 done; 1 the service refused, the job failed, a file can't be written, or something stored is damaged;
2 the command line was wrong; 3 the service can't be reached, or asks to be tried again later; 130 interrupted, and
nothing is left half done.
"""

import sys

import click
from click.shell_completion import get_completion_class

from services.cli import maintenance, patterns, processes, remote
from services.cli.keys import keys
from services.cli.output import example
from services.client import Busy, ServiceError, Unreachable


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, epilog=example("envmatte demo"))
@click.version_option(package_name="envmatte")
def main() -> None:
    """Environment mattes: film glass before a monitor, put it in front of anything.

    Exit codes: 0 done; 1 the service refused, a job failed, a file can't be written, or something stored is damaged;
    2 wrong command line; 3 the service can't be reached, or asks to be tried again later; 130 interrupted.
    """


@main.command(epilog=example('eval "$(envmatte completion bash)"', "envmatte completion fish | source"))
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print what makes a shell complete the commands and options of envmatte; have it run at the shell's start."""
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(main, {}, "envmatte", "_ENVMATTE_COMPLETE").source())


for command in (*processes.COMMANDS, keys, *maintenance.COMMANDS, *remote.COMMANDS, *patterns.COMMANDS):
    main.add_command(command)


def run() -> None:
    """The entry point: what the service refuses becomes a message and an exit code."""
    try:
        main(standalone_mode=False, prog_name="envmatte")
    except ServiceError as error:
        _end(f"Error: {error}", 3 if isinstance(error, Unreachable | Busy) else 1)
    except OSError as error:
        _end(f"Error: {error}", 1)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        _end("Interrupted.", 130)


def _end(message: str, code: int) -> None:
    click.echo(message, err=True)
    sys.exit(code)

"""The command `envmatte`: all of its commands, and what errors end it with."""

import gc
import io
import re
import signal
import sys
from typing import Any

import click
from click.shell_completion import get_completion_class

from services.cli import maintenance, processes, programs, setup
from services.cli.demo import demo
from services.cli.keys import keys
from services.cli.output import example
from services.cli.remote import jobs, mattes, records
from services.cli.remote.tether import tether
from services.client import Busy, ServiceError, Unreachable
from services.runtime.addresses import PortTaken
from storage.errors import EnvmatteError
from workflows.untrusted.control_characters import escape_controls


class _PortTaken(click.ClickException):
    exit_code = 4


class _Main(click.Group):
    def invoke(self, context: click.Context) -> Any:
        """Run a command; what the service's own code or its settings refuse becomes an error message."""
        try:
            return super().invoke(context)
        except EnvmatteError as error:
            kind = _PortTaken if isinstance(error, PortTaken) else click.ClickException
            raise kind(error.detail) from error
        except UnicodeEncodeError as error:
            raise click.UsageError(f"{error.object!r} has bytes that are not UTF-8") from error
        except ValueError as error:
            from pydantic import ValidationError

            from workflows.untrusted.validation import reason

            if isinstance(error, ValidationError):
                first = error.errors()[0]
                field = ".".join(map(str, first["loc"]))
                raise click.UsageError(f"{field} {reason(first)}".strip()) from error
            raise


@click.group(
    cls=_Main, context_settings={"help_option_names": ["-h", "--help"]}, epilog=example("envmatte demo")
)
@click.version_option(package_name="envmatte")
def main() -> None:
    """Environment mattes: film glass in front of a monitor, put it in front of anything.

    Exit codes: 0 done; 1 the service refused, a job failed, a file can't be written, or something stored is damaged;
    2 wrong command line or settings; 3 the service can't be reached, or asks to try again later; 4 another process has
    the port; 130 interrupted.
    """


@main.command(epilog=example('eval "$(envmatte completion bash)"', "envmatte completion fish | source"))
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print a script that completes commands and options. Run it when your shell starts."""
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(main, {}, "envmatte", "_ENVMATTE_COMPLETE").source())


for command in (
    *processes.COMMANDS,
    *setup.COMMANDS,
    keys,
    *maintenance.COMMANDS,
    *jobs.COMMANDS,
    *mattes.COMMANDS,
    *records.COMMANDS,
    demo,
    *programs.COMMANDS,
    tether,
):
    main.add_command(command)


def run() -> None:
    """The entry point: every error becomes a message and an exit code."""
    # What is half written is removed at these signals too, as after Ctrl-C. `nohup` has SIGHUP ignored.
    for number in (signal.SIGINT, *processes.ENDING):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    try:
        main(standalone_mode=False, prog_name="envmatte")
    except ServiceError as error:
        # Of the API's calls that errors name, people have this one as a command.
        detail = re.sub(r"GET /v1/(captures|jobs|mattes) lists", r"`envmatte list \1` lists", str(error))
        _end(f"Error: {detail}", 3 if isinstance(error, Unreachable | Busy) else 1)
    except OSError as error:
        _end(f"Error: {error}", 1)
    except click.ClickException as error:
        shown = io.StringIO()
        error.show(shown)
        _end(shown.getvalue().rstrip(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        _end("Interrupted.", 130)
    finally:
        gc.freeze()  # Python would search all modules for garbage before it ends: a second for those of a service


def _end(message: str, code: int) -> None:
    click.echo("\n".join(map(escape_controls, message.split("\n"))), err=True)
    sys.exit(code)

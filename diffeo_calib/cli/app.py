"""The program that all commands belong to.

Help is plain text: rich takes longer to load than everything else here.
"""

from __future__ import annotations

import shlex
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from diffeo_calib.cli import fleet
from diffeo_calib.cli.campaign import expanded
from diffeo_calib.cli.record import record, remove_earlier
from diffeo_calib.common.errors import printable

_arguments: list[str] = []
"""Of the command that runs."""


def command_line() -> str:
    """The command that runs, as a shell would take it."""
    return shlex.join(["diffeo-calib", *_arguments])


class FlagsOff(TyperGroup):
    """A group whose flags are off by default rather than unset, which typer converts by a library that loads slowly."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options of the program itself, all of which are flags: version, completion, help."""
        flags = super().get_params(ctx)
        for flag in flags:
            flag.default = False
        return flags

    def make_context(self, info_name: str | None, args: list[str], *others: Any, **options: Any) -> Any:
        """Parse a command line, with a campaign file written out, and remember it."""
        running = not (others or options.get("resilient_parsing")) and not {"-h", "--help"} & set(args)
        if running:
            remove_earlier(args)
        options_of_fit = [option.removeprefix("--") for one in self.commands["fit"].params for option in one.opts]
        if (several := fleet.asked(args, options_of_fit)) is not None:
            raise typer.Exit(fleet.run(several))
        _arguments[:] = expanded(args, options_of_fit)
        if running:
            remove_earlier(_arguments)
        return super().make_context(info_name, list(_arguments), *others, **options)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a bad value is named without typer's own words, and without control characters."""
        try:
            with record.written(list(_arguments)):
                return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = printable(error.message.removeprefix("Value error, "))
            raise


app = typer.Typer(
    cls=FlagsOff,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415

        typer.echo(f"diffeo-calib {version('diffeo_calib')}")
        raise typer.Exit


@app.callback()
def common(
    context: typer.Context,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say what is being done, line by line.")] = False,
) -> None:
    """Calibrate robot kinematics from measured positions or poses."""
    if verbose:
        from diffeo_calib.cli.console import log_lines  # noqa: PLC0415

        context.with_resource(log_lines())

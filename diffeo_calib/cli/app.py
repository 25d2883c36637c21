"""The program that all commands belong to.

Help is plain text: rich takes longer to load than everything else here.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import typer
from typer.core import TyperGroup

from diffeo_calib.cli import campaign
from diffeo_calib.cli.record import check_outputs, record, remove_earlier
from diffeo_calib.common.errors import printable, warn_user

Command = TypeVar("Command", bound=Callable[..., None])

MASS, FREEDOM = {"--payload": "--payload-mass"}, {"--marker": "--marker-freedom"}
RENAMED = {
    **{"correct": MASS, "export": MASS, "plan": MASS | {"--target": "--target-poses"}},
    **{"recalibrate": FREEDOM, "compare": FREEDOM},
}
"""Command -> former names of options, which had another meaning in other commands, and their names."""

_arguments: list[str] = []
"""Of the command that runs."""
_renamed: list[str] = []
"""Warnings about former names among them."""


def command_line() -> str:
    """The command that runs, as a shell would take it."""
    return shlex.join(["diffeo-calib", *_arguments])


def add_to_command_line(words: Sequence[str]) -> None:
    """Add options that were not typed but hold, so that the command line says how a table was read."""
    _arguments.extend(words)


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
        options_of_fit, of_campaign = (
            [option.removeprefix("--") for one in self.commands[name].params for option in one.opts]
            for name in (campaign.COMMAND, campaign.LIVE)
        )
        if (several := campaign.asked(args, options_of_fit)) is not None:
            raise typer.Exit(campaign.run(several))
        _arguments[:], _renamed[:] = _with_names(campaign.expanded(args, options_of_fit, of_campaign))
        if running:
            remove_earlier(_arguments)
        return super().make_context(info_name, list(_arguments), *others, **options)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a bad value is named without typer's own words, and without control characters."""
        try:
            with record.written(list(_arguments)):
                for text in _renamed:
                    warn_user(text)
                return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = printable(error.message.removeprefix("Value error, "))
            raise


def _with_names(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words with the names of options in the place of former ones, and what to say about these."""
    command = next((word for word in words if not word.startswith("-")), "")
    found, said, names = list[str](), list[str](), RENAMED.get(command, {})
    for word in words:
        name, equal, value = word.partition("=")
        if name in names:
            said.append(f"{name} of `{command}` is called {names[name]} now; {name} will be removed")
        found.append(names.get(name, name) + equal + value)
    return found, said


app = typer.Typer(
    cls=FlagsOff,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _remember(path: Path | None) -> Path | None:
    """The command writes its results to this file when it ends."""
    if path is not None:
        record.path = path
        check_outputs({}, {})
    return path


Json = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        callback=_remember,
        help="Also write the results to this file, for programs, as diffeo_calib/cli/result.schema.json says.",
    ),
]


def command(name: str) -> Callable[[Command], Command]:
    """Declare a command; parameters whose type is a dataclass are groups of options, and every command has --json."""

    def declare(function: Command) -> Command:
        hints = inspect.get_annotations(function, eval_str=True)  # get_type_hints of 3.10 hides options of None
        groups: dict[str, Any] = {key: hint for key, hint in hints.items() if is_dataclass(hint)}

        def run(**given: Any) -> None:
            del given["_json"]
            for key, group in groups.items():
                given[key] = group(**{field.name: given.pop(field.name) for field in fields(group)})
            function(**given)

        parameters = [
            inspect.Parameter(one, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            for one, annotation, default in _flat(function, hints)
        ]
        run.__name__, run.__doc__ = function.__name__, function.__doc__
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        vars(run)["__signature__"] = inspect.Signature(parameters)
        app.command(name)(run)
        return function

    return declare


def _flat(function: Callable[..., None], hints: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Name, type and default of the parameters of a command, those of its groups among them."""
    found: list[tuple[str, Any, Any]] = []
    for key, parameter in inspect.signature(function).parameters.items():
        if not is_dataclass(hints[key]):
            found.append((key, hints[key], parameter.default))
            continue
        own = get_type_hints(hints[key], include_extras=True)
        for field in fields(hints[key]):
            default = inspect.Parameter.empty if field.default is MISSING else field.default
            said, annotation = dict(field.metadata), own[field.name]
            if said:
                names = said.pop("names") or (f"--{field.name.replace('_', '-')}",)
                annotation = Annotated[annotation, typer.Option(*names, **said)]
            found.append((field.name, annotation, default))
    return [*found, ("_json", Json, None)]


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
    """Calibrate robot kinematics from rows of measurements, whatever measured them."""
    if verbose:
        from diffeo_calib.cli.console import log_lines  # noqa: PLC0415

        context.with_resource(log_lines())

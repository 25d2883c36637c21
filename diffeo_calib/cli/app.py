"""The program that all commands belong to.

Help is plain text: rich takes longer to load than everything else here.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

import typer
from typer.core import TyperGroup

from diffeo_calib.cli import campaign
from diffeo_calib.cli.record import check_outputs, record, remove_earlier
from diffeo_calib.common.errors import InputError, printable

DECLARED: dict[str, dict[str, Any]] = {}
"""Command -> name of an option or argument, without dashes -> type of its value."""
_arguments: list[str] = []
"""Of the command that runs."""


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
        _arguments[:] = campaign.expanded(args, DECLARED)
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


@dataclass(frozen=True, kw_only=True)
class Command:
    """The options of a command; its work is ``run`` of the module of its name in ``commands``, which takes them.

    Attributes:
        needs: option -> those of which it needs one. beside: option -> those that it cannot stand beside.
    """

    needs: ClassVar[dict[str, str]] = {}
    beside: ClassVar[dict[str, str]] = {}

    def check(self) -> None:
        """Refuse options that cannot be meant."""

    @property
    def more_files(self) -> dict[str, Path]:
        """Files that are written beside those that options name."""
        return {}


Options = TypeVar("Options", bound=Command)


def command(name: str) -> Callable[[type[Options]], type[Options]]:
    """Declare a command by the class of its options, whose fields may be groups of more; every command has --json."""

    def declare(plain: type[Options]) -> type[Options]:
        options = dataclass(frozen=True, kw_only=True)(plain)
        leaves = dict(leaves_of(options))
        named = {one: hint for hint, field in leaves.values() for one in names_of(field)} | {"--json": Path}
        DECLARED[name] = {one.removeprefix("--").lower(): hint for one, hint in named.items()}

        def run(_json: Any, **given: Any) -> None:
            made = _made(options, given)
            files: dict[str, dict[str, Path]] = {
                "write": dict(made.more_files),
                "read": {},
                "appended": {},
                "folder": {},
            }
            for key, (_, field) in leaves.items():
                for path in given[key] if isinstance(given[key], list) else [given[key]]:
                    if isinstance(path, Path):
                        shown = names_of(field)[0] + f" {path}" * isinstance(given[key], list)
                        files[field.metadata["file"]][shown] = path
            check_outputs(files["write"], files["read"] | files["appended"], may_come=files["appended"])
            check_together(typed_options(leaves, given), options.needs, options.beside)
            made.check()
            import_module(f"diffeo_calib.cli.commands.{name}").run(made)

        json = inspect.Parameter("_json", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Json)
        parameters = [*(_parameter(hint, field) for hint, field in leaves.values()), json]
        run.__name__, run.__doc__ = f"{name}_command", plain.__doc__
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        vars(run)["__signature__"] = inspect.Signature(parameters)
        app.command(name)(run)
        return options

    return declare


def leaves_of(group: Any) -> Iterator[tuple[str, tuple[Any, Field[Any]]]]:
    """Name, type and field of the options of a group and of the groups in it."""
    hints = get_type_hints(group)
    for field in fields(group):
        own = hints[field.name]
        yield from leaves_of(own) if is_dataclass(own) else [(field.name, (own, field))]


def names_of(field: Field[Any]) -> tuple[str, ...]:
    """What the user types for an option, or reads for an argument."""
    if field.metadata["made"] is typer.Argument:
        return (field.metadata["how"]["metavar"],)
    return field.metadata["names"] or (f"--{field.name.replace('_', '-')}",)


def typed_options(leaves: Mapping[str, tuple[Any, Field[Any]]], given: Mapping[str, Any]) -> set[str]:
    """The options and arguments whose values are not those by default."""
    return {names_of(field)[0] for key, (_, field) in leaves.items() if given[key] not in (None, [], field.default)}


def check_together(typed: Container[str], needs: Mapping[str, str], beside: Mapping[str, str]) -> None:
    """Refuse an option without those, separated by spaces, of which it needs one, or beside those that exclude it."""
    for option, others in needs.items():
        if option in typed and not any(other in typed for other in others.split()):
            what = f"{option} without {' or '.join(others.split())}"
            raise InputError.of(what, fix="name this too, or leave the option out")
    for option, others in beside.items():
        for other in others.split():
            if option in typed and other in typed:
                raise InputError.of(f"{option} beside {other}", fix="leave one of them out")


def _parameter(hint: Any, field: Field[Any]) -> inspect.Parameter:
    """A field as typer reads it."""
    names = names_of(field) if field.metadata["made"] is typer.Option else ()
    annotation = Annotated[hint, field.metadata["made"](*names, **field.metadata["how"])]
    default = inspect.Parameter.empty if field.default is MISSING else field.default
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _made(group: Any, given: dict[str, Any]) -> Any:
    """A group of options, and the groups in it, from the values of all."""
    hints = get_type_hints(group)
    names = [field.name for field in fields(group)]
    return group(**{name: _made(hints[name], given) if is_dataclass(hints[name]) else given[name] for name in names})


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

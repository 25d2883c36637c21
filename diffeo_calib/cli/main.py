"""The command line, and what its exit codes mean.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why), or `evaluate` found rows
out of step with their joints, or a median error above a tenth of the robot's reach (the errors are printed first), or
`fit` found such errors in a quarter of the rows (the model is written); 2 wrong usage;
3 the fit stopped before it converged (the model is written); 130 interrupted by Ctrl-C (the best model so far is
written).

Each command imports its work when it runs, so that help, the version and shell completion load neither torch nor SciPy
and appear at once.

Campaign files hold options, `tip = "flange"`: `diffeo-calib fit campaign.toml` runs as if they had been typed. Options
that are typed as well win, also those that may be repeated, such as `--tip`. Paths are relative to the file's folder.
"""

from __future__ import annotations

import inspect
import os
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

from diffeo_calib.cli.console import (
    EXIT_ERROR,
    EXIT_INTERRUPTED,
    INTERRUPTED,
    check_outputs,
    interrupts,
    log_lines,
    record,
    remove_earlier,
    show,
)
from diffeo_calib.cli.declarations import COMMANDS, Command
from diffeo_calib.cli.options import CORNERS, has
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning, InputError, as_written, printable, sentence
from diffeo_calib.common.files import PROGRAM, read_regular

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

SUFFIX = ".toml"
COMMAND, LIVE = "fit", "campaign"
JOINED = ("rotation-std",)  # entries that may be lists of columns although the option can be repeated
LONGEST_FILE = 1 << 20  # bytes: a file of options is short
IN_FILE_OF = {"record": "images", "demo": "fit", "predict": "evaluate"}  # command -> that whose file holds its work
GONE = {
    "compare": "write `recalibrate OLD OTHER` without -o",
    "report": "write `evaluate MODEL [CSV] --report PAGE`",
    **dict.fromkeys(("--target", "--fail-above"), "write --tolerance"),
    **dict.fromkeys(("--next", "--rows"), "write --count"),
    "--payload-mass": "write --payload",
    "--overview": "write --report",
    "--register": "write --free both",
    "--data": "name the table as an argument behind the model",
    "--residuals": "write -o",
    "--json-lines": "leave it out: --stdin answers so",
    "--tool-from": "write --tool measured:X,Y,Z[,...] for a tool in the measured frame",
    "--with-tables": "leave it out: what is written beside --correction-tables is for use together with them",
    "--figure": "write --report, whose page shows the same pictures",
    "--marker-freedom": "write --free base (same markers), --free remounted (moved) or --free both (other)",
    "--seen": "name the topic as an argument behind the bag",
    "--shortest": "write it behind that of --still: --still MOTION,SECONDS",
    "--drift": "write `evaluate MODEL CSV --free both -o NEW` where nothing but device and markers may have changed",
    "--ur-hash": "write --ur-kinematics over a copy of the robot's own calibration file, whose hash it keeps",
}
"""Former name of a command or an option, and what to do now."""
DECLARED: dict[str, dict[str, Any]] = {}
"""Command -> name of an option or argument, without dashes -> type of its value."""
_arguments: list[str] = []  # of the command that runs


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
        if running:
            refuse_gone(args)
        _arguments[:] = expanded(args)
        if running:
            remove_earlier(_arguments)
        return super().make_context(info_name, list(_arguments), *others, **options)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a bad value is named without typer's own words, and without control characters."""
        try:
            with record.written(list(_arguments)):
                try:
                    return super().invoke(ctx)
                except KeyboardInterrupt:  # there is no result to keep
                    show("error", f"{INTERRUPTED}.")
                    raise typer.Exit(EXIT_INTERRUPTED) from None
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
        help="Also write the results to this file, for programs; `python -m diffeo_calib.reports.results` prints the "
        "schema.",
    ),
]


def _declare(name: str, options: type[Command]) -> None:
    declared = sorted(options.all(), key=lambda option: bool(option.names))  # arguments first, in messages too
    parameters = list[inspect.Parameter]()
    named = {word: option.hint for option in declared for word in option.names or (option.shown,)} | {"--json": Path}
    DECLARED[name] = {word.removeprefix("--").lower(): hint for word, hint in named.items()}

    def run(_json: Any, **given: Any) -> None:
        written, read, appended = dict[str, Path](), dict[str, Path](), dict[str, Path]()
        files = {"write": written, "source": written, "read": read, "later": appended}
        for option in declared:
            value = given[option.field]
            for path in value if isinstance(value, list) else [value]:
                if option.kind in files and isinstance(path, Path):
                    files[option.kind][option.shown + f" {path}" * isinstance(value, list)] = path
                    if option.kind == "source":
                        written[f"{option.shown} (its header)"] = path.with_suffix(".h")
        check_outputs(written, read | appended, may_come=appended)
        options.check_together(given)
        module = import_module(f"diffeo_calib.cli.commands.{IN_FILE_OF.get(name, name)}")
        getattr(module, f"run_{name}" if name in IN_FILE_OF else "run")(options(**given))

    for option in declared:
        typed = typer.Option(*option.names, **option.how) if option.names else typer.Argument(**option.how)
        default = inspect.Parameter.empty if option.default is MISSING else option.default
        kind, annotation = inspect.Parameter.KEYWORD_ONLY, Annotated[option.hint, typed]
        parameters.append(inspect.Parameter(option.field, kind, default=default, annotation=annotation))
    parameters.append(inspect.Parameter("_json", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Json))
    run.__name__, run.__doc__ = f"{name}_command", options.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(run)["__signature__"] = inspect.Signature(parameters)
    app.command(name)(run)


for _name, _options in COMMANDS.items():
    _declare(_name, _options)


def _print_version(wanted: bool) -> None:
    if wanted:
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
        context.with_resource(log_lines())


# --- campaign files ---------------------------------------------------------------------------------------------------


def _place_of_command(words: Sequence[str]) -> int:
    return next((place for place, word in enumerate(words) if not word.startswith("-")), len(words))


def refuse_gone(words: Sequence[str]) -> None:
    """Raise InputError for a former name of a command or an option, which says what to do now."""
    at = _place_of_command(words)
    names = [*words[at : at + 1], *(word.partition("=")[0] for word in words[at + 1 :] if word.startswith("--"))]
    for name in names:
        if name in GONE:
            raise InputError.of(f"{name} is gone", fix=GONE[name])


def expanded(arguments: Sequence[str]) -> list[str]:
    """The command line with a campaign file written out, for `campaign` without what only `fit` knows."""
    words = list(arguments)
    at = _place_of_command(words)
    if len(words) < at + 2 or words[at] not in (COMMAND, LIVE) or not words[at + 1].lower().endswith(SUFFIX):
        return words
    path = Path(words[at + 1])
    options = DECLARED[words[at]]
    of_fit = {*DECLARED[COMMAND]} - {*options}
    entries = {name: value for name, value in _entries(path).items() if name not in of_fit}
    refuse_gone(["", *(f"--{name}" for name in entries)])
    if unknown := [name for name in entries if name not in options]:
        expected = f"options of `{words[at]}`: {', '.join(options)}"
        raise InputError.of(f"{path}: {', '.join(unknown)}", expected=expected, fix="correct the names")
    if "csv" not in entries:
        raise InputError.of(f"{path} has no entry csv", fix='add csv = "measurements.csv", the table to calibrate with')
    typed = {word.removeprefix("--").partition("=")[0] for word in words[at + 2 :] if word.startswith("--")}
    table = _text(path, "csv", entries.pop("csv"), options["csv"])
    kept = {name: value for name, value in entries.items() if name not in typed}
    written = [word for name, value in kept.items() for word in _words(path, name, value, options[name])]
    return [*words[: at + 1], table, *written, *words[at + 2 :]]


def _entries(path: Path) -> dict[str, Any]:
    content = read_regular(path, "campaign file", LONGEST_FILE)
    try:
        return {name.replace("_", "-"): value for name, value in tomllib.loads(content.decode("utf-8-sig")).items()}
    except (ValueError, RecursionError) as error:  # TOML, text or a name that is none, or lists in lists
        fix = 'write one option per line: length = "mm"'
        raise InputError.of(f"{path} is no TOML", got=str(error), fix=fix) from error


def _words(path: Path, name: str, value: object, hint: Any) -> list[str]:
    if isinstance(value, bool):
        return [f"--{name}"] * value
    values = value if isinstance(value, list) else [value]
    if isinstance(value, list) and (name in JOINED or not has(hint, list)):
        values = [",".join(map(str, value))]
    return [word for element in values for word in (f"--{name}", _text(path, name, element, hint))]


def _text(path: Path, name: str, value: object, hint: Any) -> str:
    """A value as a word; files relative to the folder of the campaign."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise InputError.of(f"{path}: {name}", expected="text or a number", got=as_written(value))
    begin = CORNERS if str(value).startswith(CORNERS) and str(value).endswith(".yaml") else ""
    if PROGRAM in str(value):
        begin = str(value).rpartition("=")[0] + "="
    file = str(value).removeprefix(begin)
    return f"{begin}{path.parent / file}" if begin or has(hint, Path) else file


# --- the program ---


def main() -> None:
    """Run the command line; every error of this package becomes one sentence and an exit code."""
    interrupts.install()
    with forgiving_streams(), warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = lambda message, *_, **__: show("warning", record.warned(message))
        try:
            app()
        except DiffeoCalibError as error:
            show("error", error)
            sys.exit(EXIT_ERROR)
        except OSError as error:  # a name that no file system takes, or a file that went away
            if error.filename is None:
                raise
            show("error", sentence(f"{as_written(str(error.filename))}: {error.strerror}", fix="check the path"))
            sys.exit(EXIT_ERROR)


class ForgivingStream:
    """A text stream, or the lack of one, whose failures to write end the output, not the program."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream if stream is not None else open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115

    def write(self, text: str) -> int:
        """Write, or drop the text where that fails."""
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop what is buffered where that fails."""
        self._try(self._stream.flush)

    def _try(self, action: Any, *given: str) -> None:
        try:
            action(*given)
        except (OSError, ValueError):
            with suppress(OSError, ValueError):  # the buffer, too, is flushed again when the interpreter ends
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def forgiving_streams() -> Iterator[None]:
    """Forgive failures of standard output and standard error inside."""
    for number in range(3):  # closed ones: the next file would be number 1 or 2, and take what others print
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (ForgivingStream(stream) for stream in before)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before

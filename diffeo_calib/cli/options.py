"""The options of all commands, as options.md describes them: classes of options made from it. Imports nothing slow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args, get_origin

from diffeo_calib.common.errors import InputError

DESCRIPTION = Path(__file__).with_name("options.md")
TYPES: dict[str, tuple[Any, Any]] = {
    "text": (str, str),
    "texts": (list[str], str),
    "number": (float, float),
    "count": (int, int),
    "seed": (int, int),
    "flag": (bool, bool),
    "files": (list[Path], Path),
    **dict.fromkeys(("file", "table", "output", "source", "folder"), (Path, Path)),
}
"""Word for a type -> the type of a value, and what makes one of a text."""
SHORT = {"output": "-o", "count": "-n"}
SEEDS = {"min": 0, "max": 2**63 - 1}
"""The largest as in common/checks.py, which loads torch."""
DRAWN = 3000
CORNERS = "corners="
"""Begin of --reading for images of a board."""


class Option(NamedTuple):
    """An option, or an argument, as typer takes it.

    Args:
        field: its name in Python. hint: type of its value. default: MISSING where one is required. names: as typed,
            none of an argument. shown: in messages. kind: word for its type. how: its help and limits.
    """

    field: str
    hint: Any
    default: Any
    names: tuple[str, ...]
    shown: str
    kind: str
    how: dict[str, Any]

    @classmethod
    def of(cls, entry: str) -> Option:
        """One of a line of options.md."""
        head, _, text = entry.partition(": ")
        mark, name, spec, *more = head.split(" ")
        kind, equal, default = spec.rstrip("!").partition("=")
        hint: Any
        hint, made = TYPES.get(kind) or (Literal[tuple(kind.split("|"))], str)
        how: dict[str, Any] = dict(SEEDS) if kind == "seed" else {}
        if more and re.match(r"[\d.e-]+\.\.", more[0]):
            ends = more.pop(0).partition("..")
            how = {end: made(number) for end, number in zip(("min", "max"), ends[::2], strict=True) if number}
        how |= {"help": text, "metavar": more[0] if more else None}
        value = made(default) if equal else {"seed": 0, "flag": False}.get(kind)
        long = f"--{name.replace('_', '-')}"
        names = () if mark == "*" else tuple(filter(None, (SHORT.get(name), long)))
        hint = hint if spec.endswith("!") or value is not None else hint | None
        return cls(name, hint, MISSING if spec.endswith("!") else value, names, (*names, *more)[0], kind, how)


class Section(NamedTuple):
    """One of options.md: its text, field -> its entry, and which options need or exclude which."""

    text: str
    entries: dict[str, str]
    rules: list[tuple[list[str], bool, list[str]]]


@cache
def description() -> dict[str, Section]:
    """The sections of options.md."""
    found = dict[str, Section]()
    for section in DESCRIPTION.read_text(encoding="utf-8").split("\n# ")[1:]:
        name, _, body = section.partition("\n")
        text, *lines = re.split("^(?=[-*+!] )", body, flags=re.MULTILINE)
        heads = [(" ".join(line.split())).partition(":") for line in lines]
        rules = [(head[2:].split(), rest.split()) for head, _, rest in heads if head.startswith("!")]
        entries = {head.split(" ")[1]: f"{head}{colon}{rest}" for head, colon, rest in heads if head[0] != "!"}
        found[name] = Section(text.strip(), entries, [(own, rest[0] == "need", rest[1:]) for own, rest in rules])
    return found


class Options:
    """A group of options: a dataclass with the fields of its section."""

    groups: ClassVar[dict[str, type[Options]]] = {}
    parts: ClassVar[dict[str, type[Options] | Option]] = {}
    """Field -> what it is."""

    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Any]]

        def __init__(self, **given: Any) -> None: ...

        def __getattr__(self, name: str) -> Any: ...

    def __init_subclass__(cls) -> None:
        section = cls.__name__.lower()
        if section in description():
            cls.groups[section], cls.parts, cls.__annotations__ = cls, {}, {}
            for name, entry in description()[section].entries.items():
                if entry.startswith("+"):
                    cls.parts[entry.split(" ")[2]] = cls.groups.get(name) or type(name, (Options,), {})
                else:
                    cls.parts[name] = Option.of(entry if ": " in entry else description()["shared"].entries[name])
            for name, part in cls.parts.items():
                cls.__annotations__[name] = "Any"
                if isinstance(part, Option) and part.default is not MISSING:
                    setattr(cls, name, field(default=part.default))
            dataclass(frozen=True, kw_only=True)(cls)

    @classmethod
    def all(cls) -> Iterator[Option]:
        """Its options, and those of the groups in it."""
        for part in cls.parts.values():
            yield from [part] if isinstance(part, Option) else part.all()

    @classmethod
    def made(cls, given: Mapping[str, Any]) -> Any:
        """The group, and the groups in it, from the values of all options."""
        found = cls.parts.items()
        return cls(**{name: given[name] if isinstance(part, Option) else part.made(given) for name, part in found})

    @classmethod
    def check_together(cls, given: Mapping[str, Any]) -> None:
        """Refuse options without those of which they need one, or beside those that they exclude."""
        typed = {one.shown for one in cls.all() if given[one.field] not in (None, [], one.default)}
        for options, need, others in description()[cls.__name__.lower()].rules:
            for option in (one for one in options if one in typed):
                if need and not typed & {*others}:
                    what = f"{option} without {' or '.join(others)}"
                    raise InputError.of(what, fix="name this too, or leave the option out")
                if not need and typed & {*others}:
                    raise InputError.of(f"{option} beside {min(typed & {*others})}", fix="leave one of them out")


def has(hint: Any, part: Any) -> bool:
    """Whether a type, or a part of it, is this one."""
    return part in {hint, get_origin(hint)} or any(has(one, part) for one in get_args(hint))


class Units(Options):
    """How tables are written; a model knows that of the table of its fit."""


class Places(Options):
    """Measured places in a file of their own."""


class Rows(Options):
    """Columns of the measurements in a table, of any kinds."""

    @property
    def named(self) -> bool:
        """Whether columns of some kind of rows are named."""
        return bool(self.position or self.socket or self.reading)

    @property
    def images(self) -> bool:
        """Whether rows are images of a printed board."""
        return any(text.startswith(CORNERS) for text in self.reading or ())


class Links(Options):
    """Which part of the robot in a file."""


class Robot(Options):
    """Which robot was measured; none where --robot-pose names commanded poses."""


class Targets(Options):
    """Columns of the poses that a tool shall have."""


class Candidates(Options):
    """Configurations to choose from: a table, or random ones within what the cell allows."""


class Command(Options):
    """The options of a command; its work is ``run`` of the module of its name in ``commands``, which takes them."""


COMMANDS = {name: type(name, (Command,), {}) for name, section in description().items() if section.text}
"""By name, in the order of the help."""

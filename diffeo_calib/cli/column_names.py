"""What the name of a column says: its words, its unit, and whether it holds what was measured or what was wished."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise
from typing import NamedTuple

from diffeo_calib.measurements.csv.lines import UNITS

ROLES = {
    "measured": "actual act measured meas measure measurement msr ist istwert reported encoder enc feedback fb "
    "observed observation obs gemessen mess messung messwert mesure mesuree misurato misurata medido medida real "
    "reale reel gemeten zmierzone 实际 实测 実測 実測値 測定 測定値",
    "wished": "target cmd command commanded goal desired des soll sollwert ziel vorgabe geplant nenn referenz sp ref "
    "setpoint reference nominal nom plan planned wish wished wanted demand demanded ideal action theoretical theo calc "
    "calculated computed fk sim simulated predicted expected consigne cible commande theorique nominale comando "
    "riferimento deseado desejado objetivo teorico teorica gewenst zadane "
    "目標 目標値 目标 指令 指令値 理论 設定 設定値",
    "deviation": "std stddev stdev dev deviation sigma err error uncertainty unc rms var residual",
    "rate": "vel velocity velocities speed qd dq qdot dot acc accel acceleration qdd ddq gyro imu tau torque torques "
    "effort moment force wrench ft current currents voltage volt power temp temperature mode control window momentum "
    "load pressure status nm strom drehmoment geschwindigkeit vitesse couple",
    "turn": "rot rotation euler quat quaternion ang angle angles orientation ori rotvec rvec rpy phi q",
    "place": "t p pos position trans translation tvec point",
    "tool": "tcp pose ee cartesian cart tool marker point",
    "joint": "q j joint joints jnt axis axes ax a rax achse gelenk theta th qpos jpos pos position positions angle "
    "angles state states 关节 軸 轴 関節",
    "external": "e ext external extax eax rail track slide linear",
    "pixel": "px pixel pixels",
    "distance": "r d sd dist distance range slope rho radius strecke schragstrecke schragdistanz",
    "around": "hz az azimuth azim azimut horizontal horiz hor ha",
    "elevation": "elevation elev el",
    "zenith": "zenith zen",
    "vertical": "elevation elev el zenith zen v va vz vertical vert",
    "machine": "robot flange tcp tool ee eef effector gripper hand command cmd base",
    "seen": "board camera cam marker tracker tag charuco aruco pattern target object world",
}
"""What words of names say: a rate is anything but a place or a joint's value, an external axis is beside the arm's.

A machine has poses of its own, beside what was seen.
"""
WORDS = {role: frozenset(words.split()) for role, words in ROLES.items()}
NAMED_UNITS = UNITS | {"kg": "kg", "grad": "deg"}  # units as names of columns say them
SAID = WORDS["measured"] | WORDS["wished"] | WORDS["deviation"]
GLUED = {word: word for word in {*SAID, *WORDS["turn"], "t", "p", "m", "pos", "position", "trans", "tcp"} - {"q"}}
GLUED |= {"d": "err", "e": "err", "s": "std"}
"""What stands before x, y or z in one word, and what it means."""
AXES = {"east": "x", "easting": "x", "north": "y", "northing": "y", "up": "z"}
SURVEYED = tuple("enh"), tuple("enu"), ("x", "y", "height"), ("x", "y", "elevation")
SPLIT = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
LONGEST_LABEL = 6  # words of a name that are compared with one label


@dataclass(frozen=True)
class Column:
    """A column by its name."""

    name: str  # as written
    words: tuple[str, ...]  # in lower case, without the unit; numbers and axes are words of their own
    unit: str = ""  # mm, m, cm, um, inch, rad, mrad, deg, gon or kg; empty where the name says none

    @property
    def plain(self) -> str:
        """The name without unit, case and signs."""
        return "".join(self.words)


class Group(NamedTuple):
    """Columns whose names differ by a label alone, between the words that all have in common."""

    before: tuple[str, ...]
    after: tuple[str, ...]
    names: dict[str, str]  # label -> column

    @property
    def shared(self) -> frozenset[str]:
        """The words that all have in common."""
        return frozenset(self.before + self.after)

    def says(self, *roles: str) -> frozenset[str]:
        """Words that have one of some roles."""
        return self.shared & frozenset[str]().union(*(WORDS[role] for role in roles))

    @property
    def wished(self) -> bool:
        """Whether they hold what was commanded: q_d and O_T_EE_d are desired, target 1 is a reflector."""
        words = [*self.before, "", *self.after]
        reflector = any(word == "target" and after.isdigit() for word, after in pairwise(words))
        desired = "d" in self.shared and not self.shared.isdisjoint({"q", "ee"})
        return desired or bool(self.says("wished") - ({"target"} if reflector else set()))

    @property
    def rank(self) -> int:
        """0: measured, 1: nothing is said, 2: wished."""
        return 2 if self.wished else int(not self.says("measured"))

    @property
    def stem(self) -> frozenset[str]:
        """The words that all have in common, but for measured or wished."""
        return self.shared - self.says("measured", "wished")


@cache
def column(name: str) -> Column:
    """The description of a column, parsed once."""
    text = re.sub(r"/s(?![a-z])", " speed ", re.sub("[°º˚]", " deg ", name))
    text = "".join(sign for sign in unicodedata.normalize("NFKD", text) if not unicodedata.combining(sign))
    text = re.sub("(?<![A-Za-z])[a-z][XYZW](?![A-Za-z])", lambda axis: axis[0].lower(), text)  # dX, rX
    words = [part for word in SPLIT.findall(text) for part in _parts(word.lower())]
    units = [k for k, word in enumerate(words) if word in NAMED_UNITS and k]
    at = [k for k in units if len(words[k]) > 2 or words[k] == "mm" or k + 1 == len(words)]
    unit = NAMED_UNITS[words.pop(at[-1])] if at else ""
    for place, word in enumerate(words):  # the current position, not the current of a motor
        if word == "current" and {*words[place + 1 :]} & ({*WORDS["joint"], *WORDS["tool"], *"xyz"} - {"a"}):
            words[place] = "actual"
    if words[-2:-1] in (["tvec"], ["rvec"]) and words[-1] in ("0", "1", "2"):  # of OpenCV
        words[-1] = "xyz"[int(words[-1])]
    return Column(name, tuple(words), unit)


def _parts(word: str) -> list[str]:
    """A word, divided where an axis or q is glued to another one: tx, xist, qcmd."""
    if word[-1] in "xyz" and word[:-1] in GLUED:
        return [GLUED[word[:-1]], word[-1]]
    if word[0] in "xyzqj" and word[1:] in SAID | {"pos", "m", "mm"}:
        return [word[0], "meas" if word[1:] == "m" else word[1:]]
    return [AXES.get(word, word)]


def groups(names: Sequence[str], labels: Sequence[str]) -> Iterator[Group]:
    """The columns whose names differ by some of these labels alone, in the order of the labels."""
    grouped: dict[tuple[tuple[str, ...], tuple[str, ...], int], dict[str, str]] = {}
    wanted, counts = set(labels), Counter[tuple[str, ...]]()
    for words, name in ((column(name).words, name) for name in names):
        counts[words] += 1  # X and x are columns of two groups
        for start, end in combinations(range(len(words) + 1), 2):
            label = "".join(words[start:end]) if end - start <= LONGEST_LABEL else ""
            if label and label in wanted:
                grouped.setdefault((words[:start], words[end:], counts[words]), {})[label] = name
    for (before, after, _), columns in grouped.items():
        yield Group(before, after, {label: columns[label] for label in labels if label in columns})


def whole(names: Sequence[str], labels: Sequence[str]) -> Iterator[Group]:
    """Columns that have all of the labels."""
    return (group for group in groups(names, labels) if len(group.names) == len(labels))


def of_places(names: Sequence[str]) -> Iterator[Group]:
    """The columns of each place by x, y and z: of a surveyed one east, north and height, or up."""
    yield from whole(names, "xyz")
    for group in (group for labels in SURVEYED for group in whole(names, labels)):
        axes = dict(zip("xyz", group.names.values(), strict=True))
        if "x" not in axes["x"].lower():  # beside x and y a height is a reading
            yield group._replace(names=axes)


def mixed_names(columns: Sequence[str], full: Sequence[str], bare: Sequence[str]) -> dict[str, str]:
    """Columns that are named after joints in part or by the first letters (x_axis, c, az), or as DH tables do (d3)."""
    there = {column(name).plain: name for name in reversed(columns)}
    starts = {text: [label for label in bare if label.startswith(text)] for text in there if len(text) > 1}
    names = dict[str, str]()
    for k, (whole_name, label) in enumerate(zip(full, bare, strict=True)):
        texts = whole_name, label, *(f"{sign}{k + 1}" for sign in ("θ", "theta", "d"))
        short = (text for text, labels in starts.items() if labels == [label])
        if text := next((text for text in texts if text in there), next(short, "")):
            names[whole_name] = there[text]
    return names if len({*names.values()}) == len(full) else {}

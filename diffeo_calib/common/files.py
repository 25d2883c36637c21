"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING

from diffeo_calib.common.errors import InputError, as_written

if TYPE_CHECKING:
    from typing_extensions import Self


try:
    import fcntl
except ImportError:  # Windows, where leftovers stay
    fcntl = None


SUFFIX = ".part"
QUOTES = b"\x85\x91\x92\x93\x94\x95\x96\x97\x99"  # quotation marks, dashes and the like in cp1252
LONGEST_STEM = 200  # bytes of a file's name that are part of the name of its temporary file; names have 255 at most
FULL = "free some space, or name a file on another disk"
FIXES = {
    errno.ENOSPC: FULL,
    errno.EDQUOT: FULL,
    errno.EFBIG: FULL,
    errno.ENOENT: "make its folder first, or name a file in another folder",
}
"""Advice on failures."""

_unfinished: set[Path] = set()  # temporary files of this process


def as_path(path: object) -> Path:
    """Raise InputError unless this can be the name of a file."""
    if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
        raise InputError.of("the name of a file", expected="text or a path", got=as_written(path))
    return path if isinstance(path, Path) else Path(path)


class WholeFile:
    """A file that takes its name when it is complete: a full disk or a kill leaves an existing file as it was.

    The content goes into a temporary file in the same folder, ``NAME.xxxxxxxx.part``, which is locked while its writer
    is alive. What killed writers have left is removed when the same file is written again. Links are followed, and an
    existing file keeps its permissions. What is no regular file, such as a pipe, is written directly.

    Used as a context: the file appears when the block ends, and does not change if the block raises.

    Args:
        path: the file.

    Raises:
        InputError: the file cannot be written, when entering, writing or leaving.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = as_path(path)
        self._target = Path(os.path.realpath(path))
        self._stack = ExitStack()
        self._part: Path | None = None
        self._file: IO[bytes] | None = None
        self._wanted = True

    def __enter__(self) -> Self:
        with _one_sentence(self.path):
            if self.path.exists() and not self.path.is_file():
                self._file = self._stack.enter_context(self.path.open("wb"))
            elif self._target.is_symlink():
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
            else:
                _remove_leftovers(self._target)
                self._file = self._open_part()
        return self

    def write(self, content: bytes) -> None:
        """Append to the file."""
        with _one_sentence(self.path):
            self._opened.write(content)

    def complete(self) -> None:
        """Bring all content to the disk; only the name is missing then."""
        with _one_sentence(self.path):
            self._opened.flush()
            if self._part is not None:
                bring_to_disk(self._opened)  # some file systems notice only now that they are full
                _take_permissions(self._part, self._target)

    def abandon(self) -> None:
        """Leave the file as it was."""
        self._wanted = False

    def __exit__(self, kind: type[BaseException] | None, _value: object, _trace: TracebackType | None) -> None:
        try:
            if kind is None and self._wanted:
                self.complete()
                with _one_sentence(self.path):
                    self._opened.close()
                    if self._part is not None:
                        os.replace(self._part, self._target)
        finally:
            with suppress(OSError):  # what is buffered is written again
                self._opened.close()
            self._stack.close()

    @property
    def _opened(self) -> IO[bytes]:
        if self._file is None:
            raise ValueError("the file is written inside a `with` block")
        return self._file

    def _open_part(self) -> IO[bytes]:
        """Make the temporary file and lock it, by a descriptor of its own: the lock outlives the closing."""
        while True:
            handle, name = tempfile.mkstemp(dir=self._target.parent, prefix=f"{_stem(self._target)}.", suffix=SUFFIX)
            lock = self._stack.enter_context(os.fdopen(handle, "wb"))
            lock_file(lock, wait=True)
            if Path(name).exists():  # otherwise another writer took it for a leftover, before it was locked
                break
        self._part = Path(name)
        _unfinished.add(self._part)
        self._stack.callback(_forget, self._part)
        return open(name, "wb")  # closed when the file is complete


def read_regular(path: Path, kind: str, most: int, error: type[InputError] = InputError) -> bytes:
    """The content of a file of at most so many bytes; not of a device or a pipe, which may never end.

    Raises:
        InputError: or the given one: there is no such file, which should be of this kind, or it cannot be read.
    """
    try:
        if not path.is_file():
            what = f"'{path}' is no file" if path.exists() else f"there is no file '{path}'"
            raise error.of(what, fix=f"check the path of the {kind}")
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as failure:
        what = f"'{path}' cannot be read ({failure.strerror})"
        raise error.of(what, fix="pass the name of a readable file") from failure
    if len(content) > most:
        what, expected = f"'{path}' is too large for a {kind}", f"at most {most // 10**6} MB"
        raise error.of(what, expected=expected, fix=f"pass the {kind} itself")
    return content


def decoded(data: bytes) -> tuple[str, str]:
    """The text of a file, and its code page where that is not UTF-8."""
    try:
        return data.decode("utf-8-sig"), ""
    except UnicodeDecodeError:  # Chinese has pairs of high bytes, usual ones below 0xD8; Japanese begins with others
        words = [word for word in re.findall(rb"[\x80-\xff]+", data) if word.strip(QUOTES)]
        pairs = words and all(len(word) % 2 == 0 and min(word) > 0xA0 for word in words) and min(words)[0] < 0xD8
        japanese = 2 * sum(0x80 < word[0] < 0xA0 for word in words) > len(words)
        page = "gb18030" if pairs else "cp932" if japanese else "cp1252"
        return data.decode(page, "replace"), page


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file, see :class:`WholeFile`; InputError if that is not possible."""
    with WholeFile(path) as file:
        file.write(content)


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write several files, none of them unless there is room for all; InputError if that is not possible."""
    with ExitStack() as stack:
        files = [(stack.enter_context(WholeFile(path)), content) for path, content in contents.items()]
        for file, content in files:
            file.write(content)
            file.complete()


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise InputError unless a file can be written, which stays as it is."""
    path = as_path(path)
    with _one_sentence(path):
        if path.is_dir():
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        special = path.exists() and not path.is_file()
        if path.exists() and not os.access(path, os.W_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
    if not special:  # opening a pipe would wait for its reader
        with WholeFile(path) as file:
            file.abandon()


def remove_unfinished() -> None:
    """Remove this process's temporary files, for an exit that ends no ``with`` block."""
    for part in list(_unfinished):
        _forget(part)


@contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """Turn a failure to write into InputError."""
    try:
        yield
    except OSError as error:
        fix = FIXES.get(error.errno or 0, "name another file, in a folder that you may write to")
        raise InputError.of(f"file '{path}' cannot be written ({error.strerror or error})", fix=fix) from error


def _forget(part: Path) -> None:
    _unfinished.discard(part)
    with suppress(OSError):
        part.unlink(missing_ok=True)


def _stem(target: Path) -> str:
    return os.fsdecode(os.fsencode(target.name)[:LONGEST_STEM])


def _remove_leftovers(target: Path) -> None:
    """Remove temporary files of the same target that no living process has locked."""
    ours = re.compile(re.escape(f"{_stem(target)}.") + r"[a-z0-9_]{8}" + re.escape(SUFFIX))
    for name in os.listdir(target.parent):
        if ours.fullmatch(name):
            with suppress(OSError), (target.parent / name).open("rb+") as file:  # it may be another user's
                if lock_file(file, wait=False):
                    os.unlink(file.name)


def lock_file(file: IO[bytes], *, wait: bool) -> bool | None:
    """Lock an open file for this process; False if another one holds it, None where there are no locks."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            return True
    except BlockingIOError:
        return False
    except OSError:  # some file systems
        pass
    return None


def bring_to_disk(file: IO[bytes]) -> None:
    """Bring a flushed file to the disk, where its file system knows how."""
    try:
        os.fsync(file.fileno())
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):
            raise


def _take_permissions(part: Path, target: Path) -> None:
    """Take the permissions of the existing file, and its owner where that is possible; of a new file the usual ones."""
    if not target.exists():
        mask = os.umask(0o022)  # the mask can only be read by setting it
        os.umask(mask)
        part.chmod(0o666 & ~mask)  # mkstemp's files are readable by their owner only
        return
    status = target.stat()
    with suppress(OSError, AttributeError):  # not for other users' files, and not on Windows
        os.chown(part, status.st_uid, status.st_gid)
    part.chmod(status.st_mode & 0o777)


PROGRAM = ".py:"  # in FILE.py:NAME, a function in a file

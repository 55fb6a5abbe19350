"""Files that are either written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

STEM_LENGTH = 40  # characters; 160 bytes in UTF-8 at most, and file systems allow names of 255


_parts: set[Path] = set()  # that are being written


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[str]:
    """The name of a file to write, which takes the place of `path` when all has gone well.

    It lies in the same folder and has the same suffix. Whatever happens, even a power failure,
    `path` is afterwards either as it was or complete; links go on pointing at it. Raises OSError,
    whose text is a sentence with `path` in it, also for an OSError raised in the block.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        what = "a folder" if target.is_dir() else "not an ordinary file"
        raise OSError(f'cannot write "{path}": it is {what}.')
    # Part of the name is enough, since a longer one might be too long
    part = target.with_name(f".{target.stem[:STEM_LENGTH]}.{os.getpid()}{target.suffix}")
    _parts.add(part)
    try:
        part.touch()  # some writers cannot tell why they fail to open a file
        yield str(part)
        with open(part, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(part, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise OSError(f'cannot write "{path}": {error.strerror or error}.') from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        _parts.discard(part)


def abandon() -> None:
    """Remove what is being written, before the process is ended in the middle of it."""
    for part in tuple(_parts):
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make the new name as lasting as the file, where folders can be opened."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

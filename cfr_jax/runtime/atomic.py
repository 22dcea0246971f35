"""Files that appear whole or not at all."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def unfinished(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yields a temporary path in the same folder to write to.

    When the block ends without an error, the file is renamed to `path`, so no reader ever sees half
    a file. After an error it is deleted. An OSError names `path`, not the temporary file.
    """
    path = Path(path)
    # not the process number: processes on several machines may share a folder
    beside = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as error:
        # a full disk says no name at all, and the other errors say one that nobody knows
        if error.errno is None or error.filename not in (None, str(beside), beside):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # a folder that is gone has taken it along
            beside.unlink(missing_ok=True)


def write_atomically(path: str | os.PathLike[str], content: bytes) -> None:
    """Writes `content` to `path`, whole or not at all."""
    with unfinished(path) as beside:
        beside.write_bytes(content)

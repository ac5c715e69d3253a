"""The lock of a directory, so that one run at a time writes into it: a locked file that names its owner."""

from __future__ import annotations

import json
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, final

from sparserob_core.errors import InputError

if TYPE_CHECKING:
    from filelock import BaseFileLock

NAME = ".lock"
# Time in seconds in which a run that is just ending may release its lock. A tenth of it is less than two looks at the
# lock; ten times as much would be waited for at every directory that somebody else writes into.
RELEASE_SECONDS = 0.2


@final
class Lock:
    """The lock of a directory: a file that the operating system locks, with the process and the host of its owner.

    The lock ends with its owner, however that ends. The file is removed while it is still locked; `filelock` does not
    take a lock on a file that was removed.
    """

    def __init__(self, directory: Path) -> None:
        self.file = directory / NAME
        self._held: BaseFileLock | None = None

    def acquire(self) -> None:
        """Take the lock; raises `InputError` where somebody else holds it, and `OSError` where nothing can be
        written."""
        from filelock import FileLock, Timeout

        lock = FileLock(self.file, timeout=RELEASE_SECONDS, thread_local=False)
        try:
            lock.acquire()
        except Timeout:
            raise InputError(
                f"{self.file.parent}: another run is writing into it ({self._describe_owner()}); expected a new or an"
                " empty directory"
            ) from None
        self._held = lock
        try:
            self.file.write_text(json.dumps({"process": os.getpid(), "host": platform.node()}), encoding="utf-8")
        except OSError:
            self.release()
            raise

    def release(self) -> None:
        """Release the lock and remove its file; nothing happens where this object does not hold it."""
        if self._held is not None:
            with suppress(OSError):
                self.file.unlink()
            self._held.release()
            self._held = None

    def _describe_owner(self) -> str:
        try:
            owner = json.loads(self.file.read_text(encoding="utf-8"))
            return f"process {owner['process']} on {owner['host']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "whose number is not written yet"


def is_free(directory: Path) -> bool:
    """Return whether nobody holds the lock of a directory."""
    lock = Lock(directory)
    try:
        lock.acquire()
    except (InputError, OSError):
        return False
    lock.release()
    return True


def is_dead(process: int, host: str) -> bool:
    """Return whether a process is known to have ended; nothing is known of a process on another host."""
    if process <= 0 or host != platform.node():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False

"""The lock of a directory, so that one run at a time writes into it: a file that names its owner."""

from __future__ import annotations

import json
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import final

from sparserob_core.errors import InputError

NAME = ".lock"
GUARD = ".lock.takeover"
LOCK_ATTEMPTS = 3  # attempts to take a lock that others take and release at the same moment


@final
class Lock:
    """The lock of a directory: a file with the process number and the host of its owner.

    The file is created exclusively, so that only one of two processes gets the lock. A lock whose owner was killed on
    this host is taken over.
    """

    def __init__(self, directory: Path) -> None:
        self.file = directory / NAME

    def acquire(self) -> None:
        """Take the lock; raises `InputError` where somebody else holds it, and `OSError` where nothing can be
        written."""
        for _ in range(LOCK_ATTEMPTS):
            try:
                self.file.touch(exist_ok=False)
            except FileExistsError:
                if self._take_over():
                    return
            else:
                self._write_owner()
                return
        raise self._make_error("")

    def _write_owner(self) -> None:
        """Write the owner into a lock that was just created.

        Where the disk is full, the lock is removed: a lock without an owner would exclude everybody.
        """
        try:
            self.file.write_text(_describe_process(), encoding="utf-8")
        except OSError:
            self.file.unlink(missing_ok=True)
            raise

    def release(self) -> None:
        """Release the lock; nothing happens where it belongs to somebody else, or does not exist."""
        with suppress(OSError):
            if self._read_content() == _describe_process():
                self.file.unlink()

    def _take_over(self) -> bool:
        """Return whether this process took over the lock of a process that is dead.

        The result is false, and the lock may be free, where it has just vanished. Only the process that creates the
        guard exclusively may replace the lock, and only after a second look at it. Two processes that find the same
        dead owner therefore cannot both take the lock.
        """
        content = self._read_content()
        if content is None:
            return False
        guard = self.file.with_name(GUARD)
        if not _is_dead(content):
            raise self._make_error(content)
        try:
            guard.touch(exist_ok=False)
        except FileExistsError:
            raise self._make_error(content) from None
        try:
            if self._read_content() != content:
                return False
            temporary = self.file.with_name(f"{NAME}.{os.getpid()}.tmp")
            temporary.write_text(_describe_process(), encoding="utf-8")
            temporary.replace(self.file)
            return True
        finally:
            guard.unlink()

    def _read_content(self) -> str | None:
        try:
            return self.file.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None

    def _make_error(self, found: str) -> InputError:
        process, host = _parse_owner(found)
        who = f"process {process} on {host}" if process else "whose number is not written yet"
        return InputError(
            f"{self.file.parent}: another run is writing into it ({who}); expected a new or an empty directory "
            f"(delete {self.file} if that run is dead)"
        )


def owner_of(directory: Path) -> tuple[int, str]:
    """Return the process that holds the lock of a directory and its host; 0 and an empty text where nobody does."""
    try:
        return _parse_owner((directory / NAME).read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return 0, ""


def _describe_process() -> str:
    return json.dumps({"process": os.getpid(), "host": platform.node()})


def _parse_owner(content: str) -> tuple[int, str]:
    """Return the number of the process, 0 where it is not known, and the host."""
    try:
        data = json.loads(content)
        return int(data["process"]), str(data["host"])
    except (ValueError, KeyError, TypeError):
        return 0, ""


def _is_dead(content: str) -> bool:
    return is_dead(*_parse_owner(content))


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

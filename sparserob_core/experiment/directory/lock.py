"""One run at a time in a directory: a lock file that names its owner."""

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
TRIES = 3  # to get a lock that others hold and let go of at the same moment


@final
class Lock:
    """The lock of a directory. It is created exclusively, so that of two processes one gets it, and holds the number
    and the host of its owner; one whose owner was killed on this host is taken over."""

    def __init__(self, directory: Path) -> None:
        self.file = directory / NAME

    def acquire(self) -> None:
        """Raises `InputError` when somebody else holds it, and `OSError` when nothing can be written there."""
        for _ in range(TRIES):
            try:
                self.file.touch(exist_ok=False)
            except FileExistsError:
                if self._taken_over():
                    return
            else:
                self._sign()
                return
        raise self._held("")

    def _sign(self) -> None:
        """Write the owner into a lock that was just created; where the disk is full it goes again: one without an
        owner would keep everybody out."""
        try:
            self.file.write_text(_me(), encoding="utf-8")
        except OSError:
            self.file.unlink(missing_ok=True)
            raise

    def release(self) -> None:
        """Let go of it; nothing happens where it is somebody else's, or gone."""
        with suppress(OSError):
            if self._content() == _me():
                self.file.unlink()

    def _taken_over(self) -> bool:
        """Whether the lock of a process that is dead is ours now; not, but it may be free, when it has just vanished.

        Only who creates the guard exclusively may replace the lock, and only after having looked again: two that find
        the same dead owner cannot both get it.
        """
        found = self._content()
        if found is None:
            return False
        guard = self.file.with_name(GUARD)
        if not _is_dead(found):
            raise self._held(found)
        try:
            guard.touch(exist_ok=False)
        except FileExistsError:
            raise self._held(found) from None
        try:
            if self._content() != found:
                return False
            temporary = self.file.with_name(f"{NAME}.{os.getpid()}.tmp")
            temporary.write_text(_me(), encoding="utf-8")
            temporary.replace(self.file)
            return True
        finally:
            guard.unlink()

    def _content(self) -> str | None:
        try:
            return self.file.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None

    def _held(self, found: str) -> InputError:
        process, host = _owner(found)
        who = f"process {process} on {host}" if process else "whose number is not written yet"
        return InputError(
            f"{self.file.parent}: another run is writing into it ({who}); expected a new or an empty directory "
            f"(delete {self.file} if that run is dead)"
        )


def owner_of(directory: Path) -> tuple[int, str]:
    """The number of the process that holds the lock of a directory, and its host; 0 and no host where nobody does."""
    try:
        return _owner((directory / NAME).read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return 0, ""


def _me() -> str:
    return json.dumps({"process": os.getpid(), "host": platform.node()})


def _owner(content: str) -> tuple[int, str]:
    """The number of the process, 0 where it is not known, and the host."""
    try:
        data = json.loads(content)
        return int(data["process"]), str(data["host"])
    except (ValueError, KeyError, TypeError):
        return 0, ""


def _is_dead(content: str) -> bool:
    return is_dead(*_owner(content))


def is_dead(process: int, host: str) -> bool:
    """Whether the process is known to be gone; of another host nothing is known."""
    if process <= 0 or host != platform.node():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False

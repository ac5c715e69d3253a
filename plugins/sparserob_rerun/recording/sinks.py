"""Destinations of a recording: a file, a viewer that listens, a viewer that is started, a browser; and what to do where
one is missing."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias, final

import sparserob_core as sr

logger = logging.getLogger("sparserob")

PORT, WEB_PORT = 9876, 9090
STARTING = 15.0  # seconds that a viewer may take until it listens
JOINING = 20.0
"""Seconds that the chunks of a finished recording may be joined for. Ten times as many, and a run waits for a large
file; with a tenth a busy machine leaves it four times as large."""
MEMORY = "25%"  # of the machine's, for a viewer that is started


@final
@dataclass(frozen=True)
class Destinations:
    """Wishes that can be fulfilled on this machine: ``save`` a file, ``connect`` a host and port where a viewer
    listens, ``spawn`` a viewer, ``serve`` to a browser through this port, from a page at the port ``web``; ``missing``
    says in words what could not be had."""

    save: Path | None
    connect: tuple[str, int] | None
    spawn: bool
    serve: int | None
    missing: tuple[str, ...] = ()
    web: int = WEB_PORT

    @property
    def any(self) -> bool:
        """True where there is anywhere to record to."""
        return self.save is not None or self.connect is not None or self.spawn or self.serve is not None

    @property
    def page(self) -> str:
        """Page that a browser is to open."""
        source = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{self.serve}%2Fproxy"
        return f"http://127.0.0.1:{self.web}/?url={source}&hide_welcome_screen=1&theme=dark"


def look(save: Path | None, connect: str | None, spawn: bool, serve: bool) -> Destinations:
    """Find out which of the wishes can be fulfilled; every other is a sentence in ``missing``."""
    missing = []
    if find_spec("rerun") is None or find_spec("rerun_bindings") is None:
        return Destinations(None, None, False, None, (sr.not_installed("rerun-sdk"),))
    if save is not None and (reason := _unwritable(save)):
        missing.append(f"{save}: cannot be written to: {reason}")
        save = None
    address = None if connect is None else address_of(connect)
    if address is not None and not listens(address, 2.0):
        missing.append(f"no viewer answers at {address[0]}:{address[1]}")
        address = None
    if (spawn or serve) and not viewer().is_file():
        missing.append("the viewer of rerun-sdk is not there")
        spawn = serve = False
    if (
        spawn
        and sys.platform.startswith("linux")
        and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    ):
        missing.append(
            "there is no display for a viewer; `save: recording.rrd` records, `serve: true` shows it in a browser"
        )
        spawn = False
    web = _free_port() if serve and listens(("127.0.0.1", WEB_PORT), 0.2) else WEB_PORT
    return Destinations(save, address, spawn, _free_port() if serve else None, tuple(missing), web)


def address_of(text: str) -> tuple[str, int]:
    """Return host and port of ``host``, ``host:port`` or a Rerun address ``rerun+http://host:port/proxy``; raises
    `ValueError`."""
    plain = text.split("://", 1)[-1].split("/", 1)[0]
    host, colon, port = plain.rpartition(":")
    if not colon:
        host, port = plain, str(PORT)
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"expected an address such as 127.0.0.1:{PORT}, got {text!r}")
    return host, int(port)


def listens(address: tuple[str, int], seconds: float) -> bool:
    """Return whether somebody accepts connections at an address."""
    try:
        with socket.create_connection(address, timeout=seconds):
            return True
    except OSError:
        return False


def viewer() -> Path:
    """Return the path of the viewer itself: the ``rerun`` script is a wrapper that would leave it behind."""
    spec = find_spec("rerun_cli")
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(spec.origin).parent / name if spec is not None and spec.origin else Path(name)


Started: TypeAlias = dict[int, "subprocess.Popen[bytes] | None"]


def start(chosen: Destinations) -> Started:
    """Start the viewers and servers that are wished for, by their ports; ``None`` for one that runs already. They are
    ready a moment later, while other things are prepared."""
    started: Started = {}
    if chosen.spawn:
        started[PORT] = None if listens(("127.0.0.1", PORT), 0.2) else _started(PORT, [])
    if chosen.serve is not None:
        started[chosen.serve] = _started(chosen.serve, ["--serve-web", "--web-viewer-port", str(chosen.web)])
    return started


def servers(chosen: Destinations, started: Started) -> list[subprocess.Popen[bytes]]:
    """Return the processes that end with the recording: a viewer stays."""
    return [process for port, process in started.items() if process is not None and port == chosen.serve]


def sinks_of(rr: Any, chosen: Destinations, started: Started) -> tuple[list[Any], list[str]]:
    """Return where a stream is to be sent, and what went wrong."""
    sinks: list[Any] = [] if chosen.save is None else [rr.FileSink(str(chosen.save))]
    addresses, wrong = [] if chosen.connect is None else [chosen.connect], []
    for port, process in started.items():
        if _waited(("127.0.0.1", port), process):
            addresses.append(("127.0.0.1", port))
        else:
            wrong.append("the viewer did not start")
    sinks += [rr.GrpcSink(f"rerun+http://{host}:{port}/proxy") for host, port in addresses]
    return sinks, wrong


def compact(file: Path, arrangement: Any) -> None:
    """Join what is in a finished recording to chunks as large as the format wants, with its last ``arrangement`` (a
    blueprint) only: live, each is as small as what has happened in a moment. A process of its own joins them, for the
    library logs to the terminal while it does. Where that cannot be done, the recording stays as it is."""
    from rerun.chunk import RrdReader

    if not file.is_file():
        return
    temporaries = [file.with_name(f".{file.name}.{suffix}") for suffix in ("joined", "chunks", "arrangement")]
    joined, chunks, screen = temporaries
    try:
        reader = RrdReader(str(file))
        (store,) = reader.recordings()
        name = store.application_id
        reader.stream(store=store).write_rrd(chunks, application_id=name, recording_id=store.recording_id)
        arrangement.save(name, screen)
        command = [str(viewer()), "rrd", "optimize", "--profile", "live", str(chunks), str(screen), "-o", str(joined)]
        subprocess.run(command, check=True, timeout=JOINING, capture_output=True, stdin=subprocess.DEVNULL)
        joined.replace(file)
    except Exception:  # a large recording is better than none
        logger.debug("the chunks of %s could not be joined", file, exc_info=True)
    for temporary in temporaries:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _unwritable(file: Path) -> str:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("ab"):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _started(port: int, extra: list[str]) -> subprocess.Popen[bytes]:
    """Start a viewer that outlives the run, and takes connections from this machine only."""
    command = [
        str(viewer()),
        "--bind",
        "127.0.0.1",
        "--port",
        str(port),
        "--memory-limit",
        MEMORY,
        "--hide-welcome-screen",
        *extra,
    ]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def _waited(address: tuple[str, int], process: subprocess.Popen[bytes] | None) -> bool:
    end = time.monotonic() + STARTING
    while time.monotonic() < end and (process is None or process.poll() is None):
        if listens(address, 0.5):
            return True
        time.sleep(0.1)
    return False


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])

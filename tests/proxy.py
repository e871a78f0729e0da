"""A cable that can be pulled: a proxy at a TCP port that closes its connections, or goes silent without it, or flaps."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import final

_PIECE = 1 << 16
_RESET = struct.pack("ii", 1, 0)


@final
class Cable:
    """Passes on what comes to its own port.

    whole: set while it passes everything on; closed connections stay closed, and none is accepted meanwhile.
    """

    def __init__(self, to: int | str) -> None:
        """to: a port of this machine, or the path of a Unix socket."""
        self._to = to
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._flows = threading.Event()
        self._flows.set()
        self._accepts = True
        self._ends: list[socket.socket] = []
        self._swallows = False
        self._swallowed: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def endpoint(self) -> str:
        """Where it listens, as Zenoh writes it."""
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def port(self) -> int:
        """The port where it listens."""
        return int(self._listener.getsockname()[1])

    @property
    def leads_somewhere(self) -> bool:
        """Whether a program listens where it leads."""
        try:
            self._dial().close()
        except OSError:
            return False
        return True

    @property
    def connections(self) -> int:
        """How many there are."""
        return len(self._ends) // 2

    def cut(self) -> None:
        """Close all connections, and take no new one. What was held back is lost."""
        self._accepts = False
        self._close()
        self._flows.set()

    def flap(self) -> None:
        """Reset all connections, those that are just being opened too, and take new ones at once."""
        for end in self._ends:
            # Both ends are told by a reset, and what is on the way is lost, as when a system drops its connections.
            with suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        for end in self._close():
            end.close()

    def swallow(self) -> None:
        """Reset all connections; the next one is taken, and never answered. Those after it are passed on."""
        self._swallows = True
        self.flap()

    @property
    def swallowed(self) -> int:
        """How many connections were taken and not answered."""
        return len(self._swallowed)

    def silence(self) -> None:
        """Stop passing anything on, without telling either end."""
        self._flows.clear()

    def heal(self) -> None:
        """Pass everything on again."""
        self._accepts = True
        self._flows.set()

    def close(self) -> None:
        """For good."""
        self._accepts = False
        self._flows.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._close()
        for end in self._swallowed:
            end.close()

    def _close(self) -> list[socket.socket]:
        ends, self._ends = self._ends, []
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        return ends

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if self._swallows:
                    self._swallows = False
                    self._swallowed.append(near)
                    continue
                self._flows.wait()
                try:
                    if not self._accepts:
                        raise ConnectionRefusedError
                    far = self._dial()
                except OSError:
                    near.close()
                    continue
                self._ends += [near, far]
                for here, there in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(here, there), daemon=True).start()

    def _dial(self) -> socket.socket:
        if isinstance(self._to, int):
            return socket.create_connection(("127.0.0.1", self._to))
        far = socket.socket(socket.AF_UNIX)
        try:
            far.connect(self._to)
        except OSError:
            far.close()
            raise
        return far

    def _carry(self, here: socket.socket, there: socket.socket) -> None:
        with suppress(OSError):
            while piece := here.recv(_PIECE):
                self._flows.wait()
                there.sendall(piece)
        for end in (here, there):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        here.close()


@contextmanager
def cable(port: int) -> Iterator[Cable]:
    """A cable to a port of this machine."""
    cable = Cable(port)
    try:
        yield cable
    finally:
        cable.close()

"""Opening a Zenoh session: with the router of a run, as such a router, which listens where the brief says, or otherwise.

A process waits for a router that is not there yet, but reports lasting errors at once. Zenoh alone cannot tell these apart: for
any error it only reports, after its time limit, that it could not connect. Zenoh panics if it cannot start a thread or read
`ZENOH_RUNTIME`: no handler of errors but that of `BaseException` sees this. So every command and process opens its sessions
here, and each says in a sentence why Zenoh cannot begin.
"""

from __future__ import annotations

import json
import socket
import ssl
import sys
from collections.abc import Callable
from typing import final

import zenoh

from evedrop.errors import BriefError, NoRouter, RunError
from evedrop.live.network.control_file import Control
from evedrop.live.network.endpoint import AnyEndpoint, Endpoint, SocketEndpoint, endpoint_in
from evedrop.live.protocol.brief import AnyBrief, Identity
from evedrop.live.protocol.keys import ZenohConfig
from evedrop.system.environment import check_zenoh_runtime
from evedrop.system.lacks import lack_of
from evedrop.system.world import world


def open_session(config: ZenohConfig) -> zenoh.Session:
    """Open a session with this configuration.

    Raises zenoh.ZError, UsageError if `ZENOH_RUNTIME` is malformed, and RunError if the machine lacks threads or memory.
    """
    check_zenoh_runtime()
    try:
        session: zenoh.Session = world().zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        raise
    except BaseException as error:
        if (lack := lack_of(error)) is None:
            raise
        raise RunError(lack) from error
    return session


LOGGED = "error,zenoh_codec::common::extension=off"
"""What Zenoh logs by default; it would log an error for every stranger's frame that it cannot read."""
_WAITING_SECONDS = 3.0  # how often a process says that it still waits for its router
_AGAIN_SECONDS = 0.02, 0.25  # between attempts, the first and the longest
_ATTEMPT_SECONDS = 3.0
_UNKNOWN_HOST_SECONDS = 2.5  # the name of a host that is just starting may not be known yet
_REFUSALS, _REFUSED_SECONDS = 4, 1.5  # a router that is just starting may hang up once
_QUICK_SECONDS = 2.0  # a refusal comes at once; a slower failure means that the machine is busy
_IDLE_SECONDS = 1.0  # a router keeps a connection at least so long on which nothing is said
_AT_ONCE_SECONDS = 0.1

_NOT_YET_VALID, _EXPIRED, _WRONG_PURPOSE, _WRONG_NAME, _WRONG_ADDRESS = 9, 10, 26, 62, 64  # of OpenSSL's X509_V_ERR


Credentials = AnyBrief | Control
"""The router's address, and a user with a password."""


@final
class WaitReporter:
    """Reports every few seconds on standard error that a process waits for its router."""

    def __init__(self, process: str, router: str) -> None:
        self._process, self._router = process, router
        self.begin()

    def begin(self, again: bool = False) -> None:
        """Start the clock. again: because a connection was lost."""
        self._began = self._told_at = world().monotonic()
        self._what = "lost the connection; waiting again" if again else "waiting"

    def poll(self, why: object) -> None:
        """Report that the process still waits, if a report is due; why: the result of the last attempt."""
        now = world().monotonic()
        if now - self._told_at >= _WAITING_SECONDS:
            self._told_at = now
            sys.stderr.write(
                f"evedrop: {self._process}: {self._what} for the router at {self._router}: no answer yet "
                f"({now - self._began:.0f} s; {why})\n"
            )
            sys.stderr.flush()

    def attempt(self, connect: Callable[[], zenoh.Session]) -> zenoh.Session:
        """Return the session that `connect` opens; if `connect` raises, report that the process still waits, and re-raise."""
        try:
            return connect()
        except (OSError, zenoh.ZError) as error:
            self.poll(_reason(error) if isinstance(error, OSError) else "Zenoh could not connect")
            raise


def _reason(error: OSError | zenoh.ZError) -> object:
    return (error.strerror or error) if isinstance(error, OSError) else "it did not answer as one"


def connected(
    entry: Credentials, config: ZenohConfig, patience: float, meanwhile: Callable[[], None] = lambda: None
) -> zenoh.Session:
    """Open a session with the router; config: for one attempt; `meanwhile` is called before each attempt.

    Raises BriefError for an error that waiting cannot mend, RunError if no router has answered after `patience` seconds.
    """
    endpoint = endpoint_of(entry.router, entry.identity)
    began = world().monotonic()
    failures, wait = Failures(endpoint.secure), WaitReporter(entry.user, entry.router)
    pause, longest = _AGAIN_SECONDS
    while True:
        meanwhile()
        tried = world().monotonic()
        try:
            _knock(endpoint, entry)
            return open_session(config)
        except (OSError, zenoh.ZError) as error:
            failures.add_attempt(error, world().monotonic() - tried)
            why = _reason(error)
            if failures.unknown_seconds > _UNKNOWN_HOST_SECONDS and isinstance(endpoint, Endpoint):
                raise BriefError(
                    f"the router's host {endpoint.host} is not known here ({why}); write it into /etc/hosts, or write the "
                    "briefs again with --connect and a name or address that this host knows"
                ) from error
            if failures.refused and cut_off(endpoint):
                failures = Failures(endpoint.secure)
            if failures.refused:
                raise BriefError(
                    f"{entry.router} does not let this brief in, which is of run {entry.run}: the router there is of another "
                    "run, or another program listens there; start the router of this run, or give the brief of that one"
                ) from error
            if world().monotonic() - began > patience:
                raise NoRouter(
                    f"no router answered at {entry.router} within {patience:.0f} s ({why}); start it there, and check that no "
                    "firewall is in between"
                ) from error
            wait.poll(why)
        world().sleep(pause)
        pause = min(longest, pause * 1.5)


@final
class Failures:
    """The results of the attempts so far."""

    def __init__(self, secure: bool = False) -> None:
        """secure: whether a router shows its certificate before it can refuse anybody."""
        self._secure = secure
        self._unknown: float | None = None
        self._refused: float | None = None
        self._refusals = 0

    def add_attempt(self, error: Exception, seconds: float) -> None:
        """Add an attempt that failed after `seconds`."""
        now = world().monotonic()
        unknown = isinstance(error, socket.gaierror)
        self._unknown = (self._unknown or now) if unknown else None
        # A listener that hangs up refuses us; one that is slow, or not there, may still answer. Under TLS a connection that ends
        # before there is a certificate was ended by something in between, such as a proxy whose router is down.
        # Such an end during the handshake is one error of TLS in some versions of Python, and another in others.
        ends = ssl.SSLEOFError | ssl.SSLZeroReturnError | ConnectionResetError | BrokenPipeError
        cut = isinstance(error, ends)
        hung_up = isinstance(error, zenoh.ZError | ssl.SSLError) if not cut else not self._secure
        if hung_up and seconds < _QUICK_SECONDS:
            self._refused, self._refusals = self._refused or now, self._refusals + 1
        elif not hung_up:
            self._refused, self._refusals = None, 0

    @property
    def unknown_seconds(self) -> float:
        """For how long the host's name has been unknown."""
        return 0.0 if self._unknown is None else world().monotonic() - self._unknown

    @property
    def refused(self) -> bool:
        """Whether it is certain that the router refuses this process."""
        return (
            self._refused is not None
            and self._refusals >= _REFUSALS
            and world().monotonic() - self._refused > _REFUSED_SECONDS
        )


def cut_off(endpoint: AnyEndpoint) -> bool:
    """Whether it is the network that ends connections, not the program there: it ends those on which nothing is said, too.

    A program that hangs up on everybody does it at once.
    """
    longest = 0.0
    for _ in range(3):
        began = world().monotonic()
        try:
            link = endpoint.dial(_ATTEMPT_SECONDS)
        except OSError:
            return True
        with link:
            link.settimeout(_IDLE_SECONDS)
            try:
                if link.recv(1):
                    return False
            except TimeoutError:
                return False
            except OSError:
                pass
        longest = max(longest, world().monotonic() - began)
    return longest > _AT_ONCE_SECONDS


def endpoint_of(router: str, identity: Identity | None) -> AnyEndpoint:
    """The router's endpoint in a brief. Raises BriefError if it is malformed, or does not fit the brief's identity."""
    try:
        endpoint = endpoint_in(router)
    except ValueError as error:
        raise BriefError(f"router: {error}; write the briefs again with `evedrop brief`") from error
    if endpoint.secure != (identity is not None):
        lack = "and there is no identity" if endpoint.secure else "which takes no identity"
        raise BriefError(f"router: is {router}, {lack}; write the briefs again with `evedrop brief`")
    return endpoint


def _knock(endpoint: AnyEndpoint, entry: Credentials) -> None:
    """Check that a program listens there and, by its certificate, is the router of this run.

    Raises OSError if none does, BriefError if the certificate cannot be trusted.
    """
    if entry.identity is None or not isinstance(endpoint, Endpoint):
        endpoint.dial(_ATTEMPT_SECONDS).close()
        return
    try:
        with endpoint.dial(_ATTEMPT_SECONDS) as link:
            trust = ssl.create_default_context(cadata=entry.identity.authority)
            # The router shows its certificate first; nothing more is needed here.
            world().certificate(link, trust, endpoint.host)
    except ssl.SSLCertVerificationError as error:
        raise _mistrusted(endpoint, entry, error) from error


def _mistrusted(endpoint: Endpoint, entry: Credentials, error: ssl.SSLCertVerificationError) -> BriefError:
    """The error that says why an endpoint's certificate cannot be trusted."""
    if error.verify_code in {_NOT_YET_VALID, _EXPIRED}:
        return BriefError(
            f"{entry.router}: the router's certificate is not valid now by this host's clock ({error.verify_message}); set the "
            "clock, or write the briefs again with `evedrop brief`, all of them"
        )
    maker = _maker_at(endpoint)
    if error.verify_code in {_WRONG_NAME, _WRONG_ADDRESS}:
        return BriefError(
            f"{entry.router}: the router's certificate does not name {endpoint.host}; write the briefs again with "
            f"--connect tls/{endpoint.host}:{endpoint.port}, all of them"
        )
    whose = f"has a certificate of {maker}, and this brief is of run {entry.run}"
    if error.verify_code == _WRONG_PURPOSE:
        whose = f"has the certificate of another process of {maker}, and is not a router"
    return BriefError(
        f"{entry.router}: the program listening there {whose}; start the router of this run there, or give the brief "
        "of that one"
    )


def _maker_at(endpoint: Endpoint) -> str:
    """Name of the authority that an endpoint's certificate gives as its issuer."""
    from evedrop.live.network.certificates import maker_of  # noqa: PLC0415 - 50 ms that only a failure needs

    anybody = ssl.create_default_context()
    anybody.check_hostname, anybody.verify_mode = False, ssl.CERT_NONE
    try:
        with endpoint.dial(_ATTEMPT_SECONDS) as link:
            return maker_of(world().certificate(link, anybody, endpoint.host))
    except (OSError, ValueError):
        return "an unknown authority"


def listening(identity: Identity | None, config: ZenohConfig) -> zenoh.Session:
    """Open a router's session. Raises BriefError if it cannot listen at the endpoint in its configuration."""
    endpoint = endpoint_of(config["listen"]["endpoints"][0], identity)
    try:
        endpoint.try_to_listen()
        return open_session(config)
    except (OSError, zenoh.ZError) as error:
        raise _cannot_listen(endpoint, error) from error


def _cannot_listen(endpoint: AnyEndpoint, error: OSError | zenoh.ZError) -> BriefError:
    """The error of a router that cannot listen, with the remedy."""
    why = (error.strerror or error) if isinstance(error, OSError) else error
    if isinstance(endpoint, SocketEndpoint):
        return BriefError(
            f"the router cannot listen at {endpoint} ({why}); set TMPDIR to a folder where sockets can be made, or run again "
            "with --listen tls/127.0.0.1:PORT"
        )
    if isinstance(error, socket.gaierror):
        return BriefError(
            f"the host of {endpoint} is not known here ({why}); write it into /etc/hosts, or write the "
            f"briefs again with --listen {endpoint.protocol}/0.0.0.0:{endpoint.port} and --connect"
        )
    if isinstance(error, zenoh.ZError):
        return BriefError(
            f"the router cannot listen at {endpoint} ({why}); write the briefs again with another --listen"
        )
    return BriefError(
        f"the router cannot listen at {endpoint} ({why}); end the program that does, or write the briefs "
        f"again with another --listen {endpoint.protocol}/HOST:PORT, of the host that the router is started on"
    )

"""Metrics of a live run for Prometheus, by HTTP.

They are made from the events of the recorder and, at each scrape, from the metrics that the run has on disk; the run itself does
nothing for them. prometheus_client is imported only here: a run without metrics needs neither it nor a web server.

Source: docs/export.md, metrics of a live run.
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from msgspec import structs

from evedrop.errors import UsageError
from evedrop.model.metrics import estimated_metrics
from evedrop.results.folder import HeldFolder
from evedrop.results.reading import Results
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    Held,
    OnEvent,
    ProgressEvent,
    RunProgress,
    Started,
)
from evedrop.scenario.tables import Scenario
from evedrop.show.view.bounded_http import BoundedServer, QuietHandler
from evedrop.system.world import world

_REQUEST_SECONDS = 2.0
_FORM = re.compile(r"(?:\[([0-9a-fA-F:.%]+)\]|([^\[\]:]+)):([0-9]{1,5})")


@dataclass(frozen=True)
class MetricsAddress:
    """Where the metrics of a run are served."""

    host: str
    port: int
    """0: any free port."""

    @classmethod
    def of(cls, text: str) -> MetricsAddress:
        """Parse HOST:PORT, with brackets around an IPv6 address. Raises UsageError if the text is malformed."""
        match = _FORM.fullmatch(text)
        host = "" if match is None else match[1] or match[2]
        host = "127.0.0.1" if host == "localhost" else host
        try:
            address = ipaddress.ip_address(host)
            port = int("" if match is None else match[3])
        except ValueError:
            port = 2**16
        if port >= 2**16 or (match is not None and bool(match[1]) != (address.version == 6)):
            raise UsageError(
                f"--metrics {text} is not an address and a port; give one such as 127.0.0.1:9464 or [::1]:9464"
            )
        return cls(str(address), port)

    @property
    def warning(self) -> str | None:
        """A warning if other machines can reach it."""
        address = ipaddress.ip_address(self.host)
        if address.is_loopback:
            return None
        return f"anybody who can reach {self._at(self.port)} can read the metrics, which reveal every receiver's error"

    def page(self, port: int) -> str:
        """The address of the page, once it is served on this port."""
        return f"http://{self._at(port)}/metrics"

    def _at(self, port: int) -> str:
        return f"[{self.host}]:{port}" if ":" in self.host else f"{self.host}:{port}"


@final
class RunMetrics:
    """The metrics of a run: a collector of prometheus_client."""

    def __init__(self, scenario: Scenario, folder: Path, on_event: OnEvent) -> None:
        """folder: of the results; on_event: gets all events after this object."""
        self._scenario, self._folder, self._on_event = scenario, folder, on_event
        self._held_folder: HeldFolder | None = None
        """The folder once it is there; it may be renamed while the run goes on."""
        self._lock = world().lock()
        self._progress = RunProgress(0, 0.0, "slots/s", {})
        self._running = self._held = False
        self._losses: Counter[str] = Counter()

    def on_event(self, event: ProgressEvent) -> None:
        """Note an event, and pass it on."""
        with self._lock:
            match event:
                case Started():
                    self._running = True
                    with contextlib.suppress(OSError):
                        self._held_folder = self._held_folder or HeldFolder(self._folder)
                case Held():
                    self._held = True
                    self._progress = structs.replace(self._progress, done=event.before, rate=0.0)
                case RunProgress():
                    self._progress, self._held = event, False
                case ConnectionOutage():
                    self._losses[event.process] += 1
        self._on_event(event)

    def close(self) -> None:
        """Let the folder go."""
        with self._lock:
            if self._held_folder is not None:
                self._held_folder.close()
            self._held_folder = None

    def _place(self) -> Path:
        """Where the folder is now."""
        with contextlib.suppress(OSError):
            if self._held_folder is not None:
                return self._held_folder.now
        return self._folder

    def describe(self) -> list[Any]:
        """Nothing: the metrics are made at each scrape."""
        return []

    def collect(self) -> Iterator[Any]:
        """The metrics at this moment."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily  # noqa: PLC0415 - an optional extra

        with self._lock:
            progress, losses, folder = self._progress, Counter(self._losses), self._place()
            running, held = self._running, self._held
        yield GaugeMetricFamily("evedrop_running", "Whether all processes have appeared.", float(running))
        yield GaugeMetricFamily("evedrop_held", "Whether the operator holds the run.", float(held))
        yield GaugeMetricFamily("evedrop_slots_planned", "The scenario's number of slots.", self._scenario.slots)
        summary = _summary(folder)
        done = max(progress.done, int(summary.get("slots", 0)))  # the last slots are in no events
        yield CounterMetricFamily("evedrop_slots", "Slots that are complete.", done)
        yield GaugeMetricFamily("evedrop_slots_per_second", "The rate of slots at present.", progress.rate)
        errors = GaugeMetricFamily(
            "evedrop_recent_squared_error", "Mean over trials and the latest slots.", labels=["receiver"]
        )
        yield _by_name(errors, progress.squared_errors)
        lost = CounterMetricFamily("evedrop_lost_connections", "Connections lost, by process.", labels=["process"])
        yield _by_name(lost, losses)
        yield from self._metrics(summary, CounterMetricFamily, GaugeMetricFamily)

    def _metrics(self, summary: Mapping[str, Any], counter: Any, gauge: Any) -> Iterator[Any]:
        """Those that are made from the metrics on disk."""
        packets = counter("evedrop_packets", "Packets by receiver and fate.", labels=["receiver", "fate"])
        for name, link in summary.get("links", {}).items():
            packets.add_metric([name, "delivered"], link["delivered"])
            for reason, count in link["lost_by"].items():
                # While the run goes on, packets that are under way may still be delivered: a counter must not fall.
                if reason != "underway" or summary["slots"] == self._scenario.slots:
                    packets.add_metric([name, reason], count)
        yield packets
        for metric, kind in estimated_metrics().items():
            if kind.only_in_mode is not None:
                continue
            family = gauge(f"evedrop_{metric}", f"{metric} so far, as in the summary.", labels=["receiver"])
            values = {name: metrics.get(metric) for name, metrics in summary.get("peers", {}).items()}
            yield _by_name(family, {name: value for name, value in values.items() if isinstance(value, (int, float))})
        for name in self._scenario.applications:
            metrics = summary.get(name) or {}
            for metric in APPLICATIONS[name].served_metrics:
                if isinstance(value := metrics.get(metric), (int, float)):
                    yield gauge(f"evedrop_{metric}", f"{metric} of {name} so far.", value)


def _by_name(family: Any, values: Mapping[str, float]) -> Any:
    """A family of metrics with one label, a name, with a value for each name."""
    for name, value in values.items():
        family.add_metric([name], value)
    return family


def _summary(folder: Path) -> Mapping[str, Any]:
    """The metrics that a run has on disk; empty if there are none yet."""
    try:
        return Results.read(folder).summary
    except UsageError:
        return {}


@contextlib.contextmanager
def metrics_served(address: MetricsAddress, metrics: RunMetrics, patience: float = _REQUEST_SECONDS) -> Iterator[str]:
    """Serve metrics while the block runs; gives the address of their page.

    patience: for a request, in seconds; a program that connects and does not send one then loses its connection.

    Raises UsageError if the extra is not installed, or nothing can listen there.
    """
    try:
        from prometheus_client import CollectorRegistry, MetricsHandler  # noqa: PLC0415 - an optional extra
    except ImportError as error:
        raise UsageError("--metrics needs pip install '.[metrics]' in the checkout first") from error
    registry = CollectorRegistry()
    registry.register(metrics)
    handler = type("ScrapeHandler", (_Scrape, MetricsHandler.factory(registry)), {"timeout": patience})
    try:
        server = _Server(address, handler)
    except OSError as error:
        raise UsageError(
            f"--metrics: {address.page(address.port)} cannot be served ({error.strerror}); give another address or port"
        ) from error
    server.start()
    try:
        yield address.page(server.server_port)
    finally:
        server.stop()


@final
class _Server(BoundedServer):
    request_queue_size = 64

    def __init__(self, address: MetricsAddress, handler: type[QuietHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        super().__init__((address.host, address.port), handler)


class _Scrape(QuietHandler):
    """A scrape: one request for each connection, because the answers of prometheus_client do not say how long they are."""

    protocol_version = "HTTP/1.0"

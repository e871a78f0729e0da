import contextlib
import socket
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

from evedrop import montecarlo, run
from evedrop.errors import UsageError
from evedrop.live.launch.metrics_server import MetricsAddress, RunMetrics, metrics_served
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    Held,
    ProgressEvent,
    RunProgress,
    Started,
    silent,
)
from tests.conftest import LIMIT, Evedrop, wait_until

pytest.importorskip("prometheus_client")
ANY_PORT = MetricsAddress("127.0.0.1", 0)
Samples = Mapping[tuple[str, ...], float]


def scraped(page: str) -> Samples:
    """The name of each sample, followed by the values of its labels in their alphabetical order → its value."""
    from prometheus_client.parser import text_string_to_metric_families

    with urlopen(page) as answer:  # noqa: S310 - our own page
        families = [*text_string_to_metric_families(answer.read().decode())]
    return {
        (sample.name, *(sample.labels[label] for label in sorted(sample.labels))): sample.value
        for family in families
        for sample in family.samples
    }


@pytest.mark.thorough
def test_a_scrape_has_the_metrics_of_the_run(tmp_path: Path) -> None:
    """During a real run the slots grow; at its end every metric is that of the summary."""
    scenario = load("restart")
    seen: list[Samples] = []

    def on_event(event: ProgressEvent) -> None:
        metrics.on_event(event)
        if isinstance(event, RunProgress):
            seen.append(scraped(page))

    metrics = RunMetrics(scenario, tmp_path / "run", silent)
    with metrics_served(ANY_PORT, metrics) as page:
        run(scenario, out=tmp_path / "run", view="off", on_event=on_event)
        last = scraped(page)
    slots = [samples["evedrop_slots_total",] for samples in seen]
    assert slots == sorted(slots)
    assert 0 < slots[0] <= last["evedrop_slots_total",] == last["evedrop_slots_planned",] == scenario.slots
    assert last["evedrop_running",] == 1
    assert all(samples["evedrop_slots_per_second",] > 0 for samples in seen)
    summary = Results.read(tmp_path / "run").summary
    for name, metrics in summary["peers"].items():
        for metric in ("mean_squared_error", "mean_trace_covariance", "received_fraction", "used_fraction"):
            assert last[f"evedrop_{metric}", name] == metrics[metric]
        assert last["evedrop_recent_squared_error", name] >= 0
    fates = {key[1:]: value for key, value in last.items() if key[0] == "evedrop_packets_total"}
    wanted = {}
    for name, link in summary["links"].items():
        wanted["delivered", name] = link["delivered"]
        wanted |= {(reason, name): count for reason, count in link["lost_by"].items()}
        assert sum(count for key, count in fates.items() if key[1] == name) == link["offered"]
    assert fates == wanted
    with pytest.raises(OSError, match="refused"):
        scraped(page)


def test_a_lost_connection_is_counted(tmp_path: Path) -> None:
    """By process; the events go on to the terminal, and without metrics on disk the rest is served."""
    told: list[ProgressEvent] = []
    metrics = RunMetrics(load("vehicle"), tmp_path, told.append)
    events = [Started(), *[ConnectionOutage("smart", slot, slot + 1, 0.5) for slot in (3, 9)]]
    with metrics_served(ANY_PORT, metrics) as page:
        assert scraped(page)["evedrop_running",] == 0
        for event in events:
            metrics.on_event(event)
        result = scraped(page)
    assert (result["evedrop_running",], result["evedrop_lost_connections_total", "smart"]) == (1, 2)
    assert told == events


@contextlib.contextmanager
def crowded(folder: Path, patience: float) -> Iterator[tuple[str, list[socket.socket]]]:
    """The page of metrics, and more programs that only connect than there are places; patience: in seconds, for each."""
    with contextlib.ExitStack() as stack:
        page = stack.enter_context(metrics_served(ANY_PORT, RunMetrics(load("vehicle"), folder, silent), patience))
        port = urlsplit(page).port
        yield page, [stack.enter_context(socket.create_connection(("127.0.0.1", port), LIMIT)) for _ in range(40)]


def test_programs_that_only_connect_keep_nobody_out_for_long(tmp_path: Path) -> None:
    """Each connection is closed, and then the metrics can be read."""
    with crowded(tmp_path, 0.5) as (page, idle):
        assert [connection.recv(1) for connection in idle] == [b""] * len(idle)
        assert scraped(page)["evedrop_running",] == 0


def test_places_are_limited(tmp_path: Path) -> None:
    """The last that connects is turned away at once; a place that somebody leaves is free again."""
    with crowded(tmp_path, 10 * LIMIT) as (page, idle):
        assert idle[-1].recv(1) == b""
        for connection in idle:
            connection.close()

        def answered() -> bool:
            with contextlib.suppress(OSError):
                return scraped(page)["evedrop_running",] == 0
            return False

        wait_until(answered, "a free place")


def test_a_run_that_is_paused_is_held(tmp_path: Path) -> None:
    """Until slots are reported again; before, it has done all slots before the pause, and does none."""
    metrics = RunMetrics(load("vehicle"), tmp_path, silent)
    latest = RunProgress(18, 9.0, "slots/s", {"smart": 0.7})
    names = "evedrop_held", "evedrop_slots_total", "evedrop_slots_per_second"
    seen = []
    with metrics_served(ANY_PORT, metrics) as page:
        for event in (Started(), latest, Held(20), RunProgress(21, 5.0, "slots/s", {"smart": 0.5})):
            metrics.on_event(event)
            samples = scraped(page)
            seen.append(tuple(samples[name,] for name in names))
        assert samples["evedrop_recent_squared_error", "smart"] == 0.5
    assert seen == [(0, 0, 0), (0, 18, 9), (1, 20, 0), (0, 21, 5)]


def test_metrics_are_those_of_the_folder_and_alarms_of_the_watermark(tmp_path: Path) -> None:
    """A folder may be renamed while the run goes on: without it, counters would fall."""
    before, after = tmp_path / "before", tmp_path / "after"
    metrics = RunMetrics(load("replay-attack"), before, silent)
    before.mkdir()
    with contextlib.closing(metrics), metrics_served(ANY_PORT, metrics) as page:
        assert ("evedrop_mean_squared_error", "legitimate") not in scraped(page)
        metrics.on_event(Started())
        before.rename(after)
        montecarlo("replay-attack", trials=10, out=after)
        result = scraped(page)
    summary = Results.read(tmp_path / "after").summary
    assert result["evedrop_mean_squared_error", "legitimate"] == summary["peers"]["legitimate"]["mean_squared_error"]
    for metric in ("false_alarm_fraction", "detected_fraction"):
        assert result[f"evedrop_{metric}",] == summary["integrity"][metric]
    assert ("evedrop_watermark_fraction",) not in result  # only those that the application names


def test_an_ipv6_address_has_brackets(tmp_path: Path) -> None:
    """In the option and in the address of the page."""
    address = MetricsAddress.of("[::1]:0")
    try:
        with metrics_served(address, RunMetrics(load("vehicle"), tmp_path, silent)) as page:
            assert page.startswith("http://[::1]:")
            assert scraped(page)["evedrop_slots_total",] == 0
    except UsageError as error:
        pytest.skip(str(error))


def test_only_loopback_has_no_warning() -> None:
    """Any other address can be reached by other machines."""
    assert MetricsAddress.of("127.0.0.1:9464").warning is None
    assert MetricsAddress.of("localhost:9464") == MetricsAddress("127.0.0.1", 9464)
    assert MetricsAddress.of("[::1]:9464").warning is None
    for text in ("0.0.0.0:9464", "[::]:9464", "10.0.0.1:1"):
        assert text in str(MetricsAddress.of(text).warning)


@pytest.mark.parametrize(
    "text", ["9464", ":9464", "127.0.0.1", "127.0.0.1:", "127.0.0.1:65536", "::1:9464", "[127.0.0.1]:1", "a b:1"]
)
def test_what_is_not_an_address_is_refused(text: str) -> None:
    """The error shows a valid address."""
    with pytest.raises(UsageError, match=r"127\.0\.0\.1:9464"):
        MetricsAddress.of(text)


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the extra that installs it."""
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with (
        pytest.raises(UsageError, match=r"'\.\[metrics\]'"),
        metrics_served(ANY_PORT, RunMetrics(load("vehicle"), tmp_path, silent)),
    ):
        pytest.fail("served")


def test_a_taken_port_is_refused_before_anything_starts(evedrop: Evedrop) -> None:
    """With status 2 and the address; no results folder is left."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = evedrop("run", "vehicle", "--view", "off", "--metrics", f"127.0.0.1:{port}")
    assert done.status == 2
    assert f"http://127.0.0.1:{port}/metrics cannot be served" in done.err
    assert not (evedrop.folder / "runs").exists()


@pytest.mark.thorough
def test_the_command_prints_the_address(evedrop: Evedrop) -> None:
    """And the run ends as any other does."""
    words = ("--slots", "50", "--view", "off", "--metrics", "127.0.0.1:0", "--out", "run")
    done = evedrop("run", "vehicle", *words)
    assert "metrics are served at http://127.0.0.1:" in done.err
    assert Results.read(evedrop.folder / "run").summary["ended"] == "complete"

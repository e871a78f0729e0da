"""A request to a run whose recorder has lost its connection for a moment."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh

from evedrop.cli.main import main
from evedrop.live.network import control_file
from evedrop.live.network.control_file import Control, remove_control
from evedrop.live.network.operator import Answer
from evedrop.live.protocol.codec import enclosed, payload_of
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.requests import LinkRequest, LinkStatus, OperatorRequest, RunStatus, read_request
from evedrop.names import RECORDER
from evedrop.system.ports import free_port

KEY = RunKeys("one").control(RECORDER)
HELD = Answer(3, "held before slot 3")


class Recorder:
    """A router, and a recorder there that lets the first requests go unanswered."""

    def __init__(self, folder: Path, unanswered: int, answer: Answer = HELD) -> None:
        self._answer = answer
        port = free_port()
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
        config.insert_json5("scouting", "{delay: 0, multicast: {enabled: false}, gossip: {enabled: false}}")
        users = folder / "users.txt"
        users.write_text("operator:secret\n")
        config.insert_json5("transport/auth/usrpwd", json.dumps({"dictionary_file": str(users)}))
        self.session = zenoh.open(config)
        self.asked, self.unanswered, self.folder = 0, unanswered, folder
        self.requests: list[OperatorRequest] = []
        self._queryable = self.session.declare_queryable(KEY, self._take)
        Control("one", f"tcp/127.0.0.1:{port}", "operator", "secret").write(folder)

    def _take(self, query: zenoh.Query) -> None:
        self.asked += 1
        assert query.payload is not None
        self.requests.append(read_request(KEY, payload_of(KEY, query.payload.to_bytes()) or b""))
        with query:
            if self.asked > self.unanswered:
                query.reply(KEY, enclosed(KEY, self._answer.pack()))
            elif self.unanswered == 1:
                remove_control(self.folder)  # the run is over


def test_a_request_that_may_be_repeated_is_asked_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Until the recorder is back."""
    recorder = Recorder(tmp_path, unanswered=2)
    with recorder.session:
        assert main(["pause", str(tmp_path)]) == 0
    assert recorder.asked == 3
    assert capsys.readouterr().out == "held before slot 3\n"


@pytest.mark.parametrize(
    ("words", "unanswered", "message"),
    [
        # Steps are counted: a second request would be another step.
        (["step", "4"], 2, "its recorder or router is away, and may still do this"),
        (["pause"], 1, "no run is going on"),
    ],
)
def test_a_request_is_asked_once(
    words: list[str], unanswered: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """If it may not be repeated, or the run is over."""
    recorder = Recorder(tmp_path, unanswered)
    with recorder.session:
        assert main([words[0], str(tmp_path), *words[1:]]) == 2
    assert recorder.asked == 1
    assert message in capsys.readouterr().err


def test_a_value_that_cannot_be_in_a_message_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the run hears of it; a date is a text there, with which the run then says what is wrong."""
    recorder = Recorder(tmp_path, unanswered=0)
    with recorder.session:
        assert main(["link", str(tmp_path), "smart", f"quality=1{'0' * 20}"]) == 2
        assert "the request has a whole number of more than 64 bits" in capsys.readouterr().err
        assert main(["link", str(tmp_path), "smart", "loss.p=1979-05-27"]) == 0
    assert recorder.requests == [LinkRequest({"link": "smart", "set": {"loss": {"p": "1979-05-27"}}})]


def test_a_status_says_which_shards_it_is_not_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Those that have not begun, or are over: the packets of their trials do not count."""
    for shard in ("1", "2", "3"):
        (tmp_path / "shards" / shard).mkdir(parents=True)
    status = RunStatus(5, 9, 1.0, "running", {"router": True}, {"eve": LinkStatus.of(5, 4)}, [])
    recorder = Recorder(tmp_path / "shards" / "2", 0, Answer(status=status))
    with recorder.session:
        assert main(["status", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "link eve: 4 of 5 packets delivered" in out
    assert "2 of 3 shards have not begun or are over; the status is that of the others" in " ".join(err.split())


def test_a_status_goes_without_a_shard_that_ends_meanwhile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its recorder does not answer any more, and its control file is gone."""
    for shard in ("1", "2"):
        (tmp_path / "shards" / shard).mkdir(parents=True)
    status = RunStatus(5, 9, 1.0, "running", {"router": True}, {"eve": LinkStatus.of(5, 4)}, [])
    over, other = Recorder(tmp_path / "shards" / "1", 1), Recorder(tmp_path / "shards" / "2", 0, Answer(status=status))
    with over.session, other.session:
        assert main(["status", str(tmp_path)]) == 0
    assert over.asked == 1
    out, err = capsys.readouterr()
    assert "link eve: 4 of 5 packets delivered" in out
    assert "1 of 2 shards have not begun or are over; the status is that of the others" in " ".join(err.split())


def test_a_control_file_that_vanishes_is_that_of_a_shard_that_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look at the folder and the reading."""
    for shard in ("1", "2"):
        (tmp_path / "shards" / shard).mkdir(parents=True)
        Control("one", "tcp/127.0.0.1:7447", "operator", shard).write(tmp_path / "shards" / shard)
    read = control_file.read_control

    def vanishing(folder: Path) -> Control:
        if folder.name == "1":
            remove_control(folder)
        return read(folder)

    monkeypatch.setattr(control_file, "read_control", vanishing)
    assert [control.password for control in control_file.read_controls(tmp_path)] == ["2"]


def test_a_status_of_shards_that_all_end_meanwhile_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another shard has just begun, but it was not asked."""
    for shard in ("1", "2"):
        (tmp_path / "shards" / shard).mkdir(parents=True)

    class Begins(Recorder):
        """The first shard, whose end is the beginning of the second."""

        def _take(self, query: zenoh.Query) -> None:
            Control("one", "tcp/127.0.0.1:7447", "operator", "secret").write(tmp_path / "shards" / "2")
            super()._take(query)

    with Begins(tmp_path / "shards" / "1", 1).session:
        assert main(["status", str(tmp_path)]) == 2
    assert "it ended before it answered" in capsys.readouterr().err

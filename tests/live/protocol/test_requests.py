"""The operator's requests, as the recorder reads them. docs/protocol.md has their bytes."""

from __future__ import annotations

import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import pack
from evedrop.live.protocol.requests import REQUESTS, read_request


@pytest.mark.parametrize(
    "payload",
    [b"\xc1", b"", pack({}), pack({"do": "end"}), pack({"do": "step"}), pack({"do": "step", "slots": 0}),
     pack({"do": "link", "event": 3}), pack({"do": "link"}), pack({"do": "link", "event": {1: 2}})],
)  # fmt: skip
def test_what_is_no_request_is_malformed(payload: bytes) -> None:
    """The error says where it came from and what was expected."""
    with pytest.raises(MalformedMessage, match=r"malformed message on operator.*expected"):
        read_request("operator", payload)


def test_only_requests_that_may_be_carried_out_twice_are_sent_again() -> None:
    """A second change of a link would be a second event, and a second step would take the run further."""
    assert {do for do, kind in REQUESTS.items() if kind.repeatable} == {"pause", "resume", "status"}

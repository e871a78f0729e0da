"""Two linked routers: what crosses between them, and what an eavesdropper at the second one can get and do.

Each test shows first that the right credentials do get or do what is denied to the attacker.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import pytest
import zenoh

from evedrop.errors import UsageError
from evedrop.live.launch.ports import endpoints_at, loopback_endpoints
from evedrop.live.network.access import Grant, access_control, at_relay, at_router, grants
from evedrop.live.network.operator import is_there
from evedrop.live.network.session import client_config
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol.brief import AnyBrief, RelayPart, RouterPart
from evedrop.live.protocol.codec import enclosed
from evedrop.live.protocol.commands import EndRun, Hold
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import Progress
from evedrop.names import RELAY
from tests.builders import part_of
from tests.conftest import wait_until
from tests.live.network.bench import Bench, Ear, bench_of, connect, small_network
from tests.messages import packet

EVE = "eve"
RECEIVERS = ("legitimate", "eve", "mallory", "nadia")
ONCE = {"timeout_ms": 0, "exit_on_failure": True}


@pytest.fixture(scope="module", params=["tcp", "tls"])
def stage(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A router and a relay for all tests of this file, without certificates and with them."""
    scenario = small_network(slots=100_000, network={"routers": 2})
    with bench_of(scenario, tmp_path_factory.mktemp("linked"), request.param) as bench:
        yield bench


def flow(stage: Bench) -> None:
    """Let one slot pass, in which everybody gets a delivery across the link."""
    k, stage.due = stage.due, stage.due + 1
    stage.put("sensor", stage.keys.uplink, packet(k, stage.packet(k)))
    for ear in stage.downlinks.values():
        assert wire.Reader(*ear.hear()).integer("k") == k


def test_everything_that_is_granted_crosses(stage: Bench) -> None:
    """Packets and deliveries, progress back to the sensor, commands to both sites, telemetry of both."""
    for _ in range(8):
        flow(stage)
    assert wire.Reader(*stage.journal.hear()).integer("c") == 8
    for name in RECEIVERS:
        stage.put(name, stage.keys.progress(name), Progress(3).pack())
        assert stage.progress[name].hear() == (stage.keys.progress(name), Progress(3).pack())
        stage.settle(name)
    stage.settle("sensor")
    for name in ("sensor", *RECEIVERS):
        stage.put("recorder", stage.keys.control(name), Hold().pack())
        assert stage.controls[name].hear() == (stage.keys.control(name), Hold().pack())


def test_an_eavesdropper_at_the_relay_hears_its_own_alone(stage: Bench) -> None:
    """With its credentials, by exact keys, wildcards and questions, it gets neither uplink nor anything of others."""
    keys = stage.keys
    others = [keys.downlink(name) for name in RECEIVERS if name != EVE]
    asked = ["**", "evedrop/**", keys.uplink, keys.journal, keys.telemetry("sensor"), *others, "@/**"]
    with connect(stage.briefs[EVE]) as attacker:
        ears = {key: Ear() for key in (keys.downlink(EVE), *asked)}
        for key, ear in ears.items():
            attacker.declare_subscriber(key, ear)
        watching = Ear()
        attacker.liveliness().declare_subscriber("evedrop/**", watching, history=True)

        def heard() -> bool:
            flow(stage)
            return not ears[keys.downlink(EVE)].messages.empty()

        wait_until(heard, "its own delivery")
        for _ in range(4):
            flow(stage)
            stage.settle("sensor")
        assert {key for ear in ears.values() for key, _ in ear.all()} == {keys.downlink(EVE)}
        assert watching.all() == []
        for key in asked:
            answers = [str(reply.ok.key_expr) for reply in attacker.get(key, timeout=5.0) if reply.ok is not None]
            assert [answer for answer in answers if not answer.startswith(f"@/{attacker.zid()}/")] == []


def test_an_eavesdropper_at_the_relay_cannot_write_for_others(stage: Bench) -> None:
    """Its messages on the keys that cross the link reach no process; its own telemetry, sent after them, arrives."""
    keys = stage.keys
    with connect(stage.briefs[EVE]) as attacker:
        for key in (
            keys.uplink,
            keys.journal,
            keys.acknowledged,
            *(keys.downlink(name) for name in RECEIVERS),
            *(keys.progress(name) for name in ("legitimate", "recorder")),
            *(keys.control(name) for name in ("sensor", "router", "relay", "legitimate")),
            *(keys.telemetry(name) for name in ("sensor", "legitimate")),
        ):
            attacker.put(key, enclosed(key, EndRun().pack()), congestion_control=zenoh.CongestionControl.BLOCK)
        mine = enclosed(keys.telemetry(EVE), b"mine")
        attacker.put(keys.telemetry(EVE), mine, congestion_control=zenoh.CongestionControl.BLOCK)
        assert stage.telemetry[EVE].hear() == (keys.telemetry(EVE), b"mine")
    flow(stage)
    for ears in (stage.controls, stage.progress, stage.telemetry):
        assert {name: ear.all() for name, ear in ears.items()} == {name: [] for name in ears}
    assert (stage.router.poll(), stage.relay.poll()) == (None, None)


def test_each_router_is_asked_for_itself(stage: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each answers for itself with its own credentials, and the relay for those at its site."""
    assert is_there(stage.briefs["router"])
    assert is_there(stage.briefs["relay"])
    monkeypatch.setattr("evedrop.live.network.operator._CONNECT_SECONDS", 0.3)
    assert not is_there(replace(stage.briefs["relay"], password="of another run"))  # noqa: S106 - that is the point


@pytest.mark.parametrize("who", ["eve", "legitimate", "recorder"])
def test_who_belongs_to_the_relay_is_not_let_in_at_the_router(who: str, stage: Bench) -> None:
    """The router's only clients are the sensor and the relay, and no other process has a password there."""
    near = stage.briefs["sensor"].router
    with pytest.raises(zenoh.ZError):
        connect(replace(stage.briefs[who], router=near), connect={"endpoints": [near], **ONCE}).close()
    connect(stage.briefs["sensor"], connect={"endpoints": [near], **ONCE}).close()


def test_nobody_can_pose_as_the_router_at_the_relay(stage: Bench) -> None:
    """A process that connects to the relay with the router's Zenoh id, which it may have learnt, is not taken for the router."""
    eve: AnyBrief = stage.briefs[EVE]
    config = {**client_config(eve), "id": part_of(stage.briefs["router"], RouterPart).zid, "mode": "router"}
    stolen = Ear()
    try:
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as attacker:
            attacker.declare_subscriber(stage.keys.progress("legitimate"), stolen)
            attacker.put(stage.keys.downlink("legitimate"), b"forged")
            attacker.put(stage.keys.journal, b"forged")
            stage.put("legitimate", stage.keys.progress("legitimate"), Progress(4).pack())
            assert stage.progress["legitimate"].hear()[1] == Progress(4).pack()
    except zenoh.ZError:
        pass  # it is not even let in
    flow(stage)
    assert stolen.all() == []
    assert b"forged" not in [payload for _, payload in stage.journal.all()]


def test_each_process_has_its_own_place(stage: Bench) -> None:
    """The sensor and the relay connect to the router, all others to the relay; each router knows those it lets in, and itself."""
    router, relay = stage.briefs["router"], stage.briefs["relay"]
    assert set(part_of(router, RouterPart).users) == {"router", "sensor", "relay"}
    assert set(part_of(relay, RelayPart).users) == {*RECEIVERS, "relay", "recorder", "operator"}
    assert {name for name, brief in stage.briefs.items() if brief.router == router.router} == {
        "router",
        "relay",
        "sensor",
    }
    assert relay.keys == {}
    assert not {"links", "scheme", "scenario"} & set(json.loads(relay.text)["part"])


def test_what_crosses_is_no_more_than_it_must_be() -> None:
    """Uplink and acknowledgements to the sensor stay at the sensor's site, telemetry of receivers and requests at theirs."""
    keys, table = RunKeys("r"), grants("r", ("legitimate", "eve"), relayed=True)
    (relay,) = [grant for grant in at_router("r", table) if grant.process == RELAY]
    (router,) = [grant for grant in at_relay("r", table, "abc") if grant.process == "router"]
    assert set(relay.reads) == {
        keys.downlink("legitimate"),
        keys.downlink("eve"),
        keys.journal,
        keys.telemetry("sensor"),
    }
    assert set(relay.writes) == {
        keys.acknowledged,
        *(keys.progress(name) for name in ("legitimate", "eve", "recorder")),
        *(keys.control(name) for name in ("sensor", "router")),
    }
    assert (router.writes, router.reads) == (relay.reads, relay.writes)
    assert (relay.asks, relay.answers, router.asks, router.answers) == ((), (), (), ())
    assert set(relay.watches) == {keys.alive("router"), keys.alive("sensor")}
    for site in (at_router("r", table), at_relay("r", table, "abc")):
        assert not [
            key for rule in access_control(site)["rules"] for key in rule["key_exprs"] if "*" in key or "$" in key
        ]
    assert [grant.process for grant in at_router("r", table)] == ["sensor", "router", RELAY]


def test_the_router_is_known_at_the_relay_by_id_and_certificate() -> None:
    """It does not ask to be let in and so has no user there: its id, and its certificate where there are any."""
    router = Grant("router", (), (), None, zid="abc")
    (clear,) = access_control([router])["subjects"]
    assert clear == {"id": "router", "zids": ["abc"]}
    (certified,) = access_control([router], certified=True)["subjects"]
    assert certified == {"id": "router", "zids": ["abc"], "cert_common_names": ["router"]}


def test_a_run_of_two_routers_takes_certificates_unless_it_is_told_otherwise() -> None:
    """On loopback, with free ports of their own, or with those that are given."""
    result = loopback_endpoints(None, None, relayed=True)
    assert result.relay is not None
    assert (result.router.secure, result.relay.secure) == (True, True)
    assert str(result.router.listen) != str(result.relay.listen)
    clear = loopback_endpoints(str(result.router.listen).replace("tls/", "tcp/"), None, relayed=True)
    assert clear.relay is not None
    assert (clear.router.secure, clear.relay.secure) == (False, False)


@pytest.mark.parametrize(
    ("options", "relayed", "message"),
    [
        (("tls/a:1",), True, "has two routers; add --relay"),
        (("tls/a:1", None, "tls/b:1"), False, "has one router; leave it out, or add --set network.routers=2"),
        (("tls/a:1", None, "tcp/127.0.0.1:1"), True, "both routers take certificates or none does"),
        (("tls/a:1", None, "tls/a:1"), True, "is where the first router is; give another port"),
        (("tls/a:1", None, None, "tls/b:1"), True, "--relay-connect belongs to a second router; add --relay"),
        (
            ("tls/a:1", None, "tls/0.0.0.0:1"),
            True,
            "--relay tls/0.0.0.0:1 means every address.*add --relay-connect tls/HOST:1",
        ),
        (("tls/a:1", None, "tcp/b:1"), True, "--relay tcp/b:1 is not encrypted"),
        (("tls/a:1", None, "b"), True, "--relay b is not an endpoint"),
    ],
)
def test_places_that_do_not_fit_are_refused(options: tuple[str | None, ...], relayed: bool, message: str) -> None:
    """Too few, too many, of two kinds, the same place twice: each with the option that mends it."""
    with pytest.raises(UsageError, match=message):
        endpoints_at(*options).check(relayed)  # type: ignore[arg-type]

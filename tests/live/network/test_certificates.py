"""A router that takes certificates: who can connect to it, as whom, and what a process says of certificates that do not fit.

Each attack is shown to fail where the same attempt with the right certificate succeeds.
"""

from __future__ import annotations

import datetime
import json
import socket
import ssl
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from evedrop.errors import BriefError, RunError, UsageError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.certificates import Authority, check_identity, tls_section
from evedrop.live.network.connecting import connected
from evedrop.live.network.control_file import Control, read_control
from evedrop.live.network.session import Session, client_config
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol.brief import AnyBrief, Identity, RecorderPart, read_brief
from evedrop.system.ports import free_port
from evedrop.system.world import RealWorld
from tests.conftest import wait_until
from tests.live.network.bench import Bench, Ear, bench_of, connect, small_network
from tests.messages import packet

EVE, MALLORY = "eve", "mallory"
NOW = datetime.datetime(2026, 5, 4, 12, tzinfo=datetime.UTC)
ONCE = {"timeout_ms": 0, "exit_on_failure": True}


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One router for all tests of this file."""
    with bench_of(small_network(slots=100_000), tmp_path_factory.mktemp("tls"), "tls") as bench:
        yield bench


def flow(stage: Bench) -> None:
    """Let one slot pass, in which everybody gets a delivery."""
    k, stage.due = stage.due, stage.due + 1
    stage.put("sensor", stage.keys.uplink, packet(k, stage.packet(k)))
    for ear in stage.downlinks.values():
        assert wire.Reader(*ear.hear()).integer("k") == k


def self_signed() -> Identity:
    """A self-signed certificate that claims to be Eve's."""
    other = Authority("nobody").identity(EVE)
    return replace(other, authority=other.certificate)


def expired() -> Identity:
    """A year-old certificate of an unknown authority."""
    return Authority("old", datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=365)).identity(EVE)


def identity_of(brief: AnyBrief) -> Identity:
    """The identity in a brief of a run with certificates."""
    assert brief.identity is not None
    return brief.identity


STRANGERS: dict[str, Callable[[AnyBrief], Identity]] = {
    "of another run": lambda _: Authority("r00000000").identity(EVE),
    "self-signed": lambda _: self_signed(),
    "expired": lambda _: expired(),
    "another run's, this run's authority": lambda brief: replace(
        Authority(brief.run).identity(EVE), authority=identity_of(brief).authority
    ),
}


@pytest.mark.parametrize("who", STRANGERS)
def test_a_certificate_that_is_not_of_this_run_opens_nothing(who: str, stage: Bench) -> None:
    """With Eve's user and password but another certificate there is no session, even for a client that trusts every router."""
    brief = stage.briefs[EVE]
    stranger = STRANGERS[who](brief)
    config = client_config(replace(brief, identity=stranger))
    config["transport"]["link"]["tls"]["verify_name_on_connect"] = False
    config["transport"]["link"]["tls"]["root_ca_certificate_base64"] = client_config(brief)["transport"]["link"]["tls"][
        "root_ca_certificate_base64"
    ]
    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))).close()
    connect(brief, connect={"endpoints": [brief.router], **ONCE}).close()
    flow(stage)


@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_without_a_certificate_there_is_no_session(protocol: str, stage: Bench) -> None:
    """Clients without a certificate, and clients without TLS, are refused."""
    brief = stage.briefs[EVE]
    config = client_config(brief)
    endpoint = f"{protocol}/{brief.router.partition('/')[2]}"
    config["connect"]["endpoints"] = [endpoint]
    config["transport"]["link"]["protocols"] = [protocol]
    tls = config["transport"]["link"].pop("tls")
    if protocol == "tls":
        authority = {"root_ca_certificate_base64": tls["root_ca_certificate_base64"], "enable_mtls": False}
        config["transport"]["link"]["tls"] = authority
    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))).close()
    flow(stage)


@pytest.mark.parametrize(("user", "shown"), [(MALLORY, EVE), (EVE, MALLORY), ("recorder", EVE)])
def test_a_certificate_opens_nothing_under_another_user(user: str, shown: str, stage: Bench) -> None:
    """A process with another's user and password, but its own certificate, cannot read or write the other's keys."""
    thief = replace(stage.briefs[user], identity=stage.briefs[shown].identity)
    telemetry = stage.keys.telemetry(user if user != "recorder" else EVE)
    with connect(thief) as attacker, connect(stage.briefs[user]) as rightful:
        stolen, own = Ear(), Ear()
        for key in (stage.keys.downlink(EVE), stage.keys.downlink(MALLORY), stage.keys.telemetry("sensor")):
            attacker.declare_subscriber(key, stolen)
            rightful.declare_subscriber(key, own)
        attacker.put(telemetry, b"forged")
        attacker.put(stage.keys.control("sensor"), b"forged")

        def heard() -> bool:
            flow(stage)
            stage.settle("sensor")
            return not own.messages.empty()

        wait_until(heard, "what is rightfully heard")
        for _ in range(3):
            flow(stage)
            stage.settle("sensor")
        assert stolen.all() == []
    for name in (EVE, MALLORY):
        stage.settle(name)
    assert stage.controls["sensor"].all() == []


def test_with_the_own_certificate_an_eavesdropper_hears_its_own_alone(stage: Bench) -> None:
    """Access control is the same as without certificates: the own downlink, and neither uplink nor another's."""
    with connect(stage.briefs[EVE]) as attacker:
        ears = {key: Ear() for key in (stage.keys.downlink(EVE), stage.keys.downlink(MALLORY), stage.keys.uplink)}
        for key, ear in ears.items():
            attacker.declare_subscriber(key, ear)

        def heard() -> bool:
            flow(stage)
            return not ears[stage.keys.downlink(EVE)].messages.empty()

        wait_until(heard, "its own delivery")
        flow(stage)
        assert {key for ear in ears.values() for key, _ in ear.all()} == {stage.keys.downlink(EVE)}


def test_an_eavesdropper_cannot_pose_as_the_router(stage: Bench) -> None:
    """No process trusts a router that has a process's certificate, and each says that this is not a router."""
    sensor, eve = stage.briefs["sensor"], stage.briefs[EVE]
    port = free_port()
    config = client_config(eve)
    tls = config["transport"]["link"]["tls"]
    for kind in ("certificate", "private_key"):
        tls[f"listen_{kind}_base64"] = tls[f"connect_{kind}_base64"]
    del config["connect"], config["transport"]["auth"]
    config |= {"mode": "router", "listen": {"endpoints": [f"tls/127.0.0.1:{port}"], "exit_on_failure": True}}
    lured = replace(sensor, router=f"tls/127.0.0.1:{port}")
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):
        with pytest.raises(zenoh.ZError):
            zenoh.open(zenoh.Config.from_json5(json.dumps(client_config(lured)))).close()
        with pytest.raises(
            BriefError, match=r"has the certificate of another process of evedrop r.*, and is not a router"
        ):
            connected(lured, client_config(lured), 20.0)


def test_a_router_is_trusted_at_its_own_names_alone(stage: Bench) -> None:
    """The router of this run at a host that its certificate does not name: one line with the option that mends it."""
    brief = stage.briefs[EVE]
    port = brief.router.rpartition(":")[2]
    elsewhere = replace(brief, router=f"tls/localhost:{port}")
    with pytest.raises(BriefError, match=rf"does not name localhost; .* --connect tls/localhost:{port}, all of them"):
        connected(elsewhere, client_config(elsewhere), 20.0)


def test_a_router_is_trusted_at_its_own_addresses_alone(stage: Bench) -> None:
    """The same, of an address instead of a name, which is another error of OpenSSL."""
    authority, port = Authority("r"), free_port()
    tls = tls_section(authority.identity("router", ["localhost"]), listens=True)
    config = {
        "mode": "router",
        "listen": {"endpoints": [f"tls/127.0.0.1:{port}"], "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    brief = replace(stage.briefs[EVE], router=f"tls/127.0.0.1:{port}", identity=authority.identity(EVE))
    with (
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))),
        pytest.raises(
            BriefError, match=rf"does not name 127\.0\.0\.1; .* --connect tls/127\.0\.0\.1:{port}, all of them"
        ),
    ):
        connected(brief, client_config(brief), 20.0)


def test_another_runs_router_is_told_apart(stage: Bench) -> None:
    """A brief of another run says whose router it found, within seconds."""
    other = briefs_of(stage.scenario, endpoints_at(stage.briefs[EVE].router), RecorderTask(Path("nowhere"), False))[EVE]
    with pytest.raises(BriefError) as caught:
        connected(other, client_config(other), 60.0)
    assert f"has a certificate of evedrop {stage.keys.run}, and this brief is of run {other.run}" in str(caught.value)


def test_the_operator_has_a_certificate_too(stage: Bench, tmp_path: Path) -> None:
    """The file that the recorder writes into its folder opens a session; without the certificate in it, none opens."""
    part = stage.briefs["recorder"].part
    assert isinstance(part, RecorderPart)
    control = Control(stage.keys.run, stage.briefs[EVE].router, "operator", part.operator, part.operator_identity)
    control.write(tmp_path)
    assert (tmp_path / "control.json").stat().st_mode & 0o777 == 0o600
    result = read_control(tmp_path)
    assert result == control
    zenoh.open(zenoh.Config.from_json5(json.dumps(client_config(result)))).close()
    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh.Config.from_json5(json.dumps(client_config(replace(result, identity=None))))).close()
    path = tmp_path / "control.json"
    path.write_text(json.dumps({**asdict(control), "identity": {"key": 3}}))
    with pytest.raises(UsageError, match=r"control\.json is not a control file"):
        read_control(tmp_path)


def test_private_keys_are_in_the_own_brief_alone(tmp_path: Path) -> None:
    """Every process has a key of its own, the operator's is with the recorder, and the authority's is nowhere."""
    made = briefs_of(
        small_network(), endpoints_at("tls/0.0.0.0:7447", "tls/router.lan:7447"), RecorderTask(tmp_path, False)
    )
    texts = {name: brief.write(tmp_path).read_text() for name, brief in made.items()}
    keys = {name: json.loads(text)["identity"]["key"] for name, text in texts.items()}
    assert len(set(keys.values())) == len(made)
    for name, key in keys.items():
        assert [other for other, text in texts.items() if json.dumps(key) in text] == [name]
    assert {name: text.count("PRIVATE KEY") // 2 for name, text in texts.items()} == {
        name: 2 if name == "recorder" else 1 for name in made
    }
    assert len({brief.identity.authority for brief in made.values() if brief.identity}) == 1
    for name in made:
        assert read_brief(tmp_path / f"{name}.json").text == texts[name]


def certificate_of(brief: AnyBrief) -> x509.Certificate:
    """The certificate in a brief."""
    assert brief.identity is not None
    return x509.load_pem_x509_certificate(brief.identity.certificate.encode())


def test_certificates_say_what_they_are_for(tmp_path: Path) -> None:
    """The router's names its hosts and is for a server; all are for a client, and the others' name no host."""
    made = briefs_of(
        small_network(), endpoints_at("tls/10.0.0.7:7447", "tls/router.lan:7447"), RecorderTask(tmp_path, False)
    )
    names = certificate_of(made["router"]).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["router.lan"]
    assert [str(address) for address in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.7"]
    for name, brief in made.items():
        certificate = certificate_of(brief)
        assert certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == name
        uses = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        servers = {ExtendedKeyUsageOID.SERVER_AUTH} if name == "router" else set()
        assert uses == {ExtendedKeyUsageOID.CLIENT_AUTH, *servers}
        if name != "router":
            with pytest.raises(x509.ExtensionNotFound):
                certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)


AUTHORITY = Authority("r01", NOW)
EVES, OTHERS = AUTHORITY.identity(EVE), Authority("r01", NOW).identity(EVE)
DAY = datetime.timedelta(days=1)


@pytest.mark.parametrize(
    ("identity", "now", "message"),
    [
        (EVES, NOW - 2 * DAY, r"not valid before 2026-05-03 12:00 UTC.*clock says 2026-05-02 12:00 UTC; set the clock"),
        (EVES, NOW + 31 * DAY, r"expired 2026-06-03 12:00 UTC.*says 2026-06-04 12:00 UTC; write the briefs again"),
        (replace(EVES, key=OTHERS.key), NOW, r"identity\.key is not that of identity\.certificate; write the briefs"),
        (replace(EVES, authority=OTHERS.authority), NOW, r"was not made by identity\.authority \(evedrop r01\)"),
        (AUTHORITY.identity(MALLORY), NOW, r"is that of mallory, not of eve"),
        (replace(EVES, certificate="none"), NOW, r"identity cannot be read \(.*\); write the briefs again"),
        (replace(EVES, key=EVES.certificate), NOW, r"identity cannot be read \(.*\); write the briefs again"),
    ],
)  # fmt: skip
def test_an_identity_that_does_not_fit_is_seen_at_once(
    identity: Identity, now: datetime.datetime, message: str
) -> None:
    """Too early, too late, another's key, another's authority, another's name, nonsense: each is one line with the remedy."""
    with pytest.raises(BriefError, match=message) as caught:
        check_identity(identity, EVE, now)
    assert "\n" not in str(caught.value)


def test_an_identity_that_fits_is_taken() -> None:
    """From a day before the authority was made, for clocks that are late, until 30 days after."""
    for now in (NOW - DAY, NOW, NOW + 30 * DAY):
        check_identity(EVES, EVE, now)


def test_the_clock_is_that_of_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """In which time may be simulated."""
    monkeypatch.setattr(RealWorld, "time", lambda _: (NOW + 31 * DAY).timestamp())
    with pytest.raises(BriefError, match=r"expired 2026-06-03 12:00 UTC.*says 2026-06-04 12:00 UTC"):
        check_identity(EVES, EVE)


def test_a_router_whose_clock_is_wrong_is_told_apart(stage: Bench) -> None:
    """A router that shows a certificate of another time: the process names the clock."""
    old = Authority(stage.keys.run, datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=365))
    router, eve = old.identity("router", ["127.0.0.1"]), old.identity(EVE)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    config = client_config(replace(stage.briefs[EVE], router=endpoint, identity=eve))
    tls = {**config["transport"]["link"]["tls"]}
    listening = client_config(replace(stage.briefs[EVE], identity=router))["transport"]["link"]["tls"]
    for kind in ("certificate", "private_key"):
        tls[f"listen_{kind}_base64"] = listening[f"connect_{kind}_base64"]
    server = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": config["scouting"],
        "transport": {"link": {"protocols": ["tls"], "tls": tls}},
    }
    with (
        zenoh.open(zenoh.Config.from_json5(json.dumps(server))),
        pytest.raises(
            BriefError, match=r"not valid now by this host's clock \(certificate has expired\); set the clock"
        ),
    ):
        connected(Control(stage.keys.run, endpoint, EVE, "", eve), config, 20.0)


@pytest.mark.thorough
def test_a_router_that_is_not_there_is_waited_for() -> None:
    """Nobody listens: the process says so when its patience ends, as a failure of the run."""
    calls: list[None] = []
    control = Control("r01", f"tcp/127.0.0.1:{free_port()}", "operator", "")
    with pytest.raises(
        RunError, match=r"no router answered at tcp/.* within 1 s \(Connection refused\); start it there"
    ):
        connected(control, {}, 1.0, lambda: calls.append(None))
    assert len(calls) > 1


def test_briefs_that_fit_no_endpoint_are_refused(stage: Bench) -> None:
    """Certificates for a router without TLS, none for a router that requires them, and malformed endpoints."""
    with pytest.raises(BriefError, match="7447 is not an endpoint"):
        Session(replace(stage.briefs[EVE], router="7447"))
    for control, message in (
        (Control("r01", "tls/127.0.0.1:7447", "operator", ""), "there is no identity"),
        (Control("r01", "tcp/127.0.0.1:7447", "operator", "", EVES), "takes no identity"),
        (Control("r01", "7447", "operator", ""), "7447 is not an endpoint"),
    ):
        with pytest.raises(BriefError, match=message):
            connected(control, {}, 1.0)


def test_the_routers_certificate_passes_the_strictest_check(stage: Bench) -> None:
    """Python's TLS, told to be strict about every field of RFC 5280, takes it: other libraries will, too."""
    brief = stage.briefs[EVE]
    assert brief.identity is not None
    strict = ssl.create_default_context(cadata=brief.identity.authority)
    strict.verify_flags |= ssl.VERIFY_X509_STRICT
    address = ("127.0.0.1", int(brief.router.rpartition(":")[2]))
    with socket.create_connection(address) as link, strict.wrap_socket(link, server_hostname="127.0.0.1") as shown:
        certificate = shown.getpeercert()
        assert certificate is not None
        assert certificate["subject"] == ((("commonName", "router"),),)

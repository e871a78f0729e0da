"""Certificates of a run: its authority makes one for every process, and each process checks its own and hands it to Zenoh.

The authority forgets its own key when it has made all certificates. A process checks that its certificate fits before any
connection is tried.

Source: docs/protocol.md, certificates.
"""

from __future__ import annotations

import base64
import datetime
import ipaddress
from collections.abc import Sequence
from typing import final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from evedrop.errors import BriefError
from evedrop.live.protocol.brief import Identity
from evedrop.live.protocol.keys import ZenohConfig
from evedrop.system.world import world

_BEFORE = datetime.timedelta(days=1)  # so that a host whose clock is slow or set to another time zone can take part
_VALID = datetime.timedelta(days=30)


def authority_name(run: str) -> str:
    """The name of a run's authority, by which a process that rejects a certificate knows which run it belongs to."""
    return f"evedrop {run}"


@final
class Authority:
    """The certificate authority of one run. Only this object holds its key: P-256, which every TLS library supports."""

    def __init__(self, run: str, now: datetime.datetime | None = None) -> None:
        """now: the start of its validity; by default, the present time."""
        begin = now or _now()
        self._from, self._until = begin - _BEFORE, begin + _VALID
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _named(authority_name(run))
        self._certificate = (
            self._begun(self._name, self._key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
            .sign(self._key, hashes.SHA256())
        )

    def identity(self, process: str, hosts: Sequence[str] = ()) -> Identity:
        """Make a process's certificate and key.

        hosts: names and addresses of a router; other certificates are not accepted as a router's.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * bool(hosts)
        made = (
            self._begun(_named(process), key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )
        if hosts:
            made = made.add_extension(x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False)
        return Identity(
            authority=_pem(self._certificate),
            certificate=_pem(made.sign(self._key, hashes.SHA256())),
            key=key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()).decode(),
        )

    def _begun(self, subject: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(self._from)
            .not_valid_after(self._until)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(Encoding.PEM).decode()


_AGAIN = "write the briefs again with `evedrop brief`, all of them"


def check_identity(identity: Identity, process: str, now: datetime.datetime | None = None) -> None:
    """Raise BriefError unless a process can use this identity now; now: by default, the clock's time."""
    now = now or _now()
    try:
        authority = x509.load_pem_x509_certificate(identity.authority.encode())
        certificate = x509.load_pem_x509_certificate(identity.certificate.encode())
        key = load_pem_private_key(identity.key.encode(), None)
    except (ValueError, TypeError) as error:
        raise BriefError(f"identity cannot be read ({_first_line(error)}); {_AGAIN}") from error
    form = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if key.public_key().public_bytes(*form) != certificate.public_key().public_bytes(*form):
        raise BriefError(f"identity.key is not that of identity.certificate; {_AGAIN}")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise BriefError(
            f"identity.certificate was not made by identity.authority ({name_of(authority)}); {_AGAIN}"
        ) from error
    if name_of(certificate) != process:
        raise BriefError(f"identity.certificate is that of {name_of(certificate)}, not of {process}; {_AGAIN}")
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now < begin:
        raise BriefError(
            f"identity.certificate is not valid before {begin:%Y-%m-%d %H:%M} UTC, and this host's clock says "
            f"{now:%Y-%m-%d %H:%M} UTC; set the clock (of this host, or of the one that wrote the briefs)"
        )
    if now > end:
        raise BriefError(
            f"identity.certificate expired {end:%Y-%m-%d %H:%M} UTC, and this host's clock says {now:%Y-%m-%d %H:%M} UTC; "
            f"{_AGAIN}, or set this host's clock"
        )


def _now() -> datetime.datetime:
    return datetime.datetime.fromtimestamp(world().time(), datetime.UTC)


def name_of(certificate: x509.Certificate) -> str:
    """Name of the process or authority that a certificate belongs to."""
    return _common_name(certificate.subject)


def maker_of(certificate: bytes) -> str:
    """Name of the authority that a DER certificate gives as its issuer. Raises ValueError if it is not a certificate."""
    return _common_name(x509.load_der_x509_certificate(certificate).issuer)


def _common_name(name: x509.Name) -> str:
    attributes = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(attributes[0].value) if attributes else "(no name)"


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0].rstrip(".")


def tls_section(identity: Identity, listens: bool = False) -> ZenohConfig:
    """The `tls` section of Zenoh's configuration: both ends show a certificate, and the router's must name its host."""
    encoded = {name: base64.b64encode(getattr(identity, name).encode()).decode() for name in ("certificate", "key")}
    section: ZenohConfig = {
        "root_ca_certificate_base64": base64.b64encode(identity.authority.encode()).decode(),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    for end in ("connect", "listen") if listens else ("connect",):
        section[f"{end}_certificate_base64"] = encoded["certificate"]
        section[f"{end}_private_key_base64"] = encoded["key"]
    return section

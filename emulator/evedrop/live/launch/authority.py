"""The certificate authority of one run: it makes the certificate of every process, and then forgets its own key.

Source: docs/protocol.md, certificates.
"""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Sequence
from typing import final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from evedrop.live.protocol.brief_parts import Identity

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
        begin = now or datetime.datetime.now(datetime.UTC)
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

"""How a client of a simulated router checks its certificate, in the words of OpenSSL.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import base64
import datetime
import ipaddress
import ssl
from collections.abc import Iterator
from contextlib import suppress

import zenoh
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from evedrop.virtual.zenoh.access import section

_UNKNOWN, _WRONG_PURPOSE, _WRONG_NAME, _WRONG_ADDRESS, _NOT_YET_VALID, _EXPIRED = 20, 26, 62, 64, 9, 10


def shown_by(config: zenoh.Config) -> bytes | None:
    """The certificate of a router with this configuration, as DER; None if it has none."""
    text = section(config, "transport/link/tls/listen_certificate_base64")
    if text is None:
        return None
    return x509.load_pem_x509_certificate(base64.b64decode(text)).public_bytes(Encoding.DER)


def check(certificate: bytes, trust: ssl.SSLContext, host: str, now: float) -> None:
    """Raise SSLCertVerificationError if a context does not trust a certificate of a host, at a time in seconds since 1970."""
    for code, what in _problems(x509.load_der_x509_certificate(certificate), trust, host, now):
        error = ssl.SSLCertVerificationError(1, f"certificate verify failed: {what}")
        error.verify_code, error.verify_message = code, what
        raise error


def _problems(certificate: x509.Certificate, trust: ssl.SSLContext, host: str, now: float) -> Iterator[tuple[int, str]]:
    """What OpenSSL finds, the first problem first."""
    if trust.verify_mode == ssl.CERT_NONE:
        return
    if not any(_made_by(certificate, authority) for authority in trust.get_ca_certs(binary_form=True)):
        yield _UNKNOWN, "unable to get local issuer certificate"
    uses = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    if ExtendedKeyUsageOID.SERVER_AUTH not in uses:
        yield _WRONG_PURPOSE, "unsuitable certificate purpose"
    if trust.check_hostname and not _names(certificate, host):
        kind, code = ("Hostname", _WRONG_NAME) if _address(host) is None else ("IP address", _WRONG_ADDRESS)
        yield code, f"{kind} mismatch, certificate is not valid for '{host}'"
    moment = datetime.datetime.fromtimestamp(now, datetime.UTC)
    if moment < certificate.not_valid_before_utc:
        yield _NOT_YET_VALID, "certificate is not yet valid"
    if moment > certificate.not_valid_after_utc:
        yield _EXPIRED, "certificate has expired"


def _made_by(certificate: x509.Certificate, authority: bytes) -> bool:
    try:
        certificate.verify_directly_issued_by(x509.load_der_x509_certificate(authority))
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _names(certificate: x509.Certificate, host: str) -> bool:
    names, address = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value, _address(host)
    if address is None:
        return host in names.get_values_for_type(x509.DNSName)
    return address in names.get_values_for_type(x509.IPAddress)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with suppress(ValueError):
        return ipaddress.ip_address(host)
    return None

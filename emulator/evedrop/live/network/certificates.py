"""A process's certificate: checks that it fits before any connection is tried, and hands it to Zenoh.

Source: docs/protocol.md, certificates.
"""

from __future__ import annotations

import base64
import datetime

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import NameOID

from evedrop.errors import BriefError
from evedrop.live.protocol.brief_parts import Identity
from evedrop.live.protocol.keys import ZenohConfig

_AGAIN = "write the briefs again with `evedrop brief`, all of them"


def check_identity(identity: Identity, process: str, now: datetime.datetime | None = None) -> None:
    """Raise BriefError unless a process can use this identity now; now: by default, the clock's time."""
    now = now or datetime.datetime.now(datetime.UTC)
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


def name_of(certificate: x509.Certificate) -> str:
    """Name of the process or authority that a certificate belongs to."""
    return _common_name(certificate.subject)


def maker_of(certificate: bytes) -> str:
    """Name of the authority that a DER certificate gives as its issuer. Raises ValueError if it is not a certificate."""
    return _common_name(x509.load_der_x509_certificate(certificate).issuer)


def _common_name(name: x509.Name) -> str:
    found = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else "(no name)"


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

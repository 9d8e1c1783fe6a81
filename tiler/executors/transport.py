"""The way to a scheduler: certificates for TLS, and whether one answers by the protocol of its address.

Dask tries again until its time is up, whatever the reason, and says no more than that: so one connection is made
here first, so that its errors can be shown.
"""

import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.data.errors import CityError, ConfigError

CONNECT = 30.0  # s for a connection, and for its first word
SILENT = 3.0  # s without a word, after which a scheduler may be one that waits for TLS
DASKS = {  # where Dask's own configuration has them
    "tls_ca": "distributed.comm.tls.ca-file",
    "tls_cert": "distributed.comm.tls.client.cert",
    "tls_key": "distributed.comm.tls.client.key",
}
ENCRYPTED = b"ENCRYPTED"  # in a private key that has a passphrase
PAGE = 'see "TLS" in docs/cluster.md'


@dataclass(frozen=True)
class TlsFiles:
    """Files of TLS, PEM; where one is empty, Dask's own configuration counts."""

    tls_ca: str = ""  #: certificate of the authority that has signed those of scheduler and workers
    tls_cert: str = ""  #: certificate of this client
    tls_key: str = ""  #: its key, without a passphrase; may lie in the file of the certificate


NO_FILES = TlsFiles()


def make_security(address: str, files: TlsFiles) -> Any:
    """Make what Dask's client takes as ``security``; None for a scheduler without TLS.

    Parameters
    ----------
    address : str
        Address of the scheduler.
    files : TlsFiles
        Files that were given.

    Raises
    ------
    ConfigError
        If a file is missing or unusable, or one is given for an address without TLS.
    """
    from dask import config
    from distributed.security import Security

    given = {name: value for name, value in vars(files).items() if value}
    if not address.startswith("tls://"):
        if given:
            names = ", ".join(name.replace("_", "-") for name in given)
            raise ConfigError(f"--{names}: counts with --scheduler tls://HOST:PORT, not with {address}")
        return None
    paths = {name: given.get(name) or config.get(place, None) or "" for name, place in DASKS.items()}
    if "tls_cert" in given:  # a pair: the key of another certificate is of no use
        paths["tls_key"] = given.get("tls_key", "")
    for name in ("tls_ca", "tls_cert"):
        if not paths[name]:
            raise ConfigError(
                f"{address}: no {name.replace('tls_', '')} file for TLS; give --{name.replace('_', '-')}, or "
                f"{DASKS[name]} in Dask's configuration; {PAGE}"
            )
    named = {name: path for name, path in paths.items() if path and "\n" not in path}  # else PEM itself
    for name, path in named.items():
        _check_file(name, path)
    security = Security(
        tls_ca_file=paths["tls_ca"],
        tls_client_cert=paths["tls_cert"],
        tls_client_key=paths["tls_key"] or None,
        require_encryption=True,
    )
    try:
        security.get_connection_args("client")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise ConfigError(
            f"{address}: {', '.join(named.values())}: cannot be used ({_tell(error)}); these must be "
            f"the certificate of an authority, one of this client and its key, as PEM; {PAGE}"
        ) from error
    return security


def check_answer(address: str, security: Any) -> None:
    """Make one connection to a scheduler and listen for its first word.

    Parameters
    ----------
    address : str
        ``tcp://HOST:PORT``, ``tls://HOST:PORT`` or ``HOST:PORT``; other protocols are left to Dask.
    security : distributed.Security or None
        From `make_security`.

    Raises
    ------
    ConfigError
        If it speaks the other protocol, or one side refuses the certificate of the other one; after some `CONNECT`
        seconds at most.
    CityError
        If nothing answers.
    """
    from distributed.comm import parse_address, parse_host_port

    protocol, place = parse_address(address)
    if protocol not in {"tcp", "tls"}:
        return
    try:
        host, port = parse_host_port(place)
    except ValueError as error:
        raise ConfigError(f"{address}: is no address of a scheduler ({error}); give tcp://HOST:PORT") from error
    context = security.get_connection_args("client")["ssl_context"] if protocol == "tls" else None
    try:
        with socket.create_connection((host, port), timeout=CONNECT) as plain:
            _listen_tls(address, plain, context) if context else _listen_plain(address, plain, host, port)
    except OSError as error:
        raise CityError(
            f"{address}: no Dask scheduler answers ({_tell(error)}); start one, or check the address"
        ) from error


def _listen_tls(address: str, plain: socket.socket, context: ssl.SSLContext) -> None:
    plain_address = address.replace("tls://", "tcp://", 1)
    try:
        stream = context.wrap_socket(plain)
    except ssl.SSLCertVerificationError as error:
        raise ConfigError(
            f"{address}: its certificate is not signed by the authority of tls_ca ({error.verify_message}); give "
            f"the --tls-ca that the cluster was started with; {PAGE}"
        ) from error
    except ssl.SSLError as error:
        if "ALERT" not in str(error.reason or error).upper():
            raise ConfigError(
                f"{address}: does not speak TLS ({_tell(error)}); a scheduler without TLS is {plain_address}"
            ) from error
        raise _refused(address, error) from error
    except TimeoutError as error:
        raise ConfigError(
            f"{address}: no answer by TLS within {CONNECT:g} s; a scheduler without TLS is {plain_address}"
        ) from error
    with stream:
        try:
            word = stream.recv(1)
        except ssl.SSLError as error:
            raise _refused(address, error) from error
        if not word:
            raise ConnectionError("it closes the connection")


def _refused(address: str, error: ssl.SSLError) -> ConfigError:
    return ConfigError(
        f"{address}: refuses the certificate of this client ({_tell(error)}); give a --tls-cert that the "
        f"authority of the cluster has signed, and its --tls-key; {PAGE}"
    )


def _listen_plain(address: str, plain: socket.socket, host: str, port: int) -> None:
    """A scheduler without TLS speaks first; one with TLS waits."""
    plain.settimeout(SILENT)
    try:
        if plain.recv(1):
            return
    except TimeoutError:
        if _speaks_tls(host, port):
            raise ConfigError(
                f"{address}: speaks TLS; give --scheduler tls://{host}:{port}, and certificates; {PAGE}"
            ) from None
        plain.settimeout(CONNECT)
        if plain.recv(1):
            return
    raise ConnectionError("it closes the connection")


def _speaks_tls(host: str, port: int) -> bool:
    """Whether the other side begins TLS; with whom does not count, as nothing is said."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with (
            socket.create_connection((host, port), timeout=CONNECT) as plain,
            context.wrap_socket(plain, do_handshake_on_connect=False) as stream,
        ):
            stream.settimeout(SILENT)
            stream.do_handshake()
    except ssl.SSLError as error:
        return "ALERT" in str(error.reason or error).upper()
    except OSError:
        return False
    return True


def _check_file(name: str, path: str) -> None:
    option = f"--{name.replace('_', '-')} (or {DASKS[name]})"
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(f"{option}: {path}: cannot be read ({error.strerror}); check the path") from error
    if name != "tls_ca" and ENCRYPTED in text:  # OpenSSL would ask for it at the terminal
        raise ConfigError(
            f"{option}: {path}: the key has a passphrase, which a run cannot ask for; `openssl pkey -in {path} "
            "-out FILE` writes it without"
        )


def _tell(error: BaseException) -> str:
    """What the system or OpenSSL says, in one line."""
    if isinstance(error, ssl.SSLError) and error.reason:
        return error.reason.lower().replace("_", " ")
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__

"""Hosts on one machine: network namespaces on one switch, whose links can be cut. Files are shared by all."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

NET = "10.77.0"


def ip(*words: str) -> None:
    """Run `ip`; CalledProcessError with what it says if it refuses."""
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@dataclass(frozen=True)
class Host:
    """One host: a namespace, and an interface in it whose other end is at the switch."""

    name: str
    switch: str
    link: str
    address: str

    def command(self, command: Sequence[str]) -> list[str]:
        """A command as it is run there."""
        return ["ip", "netns", "exec", self.name, *command]

    def cut(self) -> None:
        """Take the link away: packets are lost both ways, and nobody is told."""
        ip("-n", self.switch, "link", "set", self.link, "down")

    def mend(self) -> None:
        """Put the link back."""
        ip("-n", self.switch, "link", "set", self.link, "up")


@contextmanager
def hosts(n: int) -> Iterator[list[Host]]:
    """Make hosts that reach each other and nothing else; skips the test where the system refuses namespaces."""
    mark = f"city{os.getpid()}"
    switch = f"{mark}switch"
    with ExitStack() as stack:
        try:
            ip("netns", "add", switch)
            stack.callback(ip, "netns", "del", switch)
            ip("-n", switch, "link", "add", "bridge", "type", "bridge", "forward_delay", "0")
            ip("-n", switch, "link", "set", "bridge", "up")
            found = []
            for k in range(n):
                host = Host(f"{mark}host{k}", switch, f"port{k}", f"{NET}.{k + 1}")
                ip("netns", "add", host.name)
                stack.callback(ip, "netns", "del", host.name)
                ip("-n", switch, "link", "add", host.link, "type", "veth", "peer", "net", "netns", host.name)
                ip("-n", switch, "link", "set", host.link, "master", "bridge", "up")
                ip("-n", host.name, "address", "add", f"{host.address}/24", "dev", "net")
                for link in ("lo", "net"):
                    ip("-n", host.name, "link", "set", link, "up")
                found.append(host)
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no network namespaces here: {getattr(error, 'stderr', None) or error}")
        yield found


def certificates(folder: Path, name: str = "cluster") -> tuple[str, str, str]:
    """Make an authority and a certificate of it as docs/cluster.md does; gives their files, and the key's."""
    folder.mkdir(parents=True)
    for words in (
        f"req -x509 -newkey rsa:2048 -nodes -days 365 -subj /CN={name}-authority -keyout ca.key -out ca.pem",
        f"req -newkey rsa:2048 -nodes -subj /CN={name} -keyout node.key -out node.csr",
        "x509 -req -in node.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 365 -out node.pem",
    ):
        subprocess.run(["openssl", *words.split()], cwd=folder, check=True, capture_output=True)
    return str(folder / "ca.pem"), str(folder / "node.pem"), str(folder / "node.key")


def dask_command(what: str, *words: str, tls: tuple[str, str, str] | None = None) -> list[str]:
    """The command of a scheduler or worker."""
    files = zip(("ca-file", "cert", "key"), tls or (), strict=False)
    given = [word for name, path in files for word in (f"--tls-{name}", path)]
    return [sys.executable, "-m", "dask", what, *words, "--no-dashboard", *given]

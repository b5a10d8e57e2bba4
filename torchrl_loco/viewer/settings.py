"""What a page is served at and how many worlds it shows; it imports nothing that takes seconds."""

import ipaddress
import socket
from urllib.parse import urlsplit

from torchrl_loco.checks import POSITIVE_FRACTION, Interval, check_packages

LOOPBACK = "127.0.0.1"  # address that this machine alone reaches
PORT = 8080
WORLDS = Interval(1, 64, with_high=True)  # how many worlds a page shows
PORTS = Interval(1, 2**16)  # at which a page can be served
SHARE = POSITIVE_FRACTION  # shares of the machine's CPU time that a viewer may take


def check_viewer() -> None:
    """Checks that the extra ``viewer`` is installed."""
    check_packages("the viewer in the browser", ("viser", "mjviser"), "viewer")


def check_host(host: str) -> str:
    """Returns the address to listen on of what a person wrote, who may call this machine ``localhost``."""
    address = ipaddress.ip_address(LOOPBACK if host == "localhost" else host)
    with socket.socket(socket.AF_INET if address.version == 4 else socket.AF_INET6) as probe:
        try:
            probe.bind((str(address), 0))
        except OSError as error:  # viser would wait for ever
            raise OSError(f"host {host} is no address of this machine: {error}") from None
    return str(address)


def url_of(host: str, port: int) -> str:
    """Returns under which URL this machine reaches a page that is served at an address."""
    address = ipaddress.ip_address(host)
    if address.is_unspecified:
        address = ipaddress.ip_address(LOOPBACK if address.version == 4 else "::1")
    return f"http://{address if address.version == 4 else f'[{address}]'}:{port}"


def is_foreign(host: str, named: str | None, origin: str | None) -> bool:
    """Returns whether a request comes from a page of another site, which must neither see nor steer the worlds.

    A page's own requests name one host in both headers. Where this machine alone is served, that must be its own name:
    another site may have its name lead here. ``host`` is what the server listens on, ``named`` the header ``Host``;
    programs that are no browser send no ``origin``.
    """
    if origin is not None and urlsplit(origin).netloc.lower() != (named or "").lower():
        return True
    return ipaddress.ip_address(host).is_loopback and not _is_loopback(urlsplit(f"//{named or ''}").hostname)


def _is_loopback(name: str | None) -> bool:
    try:
        return name == "localhost" or ipaddress.ip_address(name or "").is_loopback
    except ValueError:
        return False

"""Decide which requests reach the viewer: those for the printed address, with its token.

Any page that is open in the user's browser can send requests to this machine, and a name of that page's choice can lead
here. Such requests name another Origin, another Host, and do not have the token.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import secrets
import socket
from typing import Any, Iterator, Optional
from urllib.parse import parse_qs, urlsplit

from legs_loss.errors import LegsError

_THIS_MACHINE = ("127.0.0.1", "localhost", "::1")


class Guard:
    """The rule for requests to a server.

    Args:
        host: where it listens. Beside the names of this machine's loopback, only where that is another address are the
            machine's own name and addresses in numbers taken.
    """

    def __init__(self, host: str) -> None:
        self.host: str = host.lower()
        self.token: str = secrets.token_urlsafe(24)
        self.on: bool = False

    def address(self, port: int) -> str:
        """Return the address to open."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={self.token}"

    def refusal(self, port: int, path: str, headers: Any) -> Optional[str]:
        """Return why a request is refused; None for one of the user's.

        Args:
            port: where the server listens.
            path: of the request, with its query.
            headers: of the request, a mapping with ``get_all``.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0], port):
            return f"this page is reached only by its own name and port {port} only"
        if origins and origins != [f"http://{hosts[0]}"]:
            return "a request of another page"
        query = parse_qs(path.partition("?")[2])
        if "websocket" in query:  # viser's page would obey that server
            return "this page shows no other server"
        known = self.token.encode()
        given = (token.encode("utf-8", "surrogatepass") for token in _tokens(query, port, headers))
        if not any(secrets.compare_digest(token, known) for token in given):
            return "open the whole address that legs view printed, with its token"
        return None

    @contextlib.contextmanager
    def before_every_handshake(self) -> Iterator[None]:
        """Ask this guard about each request to a websockets server that is made meanwhile, also those for files."""
        from websockets.asyncio import server as websockets_server

        serve = websockets_server.serve

        def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
            def check(connection: Any, request: Any) -> Any:
                port = connection.local_address[1]
                refusal = self.refusal(port, request.path, request.headers)
                if refusal is not None:
                    return connection.respond(403, f"Refused: {refusal}.\n")
                response = process_request(connection, request)
                if response is not None:  # the page: from here on the browser has the token, and no other site's page
                    cookie = f"{_cookie(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                    response.headers["Set-Cookie"] = cookie
                return response

            self.on = True
            return serve(*arguments, process_request=check, **options)

        websockets_server.serve = guarded  # type: ignore[assignment, misc]
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # of what is no request, a traceback each
        try:
            yield
        finally:
            websockets_server.serve = serve  # type: ignore[misc]

    def _is_ours(self, host: str, port: int) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, given = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if given != port or parts.netloc != host or "@" in host:
            return False
        if name in _THIS_MACHINE or self.host in _THIS_MACHINE:
            return name in _THIS_MACHINE
        return name in (self.host, socket.gethostname().lower()) or _is_numeric(name)


def check_address(host: str, port: int) -> None:
    """Check that a server can listen at an address.

    Raises:
        LegsError: it is none of this machine's.
    """
    if not 1 <= port <= 65535:
        raise LegsError(f"--port must be between 1 and 65535, got {port}")
    try:
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.bind((host, 0))
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise LegsError(f"--host {host}: not an address of this machine ({why})") from None


def _tokens(query: Any, port: int, headers: Any) -> Iterator[str]:
    yield from query.get("token", [])
    for part in ";".join(headers.get_all("Cookie")).split(";"):
        name, _, value = part.strip().partition("=")
        if name == _cookie(port):
            yield value


def _cookie(port: int) -> str:
    return f"legs_view_{port}"  # cookies know no ports


def _is_numeric(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True

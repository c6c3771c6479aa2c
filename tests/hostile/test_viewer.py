"""``legs view`` and requests of another page: real HTTP and WebSocket clients, whatever they claim to be."""

from __future__ import annotations

import http.client
import socket
import time

import pytest

from legs_loss import LegsError
from legs_loss.lab.ply import write_ply
from legs_loss.lab.viewer.content import find_content
from legs_loss.lab.viewer.guard import check_address
from tests.lab.test_view import free_port, some

viser = pytest.importorskip("viser")
msgpack = pytest.importorskip("msgspec").msgpack
zstandard = pytest.importorskip("zstandard")
client = pytest.importorskip("websockets.sync.client")
from websockets.exceptions import InvalidStatus  # noqa: E402

EVIL = "https://evil.example"


class Page:
    """A server with one splat, and what a client does with it."""

    def __init__(self, address, server):
        self.server, self.address = server, address
        self.root, _, self.query = address.partition("?")
        self.port = server.get_port()

    def connect(self, query="", host=None, origin=None, cookie=None):
        """Open a WebSocket as viser's page does, with these claims."""
        address = f"ws://{host or f'127.0.0.1:{self.port}'}/{query and '?' + query}"
        where = socket.create_connection(("127.0.0.1", self.port))
        headers = {} if cookie is None else {"Cookie": cookie}
        return client.connect(
            address, sock=where, origin=origin, additional_headers=headers, subprotocols=[f"viser-v{viser.__version__}"]
        )

    def get(self, path, **headers):
        """Return the answer's status, its cookie and the first of its bytes."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": f"127.0.0.1:{self.port}", **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        found = answer.status, answer.getheader("Set-Cookie"), answer.read(2000)
        connection.close()
        return found


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"])
def page(request, tmp_path_factory):
    from legs_loss.lab.viewer.server import serve

    path = tmp_path_factory.mktemp("viewer") / "g.ply"
    write_ply(path, some((255, 0, 0), 4))
    server, address = serve(find_content(path), host=request.param, port=free_port())
    yield Page(address, server)
    server.stop()


@pytest.mark.parametrize(
    ("path", "cookie"), [("/", "legs_view_{}=\u00e9\udce9"), ("/", "\u00e9"), ("//[", ""), ("//[?token=a", "")]
)
def test_what_is_no_text_is_refused_and_not_an_error(path, cookie):
    from legs_loss.lab.viewer.guard import Guard

    class Headers(dict):
        def get_all(self, name):
            return [self[name]] if name in self else []

    guard = Guard("127.0.0.1")
    headers = Headers({"Host": "127.0.0.1:8080", "Cookie": cookie.format(8080)})
    assert "with its token" in guard.refusal(8080, path, headers)
    assert guard.refusal(8080, f"{path}?token={guard.token}".replace("?token=a?", "?"), headers) is None


def types(connection):
    """Return the kinds of messages that a server sends at first."""
    found = []
    while "GaussianSplatsMessage" not in found:
        data = connection.recv(timeout=30)
        size = int.from_bytes(data[8:16], "little")
        found += [one["type"] for one in msgpack.decode(zstandard.decompress(data[16 : 16 + size]))["messages"]]
    return found


def test_no_address_is_printed_that_is_refused(tmp_path, capsys):
    from legs_loss.lab.viewer.server import serve

    write_ply(tmp_path / "g.ply", some((255, 0, 0), 4))
    server, address = serve(find_content(tmp_path / "g.ply"), port=free_port())
    server.stop()
    assert "token=" in address
    assert "http" not in capsys.readouterr().out


def test_the_printed_address_shows_the_splats(page):
    status, cookie, body = page.get(f"/?{page.query}")
    assert (status, body[:15].lower()) == (200, b"<!doctype html>")
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    own = f"http://127.0.0.1:{page.port}"
    with page.connect(origin=own, cookie=f'other={{"a":1}}; {cookie.partition(";")[0]}') as connection:
        assert "GaussianSplatsMessage" in types(connection)
    with page.connect(page.query, host=f"localhost:{page.port}") as connection:  # a program, which has no Origin
        assert "GaussianSplatsMessage" in types(connection)


# Host (None: the right one), Origin (None: none), the token; each a thing that another page or a guess would send.
REFUSED = [
    (None, EVIL, True),
    (None, "null", True),
    (None, "http://127.0.0.1:1", True),
    (None, "https://127.0.0.1:PORT", True),
    (None, "http://localhost:PORT", True),
    ("evil.example:PORT", "http://evil.example:PORT", True),  # a name that was made to lead here
    ("127.0.0.1.evil.example:PORT", None, True),
    ("127.0.0.1:1", None, True),
    ("127.0.0.1", None, True),
    (None, None, False),
    (None, "http://127.0.0.1:PORT", False),
]


@pytest.mark.parametrize(("host", "origin", "known"), REFUSED)
def test_what_is_refused_before_the_handshake(page, host, origin, known):
    host, origin = ((text or "").replace("PORT", str(page.port)) or None for text in (host, origin))
    query = page.query if known else "token=guessed"
    with pytest.raises(InvalidStatus) as refused, page.connect(query, host, origin):
        pass
    assert refused.value.response.status_code == 403
    headers = {name: value for name, value in (("Host", host), ("Origin", origin)) if value is not None}
    assert page.get(f"/?{query}", **headers)[0] == 403
    assert page.get(f"/?{query}", **headers, Upgrade="WebSocket", Connection="Upgrade")[0] == 403


def test_the_page_obeys_no_other_server(page):
    assert page.get(f"/?{page.query}&websocket=wss://evil.example")[0] == 403


@pytest.mark.parametrize(
    "host", ["evil@127.0.0.1:PORT", "127.0.0.1:PORT/a", "127.0.0.1:x", "[::1:PORT", "", ":PORT", "::1"]
)
def test_a_host_that_is_no_name(page, host):
    assert page.get(f"/?{page.query}", Host=host.replace("PORT", str(page.port)))[0] == 403


def test_a_number_is_an_address_where_the_network_may_ask(page):
    wanted = 200 if page.server.get_host() == "0.0.0.0" else 403
    assert page.get(f"/?{page.query}", Host=f"192.168.1.7:{page.port}")[0] == wanted


def test_what_is_no_request_is_not_told(page, capfd):
    for data in (b"\0\xff\r\n\r\n", b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", page.port)) as raw:
            raw.sendall(data)
            raw.shutdown(socket.SHUT_WR)
            answer = raw.makefile("rb").read()
        assert not answer or answer.split(b" ")[1] >= b"400"
    page.get(f"/?{page.query}")
    assert "Traceback" not in capfd.readouterr().err


def test_a_share_request_opens_no_tunnel(page, monkeypatch):
    opened = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *arguments, **options: opened.append(arguments))

    def ask(port, query):
        address = f"ws://127.0.0.1:{port}/?{query}"
        with client.connect(address, subprotocols=[f"viser-v{viser.__version__}"]) as connection:
            connection.send(msgpack.encode({"type": "ShareUrlRequest"}))
            for _ in range(20):
                connection.ping().wait(10)
                time.sleep(0.05)
                if opened:
                    return

    ask(page.port, page.query)
    assert opened == []
    plain = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)  # or this test would prove nothing
    try:
        ask(plain.get_port(), "")
        assert opened
    finally:
        plain.stop()


@pytest.mark.parametrize(
    ("host", "port"),
    [("192.0.2.1", 8080), ("no such name", 8080), ("", 8080), ("a" * 80, 8080), ("127.0.0.1", 0), ("127.0.0.1", 70000)],
)
def test_an_address_of_another_machine(host, port):
    with pytest.raises(LegsError, match=r"--(host|port)"):
        check_address(host, port)


NOWHERE = {
    "a place that is no number": ("means", float("nan")),
    "an infinite place": ("means", float("inf")),
    "a place of 1e38": ("means", 1e38),
    "an infinite size": ("log_scales", 1e4),
    "a turn that is no number": ("quaternions", float("nan")),
    "an opacity that is no number": ("opacity_logits", float("nan")),
    "a colour that is no number": ("sh", float("nan")),
}


@pytest.mark.parametrize("what", NOWHERE, ids=lambda what: what.replace(" ", "_"))
def test_what_is_left_out_is_counted(what, tmp_path, capsys):
    from legs_loss.lab.viewer.server import serve

    name, value = NOWHERE[what]
    gaussians = some((255, 0, 0), 16)
    getattr(gaussians, name)[[2, 3, 11]] = value
    write_ply(tmp_path / "g.ply", gaussians)
    server, _ = serve(find_content(tmp_path / "g.ply"), port=free_port())
    server.stop()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{tmp_path / 'g.ply'}: 3 of 16 Gaussians are left out: not finite, or too far or too large" in said
    getattr(gaussians, name)[:] = value
    write_ply(tmp_path / "g.ply", gaussians)
    with pytest.raises(LegsError, match="none of its 16 Gaussians can be shown"):
        serve(find_content(tmp_path / "g.ply"), port=free_port())

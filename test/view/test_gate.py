"""Who gets at the page of `longarm view`: real HTTP requests and WebSocket handshakes."""

import http.client
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import pytest
import viser
import websockets.asyncio.server as sockets
from viser import _messages as viser_messages
from viser.infra import _infra
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from longarm_comp.core.errors import JobError
from longarm_comp.view import server as view_server
from longarm_comp.view.panel import STOPS, Button
from longarm_comp.view.server import Gate, PlainPage, serve_page

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


PRESSED: list[Button] = []
PLAIN = PlainPage(STOPS, PRESSED.append)


@dataclass(frozen=True)
class Page:
    """A page that is being served."""

    gate: Gate
    server: viser.ViserServer

    @property
    def port(self) -> int:
        return self.server.get_port()

    @property
    def cookie(self) -> dict[str, str]:
        return {"Cookie": f"longarm_view_{self.port}={self.gate.token}"}

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def get(self, path: str, **headers: str) -> http.client.HTTPResponse:
        """The response to a request, with its whole body as `body`."""
        asked = http.client.HTTPConnection("127.0.0.1", self.port, timeout=300)
        asked.request("GET", path, headers=headers)
        response = asked.getresponse()
        response.body = response.read()  # type: ignore[attr-defined]
        asked.close()
        return response

    def knock(self, origin: str | None, host: str = "127.0.0.1", **headers: str) -> int:
        """HTTP status of a WebSocket handshake; 101: it is open, and a message came."""
        uri = f"ws://{host}:{self.port}"
        try:
            with (
                socket.create_connection(("127.0.0.1", self.port)) as line,
                connect(
                    uri,
                    sock=line,
                    origin=None if origin is None else Origin(origin),
                    additional_headers=headers,
                    subprotocols=[PROTOCOL],
                    open_timeout=300,
                    proxy=None,
                ) as opened,
            ):
                assert opened.recv(timeout=300)
        except InvalidStatus as refused:
            return refused.response.status_code
        return 101


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    gate = Gate(plain=PLAIN.answer)
    with serve_page(0, gate) as server:
        yield Page(gate, server)


def test_it_listens_on_the_loopback_address_alone(page: Page) -> None:
    where = f"{page.port:04X}"
    listening = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with open(table) as lines:
            for words in (line.split() for line in lines):
                if words[3] == "0A" and words[1].endswith(f":{where}"):
                    listening.append(words[1])
    assert listening == [f"0100007F:{where}"]


def test_the_link_sets_the_cookie_and_hides_the_token(page: Page) -> None:
    link = page.gate.link(page.port)
    assert link.startswith(f"{page.origin}/?code=") and page.gate.token not in link
    assert page.gate.token not in repr(page.gate) and link.partition("=")[2] not in repr(page.gate)
    response = page.get(link.removeprefix(page.origin))
    assert (response.status, response.getheader("Location")) == (303, "/start")
    cookie = response.getheader("Set-Cookie", "")
    assert cookie.startswith(f"longarm_view_{page.port}={page.gate.token};")
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert page.get(link.removeprefix(page.origin)).status == 403  # it opens the page once
    other = page.gate.link(page.port).removeprefix(page.origin)
    assert other != link.removeprefix(page.origin) and page.get(other).status == 303
    assert Gate().token != page.gate.token and len(page.gate.token) >= 32


def test_without_webgl_there_are_buttons_all_the_same(page: Page) -> None:
    """Plain HTML; a press is of this page alone, leads back to it, and is made once."""
    assert page.get("/plain").status == page.get("/start").status == 403
    assert "webgl" in page.get("/start", **page.cookie).body.decode()
    PLAIN.lines = ["the arm <holds>"]
    shown = page.get("/plain", **page.cookie)
    text = shown.body.decode()
    assert "the arm &lt;holds&gt;" in text and "frame-ancestors 'none'" in str(shown.headers)
    ways = dict(re.findall(r'href="([^"]+)" title="[^"]*" style="[^"]*">([^<]+)<', text))
    assert set(ways.values()) == {button.label for button in STOPS}
    press = next(way for way, label in ways.items() if label == "Hold")
    assert page.get(press).status == 403 and not PRESSED
    assert page.get(press, **page.cookie, Origin="http://127.0.0.1:1").status == 403
    assert page.get("/plain/guessed/1", **page.cookie).status == 404 and not PRESSED
    pressed = page.get(press, **page.cookie)
    assert (pressed.status, pressed.getheader("Location")) == (303, "/plain")
    assert [button.label for button in PRESSED] == ["Hold"]


def test_the_page_may_talk_to_its_server_alone_and_is_not_framed(page: Page) -> None:
    response = page.get("/", **page.cookie)
    assert response.status == 200 and b"<html" in response.body  # type: ignore[attr-defined]
    policy = response.getheader("Content-Security-Policy", "")
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["frame-ancestors"] == "'none'"
    assert f"ws://127.0.0.1:{page.port}" in rules["connect-src"]
    for rule in rules.values():
        assert not {"*", "ws:", "http:", "https:"} & set(rule.split())
    assert response.getheader("Referrer-Policy") == "no-referrer"


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/", {}, 403),
        ("/?code=wrong", {}, 403),
        ("/?code=", {}, 403),
        ("/?code=TOKEN", {}, 403),
        ("/?code=CODE&code=CODE", {}, 403),
        ("/", {"Cookie": "longarm_view_PORT=wrong"}, 403),
        ("/", {"Cookie": "longarm_view=TOKEN"}, 403),
        ("/", {"Cookie": "longarm_view_PORT; ;=;l(o=1"}, 403),
        ("/", {"Cookie": "COOKIE", "Host": "evil.example:PORT"}, 403),
        ("/", {"Cookie": "COOKIE", "Host": "127.0.0.1:1"}, 403),
        ("/", {"Cookie": "COOKIE", "Host": "127.0.0.1"}, 403),
        ("/", {"Cookie": "COOKIE", "Origin": "http://evil.example"}, 403),
        ("/?code=CODE", {"Host": "evil.example:PORT"}, 403),
        ("/?code=CODE", {"Origin": "http://evil.example"}, 403),
        ("/other?code=CODE", {}, 403),
        ("/?websocket=ws://evil.example", {"Cookie": "COOKIE"}, 404),
        ("/../setup.py", {"Cookie": "COOKIE"}, 404),
        ("/", {"Cookie": "COOKIE"}, 200),
        ("/", {"Cookie": 'o(t,her="1; COOKIE', "Host": "localhost:PORT"}, 200),
    ],
)
def test_requests(page: Page, path: str, headers: dict[str, str], status: int) -> None:
    def filled(text: str) -> str:
        text = text.replace("COOKIE", page.cookie["Cookie"])
        text = text.replace("CODE", page.gate.link(page.port).partition("=")[2])
        return text.replace("TOKEN", page.gate.token).replace("PORT", str(page.port))

    response = page.get(filled(path), **{name: filled(text) for name, text in headers.items()})
    assert response.status == status
    if status == 403:
        assert response.body.startswith(b"longarm view: ")  # type: ignore[attr-defined]
        assert page.gate.token.encode() not in response.body  # type: ignore[attr-defined]


def test_a_handshake_needs_this_page_as_origin_and_the_cookie(page: Page) -> None:
    assert page.knock(page.origin, **page.cookie) == 101
    assert page.knock(f"http://localhost:{page.port}", host="localhost", **page.cookie) == 101
    assert page.knock(page.origin) == 403
    assert page.knock(None, **page.cookie) == 403
    for origin in (
        *("http://evil.example", "null", f"https://127.0.0.1:{page.port}", "http://127.0.0.1"),
        *(f"http://127.0.0.1:{page.port + 1}", f"http://127.0.0.1:{page.port}.evil.example"),
        f"http://localhost:{page.port}",  # another name than the one in Host
    ):
        assert page.knock(origin, **page.cookie) == 403, origin
    assert page.knock(f"http://evil.example:{page.port}", host="evil.example", **page.cookie) == 403


def test_nobody_can_ask_for_a_public_link(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """viser opens a tunnel to a public server where a client asks for one."""
    asked: list[object] = []
    refuse = type(page.server).request_share_url
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *given: asked.append(given))
    monkeypatch.setattr(
        type(page.server), "request_share_url", lambda self: asked.append(refuse(self))
    )
    wish = msgspec.msgpack.encode(viser_messages.ShareUrlRequest().as_serializable_dict())
    with connect(
        f"ws://127.0.0.1:{page.port}", origin=Origin(page.origin), subprotocols=[PROTOCOL],
        additional_headers=page.cookie, proxy=None,
    ) as opened:  # fmt: skip
        opened.send(wish)
        end = time.monotonic() + 300.0
        while not asked and time.monotonic() < end:
            time.sleep(0.01)
    assert asked == [None]


def test_a_viser_that_serves_in_another_way_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gate must be in the way of every request, or there is no page."""

    class Frozen:
        """What viser would call if it had taken the function before it was wrapped."""

        class asyncio:  # noqa: N801
            class server:  # noqa: N801
                serve = staticmethod(sockets.serve)

        exceptions = _infra.websockets.exceptions
        datastructures = _infra.websockets.datastructures

    monkeypatch.setattr(_infra, "websockets", Frozen)
    with pytest.raises(JobError, match="cannot be guarded"), serve_page(0, Gate()):
        raise AssertionError("it serves without the gate")
    assert view_server.sockets.serve is sockets.serve

"""The page's server: viser's, on the loopback address and behind the gate.

A browser without WebGL gets the same page without a scene: text and the buttons.
"""

import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import rich
import viser
import websockets.asyncio.server as sockets
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from longarm_comp.core.errors import JobError
from longarm_comp.view.panel import Button

Serve = Callable[[ServerConnection, Request], "Response | None"]

LOOPBACK = "127.0.0.1"
_NAMES = (LOOPBACK, "localhost")
_START = "/start"
PATH = "/plain"
START = f"""<!doctype html><title>longarm view</title>
<noscript><a href="{PATH}">state and buttons as plain text</a></noscript>
<script>const c = document.createElement("canvas");
location.replace(c.getContext("webgl2") || c.getContext("webgl") ? "/" : "{PATH}")</script>
"""
"""HTML that leads on to the scene if the browser can draw it, else to the plain page."""
_STYLE = """body{font:16px sans-serif;max-width:40em;margin:1em auto}
a{display:inline-block;padding:.8em 1.2em;margin:.3em .3em .3em 0;color:#fff;border-radius:.3em}"""


class PlainPage:
    """The page at `PATH`, which shows ``lines`` and loads itself anew once a second.

    The addresses of its buttons hold a random key that no other page knows.
    """

    def __init__(self, buttons: Sequence[Button], press: Callable[[Button], None]) -> None:
        self.lines: Sequence[str] = ()
        self._press = press
        key = secrets.token_urlsafe()
        self._buttons = {f"{PATH}/{key}/{k}": button for k, button in enumerate(buttons)}

    def answer(self, path: str) -> str | None:
        """Return the HTML of the page at a path, or None if there is no page.

        It is empty at the address of a button, which is pressed by that; the page is at `PATH`.
        """
        if path in self._buttons:
            self._press(self._buttons[path])
            return ""
        if path != PATH:
            return None
        links = "".join(
            f'<a href="{at}" title="{escape(button.hint)}" '
            f'style="background:rgb{button.colour}">{escape(button.label)}</a>'
            for at, button in self._buttons.items()
        )
        told = "".join(f"<p>{escape(line)}</p>" for line in self.lines)
        return (
            f'<!doctype html><meta http-equiv="refresh" content="1"><title>longarm view</title>'
            f"<style>{_STYLE}</style>{links}{told}"
        )


@dataclass(frozen=True)
class Gate:
    """The gate of the server: it refuses everyone whose cookie is not the token of this start."""

    token: str = field(default_factory=secrets.token_urlsafe, repr=False)
    plain: Callable[[str], str | None] = lambda path: None  # `PlainPage.answer`
    _codes: set[str] = field(default_factory=set, repr=False)

    def link(self, port: int) -> str:
        """Return an address that works once; to open it sets the cookie."""
        code = secrets.token_urlsafe()
        self._codes.add(code)
        return f"http://{LOOPBACK}:{port}/?code={code}"

    def guard(self, serve: Serve) -> Serve:
        """Put the server's function of HTTP requests and WebSocket handshakes behind the gate."""

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            port = connection.local_address[1]
            hosts = [f"{host}:{port}" for host in _NAMES]
            name = f"longarm_view_{port}"  # cookies are shared by all ports of a host
            why = self._find_stranger(request.headers, hosts)
            if why:
                return connection.respond(HTTPStatus.FORBIDDEN, f"longarm view: {why}\n")
            where = urlsplit(request.path)
            if where.path == "/" and self._redeem_code(*parse_qs(where.query).get("code", [])):
                cookie = f"{name}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                return _make_redirect(_START, {"Set-Cookie": cookie})
            cookies = ";".join(request.headers.get_all("Cookie")).split(
                ";"
            )  # also of other servers
            pairs = [cookie.strip().partition("=") for cookie in cookies]
            given = [value.encode() for key, _, value in pairs if key == name]
            if len(given) != 1 or not secrets.compare_digest(given[0], self.token.encode()):
                why = "open the link that `longarm view` printed; it opens the page once"
                return connection.respond(HTTPStatus.FORBIDDEN, f"longarm view: {why}\n")
            page = START if where.path == _START else self.plain(where.path)
            if page is not None and not where.query:
                if not page:  # a button was pressed
                    return _make_redirect(PATH, _policy_headers(hosts))
                body, kind = page.encode(), {"Content-Type": "text/html; charset=utf-8"}
                kind |= {"Content-Length": str(len(body))} | _policy_headers(hosts)
                return Response(HTTPStatus.OK, "OK", Headers(kind), body)
            if where.query:  # the viewer would connect to the server that ?websocket= names
                return connection.respond(HTTPStatus.NOT_FOUND, "longarm view: no such page\n")
            response = serve(connection, request)
            if response is not None:
                response.headers.update(_policy_headers(hosts))
            return response

        return answer

    def _find_stranger(self, headers: Headers, hosts: list[str]) -> str:
        """Say why a request is not from this page; empty if it is."""
        asked, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(asked) != 1 or asked[0] not in hosts:
            return f"Host {', '.join(asked)!r} is not this server; allowed: {', '.join(hosts)}"
        if origins and origins != [f"http://{asked[0]}"]:
            return f"Origin {', '.join(origins)!r} is not this page"
        if not origins and "Upgrade" in headers:
            return "a WebSocket needs an Origin"
        return ""

    def _redeem_code(self, *given: str) -> bool:
        """Use up the code of a link; return whether it was known and not used before."""
        try:
            self._codes.remove(*given)
        except (KeyError, TypeError):  # unknown, another request was quicker; none or several
            return False
        return True


def _make_redirect(to: str, headers: dict[str, str]) -> Response:
    """Return a redirect that the browser must not store, nor name to others as its referrer."""
    private = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
    made = Headers(headers | private | {"Location": to, "Content-Length": "0"})
    return Response(HTTPStatus.SEE_OTHER, "See Other", made)


def _policy_headers(hosts: list[str]) -> dict[str, str]:
    """Return the headers of every page: it may connect to this server alone, and not be framed."""
    sockets = " ".join(f"ws://{host}" for host in hosts)
    return {
        "Content-Security-Policy": (
            "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
            f"connect-src 'self' data: blob: {sockets}; frame-ancestors 'none'; form-action 'none'"
        ),
        "X-Frame-Options": "DENY",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }


class _Server(viser.ViserServer):
    """A viser server without public share links, which any client could request."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextmanager
def serve_page(port: int, gate: Gate) -> Iterator[viser.ViserServer]:
    """Serve a page until the end of the ``with`` block, on the next free port if this one is taken.

    viser has no option to check requests. So the function of `websockets` that it serves with is
    wrapped while it starts. Raises JobError if this version of viser cannot be wrapped.
    """
    serve, guarded = sockets.serve, []

    def behind_the_gate(handler: Any, host: str, port: int, **options: Any) -> Any:
        guarded.append(host)
        options["process_request"] = gate.guard(options["process_request"])
        return serve(handler, host, port, **options)

    console = rich.get_console()  # viser prints an address without the token
    quiet, console.quiet = console.quiet, True
    server = None
    try:
        sockets.serve = behind_the_gate  # type: ignore[assignment,misc]
        try:
            server = _Server(host=LOOPBACK, port=port, verbose=False)
        finally:
            sockets.serve = serve  # type: ignore[misc]
        if set(guarded) != {LOOPBACK}:
            raise JobError("this viser cannot be guarded: pip install 'longarm_comp[view]'")
        yield server
    finally:
        if server is not None:
            server.stop()
        console.quiet = quiet

"""The page's server: viser's, on the loopback address and behind the gate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rich
import viser
import websockets.asyncio.server as sockets

from longarm_comp.core.errors import JobError
from longarm_comp.view.gate import LOOPBACK, Gate


class _Server(viser.ViserServer):
    """Without viser's public link, which any client may ask for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse."""
        return None


@contextmanager
def serving(port: int, gate: Gate) -> Iterator[viser.ViserServer]:
    """Serve a page until the end of the context; on the next free port where this one is taken.

    viser has no option for a check of requests. So the function of `websockets` that it serves
    with is wrapped while it starts.
    """
    serve, guarded = sockets.serve, []

    def behind_the_gate(handler: Any, host: str, port: int, **options: Any) -> Any:
        guarded.append(host)
        options["process_request"] = gate.guarded(options["process_request"])
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

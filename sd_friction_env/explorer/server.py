"""The explorer's server: Bokeh's own. It answers requests for its host names only, and limits the number of pages.

It streams to the page over one socket and loads nothing from elsewhere.

Another site can point its own host name at this machine (DNS rebinding) and would then share the explorer's origin. Its
requests carry that name in Host, so every request is checked before anything else sees it.
"""

import contextlib
import re
import socket
import time
import weakref
import webbrowser
from collections.abc import Callable, Iterable
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.protocol.exceptions import ProtocolError
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import HTTPError, RequestHandler

from sd_friction_env.explorer.model import PlantPicture, passive_curve
from sd_friction_env.explorer.page import Page
from sd_friction_env.physics.parameters import OscillatorParameters

HOST = "127.0.0.1"
PORT = 5006
SESSIONS, MOST_SESSIONS = 8, 1000  # pages at a time, unless said otherwise, and at most
EVERYWHERE = "0.0.0.0"
_NAME = re.compile(r"([a-z0-9]([a-z0-9._-]*[a-z0-9])?|\[[0-9a-f:.]+\])(?P<port>:[0-9]{1,5})?", re.IGNORECASE)
_LEFT = 3_000  # milliseconds without a connection, after which a page gives way to another
_LARGEST_MESSAGE = 1_000_000  # bytes from a browser; a slider's are a few hundred


def served_hosts(host: str, port: int, allowed: Iterable[str] = ()) -> frozenset[str]:
    """Return what a request's Host may be: the names the explorer was started for, with its port, in lower case.

    Args:
        host, port: where it listens. allowed: further names; with a port if it is another (of a proxy, say).

    Raises:
        ValueError: if one of them is no name.
    """
    hosts = set()
    for name in ["localhost", "127.0.0.1", "[::1]", *(_own_names() if host == EVERYWHERE else [host]), *allowed]:
        found = _NAME.fullmatch(name)
        if found is None:
            raise ValueError(f"a host must be a name or an address, with or without a port, got {name!r}")
        hosts.add(name if found["port"] else f"{name}:{port}")
    # Browsers leave out the port that goes with http and https.
    hosts |= {name.removesuffix(usual) for name in hosts for usual in (":80", ":443") if name.endswith(usual)}
    return frozenset(name.lower() for name in hosts)


def _own_names() -> set[str]:
    """Return this machine's name and the IPv4 addresses that it knows of."""
    names = {socket.gethostname()}
    with contextlib.suppress(OSError):
        names |= {str(found[4][0]) for found in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing: it asks which address leads out
        names.add(probe.getsockname()[0])
    return names


class _Refusal(RequestHandler):
    def initialize(self, hosts: frozenset[str]) -> None:
        self.hosts = hosts

    def prepare(self) -> None:
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(
            f"Refused: this explorer answers requests for {', '.join(sorted(self.hosts))} alone, and none that come "
            "from another site. To serve it under a further name: sd-friction explore --allow-host NAME.\n"
        )


class ExplorerApplication(BokehTornado):  # type: ignore[misc]
    """The explorer's pages, for listed hosts alone and no more than so many at a time.

    Args:
        hosts: that a request may be for, :func:`served_hosts`. sessions: pages at a time.
    """

    def __init__(self, hosts: frozenset[str], sessions: int) -> None:
        super().__init__(
            {"/": Application(FunctionHandler(self._open_page))},
            extra_websocket_origins=sorted(hosts),
            websocket_max_message_size_bytes=_LARGEST_MESSAGE,
        )
        self.hosts, self.sessions = hosts, sessions
        self._pages: weakref.WeakSet[Page] = weakref.WeakSet()
        self._sockets: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()  # with the session's id
        (self._context,) = self.applications.values()
        self._create_session = self._context.create_session_if_needed
        self._context.create_session_if_needed = self._create_session_if_there_is_room

    def find_handler(self, request: HTTPServerRequest, **arguments: Any) -> Any:
        """Return what answers a request; all of them come here first, those that open a websocket too."""
        if self._is_listed(request):
            return super().find_handler(request, **arguments)
        return self.get_handler_delegate(request, _Refusal, {"hosts": self.hosts})

    def _is_listed(self, request: HTTPServerRequest) -> bool:
        headers = request.headers  # not request.host: where there is no Host, Tornado takes 127.0.0.1 for it
        hosts = headers.get_list("Host")
        origins = [*headers.get_list("Origin"), *headers.get_list("Sec-WebSocket-Origin")]
        named = [*hosts, *(re.sub("^https?://", "", origin) for origin in origins)]
        return len(hosts) == 1 and all(name.lower() in self.hosts for name in named)

    async def _create_session_if_there_is_room(self, session_id: str, request: Any = None, token: Any = None) -> Any:
        def is_too_many() -> bool:
            known = self._context._sessions.keys() | self._context._pending_sessions.keys()
            return session_id not in known and len(known) >= self.sessions

        if is_too_many():
            await self._context._cleanup_sessions(_LEFT)
        if is_too_many():
            full = f"the {self.sessions} pages that this explorer serves at a time are open, close one of them first"
            raise ProtocolError(full) if request.path.endswith("/ws") else HTTPError(503, reason=full)
        return await self._create_session(session_id, request, token)

    def _open_page(self, document: Any) -> None:
        session_id = document.session_context.id
        self._pages.add(Page(document, on_idle=lambda: self._hang_up(session_id)))

    def _hang_up(self, session_id: str) -> None:
        """Close a session's connections; Bokeh then forgets it, and its token is too old to come back with."""
        for handler in [handler for handler, its_id in self._sockets.items() if its_id == session_id]:
            handler.close(1000, "idle")

    def new_connection(self, protocol: Any, socket: Any, application_context: Any, session: Any) -> Any:
        """Return a new connection to a session."""
        self._sockets[socket] = session.id
        return super().new_connection(protocol, socket, application_context, session)

    def stop(self, wait: bool = True) -> None:
        """Stop the pages too."""
        for page in list(self._pages):
            page.end()
        super().stop(wait)


def make_server(host: str, port: int, allowed: Iterable[str] = (), sessions: int = SESSIONS) -> tuple[BaseServer, str]:
    """Return the explorer's server, which listens and answers once its loop runs, and its address.

    Args:
        host, port, allowed, sessions: as of :func:`serve`.

    Raises:
        OSError: if it cannot listen there. ValueError: if a name is none.
    """
    allowed = list(allowed)
    served_hosts(host, port, allowed)
    listening = socket.create_server((host, port))
    listening.setblocking(False)
    port = listening.getsockname()[1]
    application = ExplorerApplication(served_hosts(host, port, allowed), sessions)
    http = HTTPServer(application)
    http.add_sockets([listening])
    server = BaseServer(IOLoop.current(), application, http)
    return server, f"http://{'localhost' if host == EVERYWHERE else host}:{port}/"


def serve(
    host: str = HOST,
    port: int = PORT,
    *,
    allowed: Iterable[str] = (),
    sessions: int = SESSIONS,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Offer the explorer until interrupted.

    Args:
        host: address to listen at; others than this machine can come only if it is not a loopback address.
        port: 0: any that is free. allowed: further names that a request may be for, see
            :func:`served_hosts`. sessions: pages at a time, at least 1.
        browser: open one. say: receives the page's address.

    Raises:
        OSError: if the port is taken. ValueError: if a name is none.
    """
    server, address = make_server(host, port, allowed, sessions)
    # Compiled before the first page asks for it.
    PlantPicture.of(OscillatorParameters())
    begun = time.perf_counter()
    passive_curve(OscillatorParameters())
    took = time.perf_counter() - begun
    server.start()
    say(f"The explorer is at {address} (a curve takes {1e3 * took:.0f} ms); Ctrl-C ends it.")
    if browser:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        say("")
    finally:
        server.stop()

"""Checks who uses the page and what it sends, in one place, before viser reads anything.

A browser lets every web page open a WebSocket to this machine. Three rules keep strangers out:

- A request must name a host that the page is served under (`Host`), so that a name which an
  attacker resolves to this machine reaches nothing.
- A request with an `Origin` must come from a page of the same host and port. Browsers send one with
  every WebSocket; programs that send none are let in: whatever runs on this machine could steer
  anyway.
- A message must set a control of the page to a value that the control offers, trigger one of its
  keys, or say where the page's camera is. Other messages are dropped; among them are viser's
  uploads and its public tunnel.
"""

import asyncio
import ipaddress
import math
import socket
import threading
import urllib.parse
from collections.abc import Awaitable, Callable
from typing import Any

from polypod import _core
from polypod.extras import package

LARGEST_MESSAGE = 1 << 16
"""Bytes of a message; the largest one that the page sends has some hundred."""
LARGEST_NUMBER = 1e9
"""Largest number of a camera's pose."""
TOLERANCE = 1e-6
"""Share of a slider's range by which a page's rounding may leave it."""
_CAMERA = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
_LENS = ("fov", "near", "far", "image_height", "image_width")
_PATIENCE = 0.02
"""Time between two looks at whether the page is ready, s."""
_serve_lock = threading.Lock()


class Gate:
    """Decides about requests and messages of one page."""

    def __init__(self, host: str) -> None:
        """Lets nobody in before `open`.

        Args:
            host: address that the page is served at.
        """
        self._names = {"localhost", host.lower()}
        self.is_public = not _is_loopback(host)
        """Whether other machines reach the page."""
        if self.is_public:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local"}
        self._is_open = False
        self._controls: dict[str, Any] = {}
        self._keys: set[str] = set()

    def open(self) -> None:
        """Lets pages in."""
        self._is_open = True

    def offer(self, handle: Any) -> None:
        """Lets pages set a control of viser's to the values that it offers."""
        self._controls[handle._impl.uuid] = handle

    def offer_key(self, handle: Any) -> None:
        """Lets pages trigger a command of viser's."""
        self._keys.add(handle._impl.uuid)

    def refusal(self, hosts: list[str], origins: list[str]) -> str | None:
        """Why a request with these headers is refused; None: it is not."""
        if len(hosts) != 1:
            return "a request names one Host"
        host = _split(f"http://{hosts[0]}")
        if host is None or not self._is_served_as(host[0]):
            return "this page is not served under that name; open it by the address that polypod printed"
        if not origins:
            return None
        # a browser leaves out the port that is usual for the scheme
        scheme = "https" if origins[0].lower().startswith("https:") else "http"
        if len(origins) > 1 or _split(origins[0]) is None or _split(origins[0]) != _split(f"{scheme}://{hosts[0]}"):
            return "another web page may not use this one"
        return None

    def admits(self, frame: str | bytes) -> bool:
        """Whether a message is one that the page may send."""
        if not isinstance(frame, bytes):
            return False
        try:
            message = package("msgspec.msgpack", "the viewer", "play").decode(frame)
        except Exception:  # whatever bytes of a stranger do to a decoder
            return False
        return isinstance(message, dict) and self._is_offered(message)

    def _is_offered(self, message: dict[Any, Any]) -> bool:
        kind, keys = message.get("type"), message.keys() - {"type"}
        if kind == "ViewerCameraMessage":
            return keys == {*_CAMERA, *_LENS} and _is_pose(message)
        uuid = message.get("uuid")
        if not isinstance(uuid, str):
            return False
        if kind == "CommandTriggerMessage":
            return keys == {"uuid"} and uuid in self._keys
        updates = message.get("updates")
        return (
            kind == "GuiUpdateMessage"
            and keys == {"uuid", "updates"}
            and isinstance(updates, dict)
            and updates.keys() == {"value"}
            and uuid in self._controls
            and offers(self._controls[uuid], updates["value"])
        )

    def _is_served_as(self, name: str) -> bool:
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return address.is_loopback or self.is_public

    def _respond(self, inner: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """The check of a request, then what viser does with it."""

        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            problem = self.refusal(headers.get_all("Host"), headers.get_all("Origin"))
            return inner(connection, request) if problem is None else connection.respond(403, f"{problem}\n")

        return check

    def _filter(self, handler: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
        """Viser's handler of a connection, which gets the messages that pass."""

        async def handle(connection: Any) -> None:
            while not self._is_open:
                await asyncio.sleep(_PATIENCE)
                if connection.close_code is not None or connection.state.name != "OPEN":
                    return
            receive = connection.recv

            async def admitted(*arguments: Any, **options: Any) -> Any:
                while not self.admits(frame := await receive(*arguments, **options)):
                    pass
                return frame

            connection.recv = admitted
            await handler(connection)

        return handle


def offers(handle: Any, value: Any) -> bool:
    """Whether a control of viser's offers a value: an option, a number in range, yes or no."""
    if handle.disabled:
        return False
    options = getattr(handle, "options", None)
    if options is not None:
        return isinstance(value, str) and value in options
    low, high = getattr(handle, "min", None), getattr(handle, "max", None)
    if low is None or high is None:
        return isinstance(value, bool)
    slack = TOLERANCE * (high - low)
    return _is_number(value) and low - slack <= value <= high + slack


def open_server(gate: Gate, host: str, port: int) -> Any:
    """Viser's server behind a gate, which has still to be opened.

    viser has no setting for the origins that it serves or for the messages that it takes. While it
    starts, `websockets.asyncio.server.serve` is therefore one that adds them.

    Raises:
        ConfigError: for a version of viser that starts its server in another way.
    """
    viser = package("viser", "the viewer", "play")
    sockets = package("websockets.asyncio.server", "the viewer", "play")
    guarded = threading.Event()
    with _serve_lock:
        serve = sockets.serve

        def serve_behind_gate(handler: Any, *arguments: Any, **options: Any) -> Any:
            if not handler.__module__.startswith("viser."):
                return serve(handler, *arguments, **options)
            options["process_request"] = gate._respond(options["process_request"])
            options["max_size"] = LARGEST_MESSAGE
            guarded.set()
            return serve(gate._filter(handler), *arguments, **options)

        sockets.serve = serve_behind_gate
        try:
            server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            sockets.serve = serve
    if not guarded.is_set():
        server.stop()
        raise _core.ConfigError(
            f"viser {viser.__version__} cannot be kept from other web pages; install the version of the extra play: "
            "pip install 'polypod[play]'"
        )
    return server


def wake_safely(buffer: Any) -> None:
    """Lets a buffer of viser's be filled by any thread.

    It has to be called before anything waits for the buffer.

    viser sets the buffer's event in the thread that adds a message, while asyncio's events belong
    to their loop: a page that connects or leaves at this moment would end the thread with "deque
    mutated during iteration".
    """
    buffer.message_event = _EventOfAnyThread(buffer.event_loop)


class _EventOfAnyThread(asyncio.Event):
    """An event that other threads than its loop's may set; they do so in the loop's next turn."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._home = loop
        self._is_due = False

    def set(self) -> None:
        """Wakes whoever waits."""
        try:
            at_home = asyncio.get_running_loop() is self._home
        except RuntimeError:
            at_home = False
        if at_home:
            self._is_due = False
            super().set()
        elif not self._is_due:
            self._is_due = True
            try:
                self._home.call_soon_threadsafe(self.set)
            except RuntimeError:  # the loop has ended, and nobody waits
                self._is_due = False


def _split(origin: str) -> tuple[str, int] | None:
    """Host and port of an origin; None for anything else."""
    try:
        parts = urllib.parse.urlsplit(origin)
        port = parts.port
    except ValueError:
        return None
    usual = {"http": 80, "https": 443}.get(parts.scheme)
    extra = parts.username or parts.password or parts.path or parts.query or parts.fragment
    if usual is None or extra or not parts.hostname:
        return None
    return parts.hostname.rstrip("."), usual if port is None else port


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _is_pose(message: dict[Any, Any]) -> bool:
    vectors = [(message[name], count) for name, count in _CAMERA.items()]
    numbers = [message[name] for name in _LENS]
    for vector, count in vectors:
        if not isinstance(vector, list) or len(vector) != count:
            return False
        numbers += vector
    return all(_is_number(number) and abs(number) <= LARGEST_NUMBER for number in numbers)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)

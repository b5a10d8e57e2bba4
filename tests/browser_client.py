"""A page of the viewer without a browser: what one sends and receives over its WebSocket."""

import contextlib
import threading
import time
from collections import deque

import msgspec
import viser
from viser import _messages as messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


class Client:
    """An open page, which counts as one once its camera is known."""

    def __init__(self, socket, server):
        self._socket = socket
        self.look_from(3.0)
        if server is not None:
            self._until(server.get_clients)

    def look_from(self, x):
        place = (1.0, 0.0, 0.0, 0.0), (x, 0.0, 1.0), 1.0, 0.1, 100.0, 480, 640, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
        self._send(messages.ViewerCameraMessage(*place))

    def set(self, control, value):
        """Does what a person does to a control, and waits until the server knows."""
        before = control.update_timestamp
        self._send(messages.GuiUpdateMessage(control._impl.uuid, {"value": value}))
        self._until(lambda: control.update_timestamp != before)
        time.sleep(0.02)  # callbacks run in threads

    def ask_for_a_tunnel(self):
        self._send(messages.ShareUrlRequest())
        time.sleep(0.1)

    def _send(self, message):
        self._socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    @staticmethod
    def _until(happened):
        ends = time.monotonic() + 20
        while not happened():
            assert time.monotonic() < ends
            time.sleep(0.005)


def _drain(socket):
    """Takes what the server sends, until the connection is closed."""
    with contextlib.suppress(ConnectionClosed):
        deque(socket, maxlen=0)


@contextlib.contextmanager
def open_page(viewer):
    """Opens the page of a viewer, or of another process by its URL, as a browser does."""
    url, server = (viewer, None) if isinstance(viewer, str) else (viewer.url, viewer.page.server)
    version = f"viser-v{viser.__version__}"
    with connect(url.replace("http", "ws"), origin=url, subprotocols=[version], max_size=None) as socket:
        reader = threading.Thread(target=_drain, args=(socket,))
        reader.start()
        yield Client(socket, server)
    reader.join()

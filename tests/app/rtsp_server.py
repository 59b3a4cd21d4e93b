"""An RTSP server on a loopback address, just enough of RFC 2326: one client, MPEG-TS as RTP within TCP."""

from __future__ import annotations

import io
import socketserver
import struct
import threading
import time
from collections.abc import Sequence
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray

_CHUNK = 7 * 188  # bytes of a packet: whole ones of MPEG-TS
_MP2T = 33  # RTP's number of MPEG-TS, RFC 3551
_SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\nm=video 0 RTP/AVP 33\r\na=control:track\r\n"


def transport_stream(images: Sequence[NDArray[np.uint8]], fps: int, bframes: int = 0) -> bytes:
    """Encode images (H, W, 3) RGB as H.264 in an MPEG transport stream."""
    whole = io.BytesIO()
    with av.open(whole, "w", format="mpegts") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps))
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"g": "10", "bf": str(bframes)}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode())
    return whole.getvalue()


def _packet(number: int, seconds: float, chunk: bytes) -> bytes:
    """Return an RTP packet (RFC 3550) as it goes in an RTSP connection (RFC 2326, 10.12)."""
    head = struct.pack(">BBHII", 0x80, _MP2T, number & 0xFFFF, int(90_000 * seconds), 1)
    return struct.pack(">cBH", b"$", 0, len(head) + len(chunk)) + head + chunk


class _Handler(socketserver.StreamRequestHandler):
    server: RtspServer

    def handle(self) -> None:
        try:
            while self._answer() != "PLAY":
                pass
            self._play()
        except OSError:
            return  # the reader has gone

    def _answer(self) -> str:
        lines = []
        while line := self.rfile.readline().decode().strip():
            lines.append(line)
        if not lines:
            raise OSError("closed")
        method = lines[0].split()[0]
        fields = dict(line.split(": ", 1) for line in lines[1:])
        body = _SDP if method == "DESCRIBE" else ""
        head = f"RTSP/1.0 200 OK\r\nCSeq: {fields['CSeq']}\r\nSession: 1\r\n"
        head += {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n",
            "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n",
        }.get(method, "")
        self.wfile.write(f"{head}\r\n{body}".encode())
        return method

    def _play(self) -> None:
        content, seconds = self.server.content, self.server.seconds
        begin, count = time.monotonic(), -(-len(content) // _CHUNK)
        for number in range(count):
            due = seconds * number / count
            time.sleep(max(0.0, begin + due - time.monotonic()))
            if number == self.server.breaks_at:
                return
            self.wfile.write(_packet(number, due, content[_CHUNK * number : _CHUNK * (number + 1)]))


class RtspServer(socketserver.ThreadingTCPServer):
    """Plays a transport stream once, as long as ``seconds``; use as a context manager.

    Args:
        content: the stream.
        seconds: how long it is.
        breaks_at: number of the packet before which the connection breaks off, None for the end.
    """

    daemon_threads = True

    def __init__(self, content: bytes, seconds: float, breaks_at: int | None = None) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content, self.seconds, self.breaks_at = content, seconds, breaks_at
        self.address = f"rtsp://127.0.0.1:{self.server_address[1]}/stream"

    def __enter__(self) -> RtspServer:
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

"""Live cameras: addresses that are served here, connections that break, and cameras that are slow or gone."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from predicting import run
from videos import number_of, numbered, write_video

import saunet
from saunet.errors import ConfigError, DataError
from saunet.io import live
from saunet.io.live import CameraReader, live_source, live_title
from saunet.io.video import VideoReader
from saunet.prediction.predictor import Predictor
from saunet.prediction.sinks import VideoSink
from saunet.prediction.sources import Frame

FPS = 25


class Server:
    """A camera on the network that serves each connection in turn with a function."""

    def __init__(self, serve: Callable[[socket.socket, Callable[[], int]], None]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.sent: dict[int, float] = {}
        """Frame -> when it was sent."""
        self.closed = False
        self._numbers = itertools.count()
        self._serve = serve
        threading.Thread(target=self._run, daemon=True).start()

    def next(self) -> int:
        """Return the number of the next frame, at its time."""
        number = next(self._numbers)
        time.sleep(1 / FPS)
        self.sent[number] = time.monotonic()
        return number

    def _run(self) -> None:
        while not self.closed:
            try:
                connection, _ = self._listener.accept()
                with connection:
                    self._serve(connection, self.next)
            except (OSError, av.FFmpegError):  # the reader went away, or the test ended
                continue

    def close(self) -> None:
        self.closed = True
        self._listener.close()


@pytest.fixture
def served() -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def start(serve: Callable[..., None]) -> Server:
        servers.append(Server(serve))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


class _Pipe:
    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def write(self, data: bytes) -> int:
        self._connection.sendall(data)
        return len(data)


def transport_stream(frames: int = 10**6, http: bool = True) -> Callable[[socket.socket, Callable[[], int]], None]:
    """H.264 in an MPEG transport stream, as encoders send it; the connection breaks after so many frames."""

    def serve(connection: socket.socket, number: Callable[[], int]) -> None:
        if http:
            connection.recv(4096)
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: video/mp2t\r\nConnection: close\r\n\r\n")
        with av.open(_Pipe(connection), "w", format="mpegts", options={"flush_packets": "1"}) as out:
            options = {"preset": "ultrafast", "tune": "zerolatency", "g": "10"}
            stream: Any = out.add_stream("libx264", rate=FPS, options=options)
            stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
            for _ in range(frames):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(number() % 256), "rgb24")))

    return serve


def pictures(connection: socket.socket, number: Callable[[], int]) -> None:
    """One JPEG after the other, as many network cameras send them."""
    connection.recv(4096)
    head = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n"
    connection.sendall(head)
    while True:
        data = cv2.imencode(".jpg", numbered(number() % 256)[..., ::-1])[1].tobytes()
        part = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
        connection.sendall(part.encode() + data + b"\r\n")


@pytest.mark.parametrize(
    ("serve", "address"),
    [
        (transport_stream(), "http://user:secret@127.0.0.1:{}/drive.ts?token=1"),
        (transport_stream(http=False), "tcp://127.0.0.1:{}"),
        (pictures, "http://127.0.0.1:{}/video"),
    ],
    ids=["http", "tcp", "jpeg"],
)
def test_latency_stays_under_three_frames(served: Callable[..., Server], serve: Any, address: str) -> None:
    """From the moment a frame is sent to the moment it can be predicted, encoding and decoding included."""
    server = served(serve)
    camera = CameraReader(address.format(server.port))
    waited: list[float] = []
    seen: list[int] = []
    for frame in itertools.islice(camera.frames(), 60):
        seen.append(number_of(frame.image))
        waited.append(time.monotonic() - server.sent[seen[-1]])
    camera.close()
    assert "secret" not in camera.name
    assert "token" not in camera.name
    assert seen == sorted(set(seen))
    steady = waited[20:]  # probing a stream takes its first frames
    # A transport stream alone takes two frames: a picture ends where the next begins, for the demuxer and the parser.
    assert np.median(steady) < (1 if serve is pictures else 3) / FPS


def test_a_nano_model_keeps_up_with_25_frames_per_second(
    served: Callable[..., Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the moment a frame is sent to the moment its depth is in the video: under three frames' time."""
    depth = saunet.build("model", "sau_net_nano", pose=None).depth
    server, late = served(pictures), list[float]()
    add = VideoSink.add

    def added(sink: VideoSink, frame: Frame, *more: Any) -> None:
        add(sink, frame, *more)
        late.append(time.monotonic() - server.sent[number_of(frame.read())])

    monkeypatch.setattr(VideoSink, "add", added)
    result = run(Predictor(depth, 32, 96), f"http://127.0.0.1:{server.port}", tmp_path, max_frames=80)
    assert result.frames == 80
    assert np.quantile(late[20:], 0.9) < 3 / FPS
    print(
        f"sau_net_nano: median {np.median(late[20:]):.3f} s, 90 % {np.quantile(late[20:], 0.9):.3f} s; {result.notes}"
    )


def test_what_comes_too_fast_is_dropped_and_the_newest_is_taken(served: Callable[..., Server]) -> None:
    server = served(pictures)
    camera = CameraReader(f"http://127.0.0.1:{server.port}/")
    late = []
    for frame in itertools.islice(camera.frames(), 8):
        time.sleep(5 / FPS)  # the work of five frames
        late.append(time.monotonic() - server.sent[number_of(frame.image)])
    camera.close()
    assert camera.dropped >= 15
    assert max(late[2:]) < (5 + 5 + 3) / FPS  # one turn of waiting, one of work
    assert f"{camera.dropped} frames arrived faster" in " ".join(camera.notes)


def test_a_lost_connection_is_opened_again(served: Callable[..., Server], predictor: Predictor, tmp_path: Path) -> None:
    server = served(transport_stream(frames=40))
    address = f"http://127.0.0.1:{server.port}/cam.ts"
    result = run(predictor, address, tmp_path, max_frames=60)
    assert (result.frames, result.exit_code) == (60, 0)
    with VideoReader(tmp_path / "127_0_0_1_cam_disparity.mp4") as reader:
        frames = list(reader.frames())
    assert len(frames) == 60
    assert max(np.diff([frame.time for frame in frames])) > 0.2  # the gap is in its times
    assert any("was lost and reopened" in note for note in result.notes)
    assert "median" in result.notes[0]
    assert result.notes[0] in str(result)


def test_a_camera_that_stays_away_ends_the_recording_completely(
    served: Callable[..., Server], predictor: Predictor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "_PATIENCE", 0.3)
    monkeypatch.setattr(live, "_SILENCE", 0.5)
    server = served(lambda connection, number: (transport_stream(40)(connection, number), server.close()))
    result = run(predictor, f"http://127.0.0.1:{server.port}", tmp_path)
    assert result.frames >= 10
    assert result.exit_code == 1
    assert "has given no picture" in result.failures[0]
    with VideoReader(tmp_path / "127_0_0_1_disparity.mp4") as reader:
        assert len(list(reader)) == result.frames


def test_ctrl_c_ends_a_recording_that_waits_for_its_camera(
    served: Callable[..., Server], predictor: Predictor, tmp_path: Path
) -> None:
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals arrive in the main thread, and the tests run in another")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell job ignores it
    server = served(lambda connection, number: (transport_stream(50)(connection, number), server.close()))
    timer = threading.Timer(3.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        result = run(predictor, f"http://127.0.0.1:{server.port}", tmp_path)
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)
    assert result.frames >= 5
    assert result.exit_code == 0
    assert (tmp_path / "127_0_0_1_disparity.mp4").is_file()


def test_refused(served: Callable[..., Server], tmp_path: Path) -> None:
    closed = socket.create_server(("127.0.0.1", 0))
    port = closed.getsockname()[1]
    closed.close()
    with pytest.raises(DataError, match=r"tcp://127.0.0.1:\d+ gives no picture"):
        CameraReader(f"tcp://user:secret@127.0.0.1:{port}")
    with pytest.raises(DataError, match="/dev/video97 gives no picture"):
        CameraReader("/dev/video97")
    with pytest.raises(ConfigError, match=r"kind of address of gopher://x/y is 'gopher'.*rtsp"):
        live_source("gopher://me:secret@x/y")
    video = write_video(tmp_path / "a.mp4", 30).read_bytes()

    def finished(connection: socket.socket, number: Callable[[], int]) -> None:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(video) + video)

    with pytest.raises(DataError, match=r"a\.mp4 is a finished video.*download it"):
        CameraReader(f"http://127.0.0.1:{served(finished).port}/a.mp4")


def test_what_names_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert [live_source(each) for each in (0, "1", "/dev/video2", "rtsp://a/b")] == [0, 1, "/dev/video2", "rtsp://a/b"]
    Path("7").mkdir()
    assert [live_source(each) for each in ("7", "drive.mp4", Path("a"), ["b"])] == [None] * 4
    names = [
        live_title(each) for each in (0, "/dev/video2", "rtsp://me:secret@10.0.0.5:554/s/main.sdp?x=1", "tcp://h:1")
    ]
    assert names == ["camera0", "video2", "10_0_0_5_main", "h"]

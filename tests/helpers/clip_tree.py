"""Small clips of a camera of one's own: a texture that slides by, as folders of frames and as videos."""

from __future__ import annotations

import cv2
import numpy as np

CAMERA = "image_size: [320, 200]\nK: [250, 252, 158.0, 101.0]\nfps: 10\ncamera_height: 1.4\n"


def texture(seed=0):
    noise = np.random.default_rng(seed).integers(0, 255, (60, 400, 3), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(noise, (1600, 240), interpolation=cv2.INTER_CUBIC), (0, 0), 1.5)


def frames(count=10, step=4, seed=0, size=(200, 320)):
    """Return RGB frames that move by ``step`` pixels each (or by each number of a list)."""
    world = texture(seed)
    steps = [step] * count if isinstance(step, int) else list(step)
    places = np.cumsum([0, *steps[1:]])
    return [np.ascontiguousarray(world[: size[0], place : place + size[1]]) for place in places]


def make_clip(root, name, pictures=None, camera=CAMERA, suffix=".png"):
    """Write a folder of frames; a camera file at the root unless there is one."""
    folder = root / name
    folder.mkdir(parents=True)
    for number, picture in enumerate(frames() if pictures is None else pictures):
        cv2.imwrite(str(folder / f"frame_{number}{suffix}"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if camera and not (root / "camera.yaml").exists():
        (root / "camera.yaml").write_text(camera)
    return folder


def make_video(path, pictures=None, fps=10, camera=CAMERA):
    """Write a video; a camera file beside it unless there is one."""
    pictures = frames() if pictures is None else pictures
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
    if camera and not (path.parent / "camera.yaml").exists():
        (path.parent / "camera.yaml").write_text(camera)
    return path

"""Rendered frames as training samples: crops, camera normalization and photometric changes.

Depth is taught as a camera of KITTI's angle would see it: a network cannot tell a longer lens from a nearer object, so
depth is multiplied by ``CANONICAL_FOCAL`` over the focal length in image widths. The same factor applies to a motion's
translation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.io.atomic import replacing

CANONICAL_FOCAL = 0.58
"""Focal length over image width of KITTI's color cameras."""
HEIGHT, WIDTH = 192, 640
"""Of rendered frames."""
Array = NDArray[np.float32]


def save(path: Path, data: dict[str, Any]) -> None:
    """Write a scene's file whole or not at all."""
    sizes = np.array([len(x) for x in data["images"]])
    plain = {**data, "images": np.frombuffer(b"".join(data["images"]), np.uint8), "sizes": sizes}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **plain)


class Frames:
    """All frames of a folder of rendered scenes, kept in memory as JPEG and half-precision depth.

    Args:
        folder: Files written by render.py; `refresh` takes in those that came later.
        every: Use each scene whose number modulo ``of`` is in ``every``: a split into training and held-out scenes.
        of: See ``every``.
    """

    def __init__(self, folder: Path, every: range = range(1, 20), of: int = 20) -> None:
        self.folder, self.every, self.of = folder, every, of
        self.seen: set[str] = set()
        self.images: list[NDArray[np.uint8]] = []
        self.depths: list[NDArray[np.float16]] = []
        self.K: list[Array] = []
        self.T: list[NDArray[np.float64]] = []
        self.pairs: list[int] = []
        """Indices of first frames of pairs; the second follows."""
        self.refresh()

    def refresh(self) -> int:
        """Read the files that appeared since; return the number of frames."""
        for path in sorted(self.folder.glob("*.npz")):
            if path.name in self.seen or int(path.stem) % self.of not in self.every:
                continue
            self.seen.add(path.name)
            with np.load(path) as data:
                ends = np.cumsum(np.concatenate([[0], data["sizes"]]))
                blob, depth, second = data["images"], data["depth"], data["second"]
                K, T = data["K"], data["T_world_cam"]
            seen = [in_the_open(z) for z in depth]
            for i in range(len(depth)):
                if not seen[i] or (second[i] and not seen[i - 1]):
                    continue  # the camera stands inside of something
                if second[i]:
                    self.pairs.append(len(self.images) - 1)
                self.images.append(blob[ends[i] : ends[i + 1]])
                self.depths.append(depth[i])
                self.K.append(K[i])
                self.T.append(T[i])
        return len(self.images)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return a frame, h w 3 RGB."""
        return cv2.imdecode(self.images[index], cv2.IMREAD_COLOR)[..., ::-1]

    def depth_sample(
        self, rng: np.random.Generator, index: int, size: tuple[int, int], augment: bool = True
    ) -> tuple[Array, Array]:
        """Return an image in [0, 1], h w 3, and its canonical depth, h w (0 in the sky)."""
        image, depth = self.image(index), self.depths[index].astype(np.float32)
        window = crop_window(rng, image.shape[:2], size, augment)
        x = crop(image, window, size, cv2.INTER_AREA)
        depth = close_gaps(depth)
        z = crop(depth, window, size, cv2.INTER_NEAREST)
        focal = self.K[index][0, 0] / (window[3] - window[2])
        z = z * (CANONICAL_FOCAL / focal)
        if augment:
            x = photometric(rng, x)
            if rng.uniform() < 0.5:
                x, z = x[:, ::-1], z[:, ::-1]
        return x.astype(np.float32) / 255, np.ascontiguousarray(z)

    def pair_sample(
        self, rng: np.random.Generator, pair: int, size: tuple[int, int], augment: bool = True
    ) -> tuple[Array, Array, NDArray[np.float64]]:
        """Return two images, h w 3 in [0, 1] in the order of time, and the canonical T_later_earlier, 4 4."""
        first = self.pairs[pair]
        images = [self.image(first), self.image(first + 1)]
        T = np.linalg.inv(self.T[first + 1]) @ self.T[first]
        if augment and rng.uniform() < 0.3:  # the car stands: the turn below is all there is to see
            images[1], T = images[0], np.eye(4)
        if augment and rng.uniform() < 0.8:  # turn the second camera: exact, since a turn has no parallax
            turned = np.deg2rad([rng.normal(0, 0.3), rng.normal(0, 1.5), rng.normal(0, 0.2)])
            R = cv2.Rodrigues(turned)[0]
            K = self.K[first].astype(float)
            H = K @ R @ np.linalg.inv(K)
            images[1] = cv2.warpPerspective(
                images[1], H, images[1].shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
            )
            T[:3] = R @ T[:3]
        window = crop_window(rng, images[0].shape[:2], size, augment, zoom=0.85)
        images = [crop(x, window, size, cv2.INTER_AREA) for x in images]
        if augment and rng.uniform() < 0.3:
            state = rng.integers(2**32)
            images = [photometric(np.random.default_rng(state), x, fresh=rng) for x in images]
        T[:3, 3] *= CANONICAL_FOCAL / (self.K[first][0, 0] / (window[3] - window[2]))
        if augment and rng.uniform() < 0.5:
            images = [x[:, ::-1] for x in images]
            mirror = np.diag([-1.0, 1, 1, 1])
            T = mirror @ T @ mirror
        if augment and rng.uniform() < 0.05:  # the same drive backward
            images, T = images[::-1], np.linalg.inv(T)
        return images[0].astype(np.float32) / 255, images[1].astype(np.float32) / 255, T


def in_the_open(depth: NDArray[np.float16]) -> bool:
    """Return whether a view is not blocked by something right before the camera; the sky counts as open."""
    return bool(((depth > 0) & (depth < 2.5)).mean() < 0.4)


def close_gaps(depth: Array, low: float = 7 / 160, high: float = 17 / 160) -> Array:
    """Return depth with the gaps in foliage and fences filled, as a laser or an eye takes a crown for one body.

    Far pixels within a gap between near ones get the near depth; near things keep their shape. Gaps may be ``low``
    image heights wide in the lower half of the picture and ``high`` in the upper half, where crowns are.
    """
    far = np.where(depth > 0, depth, np.float32(1e4))
    half = len(far) // 2
    parts = []
    for part, share in ((far[: half + half // 2], high), (far[half // 2 :], low)):
        side = max(3, round(share * len(far)) | 1)
        parts.append(cv2.morphologyEx(part, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))))
    filled = np.concatenate([parts[0][:half], parts[1][half - half // 2 :]])
    return np.where(filled < 9e3, filled, np.float32(0))


def crop_window(
    rng: np.random.Generator, shape: tuple[int, ...], size: tuple[int, int], augment: bool, zoom: float = 0.55
) -> tuple[float, float, float, float]:
    """Return top, bottom, left, right of a crop with about the aspect of ``size``."""
    height, width = shape[:2]
    aspect = size[1] / size[0] * (np.exp(rng.normal(0, 0.06)) if augment else 1.0)
    w = min(width, height * aspect) * (rng.uniform(zoom, 1.0) if augment and rng.uniform() < 0.7 else 1.0)
    h = min(height, w / aspect)
    top = rng.uniform(0, height - h) if augment else (height - h) / 2
    left = rng.uniform(0, width - w) if augment else (width - w) / 2
    return top, top + h, left, left + w


def crop(
    image: NDArray, window: tuple[float, float, float, float], size: tuple[int, int], interpolation: int
) -> NDArray:
    """Cut a window out of an image and resize it to (height, width)."""
    top, bottom, left, right = (round(x) for x in window)
    return cv2.resize(np.ascontiguousarray(image[top:bottom, left:right]), size[::-1], interpolation=interpolation)


def photometric(
    rng: np.random.Generator, image: NDArray[np.uint8], fresh: np.random.Generator | None = None
) -> NDArray[np.uint8]:
    """Change an 8-bit RGB image as cameras and weather do; ``fresh`` draws what differs between frames of a pair."""
    fresh = fresh or rng
    x = image.astype(np.float32) / 255
    if rng.uniform() < 0.3:  # haze or dirt: a smooth bright veil
        veil = cv2.resize(
            rng.uniform(0, 1, (2, 4)).astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_CUBIC
        )[..., None]
        x = x + rng.uniform(0, 0.25) * veil * (rng.uniform(0.3, 1.0) - x)
    if rng.uniform() < 0.8:
        x = x.clip(0, 1) ** np.exp(rng.normal(0, 0.3))
    if rng.uniform() < 0.8:
        x = (x - x.mean()) * np.exp(rng.normal(0.2, 0.3)) + x.mean() * np.exp(rng.normal(0, 0.2))
    gray = x @ rng.dirichlet((1, 1, 1))[:, None]  # a red filter darkens the sky, a green one lightens leaves
    if rng.uniform() < 0.35:
        x = np.repeat(gray, 3, 2)
    elif rng.uniform() < 0.7:
        x = gray + (x - gray) * rng.uniform(0.2, 1.5)
        x = x * rng.uniform(0.85, 1.15, 3)
        if rng.uniform() < 0.2:
            x = x @ (np.eye(3) + rng.normal(0, 0.12, (3, 3)))
    roll = rng.uniform()
    if roll < 0.25:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.4))
    elif roll < 0.7:
        x = x + rng.uniform(0.2, 1.5) * (x - cv2.GaussianBlur(x, (0, 0), rng.uniform(0.6, 1.5)))
    if rng.uniform() < 0.5:
        x = x + fresh.normal(0, rng.uniform(0, 0.04), (*x.shape[:2], 3 if rng.uniform() < 0.5 else 1))
    out = (x.clip(0, 1) * 255).astype(np.uint8)
    if rng.uniform() < 0.2:
        data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))])[1]
        out = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return out
